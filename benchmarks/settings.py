"""Settings of a script that may be changed from its command line: the fields of a dataclass, `--set field=value`."""

import argparse
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from sidestep.errors import InputError


def changed(settings: Any, overrides: Sequence[str], fixed: Sequence[str] = ()) -> Any:
    """A dataclass of settings with some fields changed, each given as `field=value`; `null` is None.

    Raises `InputError` for a field that is not there or `fixed`, and for a value of another type.
    """
    hints, values = _changeable(type(settings), fixed), {}
    for override in overrides:
        name, _, text = override.partition("=")
        if name not in hints:
            raise InputError(f"expected one of {', '.join(hints)} and a value, found {override!r}", source="--set")
        values[name] = yaml.safe_load(text)
        if not _fits(values[name], hints[name]):
            raise InputError(f"cannot be {text!r}", source="--set", field=name)
    return replace(settings, **values)


def add_set_option(parser: argparse.ArgumentParser, kind: type, fixed: Sequence[str] = ()) -> None:
    """The option `--set`, for the settings of a dataclass."""
    names = ", ".join(_changeable(kind, fixed))
    parser.add_argument("--set", nargs="+", default=[], metavar="FIELD=VALUE", help=f"settings: {names}")


def described(settings: Any) -> str:
    """What differs from the shipped defaults."""
    shipped = type(settings)()
    names = [field.name for field in fields(settings)]
    different = [f"{n}={getattr(settings, n)}" for n in names if getattr(settings, n) != getattr(shipped, n)]
    return ", ".join(different) or "shipped defaults"


def _changeable(kind: type, fixed: Sequence[str]) -> dict[str, Any]:
    return {name: hint for name, hint in get_type_hints(kind).items() if name not in fixed}


def _fits(value: object, hint: Any) -> bool:
    """Whether a value is of a setting's type; whole numbers pass for others."""
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if get_args(hint):
        return any(_fits(value, one) for one in get_args(hint))
    if hint is bool:
        return isinstance(value, bool)
    return isinstance(value, (int, float) if hint is float else hint) and not isinstance(value, bool)
