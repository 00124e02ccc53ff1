"""Compiled programs that are kept from process to process.

JAX keeps compiled code (`_cache.keep_compiled_code`), but a new process has to trace a function in Python and lower it
before it can look its code up. For a fit of a small map that takes longer than the fit. `keep_program` stores the whole
executable (`jax.experimental.serialize_executable`); `python -m benchmarks startup` shows the time of whole processes.

An entry belongs to the files of this package, to the versions of JAX and of the other traced libraries, to the kind of
processor, and to the types of all arguments. A function that calls back into Python cannot be stored; where there are
several devices, or for arguments of classes from elsewhere, no program is. An entry that is damaged, or that XLA
refuses, is replaced.
"""

import hashlib
import os
import pickle
import platform
from collections.abc import Callable
from contextlib import suppress
from functools import cache, wraps
from importlib.util import find_spec
from pathlib import Path
from threading import Lock, Thread
from typing import Any, TypeVar, cast

from sidestep import _cache

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Program = tuple[Callable[..., Any], Any]
"""A function of arrays that returns a tuple of arrays, and the structure of the result."""
_TRACED_LIBRARIES = ("jax", "jaxlib", "equinox", "optax", "numpy")
_OWNERS = {"builtins", "sidestep", *_TRACED_LIBRARIES}
"""Programs are kept only for arguments of these packages' classes: no key tells whether the code of others changed."""
_compiling = Lock()
"""Held while a setting of JAX is another one."""


def keep_program(function: _Function) -> _Function:
    """Compile a function as `eqx.filter_jit` does, and keep the program where compiled code is kept.

    The function takes positional arguments only.
    """
    import equinox as eqx

    compiled = eqx.filter_jit(function)
    programs: dict[Any, _Program] = {}

    @wraps(function)
    def run(*arguments: Any) -> Any:
        import jax
        import numpy as np
        from jax.core import Tracer

        folder = _cache.kept_in()
        leaves, structure = jax.tree.flatten(arguments)
        arrays = [leaf for leaf in leaves if isinstance(leaf, jax.Array | np.ndarray)]
        if folder is None or jax.device_count() > 1 or any(isinstance(array, Tracer) for array in arrays):
            return compiled(*arguments)
        others = tuple(... if isinstance(leaf, jax.Array | np.ndarray) else leaf for leaf in leaves)
        key = structure, others, *((a.shape, a.dtype, bool(getattr(a, "weak_type", False))) for a in arrays)
        if key not in programs:
            text = f"{_package()} {function.__module__}.{function.__qualname__} {key}"
            known = all(kind.__module__.partition(".")[0] in _OWNERS for kind in _kinds(structure))
            if not known or " at 0x" in text:  # an address is another one in every process
                return compiled(*arguments)
            path = folder / "programs" / f"{function.__qualname__}-{hashlib.sha256(text.encode()).hexdigest()}"
            programs[key] = _load(path) or _compile(path, function, arrays, structure, others)
        call, result = programs[key]
        return jax.tree.unflatten(result, call(*arrays))

    return cast(_Function, run)


def _kinds(structure: Any) -> set[type]:
    """Return the classes of all nodes of a tree."""
    node = structure.node_data()
    return set().union([node[0]] if node else [], *map(_kinds, structure.children()))


def _load(path: Path) -> _Program | None:
    """Return the program of an entry; None if it is missing, damaged or refused by XLA."""
    content = _cache.kept_entry(path)
    if content is None:
        return None
    import jax
    from jax.errors import JaxRuntimeError
    from jax.experimental.serialize_executable import deserialize_and_load

    try:
        program, skeleton, calls_lapack = pickle.loads(content)
        if calls_lapack:
            _register_lapack()
        return deserialize_and_load(*program), jax.tree.structure(skeleton)
    except (JaxRuntimeError, ValueError, AttributeError, ImportError, pickle.UnpicklingError):
        return None


def _compile(path: Path, function: Callable[..., Any], arrays: list[Any], structure: Any, others: Any) -> _Program:
    """Compile a function, and start to store the program; `...` in the place of an array in `others`."""
    import jax

    result = None

    def program_of_sidestep(*arrays: Any) -> tuple[Any, ...]:
        nonlocal result
        remaining = iter(arrays)
        leaves = [next(remaining) if other is ... else other for other in others]
        outputs, result = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
        return tuple(outputs)

    # an executable that comes from JAX's own cache cannot be stored again; so JAX must not keep this one
    setting = "jax_persistent_cache_min_compile_time_secs"
    with _compiling:
        written_after = getattr(jax.config, setting)
        jax.config.update(setting, float("inf"))
        try:
            program = jax.jit(program_of_sidestep).lower(*arrays).compile()
        finally:
            jax.config.update(setting, written_after)
    assert result is not None
    # beside the first run of the program; a process waits for its threads before it ends
    Thread(target=_keep, args=(path, program, jax.tree.unflatten(result, range(result.num_leaves)))).start()
    return program, result


def _keep(path: Path, program: Any, skeleton: Any) -> None:
    """Store a program if it does not call back into Python."""
    from jax.errors import JaxRuntimeError
    from jax.experimental.serialize_executable import serialize

    with suppress(AttributeError, JaxRuntimeError, NotImplementedError, TypeError, ValueError, pickle.PicklingError):
        calls_lapack = "lapack_" in program.as_text()
        _cache.keep_entry(path, pickle.dumps((serialize(program), skeleton, calls_lapack)))


@cache
def _register_lapack() -> None:
    """Register LAPACK's functions in this process.

    JAX does so when it lowers the first of them. A program that is loaded before would call a null pointer.
    """
    import jax
    from jax.scipy.linalg import lu_factor

    jax.jit(lu_factor).lower(jax.ShapeDtypeStruct((1, 1), "float32"))


@cache
def _package() -> str:
    """Return a text of the settings, files, processor and devices for which programs are compiled.

    The first file of a library stands for its version, which takes longer to read.
    """
    import jax

    files = sorted(Path(__file__).parent.rglob("*.py"))
    specs = [find_spec(name) for name in _TRACED_LIBRARIES]
    files += [Path(spec.origin) for spec in specs if spec is not None and spec.origin is not None]
    stats = [(str(file), stat.st_size, stat.st_mtime_ns) for file in files for stat in [file.stat()]]
    variables = sorted(item for item in os.environ.items() if item[0].startswith(("JAX_", "XLA_")))
    settings = jax.config.read("jax_enable_x64"), jax.default_backend(), jax.device_count(), variables
    return f"{settings} {hashlib.sha256(f'{stats} {_processor()}'.encode()).hexdigest()}"


def _processor() -> str:
    """Return the kind of processor, and its instructions where the system lists them."""
    with suppress(OSError), open("/proc/cpuinfo") as lines:
        return next((line for line in lines if line.lower().startswith(("flags", "features"))), platform.platform())
    return platform.platform()
