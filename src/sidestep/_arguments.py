"""Arguments as arrays: lists, NumPy's and JAX's arrays, converted and checked where a public function takes them.

Each function returns an array or raises `InputError`. Arrays that fit are returned as they are, without a copy. Of
JAX's tracers (under `jit`, `grad` and `vmap`) only type and shape are checked. Nothing here compiles.
"""

from math import inf
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.dtypes import prng_key

from sidestep.errors import InputError, Limit, describe, limits

Shape = tuple[int | str, ...]
"""An expected shape: a number, or the name of a dimension of any size."""


def to_floats(value: object, field: str, *shapes: Shape) -> Any:
    """Return real numbers of one of some shapes as an array of floating-point numbers; NaN and infinite ones may be.

    Args:
        value: Numbers, or a (nested) list of them.
        field: The argument, for the error.
        *shapes: The shapes that fit, `()` for one number; without any, every shape does.

    Raises:
        InputError: For texts, booleans, complex numbers, lists of unequal lengths, and other shapes.

    Example:
        >>> to_floats([1, 2], "lengths", ("links",)).tolist()
        [1.0, 2.0]
    """
    array = _to_array(value, field, "numbers", shapes)
    if array.dtype.kind == "f" or jnp.issubdtype(array.dtype, np.floating):
        return array
    if not jnp.issubdtype(array.dtype, np.integer):
        raise InputError(f"expected numbers, found {_contents(value, array)}", field=field)
    return array.astype(float) if isinstance(array, Tracer) else np.asarray(array, np.float64)


def to_finite(
    value: object,
    field: str,
    *shapes: Shape,
    above: Limit = -inf,
    least: Limit = -inf,
    below: Limit = inf,
    most: Limit = inf,
) -> Any:
    """Return finite numbers in a range as an array, as `to_floats` does.

    Args:
        value: Numbers, or a (nested) list of them.
        field: The argument, for the error.
        *shapes: The shapes that fit.
        above, least, below, most: The limits of the numbers.

    Raises:
        InputError: As `to_floats` does, and for numbers that are not finite or lie outside the limits.
    """
    array = to_floats(value, field, *shapes)
    if isinstance(array, Tracer):
        return array
    numbers = np.asarray(array)
    valid: Any = np.isfinite(numbers)
    if above > -inf or below < inf:
        valid = valid & (numbers > above) & (numbers < below)
    if least > -inf or most < inf:
        valid = valid & (numbers >= least) & (numbers <= most)
    if not valid.all():
        what = "finite numbers" if numbers.ndim else "a finite number"
        raise InputError(
            f"expected {what}{limits(above=above, least=least, below=below, most=most)}, "
            f"found {_first(numbers, valid)}",
            field=field,
        )
    return array


def to_logits(value: object, count: int, field: str = "logits") -> Any:
    """Return logits as an array: one number for all, or one for each; infinite ones may be.

    Args:
        value: A number, or a list of numbers.
        count: The number of logits.
        field: The argument, for the error.

    Raises:
        InputError: As `to_floats` does, and for NaN.
    """
    array = to_floats(value, field, (), (count,))
    if not isinstance(array, Tracer):
        valid = ~np.isnan(np.asarray(array))
        if not valid.all():
            raise InputError(f"expected numbers, found {_first(np.asarray(array), valid)}", field=field)
    return array


def to_integers(
    value: object,
    field: str,
    *shapes: Shape,
    least: int | None = None,
    most: int | None = None,
    what: str = "whole numbers",
) -> Any:
    """Return whole numbers of one of some shapes as an array of integers.

    Args:
        value: Integers, or a (nested) list of them.
        field: The argument, for the error.
        *shapes: The shapes that fit.
        least, most: The limits of the numbers.
        what: The name of such numbers, for the error.

    Raises:
        InputError: For floating-point numbers (whole ones too), booleans, other shapes, and numbers beyond the limits.

    Example:
        >>> to_integers([0, 2], "starts", ("starts",), least=0, most=2).tolist()
        [0, 2]
    """
    array = _to_array(value, field, what, shapes)
    if array.dtype.kind not in "iu":
        if array.size or hasattr(value, "dtype"):
            raise InputError(f"expected {what}, found {_contents(value, array)}", field=field)
        array = array.astype(np.int64)  # of an empty list
    if isinstance(array, Tracer):
        return array
    numbers = np.asarray(array)
    lower = -inf if least is None else least
    upper = inf if most is None else most
    if numbers.size and (numbers.min() < lower or numbers.max() > upper):
        valid = (numbers >= lower) & (numbers <= upper)
        span = f" in {least}…{most}" if None not in (least, most) else f", at least {least}"
        span = f", at most {most}" if least is None else span
        raise InputError(f"expected {what}{span}, found {_first(numbers, valid)}", field=field)
    return numbers


def to_states(value: object, states: int, field: str, *shapes: Shape) -> Any:
    """Return states of a world as an array of 64-bit integers.

    Args:
        value: States, or a list of them.
        states: The number of states of the world.
        field: The argument, for the error.
        *shapes: The shapes that fit; by default one dimension.

    Raises:
        InputError: As `to_integers` does.
    """
    numbers = to_integers(value, field, *(shapes or (("states",),)), least=0, most=states - 1, what="states")
    return numbers if isinstance(numbers, Tracer) else numbers.astype(np.int64, copy=False)


def to_indices(value: object, count: int, field: str, what: str) -> Any:
    """Return the indices of rows that a mask or a list of indices selects, from 0 to `count` − 1.

    Args:
        value: A boolean for each row, or indices, of which negative ones count from the end.
        count: The number of rows.
        field: The argument, for the error.
        what: The name of the rows, for the error.

    Raises:
        InputError: As `to_mask` and `to_integers` do.

    Example:
        >>> to_indices([True, False], 2, "index", "walks").tolist(), to_indices([-1], 2, "index", "walks").tolist()
        ([0], [1])
    """
    array = np.asarray(_to_array(value, field, f"indices of {what}, or a mask,", (("selected",),)))
    if array.dtype == bool:
        return np.flatnonzero(to_mask(array, field, (count,)))
    indices = to_integers(value, field, ("selected",), least=-count, most=count - 1, what=f"indices of {what}")
    return np.where(indices < 0, indices + count, indices)


def to_mask(value: object, field: str, *shapes: Shape) -> Any:
    """Return booleans of one of some shapes as an array.

    Args:
        value: Booleans, or a (nested) list of them.
        field: The argument, for the error.
        *shapes: The shapes that fit.

    Raises:
        InputError: For numbers (0 and 1 too), and other shapes.
    """
    array = _to_array(value, field, "booleans", shapes)
    if array.dtype == bool:
        return array
    if array.size or hasattr(value, "dtype"):
        raise InputError(f"expected booleans, found {_contents(value, array)}", field=field)
    return np.asarray(array, bool)  # of an empty list


def to_key(value: object, field: str = "key") -> jax.Array:
    """Return a random key of JAX: one of `jax.random.key`, or the two words of `jax.random.PRNGKey`.

    Args:
        value: The key.
        field: The argument, for the error.

    Raises:
        InputError: For anything else, such as a seed.
    """
    if isinstance(value, jax.Array):
        is_typed = jnp.issubdtype(value.dtype, prng_key)
        if value.shape == () if is_typed else value.dtype == np.uint32 and value.shape == (2,):
            return value
    raise InputError(f"expected a random key such as jax.random.key(0), found {describe(value)}", field=field)


def _to_array(value: object, field: str, what: str, shapes: tuple[Shape, ...]) -> Any:
    """Return an array of any type; raise `InputError` for other shapes, and for what is not an array."""
    array: Any = value
    if not isinstance(value, jax.Array | np.ndarray):
        try:
            array = np.asarray(value)
        except (TypeError, ValueError) as error:
            raise InputError(f"expected {what}, found {describe(value)} ({error})", field=field) from error
    if shapes and array.shape not in shapes and not any(_fits(array.shape, shape) for shape in shapes):
        expected = " or ".join(_words(shape) for shape in shapes)
        actual = _contents(value, array) if array.dtype.kind in "OUS" or not array.ndim else f"shape {array.shape}"
        raise InputError(f"expected {what} of shape {expected}, found {actual}", field=field)
    return array


def _fits(shape: tuple[int, ...], expected: Shape) -> bool:
    pairs = zip(shape, expected, strict=False)
    return len(shape) == len(expected) and all(isinstance(want, str) or want == size for size, want in pairs)


def _words(shape: Shape) -> str:
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"


def _contents(value: object, array: Any) -> str:
    """Return what an array with numbers of another type holds, for a message."""
    return describe(value if array.dtype.kind in "OUS" or array.ndim == 0 else array)


def _first(numbers: np.ndarray, valid: np.ndarray | np.bool) -> str:
    """Return the first number that is not valid and its place."""
    if not numbers.ndim:
        return str(numbers)
    place = tuple(int(axis) for axis in np.unravel_index(int(np.argmin(valid)), valid.shape))
    return f"{numbers[place]} at {place[0] if len(place) == 1 else place}"
