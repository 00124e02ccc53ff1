"""Errors of `sidestep`: each names the place, the expectation and the actual value."""

from collections.abc import Iterator
from contextlib import contextmanager
from math import isfinite
from numbers import Integral


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


def check_count(value: object, least: int, field: str) -> None:
    """Raise `InputError` unless a setting is a whole number, at least `least`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        what = f"at least {least}" if isinstance(value, Integral) else f"a whole number, at least {least}"
        raise InputError(f"expected {what}, found {value}", field=field)


def check_positive(value: float, field: str) -> None:
    """Raise `InputError` unless a setting is a finite number above 0."""
    if not (isfinite(value) and value > 0):
        raise InputError(f"expected a finite number above 0, found {value}", field=field)


def check_not_negative(value: float, field: str) -> None:
    """Raise `InputError` unless a setting is a finite number, at least 0."""
    if not (isfinite(value) and value >= 0):
        raise InputError(f"expected a finite number, at least 0, found {value}", field=field)


class ImproperTask(SidestepError):
    """A task with infinite or ambiguous values, such as one in which continuing is better than arriving."""


class NotConverged(SidestepError):
    """A solution with values that have not converged; its numbers must not be used."""
