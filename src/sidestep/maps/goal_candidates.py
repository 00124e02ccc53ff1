"""Walks that do not name their goals: candidates, and a posterior over them for each walk."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._arguments import to_finite
from sidestep.errors import check, to_path
from sidestep.inference.fit import Fit
from sidestep.inference.goals import GoalFit, fit_goals
from sidestep.inference.maximize import Progress
from sidestep.io.demonstrations import connected_regions
from sidestep.io.gridding import Moves
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import behavior_of, fit_map
from sidestep.maps.sensors import SensorMap
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid

_CERTAIN = 0.9
"""The posterior probability above which a goal counts as certain."""


@dataclass(frozen=True, eq=False)
class GoalCandidates:
    """The goals that walks may have had.

    Attributes:
        positions: x, y of each candidate in metres, two candidates at least.
        source: The file, for error messages.

    Example:
        >>> len(GoalCandidates(np.array([[0.5, 0.5], [2.5, 0.5]])).positions)
        2
    """

    positions: Float[np.ndarray, "candidates 2"]
    source: str = "goal candidates"

    def __post_init__(self) -> None:
        positions = to_finite(self.positions, "positions", ("candidates", 2))
        message = f"expected at least 2 candidates, found {len(positions)}"
        check(len(positions) > 1, message, source=self.source)
        object.__setattr__(self, "positions", positions)


class GoalPosterior(NamedTuple):
    """A posterior over the goal of each walk.

    Attributes:
        fit: The model, and P(goal | walk).
        walks: The index of each walk that moves.
        candidates: The states of the candidates.
        moves: The moves, with the most probable goal of each walk.
        labels: The label of each of `walks`.
    """

    fit: GoalFit[ObstacleGrid]
    walks: Int[np.ndarray, " walks"]
    candidates: Int[np.ndarray, " candidates"]
    moves: Moves
    labels: list[object]

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `summary.json`."""
        return {
            "candidates": len(self.candidates),
            "probabilities": self.fit.goal_probabilities.tolist(),
            "fraction_certain": float((self.fit.posterior.max(axis=1) > _CERTAIN).mean()),
            "evidence": list(self.fit.log_likelihoods),
            "converged": self.fit.converged,
        }


def read_goal_candidates(path: str | Path) -> GoalCandidates:
    """Read a table with columns `goal_x`, `goal_y` in metres, one row a candidate.

    Args:
        path: A CSV or Parquet file.

    Returns:
        Two positions or more, in the order of the rows.

    Raises:
        InputError: For columns that are missing or not finite, and fewer than two rows.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "goals.csv"
        ...     _ = path.write_text("goal_x,goal_y\\n0.5,0.5\\n2.5,0.5\\n")
        ...     read_goal_candidates(path).positions.tolist()
        [[0.5, 0.5], [2.5, 0.5]]
    """
    from sidestep.io.tables import check_columns, finite_column, read_table

    table = read_table(to_path(path))
    check_columns(table, ("goal_x", "goal_y"), str(path))
    positions = np.stack([finite_column(table, name, str(path)) for name in ("goal_x", "goal_y")], axis=1)
    return GoalCandidates(positions, str(path))


def candidate_states(candidates: GoalCandidates, grid: Grid, moves: Moves) -> Int[np.ndarray, " candidates"]:
    """Return the states of candidates on a grid.

    Args:
        candidates: Their positions.
        grid: The map.
        moves: The moves of all walks.

    Raises:
        InputError: With the row, for positions outside the map, in known obstacles or separated by these from a
            move, and for a cell named twice.
    """
    positions = candidates.positions
    _refuse(~grid.contains(positions), candidates, "expected a position on the map")
    states = grid.states(positions)
    _refuse(grid.known.reshape(-1)[states] == Cell.OCCUPIED, candidates, "expected a position outside known obstacles")
    part = connected_regions(grid)
    separated = ~(part[states][:, None] == part[moves.states]).all(axis=1)
    _refuse(separated, candidates, "expected a position that every walk can reach")
    first = np.unique(states, return_index=True)[1]
    repeated = ~np.isin(np.arange(len(states)), first)
    _refuse(repeated, candidates, "expected a cell of its own for every candidate")
    return states


def _refuse(bad: Bool[np.ndarray, " candidates"], candidates: GoalCandidates, expected: str) -> None:
    check(not bad.any(), expected, source=candidates.source, row=int(np.argmax(bad)) + 1, field="goal_x, goal_y")


def fit_with_unknown_goals(
    model: ObstacleGrid,
    grid: Grid,
    moves: Moves,
    candidates: GoalCandidates,
    labels: list[object],
    config: MapConfig,
    sensor: SensorMap | None = None,
    callback: Callable[[Progress], None] | None = None,
) -> GoalPosterior:
    """Fit a map and the goals of walks by expectation maximization (`sidestep.inference.goals`).

    Args:
        model: The model from which the fit starts.
        grid: The grid.
        moves: The moves of all walks.
        candidates: The goals that walks may have had.
        labels: The label of every walk.
        config: The configuration.
        sensor: What sensors saw of unknown cells.
        callback: Called with the progress of every iteration of every fit.

    Returns:
        The map, and the posterior over the goal of each walk.

    Raises:
        InputError: As `candidate_states` and `fit_goals` do.
    """
    states = candidate_states(candidates, grid, moves)
    walks = np.unique(moves.walk)
    tasks = [config.reward.reach(grid, int(state)) for state in states]

    def learn(current: ObstacleGrid, demonstrations: Demonstrations) -> Fit[ObstacleGrid]:
        first = current is model
        return fit_map(current, demonstrations, config, sensor=sensor, initialize=first, callback=callback)

    result = fit_goals(model, moves.trajectories(), tasks, behavior_of(config), learn)
    goals = moves.goals.copy()
    goals[walks] = states[result.posterior.argmax(axis=1)]
    return GoalPosterior(result, walks, states, replace(moves, goals=goals), [labels[walk] for walk in walks.tolist()])


def write_goal_posterior(path: Path, posterior: GoalPosterior, grid: Grid) -> None:
    """Write a table of `walk, goal_x, goal_y, probability`, one row for each walk and candidate.

    Args:
        path: A CSV or Parquet file.
        posterior: The posterior.
        grid: The map, for the positions of candidates.
    """
    import pyarrow as pa

    from sidestep.io.tables import write_table

    count, positions = len(posterior.candidates), grid.centers(posterior.candidates)
    goal_x, goal_y = np.tile(positions, (len(posterior.walks), 1)).T
    labels = [label for label in posterior.labels for _ in range(count)]
    probability = posterior.fit.posterior.ravel()
    write_table(path, pa.table({"walk": labels, "goal_x": goal_x, "goal_y": goal_y, "probability": probability}))
