"""Trees of records as JSON and arrays, and back.

`describe` and `rebuild` are inverse. Records are named by their public names. `rebuild` makes only classes and
functions on a fixed list, by setting fields, so that no code of a description runs; others are taken from a template.
"""

import dataclasses
import enum
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import jax
import numpy as np

from sidestep.errors import check, input_errors

_PUBLIC = "sidestep", "sidestep.continuous"
"""Modules with public names; their records and enumerations are made from descriptions."""
_OTHERS = (
    "sidestep.continuous.likelihood.FitProblem",
    "sidestep.continuous.policies.ScaledNetwork",
    "sidestep.inference.objective.Problem",
    "sidestep.tabular.behavior_model.BehaviorParameters",
    "sidestep.tabular.solvers.base.WarmStart",
    "equinox.nn.Linear",
    "equinox.nn.MLP",
    "optax.EmptyState",
    "optax.ScaleByAdamState",
    "optax.ScaleByScheduleState",
    "equinox.nn._mlp._identity",
    "jax.nn.relu",
    "jax.nn.sigmoid",
    "jax.nn.softplus",
    "jax.nn.tanh",
    "jax.numpy.tanh",
)
"""Classes and functions that are parts of public records."""
_Plain = bool | int | str | None
"""What JSON has as it is."""
_KINDS = "biufcUSmM"
"""Of the arrays that can be saved: numbers, texts and times."""


def describe(value: Any) -> tuple[Any, list[np.ndarray]]:
    """Return a tree as JSON can hold it, and its arrays, each once.

    Args:
        value: A record, a container, an array or a plain value.

    Raises:
        InputError: With the place, for arrays of other things than numbers and texts, and for objects that are neither
            records nor functions, such as sets, bytes, complex numbers and paths.
    """
    writer = _Writer()
    return writer.described(value, "result"), writer.arrays


def rebuild(tree: Any, arrays: Sequence[np.ndarray], template: Any = None) -> Any:
    """Return the value that `describe` has described.

    Args:
        tree: The description.
        arrays: Its arrays.
        template: A value of the same structure.

    Raises:
        InputError: With the place, for classes and functions that are not on the list and not in the template, for
            records with other fields, and for 64-bit numbers where JAX has 32-bit ones.
    """
    return _Reader(arrays).made(tree, template, "result")


class _Writer:
    """Describes a tree, and collects its arrays."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self.numbers: dict[int, tuple[Any, int]] = {}

    def described(self, value: Any, path: str) -> Any:
        if isinstance(value, enum.Enum):
            return {"enum": _name(type(value)), "name": value.name}
        if isinstance(value, jax.Array):
            return {"jax": self._number(value, path)}
        if isinstance(value, np.ndarray | np.generic):
            return {"numpy" if isinstance(value, np.ndarray) else "number": self._number(value, path)}
        if isinstance(value, float):
            return value if math.isfinite(value) else {"float": str(value)}
        if isinstance(value, _Plain):
            # half of a pair of surrogates has no bytes, and a number of thousands of digits no text
            with input_errors("expected texts and numbers that a file can hold", ValueError, source="save", field=path):
                json.dumps(value, ensure_ascii=False).encode()
            return value
        if isinstance(value, Mapping):
            return {"dict": [[self.described(key, path), self.described(value[key], _at(path, key))] for key in value]}
        if _is_record(type(value)):
            parts = {name: self.described(getattr(value, name), f"{path}.{name}") for name in _fields(type(value))}
            return {"record": _name(type(value)), "fields": parts}
        if isinstance(value, list | tuple):
            kind = "list" if isinstance(value, list) else "tuple"
            return {kind: [self.described(each, _at(path, at)) for at, each in enumerate(value)]}
        message = "expected a record, a container, an array, a number, a text or a function"
        check(callable(value), f"{message}, found {type(value).__name__}", source="save", field=path)
        return {"other": _name(value)}

    def _number(self, array: Any, path: str) -> int:
        """Return the number of an array."""
        if id(array) not in self.numbers:
            with input_errors("expected an array of numbers", TypeError, ValueError, source="save", field=path):
                plain = np.asarray(array)
            message = f"expected an array of numbers or texts, found {array.dtype}"
            check(plain.dtype.kind in _KINDS, message, source="save", field=path)
            self.numbers[id(array)] = array, len(self.arrays)
            self.arrays.append(plain)
        return self.numbers[id(array)][1]


class _Reader:
    """Makes a result from its description."""

    def __init__(self, arrays: Sequence[np.ndarray]):
        self.arrays = arrays
        self.on_device: dict[int, jax.Array] = {}

    def made(self, node: Any, template: Any, path: str) -> Any:
        if isinstance(node, float | _Plain):
            return node
        if "jax" in node:
            return self._on_device(node["jax"])
        if "numpy" in node:
            return self.arrays[node["numpy"]]
        if "number" in node:
            return self.arrays[node["number"]][()]
        if "float" in node:
            return float(node["float"])
        if "enum" in node:
            kind = self._kind(node["enum"], template, path)
            check(issubclass(kind, enum.Enum), f"expected an enumeration, found {node['enum']}", field=path)
            return kind[node["name"]]
        if "dict" in node:
            parts = ((self.made(key, None, path), each) for key, each in node["dict"])
            return {key: self.made(each, _part(template, key), _at(path, key)) for key, each in parts}
        if "record" in node:
            return self._record(node, template, path)
        for name, kind in (("list", list), ("tuple", tuple)):
            if name in node:
                parts = enumerate(node[name])
                return kind(self.made(each, _part(template, at), _at(path, at)) for at, each in parts)
        return self._other(node["other"], template, path)

    def _on_device(self, number: int) -> jax.Array:
        """Return an array of JAX, once."""
        if number not in self.on_device:
            array = self.arrays[number]
            message = "has 64-bit numbers: expected jax.config.update('jax_enable_x64', True) before it is loaded"
            check(jax.dtypes.canonicalize_dtype(array.dtype) == array.dtype, message)
            self.on_device[number] = jax.device_put(array)
        return self.on_device[number]

    def _record(self, node: Any, template: Any, path: str) -> Any:
        kind, saved = self._kind(node["record"], template, path), node["fields"]
        check(isinstance(kind, type) and _is_record(kind), f"expected a record, found {node['record']}", field=path)
        names = _fields(kind)
        message = f"expected the fields {', '.join(names)} of {node['record']}, found {', '.join(saved)}"
        check(names == list(saved), message, field=path)
        fields = {
            name: self.made(each, getattr(template, name, None), f"{path}.{name}") for name, each in saved.items()
        }
        if issubclass(kind, tuple):
            return kind(**fields)
        record = object.__new__(kind)  # checks and conversions were done when the record was first made
        for name, value in fields.items():
            object.__setattr__(record, name, value)
        return record

    def _kind(self, name: str, template: Any, path: str) -> Any:
        """Return the class of a name: the library's, or that of the template."""
        kind = _registered(name)
        if kind is not None:
            return kind
        message = f"{name} is not a class of the library: expected template=…, a result with one in this place"
        check(_name(type(template)) == name, f"{message}, found {type(template).__name__}", field=path)
        return type(template)

    def _other(self, name: str, template: Any, path: str) -> Any:
        """Return a function of a name, or what the template has in its place."""
        thing = _registered(name)
        if thing is not None:
            return thing
        message = f"{name} cannot be saved: expected template=…, a result that has it in this place"
        check(template is not None, message, field=path)
        return template


def _part(template: Any, key: Any) -> Any:
    """Return the part of a template at a key; None where there is none."""
    try:
        return template[key]
    except (TypeError, KeyError, IndexError):
        return None


def _at(path: str, key: object) -> str:
    return f"{path}[{key!r}]"


def _is_record(kind: type) -> bool:
    return dataclasses.is_dataclass(kind) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def _fields(kind: Any) -> list[str]:
    """Return the names of the fields of a class of records."""
    return [field.name for field in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else list(kind._fields)


def _name(thing: Any) -> str:
    """Return the name of a class or function: the public one, where it has one."""
    for name, known in _known().items():
        if known is thing:
            return name
    own = getattr(thing, "__qualname__", type(thing).__qualname__)
    for module in map(import_module, _PUBLIC):
        if own in module.__all__ and getattr(module, own) is thing:
            return f"{module.__name__}.{own}"
    return f"{getattr(thing, '__module__', None) or type(thing).__module__}.{own}"


@cache
def _known() -> dict[str, Any]:
    """Return the classes and functions on the list, by name; those of another version of their library are left out."""

    def resolved() -> Iterator[tuple[str, Any]]:
        for name in _OTHERS:
            module, _, last = name.rpartition(".")
            thing = getattr(import_module(module), last, None)
            if thing is not None:
                yield name, thing

    return dict(resolved())


def _registered(name: str) -> Any:
    """Return the class or function of a name; None where it is not the library's."""
    module, _, last = name.rpartition(".")
    if module in _PUBLIC and last in import_module(module).__all__:
        return getattr(import_module(module), last)
    return _known().get(name)
