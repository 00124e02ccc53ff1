"""How good a learned map is: its cells and the paths planned in it, against the truth.

`scoring` compares arrays and paths; here the paths are planned, between all pairs of free cells where the map is
small and between sampled ones where it is large.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.scoring import relevant_obstacles, score_map, score_paths
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.planning import plan
from sidestep.tasks import Task, reach

MOST_PLACES = 150
"""The most starts, and the most goals, that paths are planned between; on larger maps they are drawn at random."""


@dataclass(frozen=True)
class Reward:
    """The reward that planned paths pursue: `discount` and `step_cost` as in `reach`."""

    discount: float = 0.95
    step_cost: float | None = None

    def reach(self, grid: Grid, goal: int) -> Task:
        """The task of reaching a state."""
        return reach(grid, goal, discount=self.discount, step_cost=self.step_cost)


def evaluate(
    model: TransitionModel,
    blocked: Float[np.ndarray, "rows columns"],
    truth: Grid,
    scored: Bool[np.ndarray, "rows columns"],
    visited: Int[np.ndarray, "visits 2"],
    reward: Reward,
    seed: int = 0,
) -> Mapping[str, float | None]:
    """All scores of a learned map, by name (see `scoring.MapScores` and `scoring.PathScores`).

    - `model`, `blocked`: the learned model and its P(blocked).
    - `scored`: the cells that had to be learned.
    - `visited`: (state, goal) of the moves that were learned from; they tell which obstacles matter.
    - `reward`: what planned paths pursue. `seed` draws their starts and goals on maps too large for all pairs.

    Values are `None` where there is nothing to average.
    """
    relevant = relevant_obstacles(truth, visited[:, 0], visited[:, 1])
    free = np.flatnonzero(truth.known == Cell.FREE)
    # where the learned map is known to be occupied nobody can plan to, whatever the truth says
    free = free[blocked.reshape(-1)[free] < 1]
    random = np.random.default_rng(seed)
    places = [
        np.sort(random.choice(free, MOST_PLACES, replace=False)) if len(free) > MOST_PLACES else free for _ in range(2)
    ]
    paths, goals = plan_paths(model, truth, places[0], places[1], reward)
    return {
        **asdict(score_map(blocked, truth, scored, relevant)),
        **asdict(score_paths(paths, goals, truth)),
    }


def plan_paths(
    model: TransitionModel,
    grid: Grid,
    starts: Int[np.ndarray, " starts"],
    goals: Int[np.ndarray, " goals"],
    reward: Reward,
) -> tuple[Sequence[Int[np.ndarray, " steps"]], Int[np.ndarray, " paths"]]:
    """The optimal paths under a model from every start to every other goal, and the goal of each.

    A path that never arrives ends where the plan leads nowhere new or after as many moves as there are states. Raises
    `NotConverged` if a plan's values did not converge.
    """
    geometry = grid.forget()
    paths, path_goals = [], []
    for goal in goals:
        others = starts[starts != goal]
        intended = np.asarray(plan(model, reward.reach(geometry, int(goal))).intended)
        paths += _followed(intended, others, int(goal))
        path_goals += [int(goal)] * len(others)
    return paths, np.asarray(path_goals, dtype=np.int64)


def _followed(
    intended: Int[np.ndarray, " states"], starts: Int[np.ndarray, " starts"], goal: int
) -> list[Int[np.ndarray, " steps"]]:
    """The paths from all starts, moved on together until all are at the goal or stand still."""
    visited = [starts]
    while len(visited) <= len(intended):
        here = visited[-1]
        after = np.where(here == goal, goal, intended[here])
        if (after == here).all():
            break
        visited.append(after)
    together = np.stack(visited, axis=1)
    lengths = np.where((together == goal).any(axis=1), (together == goal).argmax(axis=1) + 1, together.shape[1])
    return [path[:length] for path, length in zip(together, lengths, strict=True)]
