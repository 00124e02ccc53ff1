"""Compiled functions with traced programs that are kept from process to process.

JAX keeps compiled code (`_cache.keep_compiled_code`), but a new process has to trace a function in Python before it can
look its code up. For a fit of a small map the trace takes longer than the fit. `keep_trace` stores the traced program
(`jax.export`); `python -m benchmarks startup` shows the time of whole processes.

An entry belongs to the files of this package, to the versions of JAX and of the other traced libraries, and to the
types of all arguments. A function that calls back into Python cannot be stored; it is traced anew. A damaged entry is
replaced.
"""

import hashlib
import pickle
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from typing import Any, TypeVar, cast

from sidestep import _cache
from sidestep._files import read_whole, write_whole
from sidestep.errors import InputError

_Function = TypeVar("_Function", bound=Callable[..., Any])
_TRACED_LIBRARIES = ("jax", "equinox", "optax", "numpy")
_DIGEST = 32
"""The bytes of a SHA-256 digest, which an entry begins with."""


def keep_trace(function: _Function) -> _Function:
    """Compile a function as `eqx.filter_jit` does, and keep its trace where compiled code is kept.

    The function takes positional arguments only.
    """
    import equinox as eqx

    compiled = eqx.filter_jit(function)
    loaded: dict[str, Any] = {}

    @wraps(function)
    def run(*arguments: Any) -> Any:
        folder = _cache.kept_in()
        if folder is None:
            return compiled(*arguments)
        import jax
        import numpy as np
        from jax.core import Tracer

        dynamic, static = eqx.partition(arguments, lambda leaf: eqx.is_array(leaf) or isinstance(leaf, np.ndarray))
        leaves, structure = jax.tree.flatten(dynamic)
        others = f"{structure} {jax.tree.flatten(static)}"
        if any(isinstance(leaf, Tracer) for leaf in leaves) or " at 0x" in others:
            return compiled(*arguments)
        types = [(leaf.shape, str(leaf.dtype), bool(getattr(leaf, "weak_type", False))) for leaf in leaves]
        key = hashlib.sha256(f"{_package()} {function.__qualname__} {others} {types}".encode()).hexdigest()
        if key not in loaded:
            path = folder / "traces" / f"{function.__qualname__}-{key}"
            loaded[key] = _load(path) or _trace(path, function, leaves, structure, static)
        if loaded[key] == _NOT_STORABLE:
            return compiled(*arguments)
        call, result = loaded[key]
        return jax.tree.unflatten(result, call(*leaves))

    return cast(_Function, run)


_NOT_STORABLE = "not storable"


def _load(path: Path) -> Any:
    """Return an entry as a function of arrays and the structure of its result; None if it is missing or damaged."""
    if not path.exists():
        return None
    import jax
    from jax import export

    try:
        content = read_whole(path)
        if hashlib.sha256(content[_DIGEST:]).digest() != content[:_DIGEST]:
            return None
        entry = pickle.loads(content[_DIGEST:])
        if entry == _NOT_STORABLE:
            return entry
        program, skeleton = entry
        return jax.jit(export.deserialize(program).call), jax.tree.structure(skeleton)
    except (InputError, ValueError, AttributeError, ImportError, pickle.UnpicklingError):
        return None


def _trace(path: Path, function: Callable[..., Any], leaves: list[Any], structure: Any, static: Any) -> Any:
    """Trace a function, store the trace, and return it as `_load` does."""
    import equinox as eqx
    import jax
    from jax import export

    result = None

    def flat(*leaves: Any) -> tuple[Any, ...]:
        nonlocal result
        outputs, result = jax.tree.flatten(function(*eqx.combine(jax.tree.unflatten(structure, leaves), static)))
        return tuple(outputs)

    try:
        program = export.export(jax.jit(flat))(*leaves).serialize()
        assert result is not None
        skeleton = jax.tree.unflatten(result, range(result.num_leaves))
        _store(path, (bytes(program), skeleton))
        return jax.jit(export.deserialize(program).call), result
    except (NotImplementedError, ValueError):
        _store(path, _NOT_STORABLE)
        return _NOT_STORABLE


def _store(path: Path, entry: Any) -> None:
    """Write an entry; a folder that cannot be written is no reason to stop."""
    content = pickle.dumps(entry)
    try:
        write_whole(path, lambda file: file.write(hashlib.sha256(content).digest() + content))
    except InputError:
        return


@cache
def _package() -> str:
    """Return what every entry belongs to: versions of libraries, settings of JAX, and the files of this package."""
    from importlib import metadata

    import jax

    files = sorted(Path(__file__).parent.rglob("*.py"))
    stats = [(str(file), stat.st_size, stat.st_mtime_ns) for file in files for stat in [file.stat()]]
    settings = jax.config.read("jax_enable_x64"), jax.default_backend(), jax.device_count()
    versions = [metadata.version(name) for name in _TRACED_LIBRARIES]
    return f"{versions} {settings} {hashlib.sha256(str(stats).encode()).hexdigest()}"
