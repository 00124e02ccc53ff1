"""Learned maps on disk: the folder that `sidestep learn` writes and that `plan` and `evaluate` read.

| file           | what it holds                                                                            |
|----------------|------------------------------------------------------------------------------------------|
| `map.yaml`, `map.pgm` | the learned map for ROS (`map_server`, mode scale)                                 |
| `blocked.npy`  | P(blocked) of each cell, row 0 at the top; exactly 0 or 1 where the map knew             |
| `visited.npy`  | the (state, goal) pairs of all that people passed whose walks it was learned from        |
| `summary.json` | settings, the final objective and its parts, the convergence of every task, time, memory |
| `learned.png`  | the picture                                                                              |
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._files import read_array, read_json, write_array, write_json
from sidestep.errors import InputError
from sidestep.io.maps import read_map, write_map
from sidestep.robots.planners import ModelPlanner
from sidestep.robots.robot import BUMP_COST, risk_averse_robot
from sidestep.tabular.grid import Cell, Connectivity, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import Reward


@dataclass(frozen=True, eq=False)
class LearnedMap:
    """A learned map with what later steps need to know of how it was learned.

    - `grid`: geometry and moves, and what was known beforehand.
    - `blocked`: P(blocked), exactly 0 or 1 where the map knew.
    - `visited`: the (state, goal) pairs of all that people passed whose walks it was learned from.
    - `reward`: what the walkers were taken to pursue.
    """

    grid: Grid
    blocked: Float[np.ndarray, "rows columns"]
    visited: Int[np.ndarray, "visits 2"]
    reward: Reward

    @property
    def unknown(self) -> Bool[np.ndarray, "rows columns"]:
        """The cells that had to be learned."""
        return self.grid.known == Cell.UNKNOWN

    def model(self) -> ObstacleGrid:
        """The transition model of the learned map."""
        with np.errstate(divide="ignore"):
            logits = np.log(self.blocked) - np.log1p(-self.blocked)
        return ObstacleGrid(self.grid, np.where(self.unknown, logits, 0.0).reshape(-1))

    def robot(self, bump_cost: float = BUMP_COST) -> ModelPlanner:
        """Who knows the learned map, and where people walked (see `sidestep.robots.robot`)."""
        return risk_averse_robot(self.model(), self.visited[:, 0], bump_cost)


def write_learned_map(folder: Path, learned: LearnedMap, summary: dict[str, Any]) -> None:
    """Writes the numbers of a learned map, each file whole or not at all, `summary.json` last.

    What is learned is never written as exactly 0 or 1, which would say that it had been known.
    """
    smallest = np.finfo(np.float64).epsneg
    blocked = np.where(learned.unknown, np.clip(learned.blocked, smallest, 1 - smallest), learned.blocked)
    write_map(folder / "map.yaml", blocked, learned.grid)
    write_array(folder / "blocked.npy", blocked)
    write_array(folder / "visited.npy", learned.visited)
    write_json(folder / "summary.json", summary)


def add_to_summary(folder: Path, out: Path, key: str | None, summary: dict[str, Any]) -> None:
    """Writes the summary of a later step to `out`; into the learned map's own where that is the same folder.

    There it stands under `key`, or at the top level without one.
    """
    path = out / "summary.json"
    if out.resolve() == folder.resolve():
        summary = {**read_json(path), **(summary if key is None else {key: summary})}
    write_json(path, summary)


def read_learned_map(folder: Path | str) -> LearnedMap:
    """A learned map back from its folder; raises `InputError` for a file that is missing or does not fit."""
    folder = Path(folder)
    connectivity, reward = _settings(folder / "summary.json")
    geometry = read_map(folder / "map.yaml", connectivity=connectivity)
    blocked = read_array(folder / "blocked.npy", kinds="f")
    if blocked.shape != geometry.shape or not ((blocked >= 0) & (blocked <= 1)).all():
        raise InputError(
            f"expected probabilities in the map's shape {geometry.shape}, found shape {blocked.shape}",
            source=folder / "blocked.npy",
        )
    visited = read_array(folder / "visited.npy", kinds="iu")
    if visited.ndim != 2 or visited.shape[1] != 2 or not ((visited >= 0) & (visited < blocked.size)).all():
        raise InputError(
            f"expected pairs of states in 0…{blocked.size - 1}, found shape {visited.shape}",
            source=folder / "visited.npy",
        )
    known = np.where(blocked == 0, Cell.FREE, np.where(blocked == 1, Cell.OCCUPIED, Cell.UNKNOWN))
    return LearnedMap(
        replace(geometry, known=known.astype(np.int64)),
        blocked.astype(np.float64),
        visited.astype(np.int64),
        reward,
    )


def _settings(path: Path) -> tuple[Connectivity, Reward]:
    """The connectivity and the reward that a map was learned with, from its summary."""
    summary = read_json(path)
    settings = summary.get("settings") if isinstance(summary, dict) else None
    if not isinstance(settings, dict) or not {"connectivity", "discount", "step_cost"} <= set(settings):
        raise InputError(
            "expected settings with connectivity, discount and step_cost, as `sidestep learn` writes them", source=path
        )
    if settings["connectivity"] not in (4, 8):
        raise InputError(f"expected 4 or 8, found {settings['connectivity']!r}", source=path, field="connectivity")
    discount, step_cost = settings["discount"], settings["step_cost"]
    if not isinstance(discount, int | float) or not 0 < discount <= 1:
        raise InputError(f"expected a number above 0 and at most 1, found {discount!r}", source=path, field="discount")
    if step_cost is not None and not (isinstance(step_cost, int | float) and 0 < step_cost < np.inf):
        raise InputError(f"expected a number above 0, found {step_cost!r}", source=path, field="step_cost")
    return settings["connectivity"], Reward(float(discount), None if step_cost is None else float(step_cost))
