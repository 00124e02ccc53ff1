"""`sidestep learn --candidates`: walks that do not name their goals, each with a posterior over candidates."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from sidestep.errors import InputError
from sidestep.inference.fit import Fit
from sidestep.inference.goals import GoalFit, fit_goals
from sidestep.inference.maximize import Progress
from sidestep.inference.priors import Normal
from sidestep.io.demonstrations import connected_regions
from sidestep.io.gridding import Moves
from sidestep.io.tables import check_columns, finite_column, read_table, write_table
from sidestep.maps.config import Settings, fit_map
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import reach


class GoalPosterior(NamedTuple):
    """What was learned of walks without goals.

    - `found`: the model, and P(g | walk) for each of `walks` and `candidates`.
    - `walks`: those that moved at all. `candidates`: states.
    - `moves`: theirs, with the most probable goal of each.
    """

    found: GoalFit[ObstacleGrid]
    walks: Int[np.ndarray, " walks"]
    candidates: Int[np.ndarray, " candidates"]
    moves: Moves

    @property
    def fit(self) -> Fit[ObstacleGrid]:
        """The last fit."""
        return self.found.fit

    def told(self) -> dict[str, Any]:
        """For a summary."""
        return {
            "candidates": len(self.candidates),
            "shares": self.found.shares.tolist(),
            "surely_known": float((self.found.posterior.max(axis=1) > _SURELY).mean()),
            "evidence": list(self.found.evidence),
            "converged": self.found.converged,
        }


_SURELY = 0.9
"""A goal is surely known where its posterior is above this."""


def read_candidates(path: Path, grid: Grid, moves: Moves) -> Int[np.ndarray, " candidates"]:
    """The states of the goals that a table names, in metres: `goal_x`, `goal_y`.

    Raises `InputError`, with the row, for places outside the map, in known obstacles or walled off by these from where
    some move was made, and for a cell named twice.
    """
    table = read_table(path)
    check_columns(table, ("goal_x", "goal_y"), str(path))
    places = np.stack([finite_column(table, name, str(path)) for name in ("goal_x", "goal_y")], axis=1)
    if len(places) < 2:
        raise InputError(f"expected at least 2 candidates, found {len(places)}", source=path)
    _refuse(~grid.contains(places), path, "expected a place on the map")
    states = grid.states(places)
    _refuse(grid.known.reshape(-1)[states] == Cell.OCCUPIED, path, "expected a place outside known obstacles")
    part = connected_regions(grid)
    _refuse(~(part[states][:, None] == part[moves.states]).all(axis=1), path, "expected a place that all can reach")
    first = np.unique(states, return_index=True)[1]
    _refuse(~np.isin(np.arange(len(states)), first), path, "expected a cell of its own for every candidate")
    return states


def _refuse(bad: np.ndarray, path: Path, expected: str) -> None:
    if bad.any():
        raise InputError(expected, source=path, row=int(np.argmax(bad)) + 1, field="goal_x, goal_y")


def fit_candidates(
    model: ObstacleGrid,
    grid: Grid,
    moves: Moves,
    candidates: Int[np.ndarray, " candidates"],
    settings: Settings,
    prior: Normal | None = None,
    report: Callable[[Progress], None] | None = None,
) -> GoalPosterior:
    """The map and the goals that make walks most probable, by expectation maximisation (`sidestep.inference.goals`).

    `report` is told of every round's fit. Raises `InputError` as `fit_goals` does.
    """
    walks = np.unique(moves.walk)
    tasks = [reach(grid, int(state), discount=settings.discount, step_cost=settings.step_cost) for state in candidates]

    def learn(present: ObstacleGrid, shown: Demonstrations) -> Fit[ObstacleGrid]:
        return fit_map(present, shown, settings, report, each=prior, afresh=present is model)

    found = fit_goals(model, moves.trajectories(), tasks, settings.behavior(), learn)
    goals = moves.goals.copy()
    goals[walks] = candidates[found.posterior.argmax(axis=1)]
    return GoalPosterior(found, walks, candidates, replace(moves, goals=goals))


def write_posterior(path: Path, guessed: GoalPosterior, labels: list[object], grid: Grid) -> None:
    """A table of `walk, goal_x, goal_y, probability`: a row for every walk and candidate."""
    count, places = len(guessed.candidates), grid.centres(guessed.candidates)
    own = [labels[walk] for walk in np.repeat(guessed.walks, count).tolist()]
    goal_x, goal_y = np.tile(places, (len(guessed.walks), 1)).T
    columns = {"walk": own, "goal_x": goal_x, "goal_y": goal_y, "probability": guessed.found.posterior.ravel()}
    write_table(path, pa.table(columns))
