"""Short text and tables for records: arrays by type, shape and range, parts by their class.

`short_repr` is the one mechanism; a class names at most which of its attributes are worth a place. The result is for
people and is no digest: different arrays may have the same text. `eqx.tree_pformat` prints everything.
"""

import dataclasses
import enum
import html
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

_Class = TypeVar("_Class", bound=type)

_WIDTH = 100
"""The longest text on one line; a longer one has a line for each attribute."""
_PART = 64
"""The longest text of a part that is shown in full."""
_LARGE = 1_000_000
"""The number of entries above which an array's range is not computed."""
_FEW = 4
"""The most entries of an array or a tuple that are shown one by one."""


def short_repr(*shown: str) -> Callable[[_Class], _Class]:
    """Return a class decorator that gives a class a short `repr` and a table in notebooks.

    Args:
        shown: The names of the attributes that are shown; all fields by default.
    """

    def decorate(cls: _Class) -> _Class:
        def as_text(self: Any) -> str:
            parts = [f"{name}={text}" for name, text in _rows(self, shown)]
            line = f"{type(self).__name__}({', '.join(parts)})"
            if len(line) <= _WIDTH:
                return line
            return f"{type(self).__name__}(" + "".join(f"\n    {part}," for part in parts) + "\n)"

        def as_html(self: Any) -> str:
            cells = "".join(
                f"<tr><th style='text-align: left'>{html.escape(name)}</th>"
                f"<td style='text-align: left'>{html.escape(text)}</td></tr>"
                for name, text in _rows(self, shown)
            )
            return f"<table><caption>{html.escape(type(self).__name__)}</caption>{cells}</table>"

        for name, method in (("__repr__", as_text), ("_repr_html_", as_html)):
            setattr(cls, name, method)
        return cls

    return decorate


def _rows(record: Any, shown: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return the names and texts of the attributes of a record that are not None."""
    if shown:
        names = list(shown)
    elif dataclasses.is_dataclass(record):
        names = [field.name for field in dataclasses.fields(record)]
    else:
        names = list(record._fields)
    return [(name, text) for name in names if (text := _text_of(record, name)) != "None"]


def _text_of(record: Any, name: str) -> str:
    """Return the text of an attribute; `…` where it cannot be computed, as in a tree of None or before it is set."""
    try:
        return _text(getattr(record, name))
    except Exception:  # an error here would hide the one that is being reported
        return "…"


def _text(value: Any) -> str:
    if isinstance(value, str):
        return repr(value) if len(value) <= _WIDTH else repr(value[: _WIDTH - 1] + "…")
    if isinstance(value, bool | int | None):
        return str(value) if not isinstance(value, enum.Enum) else value.name
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, enum.Enum):
        return value.name
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return _array(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(map(str, value))}}}"
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        return _sequence(value)
    text = repr(value)
    return text if len(text) <= _PART and "\n" not in text else f"{type(value).__name__}(…)"


def _sequence(values: tuple[Any, ...] | list[Any]) -> str:
    plain = all(isinstance(value, str | bool | int | float | None) for value in values)
    if plain and len(values) <= _FEW:
        return f"({', '.join(map(_text, values))})"
    kinds = {type(value).__name__ for value in values}
    return f"{len(values)} × {kinds.pop() if len(kinds) == 1 else 'values'}"


def _array(array: Any) -> str:
    """Return the type and shape of an array, and its range or entries where they are known."""
    kind = f"{array.dtype}{[*array.shape]}"
    if not _is_known(array) or array.size == 0 or array.size > _LARGE:
        return kind
    numbers = np.asarray(array)
    if numbers.dtype == bool:
        return str(bool(numbers)) if numbers.ndim == 0 else f"{kind}, {int(numbers.sum())} true"
    if numbers.dtype.kind not in "iuf":
        return kind
    if numbers.ndim == 0:
        return f"{numbers:.6g}" if numbers.dtype.kind == "f" else str(numbers)
    if numbers.ndim == 1 and len(numbers) <= _FEW:
        return f"[{', '.join(f'{number:.6g}' for number in numbers)}]"
    finite = numbers[np.isfinite(numbers)]
    other = "" if len(finite) == numbers.size else f", {numbers.size - len(finite)} not finite"
    least, most = (f"{bound(finite):.4g}" if len(finite) else "" for bound in (np.min, np.max))
    between = f", {least} … {most}" if least != most else f", all {least}" if least else ""
    return f"{kind}{between}{other}"


def _is_known(array: Any) -> bool:
    """Return whether the numbers of an array are there: it is not traced, nor in another process."""
    if isinstance(array, np.ndarray | np.generic):
        return True
    import jax
    from jax.core import Tracer

    concrete = isinstance(array, jax.Array) and not isinstance(array, Tracer)
    return concrete and array.is_fully_addressable and not array.is_deleted()
