"""Machine code (numba): compiled once and for all, where there is a folder to keep it in.

Keep a function that is `inlined` in the file of those that call it: numba looks for changes only in the file of the
function whose code it has kept.
"""

from collections.abc import Callable
from inspect import unwrap
from typing import Any

from numba import njit


def compiled(**options: Any) -> Callable[[Callable], Any]:
    """numba's `njit` with `options`, without Python's lock, kept from process to process if that is possible.

    numba keeps code beside its source or else in the user's cache folder, and refuses where it can write to neither.
    """

    def decorate(function: Callable) -> Any:
        try:
            return _machine_code(function, cache=True, **options)
        except RuntimeError:
            return _machine_code(function, **options)

    return decorate


def inlined(**options: Any) -> Callable[[Callable], Any]:
    """numba's `njit` for a function that becomes part of those that call it."""
    return lambda function: _machine_code(function, inline="always", **options)


def _machine_code(function: Callable, **options: Any) -> Any:
    # checks of types may have been wrapped around the function, which numba cannot see through
    return njit(nogil=True, error_model="numpy", **options)(unwrap(function))
