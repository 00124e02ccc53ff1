"""A learned map: its numbers, a robot that plans in it, and its folder.

| file           | content                                                                          |
|----------------|----------------------------------------------------------------------------------|
| `map.yaml`, `map.pgm` | the map for ROS (`map_server`, mode raw)                                  |
| `blocked.npy`  | P(blocked) of each cell, row 0 at the top; exactly 0 or 1 where the map knew     |
| `information.npy` | what walks say of each cell, in nats; 0 where the map knew                    |
| `samples.npz`  | `blocked`: maps from the posterior, where it was sampled                         |
| `visited.npy`  | the (state, goal) pairs that the walks passed                                    |
| `posterior.csv`| P(goal) of each walk, where the walks did not name their goals                   |
| `summary.json` | settings, the final objective and its parts, convergence, time, memory           |
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._arguments import to_finite, to_floats, to_mask, to_states
from sidestep._files import read_array, read_json, write_array, write_arrays, write_json
from sidestep._repr import short_repr
from sidestep.errors import InputError, check, check_instance, check_not_negative, input_errors, to_number, to_path
from sidestep.io.maps import read_map, write_map
from sidestep.robots.planners import GoalPlan, ModelPlanner
from sidestep.robots.risk import expected_length, independent_open_probability, open_probability
from sidestep.robots.robot import BUMP_COST, risk_averse_robot
from sidestep.tabular.grid import Cell, Connectivity, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.tabular.tasks import state_at

if TYPE_CHECKING:
    import sidestep.evaluation.evaluate
    import sidestep.maps.learn

Position = tuple[float, float]

_BUMP_FACTORS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""The factors of the bump cost at which paths are planned where a risk is named."""


@short_repr()
@dataclass(frozen=True, eq=False)
class PlannedPath:
    """A path that was planned in a learned map.

    Attributes:
        states: The states along the path, the start first.
        positions: x, y of their centers in metres.
        blocked: P(blocked) of each.
        length: The length of the path in metres.
        open_probability: The probability that the path is open given that its start and goal are free: over maps from
            the posterior, or where there are none the product over its cells, as if they were independent. It is 1 for
            a path along cells that walks passed or the map knew.
        goal_blocked: P(blocked) of the goal, which the risk of the path does not contain; 0 where walks passed it.
        expected_length: The mean length in metres that the robot executes in maps from the posterior, with bumps and
            detours; None where there are none, or where it arrives in none.
        alternatives: Other paths, the shortest first, where a risk was named.
    """

    states: Int[np.ndarray, " steps"]
    positions: Float[np.ndarray, "steps 2"]
    blocked: Float[np.ndarray, " steps"]
    length: float
    open_probability: float
    goal_blocked: float
    expected_length: float | None
    alternatives: tuple["PlannedPath", ...] = ()

    def within(self, max_risk: float) -> bool:
        """Return whether the path is open with a probability of at least 1 − `max_risk`.

        Args:
            max_risk: The largest probability that the path is not open.
        """
        return self.open_probability >= 1 - to_number(max_risk, "max_risk", least=0, most=1)


@short_repr()
@dataclass(frozen=True, eq=False)
class LearnedMap:
    """A learned map.

    Attributes:
        grid: The geometry, the moves, and what was known of each cell beforehand.
        blocked: P(blocked) of each cell, row 0 at the top; exactly 0 or 1 where the map knew.
        visited: The (state, goal) pairs that the walks passed.
        reward: The reward that the agents pursued.
        learning: How the map was learned; None for a map that was loaded from a folder.
        samples: Maps from the posterior: whether each cell is blocked; None where it was not sampled.
        information: What walks say of each cell in nats (`sidestep.inference.cell_information`), 0 where the map knew;
            None where it was not computed.
        unknown_below: Cells of which walks say less than this (nats) stay unknown in maps for ROS.

    Example:
        >>> grid = Grid(np.array([[0, -1, 0]]))
        >>> learned = LearnedMap(grid, np.array([[0.0, 0.1, 0.0]]), np.array([[0, 2]]), Reward(0.95))
        >>> learned.unknown.tolist()
        [[False, True, False]]
    """

    grid: Grid
    blocked: Float[np.ndarray, "rows columns"]
    visited: Int[np.ndarray, "visits 2"]
    reward: Reward
    learning: "sidestep.maps.learn.Learning | None" = None
    samples: Bool[np.ndarray, "samples rows columns"] | None = None
    information: Float[np.ndarray, "rows columns"] | None = None
    unknown_below: float = 0.0

    def __post_init__(self) -> None:
        check_instance(self.grid, Grid, "grid")
        check_instance(self.reward, Reward, "reward")
        shape, states = self.grid.shape, self.grid.size
        arrays = {
            "blocked": to_finite(self.blocked, "blocked", shape, least=0, most=1),
            "visited": to_states(self.visited, states, "visited", ("visits", 2)),
            "unknown_below": to_number(self.unknown_below, "unknown_below", least=0),
        }
        if self.samples is not None:
            arrays["samples"] = to_mask(self.samples, "samples", ("samples", *shape))
        if self.information is not None:
            arrays["information"] = to_floats(self.information, "information", shape)
        for name, array in arrays.items():
            object.__setattr__(self, name, array)

    @property
    def unknown(self) -> Bool[np.ndarray, "rows columns"]:
        """The cells that had to be learned."""
        return self.grid.known == Cell.UNKNOWN

    @property
    def without_evidence(self) -> Bool[np.ndarray, "rows columns"]:
        """The cells that walks say too little of: less than `unknown_below`, and no walk was in them."""
        if self.information is None:
            return np.zeros(self.grid.shape, dtype=bool)
        visited = np.zeros(self.grid.size, dtype=bool)
        visited[self.visited[:, 0]] = True
        return self.unknown & (self.information < self.unknown_below) & ~visited.reshape(self.grid.shape)

    @property
    def converged(self) -> bool | None:
        """Whether the fit converged; None for a map that was loaded from a folder."""
        return None if self.learning is None else self.learning.fit.converged

    @cached_property
    def model(self) -> ObstacleGrid:
        """The transition model of the map."""
        with np.errstate(divide="ignore"):
            logits = np.log(self.blocked) - np.log1p(-self.blocked)
        return ObstacleGrid(self.grid, np.where(self.unknown, logits, 0.0).reshape(-1))

    def robot(self, bump_cost: float = BUMP_COST) -> ModelPlanner:
        """Return a robot that knows the map and where the walks went (`risk_averse_robot`).

        Args:
            bump_cost: The cost of the first bump at a place in cell sides, at least 0.
        """
        return risk_averse_robot(self.model, self.visited[:, 0], bump_cost)

    def plan(
        self, start: Position, goal: Position, *, bump_cost: float = BUMP_COST, max_risk: float | None = None
    ) -> PlannedPath:
        """Plan a path as a robot does, or the shortest path with a bounded risk.

        With `max_risk`, paths are planned at several bump costs. The shortest of those that are open with a probability
        of 1 − `max_risk` or more is chosen, or where there is none the one that is most probably open
        (`PlannedPath.within` tells). A risk of 0 allows only cells that walks passed or the map knew.

        Args:
            start: x, y in metres.
            goal: x, y in metres.
            bump_cost: As for `robot`.
            max_risk: The largest probability that the path is not open though its start and goal are free, from 0 to 1;
                None for the robot's own path.

        Returns:
            The states, positions and P(blocked) along the path, its length in metres, and its risk.

        Raises:
            InputError: For positions outside the map or in known obstacles, where there is no path, and for a risk
                outside [0, 1].
        """
        to_number(bump_cost, "bump_cost", least=0)
        if max_risk is not None:
            to_number(max_risk, "max_risk", least=0, most=1)
        first, last = state_at(self.grid, start, "start"), state_at(self.grid, goal, "goal")
        # a path that several bump costs lead to is assessed once
        plans: dict[bytes, tuple[GoalPlan, Int[np.ndarray, " steps"]]] = {}
        for factor in _BUMP_FACTORS if max_risk is not None else (1.0,):
            plan = self.robot(factor * bump_cost).plan_to(last)
            states = plan.paths_from(np.array([first]))[0]
            arrives = states[-1] == last
            check(arrives, f"expected a path from {start} to {goal} in the learned map, found none", field="goal")
            plans.setdefault(states.tobytes(), (plan, states))
        paths = sorted((self._planned(*each) for each in plans.values()), key=lambda path: path.length)
        if max_risk is None:
            return paths[0]
        sure = [path for path in paths if path.within(max_risk)]
        chosen = sure[0] if sure else max(paths, key=lambda path: path.open_probability)
        return replace(chosen, alternatives=tuple(path for path in paths if path is not chosen))

    @cached_property
    def _passed(self) -> Grid:
        """The grid in which the cells that walks passed are known to be free, as the robot knows them."""
        return replace(self.grid, known=np.asarray(self.robot().model.known).reshape(self.grid.shape))

    def _planned(self, plan: GoalPlan, states: Int[np.ndarray, " steps"]) -> PlannedPath:
        """Return a robot's path with its length and risk."""
        positions = self.grid.centers(states)
        length = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
        blocked = np.where(self._passed.known == Cell.FREE, 0.0, self.blocked)
        if self.samples is None:
            chance, metres = independent_open_probability(self.grid, states, blocked), None
        else:
            expected = expected_length(self.grid, plan, states, self.samples)
            metres = None if expected is None else expected * self.grid.resolution
            chance = open_probability(self._passed, states, self.samples)
        known, goal_blocked = self.blocked.reshape(-1)[states], float(blocked.reshape(-1)[states[-1]])
        return PlannedPath(states, positions, known, length, chance, goal_blocked, metres)

    def evaluate(
        self,
        truth: Grid,
        *,
        seed: int = 0,
        bump_cost: float = BUMP_COST,
        callback: Callable[[str, int, int], None] = lambda *_: None,
    ) -> "sidestep.evaluation.evaluate.Evaluation":
        """Score the map and the paths of its robot against the true map, as `sidestep.evaluate` does.

        Args:
            truth: The true map, of the same shape.
            seed: Draws starts and goals on maps too large for all pairs.
            bump_cost: As for `robot`.
            callback: Called with a stage, what is done of it and what there is to do.

        Returns:
            The scores of the map and of the paths.
        """
        from sidestep.evaluation.evaluate import evaluate

        return evaluate(self.robot(bump_cost), self.blocked, truth, self.unknown, self.visited, seed, callback)

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `summary.json`.

        Returns:
            Plain numbers, texts, lists and dictionaries.
        """
        reward = {"discount": self.reward.discount, "step_cost": self.reward.step_cost}
        settings = {"reward": reward, "unknown_below": self.unknown_below}
        summary = {"settings": settings} if self.learning is None else self.learning.summary()
        count = None if self.information is None else int(self.without_evidence.sum())
        return {"connectivity": self.grid.connectivity, "cells_without_evidence": count, **summary}

    def save(self, folder: str | Path, **entries: Any) -> None:
        """Write the map to a folder, each file whole, `summary.json` last.

        A learned probability is never written as exactly 0 or 1: that would say that the cell had been known.

        Args:
            folder: The folder; it is created.
            **entries: More entries of `summary.json`.

        Raises:
            InputError: Where the file system refuses.
        """
        folder, smallest = to_path(folder, "folder"), np.finfo(np.float64).epsneg
        blocked = np.where(self.unknown, np.clip(self.blocked, smallest, 1 - smallest), self.blocked)
        write_map(folder / "map.yaml", blocked, self.grid, unknown=self.without_evidence)
        write_array(folder / "blocked.npy", blocked)
        write_array(folder / "visited.npy", self.visited)
        if self.samples is not None:
            write_arrays(folder / "samples.npz", blocked=self.samples)
        if self.information is not None:
            write_array(folder / "information.npy", self.information)
        for name, array in (("samples.npz", self.samples), ("information.npy", self.information)):
            if array is None:
                (folder / name).unlink(missing_ok=True)  # of an earlier map in this folder
        if self.learning is not None and self.learning.goals is not None:
            from sidestep.maps.goal_candidates import write_goal_posterior

            write_goal_posterior(folder / "posterior.csv", self.learning.goals, self.grid)
        write_json(folder / "summary.json", {**entries, **self.summary()})


def load_map(folder: str | Path) -> LearnedMap:
    """Load a learned map from the folder that `LearnedMap.save` or `sidestep learn` has written.

    Args:
        folder: The folder.

    Returns:
        The map, without the record of how it was learned.

    Raises:
        InputError: For a file that is missing or does not fit.

    Example:
        >>> import tempfile
        >>> grid = Grid(np.array([[0, -1, 0]]))
        >>> learned = LearnedMap(grid, np.array([[0.0, 0.1, 0.0]]), np.array([[0, 2]]), Reward(0.95))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     learned.save(folder)
        ...     load_map(folder).blocked.tolist()
        [[0.0, 0.1, 0.0]]
    """
    folder = to_path(folder, "folder")
    connectivity, reward, unknown_below = _settings(folder / "summary.json")
    geometry = read_map(folder / "map.yaml", connectivity=connectivity)
    blocked = read_array(folder / "blocked.npy", kinds="f")
    fits = blocked.shape == geometry.shape and ((blocked >= 0) & (blocked <= 1)).all()
    message = f"expected probabilities in the map's shape {geometry.shape}, found shape {blocked.shape}"
    check(fits, message, source=folder / "blocked.npy")
    visited = read_array(folder / "visited.npy", kinds="iu")
    fits = visited.ndim == 2 and visited.shape[1] == 2 and ((visited >= 0) & (visited < blocked.size)).all()
    message = f"expected pairs of states in 0…{blocked.size - 1}, found shape {visited.shape}"
    check(fits, message, source=folder / "visited.npy")
    known = np.where(blocked == 0, Cell.FREE, np.where(blocked == 1, Cell.OCCUPIED, Cell.UNKNOWN))
    grid = replace(geometry, known=known.astype(np.int64))
    return LearnedMap(
        grid,
        blocked.astype(np.float64),
        visited.astype(np.int64),
        reward,
        samples=_read_samples(folder / "samples.npz", geometry.shape),
        information=_read_information(folder / "information.npy", geometry.shape),
        unknown_below=unknown_below,
    )


def _read_information(path: Path, shape: tuple[int, int]) -> Float[np.ndarray, "rows columns"] | None:
    if not path.exists():  # of an earlier version, or made without
        return None
    nats = read_array(path, kinds="f").astype(np.float64)
    message = f"expected numbers of at least 0 in the map's shape {shape}, found shape {nats.shape}"
    check(nats.shape == shape and (nats >= 0).all(), message, source=path)
    return nats


def _read_samples(path: Path, shape: tuple[int, int]) -> Bool[np.ndarray, "samples rows columns"] | None:
    if not path.exists():
        return None
    samples = read_array(path, kinds="b", name="blocked")
    message = f"expected maps of shape {shape}, found an array of shape {samples.shape}"
    check(samples.ndim == 3 and len(samples) and samples.shape[1:] == shape, message, source=path, field="blocked")
    return samples


def add_to_summary(folder: Path, out: Path, key: str | None, summary: dict[str, Any]) -> None:
    """Write the summary of a later step to `out`; into that of the learned map where this is the same folder.

    Args:
        folder: The folder of the learned map.
        out: The folder to write to.
        key: The entry of the learned map's summary; None for its top level.
        summary: The summary of the step.
    """
    path = out / "summary.json"
    if out.resolve() == folder.resolve():
        summary = {**read_json(path), **(summary if key is None else {key: summary})}
    write_json(path, summary)


def _settings(path: Path) -> tuple[Connectivity, Reward, float]:
    """Read the connectivity and the reward that a map was learned with, and below what cells are unknown."""
    summary = read_json(path)
    message = "expected connectivity and settings.reward with discount and step_cost, as `sidestep learn` writes"
    with input_errors(message, KeyError, TypeError, ValueError, source=path):
        connectivity, reward = summary["connectivity"], summary["settings"]["reward"]
        discount = float(reward["discount"])
        step_cost = None if reward["step_cost"] is None else float(reward["step_cost"])
        unknown_below = float(summary["settings"].get("unknown_below", 0.0))  # absent in earlier versions
    check(connectivity in (4, 8), f"expected 4 or 8, found {connectivity!r}", source=path, field="connectivity")
    check(0 < discount <= 1, f"expected a number in (0, 1], found {discount}", source=path, field="discount")
    positive = step_cost is None or 0 < step_cost < np.inf
    check(positive, f"expected a number above 0, found {step_cost}", source=path, field="step_cost")
    with input_errors("expected the threshold of unknown cells", InputError, source=path):
        check_not_negative(unknown_below, "unknown_below")
    return connectivity, Reward(discount, step_cost), unknown_below
