"""How long whole processes of the command line take, in units of a process that imports JAX and compiles an addition.

All take turns; of each, the median over turns counts, and the median of the ratio to the unit of the same turn. Before
that, each runs once, so that the caches of compiled code are warm. `first-learn` is the first run ever of `learn`: the
cache is empty in every turn (`SIDESTEP_CACHE` names an empty folder). Inputs are made by `sidestep simulate` on a map
of 10 × 10 cells.

Records: `name`, `seconds`, `unit_seconds`, `units`, `asked` (at most so many units), `over`, `turns`.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import Record, in_turns, median, median_ratio, note, option, print_table
from sidestep.errors import InputError, SidestepError
from sidestep.io.maps import write_map
from sidestep.tabular.grid import Grid

UNIT = "import jax; jax.jit(lambda x: x + x)(1.0)"
ASKED = {"help": 0.3, "plan": 1.6, "learn": 2.6, "evaluate": 2.6, "first-learn": 5.0}
"""The most units that each process may take."""
CACHES = (
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_ENABLE_COMPILATION_CACHE",
    "PYTHONDONTWRITEBYTECODE",
)
"""Variables that change what processes keep; they are taken out of the environment."""
PLAN = [(0.5, 0.5), (8.5, 8.5)]


@dataclass
class Options:
    """The options of this benchmark."""

    turns: int = option(5, "how often each process runs", quick=1)
    walks: int = option(40, "walks that are learned from")
    only: list[str] = option([], "these only, beside the unit", choices=list(ASKED))


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each process."""
    names = options.only or list(ASKED)
    with tempfile.TemporaryDirectory() as folder:
        calls = _calls(Path(folder), options)
        calls = {name: calls[name] for name in ("unit", *names)}
        for name in {*calls} - {"first-learn"}:
            note(f"{name}: {calls[name]():.2f} s, before caches are warm")
        taken = in_turns(calls, options.turns)
    for name in names:
        units = median_ratio(taken[name], taken["unit"])
        yield {
            "name": name,
            "seconds": median(taken[name]),
            "unit_seconds": median(taken["unit"]),
            "units": units,
            "asked": ASKED[name],
            "over": units is not None and units > ASKED[name],
            "turns": len(taken[name]),
        }


def show(records: Sequence[Record], options: Options) -> None:
    """Print the table, and what takes longer than asked."""
    columns = {"sidestep": "name", "seconds": "seconds .2f", "units": "units .2f", "asked": "asked .1f"}
    unit = records[0]["unit_seconds"]
    print_table(f"whole processes, in units of {unit:.2f} s ({UNIT!r}); {options.walks} walks", records, columns)
    over = [f"{record['name']} ({record['units']:.2f} for {record['asked']})" for record in records if record["over"]]
    print("more than asked: " + (", ".join(over) or "nothing"))


def _calls(folder: Path, options: Options) -> dict[str, Callable[[], float]]:
    """Return the processes, each as a call that returns its seconds; makes the map and the walks."""
    command = shutil.which("sidestep", path=str(Path(sys.executable).parent))
    if command is None:
        raise InputError(
            "expected the command `sidestep` beside this Python: install the project", source=sys.executable
        )
    truth, blank, walks, learned, scratch, empty = (
        folder / name for name in ("truth.yaml", "blank.yaml", "walks.csv", "learned", "scratch", "cache")
    )
    walls = np.zeros((10, 10))
    walls[5, 1:9] = walls[2:5, 4] = 1
    grid = Grid(walls.astype(int))
    write_map(truth, walls, grid)
    write_map(blank, np.full(walls.shape, 0.5), replace(grid, known=np.full(walls.shape, -1)))
    _seconds([command, "simulate", truth, "--out", walks, "--walks", options.walks])
    learn = [command, "learn", walks, "--map", blank, "--out"]
    _seconds([*learn, learned])
    start, goal = (f"{x},{y}" for x, y in PLAN)

    def afresh(**variables: str) -> float:
        for place in (scratch, empty):
            shutil.rmtree(place, ignore_errors=True)
        return _seconds([*learn, scratch], **variables)

    return {
        "unit": lambda: _seconds([sys.executable, "-c", UNIT]),
        "help": lambda: _seconds([command, "--help"]),
        "plan": lambda: _seconds([command, "plan", learned, "--start", start, "--goal", goal]),
        "learn": afresh,
        "evaluate": lambda: _seconds([command, "evaluate", learned, "--truth", truth]),
        "first-learn": lambda: afresh(SIDESTEP_CACHE=str(empty)),
    }


def _seconds(command: Sequence[object], **variables: str) -> float:
    """Return how long a process takes; raises `SidestepError` if it fails."""
    environment = {key: value for key, value in os.environ.items() if key not in CACHES} | variables
    started = time.perf_counter()
    done = subprocess.run([str(part) for part in command], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SidestepError(f"{' '.join(map(str, command))} failed: {done.stderr.strip()[-1000:]}")
    return time.perf_counter() - started
