"""The bridge from JAX to the host: NumPy code called from compiled JAX code, the tasks of a batch side by side."""

import ctypes
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, partial
from itertools import pairwise
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

_Result = TypeVar("_Result")


def on_the_host(solve: Callable[..., None], given: tuple, shapes: Any) -> Any:
    """What `solve` writes into NumPy arrays of the structure and shapes of `shapes`.

    It is called with these arrays and then with what is `given`, as arrays that it must not write into; under `vmap`
    once for every task, on all cores. Nothing is copied on the way. What it raises reaches the user only as an error of
    JAX's, so it should raise nothing that users can do something about.
    """
    given_leaves, given_structure = jax.tree.flatten(given)
    result_leaves, result_structure = jax.tree.flatten(shapes)
    given_axes = [jnp.ndim(leaf) for leaf in given_leaves]
    result_axes = [len(leaf.shape) for leaf in result_leaves]

    def solve_all(_: Any, results: Sequence[Any], *given: Any) -> None:
        into = [np.asarray(result) for result in results]
        batch = into[0].shape[: into[0].ndim - result_axes[0]]
        arrays = [_for_every_task(np.asarray(leaf), batch, own) for leaf, own in zip(given, given_axes, strict=True)]

        def solve_one(task: tuple[int, ...]) -> None:
            # the ellipsis keeps numbers arrays that can be written into
            result = jax.tree.unflatten(result_structure, [array[*task, ...] for array in into])
            solve(result, *jax.tree.unflatten(given_structure, [array[*task, ...] for array in arrays]))

        _side_by_side(solve_one, list(np.ndindex(batch)))
        if sum(result.nbytes for result in into) >= _WORTH_GIVING_BACK:
            _give_back()

    found = buffer_callback(solve_all, result_leaves, vmap_method="expand_dims")(*given_leaves)
    return jax.tree.unflatten(result_structure, found)


def shapes_of(arrays: Any) -> Any:
    """Arrays as their shapes."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype), arrays)


def _for_every_task(array: np.ndarray, batch: tuple[int, ...], own: int) -> np.ndarray:
    """A view with all of the batch's axes before the array's own, read-only: numba compiles once for each kind."""
    return np.broadcast_to(array, batch + array.shape[array.ndim - own :])


def _side_by_side(solve_one: Callable[[tuple[int, ...]], None], tasks: Sequence[tuple[int, ...]]) -> None:
    """Solves all tasks, or raises what one of them raised; then none is still at work in memory that JAX takes back."""
    if len(tasks) == 1:
        solve_one(tasks[0])
        return
    stop = threading.Event()

    def work(task: tuple[int, ...]) -> None:
        _here.stop = stop
        solve_one(task)

    _results_of([partial(work, task) for task in tasks], stop.set)


def _results_of(works: Sequence[Callable[[], _Result]], stop: Callable[[], None] = lambda: None) -> list[_Result]:
    """What pieces of work return, on all cores, or what one of them raised; then `stop` is called, and none goes on."""
    running = [_threads().submit(work) for work in works]
    try:
        return [each.result() for each in running]
    except BaseException:
        stop()
        for each in running:
            each.cancel()
        wait(running)
        raise


_here = threading.local()
"""What the tasks of a batch have in common, as each of their threads sees it."""


def heed_interrupts() -> None:
    """Raises `KeyboardInterrupt` if another task of the same batch has failed or been interrupted; call it often."""
    stop = getattr(_here, "stop", None)
    if stop is not None and stop.is_set():
        raise KeyboardInterrupt


_WORTH_SHARING = 2**14
"""How many states a core should have to do with, for sharing them out to pay."""


def shared_out(work: Callable[[int, int], _Result], count: int) -> list[_Result]:
    """What `work(begin, end)` returns for ranges that cover 0…count; side by side if this is the only task."""
    parts = max(1, min(cores(), count // _WORTH_SHARING)) if _only_task() else 1
    ends = [count * part // parts for part in range(parts + 1)]
    return at_once([partial(work, begin, end) for begin, end in pairwise(ends)])


def at_once(works: Sequence[Callable[[], _Result]]) -> list[_Result]:
    """What some pieces of work return; side by side if this is the only task."""
    if len(works) == 1 or not _only_task():
        return [work() for work in works]
    return _results_of(works)


def _only_task() -> bool:
    return getattr(_here, "stop", None) is None


_WORTH_GIVING_BACK = 2**22
"""How many bytes of results a call should have for what it held besides to be given back."""


def _give_back() -> None:
    """Gives free memory back to the system, where the C library keeps it until it is told otherwise (glibc's does).

    It keeps it for each thread apart, and JAX calls from whichever thread it likes, so that every one of them would
    come to keep what the largest solve needed.
    """
    trim = getattr(_c_library(), "malloc_trim", None)
    if trim is not None:
        trim(0)


@cache
def _c_library() -> ctypes.CDLL | None:
    """The C library that this process runs with; None where there is no asking for it."""
    return ctypes.CDLL(None) if os.name == "posix" else None


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _threads() -> ThreadPoolExecutor:
    """One thread a core; machine code does not hold Python's lock."""
    return ThreadPoolExecutor(cores(), thread_name_prefix="sidestep-sweeps")
