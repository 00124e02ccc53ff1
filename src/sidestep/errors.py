"""Errors of `sidestep`: each names the place, the expectation and the actual value; and its kind of warnings."""

import reprlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import inf, isfinite, nan
from numbers import Integral
from operator import index
from os import PathLike, fspath
from pathlib import Path
from typing import Any, cast

Limit = float | int
"""A limit of numbers."""
_LONGEST = 60
"""The most characters of a value that a message quotes."""


class SidestepError(Exception):
    """The base class of all errors of the library; the command line prints it and exits with 1."""


class InputError(SidestepError):
    """Data or a setting that cannot be used.

    Attributes:
        message: what was expected, and what is there instead.
        source: the file or the argument.
        row: the data row; the first row below the header is 1.
        field: the column or key.

    Example:
        >>> print(InputError("expected a number, found 'abc'", source="walks.csv", row=3, field="x"))
        walks.csv, row 3, field 'x': expected a number, found 'abc'
    """

    message: str
    source: object | None
    row: int | None
    field: str | None

    def __init__(self, message: str, *, source: object | None = None, row: int | None = None, field: str | None = None):
        self.message, self.source, self.row, self.field = message, source, row, field
        place = [str(source)] if source is not None else []
        place += [f"row {row}"] if row is not None else []
        place += [f"field '{field}'"] if field is not None else []
        super().__init__(f"{', '.join(place)}: {message}" if place else message)

    def of(self, source: object) -> "InputError":
        """Return the same error with another source and without a row."""
        return InputError(self.message, source=source, field=self.field)


def check(
    valid: object, message: str, *, source: object | None = None, row: int | None = None, field: str | None = None
) -> None:
    """Raise `InputError` with a message and a place unless something is true."""
    if not valid:
        raise InputError(message, source=source, row=row, field=field)


@contextmanager
def input_errors(message: str, *kinds: type[Exception], source: object, field: str | None = None) -> Iterator[None]:
    """Turn errors of these kinds, inside a `with`, into `InputError`: the message, then the text of the error."""
    try:
        yield
    except kinds as error:
        raise InputError(f"{message}: {error}", source=source, field=field) from error


def describe(value: object) -> str:
    """Return what a value is, in a few words: the value if it is short, or else its type, and its shape if it has one.

    Example:
        >>> print(describe(float), describe("boltzmann"), describe([1, 2]), describe(None))
        the class float 'boltzmann' [1, 2] None
    """
    if isinstance(value, type):
        return f"the class {value.__name__}"
    shape = getattr(value, "shape", None)
    try:
        if isinstance(value, str):
            return reprlib.repr(str(value))
        if type(value) in (bytes, list, tuple, dict, set):
            return reprlib.repr(value)
        if value is None or isinstance(value, int | float | complex) or shape == ():
            return str(value) if len(str(value)) <= _LONGEST else type(value).__name__
    except ValueError:  # numbers of thousands of digits have no text
        return type(value).__name__
    return type(value).__name__ if shape is None else f"{getattr(value, 'dtype', 'numbers')} of shape {shape}"


def check_instance(value: object, kinds: type | tuple[type, ...], field: str, *, source: object | None = None) -> None:
    """Raise `InputError` unless a value is an instance of a class, or of one of several."""
    if not isinstance(value, kinds):
        every = kinds if isinstance(kinds, tuple) else (kinds,)
        names = ["None" if kind is type(None) else kind.__name__ for kind in every]
        listed = ", ".join(names[:-1]) + " or " + names[-1] if len(names) > 1 else names[0]
        raise InputError(f"expected {_article(listed)} {listed}, found {describe(value)}", source=source, field=field)


def check_function(value: object, field: str) -> None:
    """Raise `InputError` unless a value can be called."""
    if not callable(value):
        raise InputError(f"expected a function, found {describe(value)}", field=field)


def check_choice(value: object, choices: Iterable[str | int], field: str) -> None:
    """Raise `InputError` unless a value is one of several texts or numbers."""
    known = isinstance(value, str | Integral) and not isinstance(value, bool) and cast(Any, value) in choices
    if not known:
        raise InputError(f"expected one of {', '.join(map(str, choices))}, found {describe(value)}", field=field)


def to_list(values: object, kinds: type | tuple[type, ...], field: str, least: int = 1) -> list[Any]:
    """Return the elements of a sequence, each an instance of a class, or of one of several.

    Raises:
        InputError: For a value that is not a sequence, for fewer elements than `least`, and elements of other types.
    """
    single = isinstance(values, str | bytes | Mapping) or (kinds is not object and isinstance(values, kinds))
    if single or not isinstance(values, Iterable) or getattr(values, "shape", None) == ():
        raise InputError(f"expected a list, found {describe(values)}", field=field)
    elements = list(cast(Iterable[Any], values))
    check(len(elements) >= least, f"expected at least {least}, found {len(elements)}", field=field)
    for place, element in enumerate(elements):
        if not isinstance(element, kinds):
            check_instance(element, kinds, f"{field}[{place}]")
    return elements


def to_count(value: object, field: str, least: int = 1, most: int | None = None) -> int:
    """Return a setting as a whole number, at least `least` and at most `most`.

    Raises:
        InputError: For other numbers, booleans and other types.
    """
    try:
        number = None if isinstance(value, bool) else index(cast(Any, value))
    except TypeError:
        number = None
    if number is None or number < least or (most is not None and number > most):
        span = f"at least {least}" if most is None else f"{least}…{most}"
        whole = "" if number is not None or isinstance(value, bool) else "a whole number, "
        raise InputError(f"expected {whole}{span}, found {describe(value)}", field=field)
    return number


def check_count(value: object, least: int, field: str) -> None:
    """Raise `InputError` unless a setting is a whole number, at least `least`."""
    to_count(value, field, least)


def to_number(
    value: object,
    field: str,
    *,
    above: Limit = -inf,
    least: Limit = -inf,
    below: Limit = inf,
    most: Limit = inf,
) -> float:
    """Return a setting as a finite number: above `above`, at least `least`, below `below` and at most `most`.

    Raises:
        InputError: For other numbers, and for anything that is no number: texts, booleans, arrays.
    """
    number = _as_float(value)
    if not (isfinite(number) and above < number < below and least <= number <= most):
        expected = f"a finite number{limits(above=above, least=least, below=below, most=most)}"
        raise InputError(f"expected {expected}, found {describe(value)}", field=field)
    return number


def limits(*, above: Limit = -inf, least: Limit = -inf, below: Limit = inf, most: Limit = inf) -> str:
    """Return the limits of a number as a message says them, such as " above 0 and at most 1"; empty without limits.

    Example:
        >>> limits(above=0, most=1), limits(least=0), limits(least=0, most=1)
        (' above 0 and at most 1', ', at least 0', ' from 0 to 1')
    """
    if least > -inf and most < inf and above == -inf and below == inf:
        return f" from {least:g} to {most:g}"
    lower = [f" above {above:g}"] if above > -inf else [f", at least {least:g}"] if least > -inf else []
    upper = [f"below {below:g}"] if below < inf else [f"at most {most:g}"] if most < inf else []
    return " and ".join([*lower, *upper]) if lower else "".join(f", {limit}" for limit in upper)


def check_positive(value: object, field: str) -> None:
    """Raise `InputError` unless a setting is a finite number above 0."""
    to_number(value, field, above=0)


def check_not_negative(value: object, field: str) -> None:
    """Raise `InputError` unless a setting is a finite number, at least 0."""
    to_number(value, field, least=0)


def to_path(value: object, field: str = "path") -> Path:
    """Return the path of a file or folder.

    Raises:
        InputError: For anything but a text or a path.
    """
    text = fspath(value) if isinstance(value, str | PathLike) else None
    check(isinstance(text, str), f"expected the path of a file, found {describe(value)}", field=field)
    return Path(cast(str, text))


def _as_float(value: Any) -> float:
    """Return a number, or NaN for what is not one."""
    if isinstance(value, float):
        return value
    dtype = getattr(value, "dtype", None)
    if isinstance(value, str | bytes | bool) or getattr(value, "ndim", 0) or getattr(dtype, "kind", "f") == "b":
        return nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return nan


def _article(noun: str) -> str:
    return "an" if noun[0].lower() in "aeiou" else "a"


class ImproperTask(SidestepError):
    """A task with infinite or ambiguous values, such as one in which continuing is better than arriving."""


class NotConverged(SidestepError):
    """A solution with values that have not converged; its numbers must not be used."""


class SidestepWarning(UserWarning):
    """A result that is right for what was asked, but hardly what was meant."""
