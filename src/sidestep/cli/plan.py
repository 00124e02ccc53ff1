"""`sidestep plan`: a path in a learned map, as CSV and PNG."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from sidestep.errors import InputError
from sidestep.io.tables import write_table
from sidestep.maps.learned_map import add_to_summary, read_learned_map
from sidestep.plotting.maps import figure_plan, save
from sidestep.robots.robot import BUMP_COST
from sidestep.tabular.grid import Cell, Grid

Position = tuple[float, float]


def plan_path(folder: Path, start: Position, goal: Position, out: Path, bump_cost: float = BUMP_COST) -> dict[str, Any]:
    """Plans as a robot does (`sidestep.robots.robot`) from `start` to `goal` (metres) in the learned map of `folder`.

    Writes `path.csv` (`step, x, y, blocked`), `path.png` and `summary.json` to `out`, and returns the summary.

    Raises `InputError` for positions outside the map or in known obstacles, and where there is no way.
    """
    learned = read_learned_map(folder)
    first, last = (_state(learned.grid, position, name) for name, position in (("start", start), ("goal", goal)))
    path = learned.robot(bump_cost).plan_to(last).paths_from(np.array([first]))[0]
    if path[-1] != last:
        raise InputError(f"no way from {start} to {goal} in the learned map", source=folder)
    chances = learned.blocked.reshape(-1)[path]
    x, y = learned.grid.centres(path).T
    lengths = np.linalg.norm(np.diff(np.stack([x, y]), axis=1), axis=0)
    summary = {
        "command": "plan",
        "start": start,
        "goal": goal,
        "bump_cost": bump_cost,
        "moves": len(path) - 1,
        "length_metres": float(lengths.sum()),
        "max_probability_blocked": float(chances.max()),
        "probability_free": float(np.prod(1 - chances)),
    }
    write_table(out / "path.csv", pa.table({"step": np.arange(len(path)), "x": x, "y": y, "blocked": chances}))
    save(figure_plan(learned.grid, learned.blocked, path), out / "path.png")
    add_to_summary(folder, out, "plan", summary)
    return summary


def _state(grid: Grid, position: Position, name: str) -> int:
    point = np.array([position], dtype=np.float64)
    if not grid.contains(point)[0]:
        raise InputError(f"{position} lies outside the map", field=name)
    state = grid.state(position)
    if grid.known.flat[state] == Cell.OCCUPIED:
        raise InputError(f"{position} lies in a known obstacle", field=name)
    return state
