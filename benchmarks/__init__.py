"""What all benchmarks share: options, timing in turns, memory in a process of its own, means, tables.

A benchmark is a module with a dataclass `Options` (each field is an option), a function `measure(options)` that returns
or yields flat records, and a function `show(records, options)` that prints them. A function `draw(records, options)`
makes its picture. `python -m benchmarks NAME` does the rest (`__main__.py`).

Timings on a shared machine drift, so everything compared takes turns, and medians count. Peak memory is that of a
process that does one thing: the largest resident set that the system has seen.
"""

import copy
import multiprocessing
import re
import resource
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import field, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from rich import box
from rich.console import Console
from rich.table import Table

from sidestep.errors import InputError

Record = dict[str, Any]
SHARED_DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
SHORTEST = 0.01
"""Seconds that a measurement takes at least; shorter calls are repeated, and their mean counts."""
MEMORY = ("peak_bytes", "imports_bytes", "excess_bytes", "building_bytes", "call_bytes")
"""The fields of `peak_memory`."""
UNITS = {"ms": (1e3, ".4g"), "µs": (1e6, ".4g"), "MiB": (2**-20, ".0f"), "GiB": (2**-30, ".2f")}
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_HELD: list[int] = []
"""What a process of its own holds after its imports."""


# ---------------------------------------------------------------------------------------------------- options


def option(
    default: Any, text: str, *, quick: Any = None, choices: Collection[str] | None = None, least: int = 1
) -> Any:
    """Return the field of an option: `quick` replaces its value with `--quick`, `least` bounds whole numbers."""
    metadata = {"help": text, "quick": quick, "choices": choices, "least": least}
    return field(default_factory=lambda: copy.copy(default), metadata=metadata)


def flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Return the fields of a dataclass and of the dataclasses in it, by names with dots."""
    values = {}
    for each in fields(settings):
        value = getattr(settings, each.name)
        values |= flat(value, f"{prefix}{each.name}.") if is_dataclass(value) else {prefix + each.name: value}
    return values


def changed(settings: Any, overrides: Sequence[str]) -> Any:
    """Return a dataclass with some fields changed, each written as `field=value`; `null` is None.

    The name of a field in another dataclass may be shortened to its last part. All fields are set before a dataclass
    checks how they go together.

    Raises:
        InputError: for a field that does not exist, and for a value of another type.
    """
    values: dict[str, Any] = {}
    for override in overrides:
        name, _, text = override.partition("=")
        names = [known for known in flat(settings) if f".{known}".endswith(f".{name}")]
        if not names:
            expected = ", ".join(flat(settings))
            raise InputError(f"expected one of {expected} and a value, found {override!r}", source="--set")
        values[names[0]] = yaml.safe_load(text)
    return _replaced(settings, values)


def _replaced(settings: Any, values: Mapping[str, Any], prefix: str = "") -> Any:
    """Return a dataclass with the values of some fields, by names with dots."""
    hints, own = get_type_hints(type(settings)), {}
    for each in fields(settings):
        name = prefix + each.name
        if name in values:
            own[each.name] = _typed(values[name], hints[each.name], each.name)
        elif any(other.startswith(f"{name}.") for other in values):
            own[each.name] = _replaced(getattr(settings, each.name), values, f"{name}.")
    return replace(settings, **own)


def _typed(value: Any, hint: Any, name: str) -> Any:
    if type(value) is int and float in (hint, *get_args(hint)):
        return float(value)
    if not _fits(value, hint):
        raise InputError(f"cannot be {value!r}", source="--set", field=name)
    return value


def described(settings: Any) -> str:
    """Return the fields of a dataclass that differ from its defaults, as text."""
    default = flat(type(settings)())
    return (
        ", ".join(f"{name}={value}" for name, value in flat(settings).items() if value != default[name]) or "defaults"
    )


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value is of a field's type."""
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if get_args(hint):
        return any(_fits(value, one) for one in get_args(hint))
    return type(value) is hint


# ---------------------------------------------------------------------------------------------------- time


def seconds_of(call: Callable[[], Any], shortest: float = SHORTEST) -> float:
    """Return how long a call takes: the mean of as many calls as fill `shortest` seconds."""
    calls, started = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - started) < shortest or not calls:
        call()
        calls += 1
    return elapsed / calls


def in_turns(
    calls: Mapping[str, Callable[[], float]], turns: int, budget: float = np.inf, fewest: int = 3
) -> dict[str, list[float]]:
    """Return the seconds that each call returns, turn by turn.

    A call that has used up `budget` seconds takes no more than `fewest` turns.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(turns):
        for name, call in calls.items():
            if len(seconds[name]) < fewest or sum(seconds[name]) <= budget:
                seconds[name].append(call())
    return seconds


def median(values: Sequence[float] | None) -> float | None:
    """Return the median; None of nothing."""
    return float(np.median(values)) if values else None


def median_ratio(values: Sequence[float] | None, units: Sequence[float]) -> float | None:
    """Return the median over turns of the ratio to the same turn's unit."""
    return median([value / unit for value, unit in zip(values or (), units, strict=False)])


# ---------------------------------------------------------------------------------------------------- memory


def peak_bytes() -> int:
    """Return the most that this process held in memory, since it began or since `_RESET` was written to."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return _status("VmHWM") or peak


def peak_memory(build: Callable[..., Callable[[], object]], *inputs: object, limit: float = 600.0) -> Record:
    """Return the peak memory of a process of its own that calls `build(*inputs)`, and then the result of that.

    - `peak_bytes`: of the whole process; `imports_bytes`: held after the imports; `excess_bytes`: the difference.
    - `building_bytes`: the peak before the call; `call_bytes`: the peak of the call less what was held before it.

    All are None, with a warning, if the process fails or takes more than `limit` seconds.
    """
    with multiprocessing.get_context("spawn").Pool(1, _begin, (build.__module__,)) as pool:
        try:
            return pool.apply_async(_memory, (build, inputs)).get(limit)
        except Exception as error:  # whatever goes wrong there, the times still count
            warn(f"the memory of {build.__module__} was not measured: {type(error).__name__}: {error}")
            return dict.fromkeys(MEMORY)


def _begin(module: str) -> None:
    """Import what the process needs, before its arguments arrive."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import_module(module)
    _HELD.append(_status("VmRSS"))


def _memory(build: Callable[..., Callable[[], object]], inputs: Sequence[object]) -> Record:
    call = build(*inputs)
    held, building, known = _status("VmRSS"), peak_bytes(), True
    try:
        _RESET.write_text("5")  # count the peak anew
    except OSError:
        known = False
    call()
    calling, imports = peak_bytes(), _HELD[0]
    peak = max(building, calling)
    return dict(zip(MEMORY, (peak, imports, peak - imports, building, calling - held if known else None), strict=True))


def _status(key: str) -> int:
    """Return a size from the system's account of this process, in bytes; 0 if there is none."""
    line = re.search(rf"^{key}:\s+(\d+) kB", _STATUS.read_text(), re.MULTILINE) if _STATUS.exists() else None
    return int(line.group(1)) * 1024 if line else 0


# ---------------------------------------------------------------------------------------------------- reporting


def groups(records: Sequence[Record], *keys: str) -> Iterator[tuple[Record, list[Record]]]:
    """Yield the records that agree in some fields, in the order of the first ones, and what they agree in."""
    for values in dict.fromkeys(tuple(record[key] for key in keys) for record in records):
        yield dict(zip(keys, values, strict=True)), [r for r in records if tuple(r[key] for key in keys) == values]


def mean_over(records: Sequence[Record], key: str, within: str | None = None) -> float | None:
    """Return the mean of a field over the records that have a value; None if none has.

    With `within`, the mean of the means over the records that agree in that field.
    """
    if within is not None:
        records = [{key: mean_over(own, key)} for _, own in groups(records, within)]
    values = [record[key] for record in records if record[key] is not None]
    return float(np.mean(values)) if values else None


def print_table(title: str, records: Sequence[Record], columns: Mapping[str, str]) -> None:
    """Print records as a table.

    Args:
        title: The line above it.
        records: A row each.
        columns: By heading, the name of a field and, after a space, its format or unit (`UNITS`).
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name, column in columns.items():
        text = any(isinstance(record.get(column), str) for record in records)
        table.add_column(name, justify="left" if text else "right", no_wrap=True)
    for record in records:
        table.add_row(*(_cell(record, column) for column in columns.values()))
    Console(width=None if sys.stdout.isatty() else 250, highlight=False, markup=False).print(title, table)


def _cell(record: Record, column: str) -> str:
    key, _, form = column.partition(" ")
    factor, form = UNITS.get(form, (None, form))
    value = record.get(key)
    return "–" if value is None else format(value if factor is None else factor * value, form)


def print_faster(others: Sequence[Record]) -> None:
    """Print which records of other methods have a smaller time than this project's (`ratio`), and how many have not."""
    faster = [record for record in others if record["ratio"] is not None and record["ratio"] < 1]
    for record in faster:
        print(f"faster than sidestep: {record['name']} ({place(record)}), {record['ratio']:.2f} of its time")
    timed = sum(record["ratio"] is not None for record in others)
    print(f"{timed - len(faster)} of {timed} times of other methods were longer than those of sidestep on the same map")


def place(record: Record) -> str:
    """Return what a record is about: the map, the backup, the model."""
    return ", ".join(
        [f"{round(record['cells'] ** 0.5)}²", *(str(record[k]) for k in ("backup", "model") if k in record)]
    )


def warn(text: str) -> None:
    """Print a warning on standard error."""
    note(f"warning: {text}")


def note(text: str) -> None:
    """Print on standard error how far a benchmark has got."""
    Console(stderr=True).print(text, markup=False, highlight=False, soft_wrap=True)
