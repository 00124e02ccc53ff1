"""What the benchmarks share: timing in turns, memory in a process of its own, tables, records, and running a script.

Timings on a shared machine drift, so what is compared takes turns (`in_turns`) and medians are told. Peak memory is
that of a process that does one thing (`in_own_process`): the largest resident set that the system has seen.
"""

import argparse
import json
import os
import platform
import re
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from sidestep._files import write_json
from sidestep.errors import SidestepError

SHORTEST = 0.01
"""Seconds that a measurement takes at least; shorter calls are repeated, and their mean counts."""
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


# ---------------------------------------------------------------------------------------------------- time


def seconds_of(call: Callable[[], Any], shortest: float = SHORTEST) -> float:
    """How long a call takes, the mean of as many as fill `shortest` seconds."""
    calls, started = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - started) < shortest or not calls:
        call()
        calls += 1
    return elapsed / calls


def in_turns(
    calls: Mapping[str, Callable[[], float]], turns: int, budget: float = np.inf, fewest: int = 3
) -> dict[str, list[float]]:
    """The seconds that each call returns, the calls taking turns.

    A call that has used up `budget` seconds takes no more than `fewest` turns.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(turns):
        for name, call in calls.items():
            if len(seconds[name]) < fewest or sum(seconds[name]) <= budget:
                seconds[name].append(call())
    return seconds


def median(values: Sequence[float] | None) -> float | None:
    """The median; None of nothing."""
    return float(np.median(values)) if values else None


# ---------------------------------------------------------------------------------------------------- memory


def held_bytes() -> int:
    """What this process holds in memory now; where the system does not tell, the most it ever held."""
    return _status("VmRSS") or peak_bytes()


def peak_bytes() -> int:
    """The most that this process held in memory, since it began or since `reset_peak`."""
    if known := _status("VmHWM"):
        return known
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def reset_peak() -> bool:
    """Counts the peak anew from what is held now; False where the system cannot."""
    try:
        _RESET.write_text("5")
    except OSError:
        return False
    return True


def _status(key: str) -> int:
    """A size from the system's account of this process, in bytes; 0 if there is none."""
    if not _STATUS.exists():
        return 0
    found = re.search(rf"^{key}:\s+(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    return int(found.group(1)) * 1024 if found else 0


def in_own_process(script: str | Path, *arguments: object, seconds: float = 600.0) -> dict[str, Any] | None:
    """The JSON object in the last line that a script prints, run by this Python; None if it fails or takes too long."""
    command = [sys.executable, str(script), *map(str, arguments)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=True)
        return json.loads(done.stdout.strip().splitlines()[-1])
    except (subprocess.SubprocessError, json.JSONDecodeError, IndexError) as error:
        detail = str(getattr(error, "stderr", "") or "").strip()[-1000:]
        complain(f"a process for measuring memory failed: {error} {detail}")
        return None


# ---------------------------------------------------------------------------------------------------- reporting


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[str] = ()) -> None:
    """A table; columns named in `left` are flush left, others flush right."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="left" if name in left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console().print(table)


def console() -> Console:
    """Where tables go; wide enough for them if it is not a terminal."""
    return Console(width=None if sys.stdout.isatty() else 160, highlight=False)


def complain(text: str) -> None:
    """A warning, on standard error."""
    Console(stderr=True).print(f"warning: {text}", markup=False, soft_wrap=True)


def note(text: str) -> None:
    """How far a script has got, on standard error."""
    Console(stderr=True).print(text, markup=False, highlight=False, soft_wrap=True)


def number(value: float | None, form: str = ".4g") -> str:
    """A number in a table; a dash for none."""
    return "–" if value is None else format(value, form)


def milliseconds(value: float | None) -> str:
    """Seconds, as milliseconds in a table."""
    return number(None if value is None else 1e3 * value)


def mebibytes(value: float | None) -> str:
    """Bytes, as MiB in a table."""
    return number(None if value is None else value / 2**20, ".0f")


def write_records(arguments: argparse.Namespace, records: Sequence[Mapping[str, Any]], **more: Any) -> None:
    """Writes flat records to the file given by `--json`, if one is, with the settings and what they were run on."""
    if not arguments.json:
        return
    settings = {key: _plain(value) for key, value in vars(arguments).items()}
    machine = {
        "device": jax.devices()[0].device_kind,
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
    }
    del settings["json"]
    write_json(arguments.json, {"settings": settings, "machine": machine, **more, "records": list(records)})


def _plain(setting: Any) -> Any:
    """A setting as JSON has it: paths as text, in lists too."""
    if isinstance(setting, Path):
        return str(setting)
    return [_plain(each) for each in setting] if isinstance(setting, list) else setting


# ---------------------------------------------------------------------------------------------------- running


def argument_parser(description: str, quick: str) -> argparse.ArgumentParser:
    """A parser with the options that all scripts have; `quick` says what `--quick` does."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    parser.add_argument("--quick", action="store_true", help=quick)
    return parser


def main(run: Callable[[argparse.Namespace], int | None], arguments: argparse.Namespace) -> int:
    """Runs a script in 64-bit numbers; the exit code is 1 for data or settings that cannot be used."""
    jax.config.update("jax_enable_x64", True)
    try:
        return run(arguments) or 0
    except SidestepError as error:
        Console(stderr=True).print(f"error: {error}", markup=False, soft_wrap=True)
        return 1
