"""Native code on the CPU: NumPy functions called from compiled JAX code, and functions compiled by numba.

- `call_host` calls a NumPy function from JAX, the tasks of a batch in parallel; `map_ranges` and `run_parallel` use the
  cores where there is one task only.
- `compiled` and `inlined` mark functions for numba. numba is imported when one is first called, and the machine code is
  kept in `cache_folder()`.
- `NativeEquation` is an equation as the host sees it. Records of `base` with NumPy arrays stand for results and
  gradients: the host writes into these.
"""

import ctypes
import hashlib
import os
import pickle
import platform
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from functools import cache, partial
from inspect import unwrap
from itertools import pairwise
from pathlib import Path
from types import CellType, FunctionType
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from jaxtyping import Array, Bool, Float, Int

from sidestep._cache import cache_folder, keep_entry, kept_entry
from sidestep.tabular.solvers.base import SolveResult

_Result = TypeVar("_Result")

HARD_MAX, BOLTZMANN, LOG_SUM_EXP, MELLOWMAX = range(4)
"""The backups that have native code, by number."""

_MIN_STATES_PER_CORE = 2**14
"""The number of states above which a further core pays."""
_MIN_BYTES_TO_TRIM = 2**22
"""The size of the results from which on free memory is given back to the system."""


# Arguments and results of host functions


class HostProcess(NamedTuple):
    """A task under a model; fields as in `DecisionProcess`, in its order but for the discount, which is a number."""

    successors: Int[np.ndarray, "states actions outcomes"]
    probabilities: Float[np.ndarray, "states actions outcomes"]
    reward: Float[np.ndarray, "#states #actions"]
    terminal_reward: Float[np.ndarray, "#states"]
    terminal: Bool[np.ndarray, " states"]
    available: Bool[np.ndarray, "#states #actions"]
    discount: np.floating

    def kernel_sizes(self) -> tuple[int, int, int]:
        """Return the numbers of actions and outcomes, and the most outcomes of an action that leave its state."""
        states, actions, outcomes = self.successors.shape
        most = map_ranges(lambda begin, end: _most_leaving_outcomes(begin, end, self.successors), states)
        return actions, outcomes, max(most)


class NativeBackup(NamedTuple):
    """A backup as native code knows it.

    Attributes:
        kind: Its number.
        beta: The inverse temperature β.
        tie: The part of the best value within which actions tie (hard max only).
    """

    kind: int
    beta: np.floating
    tie: np.floating


class NativeEquation(NamedTuple):
    """A Bellman equation, and the relative change at which to stop when it is solved; numbers are of one type."""

    process: HostProcess
    backup: NativeBackup
    tolerance: np.floating


class SolveInfo(NamedTuple):
    """How a solve went; fields as in `SolveResult`."""

    sweeps: int
    residual: float
    error: float
    converged: bool


def write_info(result: SolveResult, order: Int[Array | np.ndarray, " states"], info: SolveInfo) -> None:
    """Write all but the values into the arrays of a result."""
    for into, part in zip(result[1:], (order, *info), strict=True):
        into[...] = part


def inverse_permutation(order: Int[np.ndarray, " states"]) -> Int[np.ndarray, " states"] | None:
    """Return the position of each state in an order; None if it is not a permutation of all states."""
    if order.min() < 0 or order.max() >= len(order):
        return None
    position = np.full(len(order), -1, np.int32)
    position[order] = np.arange(len(order), dtype=np.int32)
    return None if position.min() < 0 else position


# Calls from JAX


def call_host(function: Callable[..., None], arguments: tuple[Any, ...], shapes: Any) -> Any:
    """Return the arrays that a NumPy function fills in, called from JAX without a copy.

    Args:
        function: Called with writable arrays of the structure and shapes of `shapes`, then with `arguments` as
            read-only arrays and NumPy numbers; under `vmap` once for each task, on all cores. What it raises reaches
            the user only as an error of JAX's.
        arguments: A tree of arrays, and of other things that are passed as they are.
        shapes: A tree of `jax.ShapeDtypeStruct`.
    """
    arrays, others = eqx.partition(arguments, eqx.is_array)
    argument_leaves, argument_structure = jax.tree.flatten(arrays)
    result_leaves, result_structure = jax.tree.flatten(shapes)
    argument_axes = [jnp.ndim(leaf) for leaf in argument_leaves]
    result_axes = [len(leaf.shape) for leaf in result_leaves]

    def call_all(_: Any, results: Sequence[Any], *arguments: Any) -> None:
        into = [np.asarray(result) for result in results]
        batch = into[0].shape[: into[0].ndim - result_axes[0]]
        # read-only views with all of the batch's axes: numba compiles once for each kind of array
        arrays = [
            np.broadcast_to(array, batch + array.shape[array.ndim - axes :])
            for array, axes in zip(map(np.asarray, arguments), argument_axes, strict=True)
        ]

        def call_one(task: tuple[int, ...]) -> None:
            # the ellipsis keeps numbers arrays that can be written into
            result = jax.tree.unflatten(result_structure, [array[*task, ...] for array in into])
            inputs = jax.tree.unflatten(argument_structure, [array[task] for array in arrays])
            function(result, *eqx.combine(inputs, others))

        run_batch(call_one, list(np.ndindex(batch)))
        if sum(result.nbytes for result in into) >= _MIN_BYTES_TO_TRIM:
            _memory_trimmer()(0)

    results = buffer_callback(call_all, result_leaves, vmap_method="expand_dims")(*argument_leaves)
    return jax.tree.unflatten(result_structure, results)


def shapes_of(arrays: Any) -> Any:
    """Return the shapes and dtypes of a tree of arrays."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype), arrays)


def run_batch(call_one: Callable[[tuple[int, ...]], None], tasks: Sequence[tuple[int, ...]]) -> None:
    """Call a function for each task of a batch, in parallel; a single task may use all cores itself."""
    if len(tasks) == 1:
        call_one(tasks[0])
        return
    stop = threading.Event()

    def work(task: tuple[int, ...]) -> None:
        _thread_state.stop = stop
        call_one(task)

    _run_in_pool([partial(work, task) for task in tasks], stop.set)


@cache
def _memory_trimmer() -> Callable[[int], object]:
    """Return the function that gives free memory back to the system; it does nothing unless the C library is glibc.

    glibc keeps it for each thread, and JAX calls from any thread, so that each would keep what the largest solve took.
    """
    library = ctypes.CDLL(None) if os.name == "posix" else None
    return getattr(library, "malloc_trim", lambda _: None)


# Cores


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_ranges(work: Callable[[int, int], _Result], count: int) -> list[_Result]:
    """Return `work(begin, end)` of ranges that cover 0…count; in parallel if this is the only task."""
    parts = max(1, min(cores(), count // _MIN_STATES_PER_CORE)) if _is_only_task() else 1
    ends = [count * part // parts for part in range(parts + 1)]
    return run_parallel([partial(work, begin, end) for begin, end in pairwise(ends)])


def run_parallel(works: Sequence[Callable[[], _Result]]) -> list[_Result]:
    """Return the results of several functions; in parallel if this is the only task."""
    if len(works) == 1 or not _is_only_task():
        return [work() for work in works]
    return _run_in_pool(works)


def check_interrupt() -> None:
    """Raise `KeyboardInterrupt` if another task of the batch has failed or been interrupted; call it often."""
    stop = getattr(_thread_state, "stop", None)
    if stop is not None and stop.is_set():
        raise KeyboardInterrupt


def _run_in_pool(works: Sequence[Callable[[], _Result]], stop: Callable[[], None] = lambda: None) -> list[_Result]:
    """Return the results, or raise the first error once `stop` was called and no work is left running.

    A work left running would write into memory that JAX takes back.
    """
    running = [_pool().submit(work) for work in works]
    try:
        return [each.result() for each in running]
    except BaseException:
        stop()
        for each in running:
            each.cancel()
        wait(running)
        raise


def _is_only_task() -> bool:
    return getattr(_thread_state, "stop", None) is None


_thread_state = threading.local()
"""Of a thread that solves one task of a batch: `stop`, the event by which the batch ends early."""


@cache
def _pool() -> ThreadPoolExecutor:
    """Return a pool of one thread a core; native code does not hold Python's lock."""
    return ThreadPoolExecutor(cores(), thread_name_prefix="sidestep-sweeps")


# numba


class NativeFunction:
    """A function that numba compiles when it is first called, from Python or from another one."""

    def __init__(self, function: Callable, options: dict[str, Any]):
        # type checks may have been wrapped around the function, which numba cannot see through
        self._function, self._options = unwrap(function), options
        self._dispatcher: Any = None

    def __call__(self, *arguments: Any) -> Any:
        """Call the machine code, compiled or read from the cache if it is not there yet."""
        return (self._dispatcher or self.dispatcher())(*arguments)

    def dispatcher(self) -> Any:
        """Return numba's dispatcher of the function."""
        with _making_dispatchers:
            if self._dispatcher is None:
                from numba import njit

                function = _with_dispatchers(self._function)
                # nothing calls functions by their address, as C code does
                options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True} | self._options
                self._dispatcher = njit(**options)(function)
                folder = _code_folder() if self._options.get("inline") is None else None
                if folder is not None:
                    self._dispatcher._cache = _CodeCache(function, folder)
            return self._dispatcher

    def as_part(self) -> "NativePart":
        """Return an inlined function as one that is compiled by itself and then becomes part of those that call it."""
        options = {name: option for name, option in self._options.items() if name != "inline"}
        return part(**options, forceinline=True)(self._function)


class NativePart(NativeFunction):
    """A function that only native code calls; without what Python calls it by, it compiles sooner."""

    def __call__(self, *arguments: Any) -> Any:
        """Refuse the call, for which there is no code."""
        raise TypeError(f"{self._function.__qualname__} can be called by native code only")


def compiled(**options: Any) -> Callable[[Callable], NativeFunction]:
    """Return a decorator: numba's `njit` with `options`, without Python's lock, kept from process to process."""
    return lambda function: NativeFunction(function, options)


def part(**options: Any) -> Callable[[Callable], NativePart]:
    """Return a decorator: as `compiled`, for a function that only native code calls.

    numba inlines what is `inlined` before it knows types, and so infers and lowers it again in each place; a part it
    does once. Which is faster when it runs depends on the references to arrays that numba counts: measure.
    """
    return lambda function: NativePart(function, {"no_cpython_wrapper": True} | options)


def inlined(**options: Any) -> Callable[[Callable], NativeFunction]:
    """Return a decorator: numba's `njit` for a function that becomes part of those that call it."""
    return lambda function: NativeFunction(function, {"inline": "always"} | options)


_making_dispatchers = threading.RLock()


def _with_dispatchers(function: FunctionType) -> FunctionType:
    """Return a function with the dispatchers of the native functions that it calls, as numba has to see them."""
    used = {name: function.__globals__.get(name) for name in function.__code__.co_names}
    called = {name: each.dispatcher() for name, each in used.items() if isinstance(each, NativeFunction)}
    values = [cell.cell_contents for cell in function.__closure__ or ()]
    cells = [CellType(each.dispatcher() if isinstance(each, NativeFunction) else each) for each in values]
    names = function.__globals__ | called
    copy = FunctionType(function.__code__, names, function.__name__, function.__defaults__, tuple(cells))
    copy.__qualname__ = function.__qualname__
    return copy


def _code_folder() -> Path | None:
    folder, chosen = cache_folder(), os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen) if folder and chosen else folder and folder / "numba"


class _CodeCache:
    """Machine code kept in files, one for each function, signature and machine (numba's `_Cache` interface).

    Differs from numba's own, which keeps an index for each function: (1) several processes may write at once, (2) each
    file has a checksum, and a damaged one is compiled anew, (3) code is stale when any module beside the function, or
    beside one that it calls, has changed, (4) where nothing can be written, nothing is.
    """

    def __init__(self, function: FunctionType, folder: Path):
        self.cache_path, self._function = str(folder), function

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the machine code for a signature, None if it is not kept."""
        target.refresh()
        with suppress(OSError):
            content = kept_entry(self._path(signature, target.codegen()))
            if content is not None:
                from numba.core.compiler import CompileResult

                return CompileResult._rebuild(target, *pickle.loads(content))
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the machine code for a signature, if the folder can be written."""
        from numba.core.serialize import dumps

        with suppress(OSError):
            keep_entry(self._path(signature, result.codegen), dumps(result._reduce()))

    def _path(self, signature: Any, code_generator: Any) -> Path:
        import numba

        function = self._function
        versions = (numba.__version__, np.__version__, platform.python_version(), code_generator.magic_tuple())
        key = ([_sources(folder) for folder in sorted(_folders(function))], _code_of(function), signature)
        digest = hashlib.sha256(repr((key, versions)).encode()).hexdigest()
        return Path(self.cache_path) / f"{function.__qualname__.split('.')[-1]}-{digest[:32]}.code"


def _code_of(function: FunctionType) -> tuple[Any, ...]:
    """Return the code of a function and the values that it closes over."""
    values = [cell.cell_contents for cell in function.__closure__ or ()]
    return function.__code__.co_code, [_code_of(each.py_func) if hasattr(each, "py_func") else each for each in values]


def _folders(function: FunctionType) -> set[Path]:
    """Return the folders of a function and of the native functions that it calls: their code is part of its own."""
    values = [cell.cell_contents for cell in function.__closure__ or ()]
    used = [*(function.__globals__.get(name) for name in function.__code__.co_names), *values]
    called = [_folders(each.py_func) for each in used if hasattr(each, "py_func")]
    return {Path(function.__code__.co_filename).parent}.union(*called)


@cache
def _sources(folder: Path) -> str:
    """Return a digest of the modules of a folder; `OSError` where they are not files."""
    contents = b"".join(path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix == ".py")
    return hashlib.sha256(contents).hexdigest()


@compiled()
def _most_leaving_outcomes(begin, end, successors):  # pragma: no cover
    most = 1
    for state in range(begin, end):
        for a in range(successors.shape[1]):
            count = 0
            for k in range(successors.shape[2]):
                count += successors[state, a, k] != state
            most = max(most, count)
    return most
