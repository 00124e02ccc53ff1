"""How good a learned map is: its cells and the paths planned in it, against the truth.

`scoring` compares arrays and paths; here the paths are planned, between all pairs of free cells where the map is
small and between sampled ones where it is large.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from sidestep.scoring import path_lengths, relevant_obstacles, score_map, score_paths
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, TransitionModel
from sidestep.tabular.planning import plan
from sidestep.tabular.solvers.process import reachable
from sidestep.tasks import Task, reach

MOST_PLACES = 150
"""The most starts, and the most goals, that paths are planned between; on larger maps they are drawn at random."""
MOST_FOLLOWED = 200
"""The most paths with bumps that are followed to the end for the regret."""


@dataclass(frozen=True)
class Reward:
    """The reward that planned paths pursue: `discount` and `step_cost` as in `reach`."""

    discount: float = 0.95
    step_cost: float | None = None

    def reach(self, grid: Grid, goal: int) -> Task:
        """The task of reaching a state."""
        return reach(grid, goal, discount=self.discount, step_cost=self.step_cost)


def evaluate(
    model: ObstacleGrid,
    truth: Grid,
    scored: Bool[np.ndarray, "rows columns"],
    visited: Int[np.ndarray, "visits 2"],
    reward: Reward,
    seed: int = 0,
) -> Mapping[str, float | None]:
    """All scores of a learned map, by name: those of `scoring.MapScores` and `scoring.PathScores`, and `regret`.

    - `scored`: the cells that had to be learned.
    - `visited`: (state, goal) of the moves that were learned from; they tell which obstacles matter.
    - `reward`: what planned paths pursue. `seed` draws their starts and goals on maps too large for all pairs.

    The regret is by how much a robot that follows the plans goes farther than the shortest way, on average and in cell
    sides: where it bumps into something it stays, having gone the length of the move, notes the obstacle and plans
    again. Values are `None` where there is nothing to average; the regret also where the map is so wrong about cells
    that it takes for known that the robot never arrives.
    """
    blocked = np.asarray(model.blocked, dtype=np.float64)
    relevant = relevant_obstacles(truth, visited[:, 0], visited[:, 1])
    # nobody can plan to where the learned map is known to be occupied, whatever the truth says
    free = np.flatnonzero((truth.known == Cell.FREE) & (blocked < 1))
    random = np.random.default_rng(seed)
    starts, goals = (_some(free, MOST_PLACES, random) for _ in range(2))
    paths, path_goals = plan_paths(model, truth, starts, goals, reward)
    return {
        **asdict(score_map(blocked, truth, scored, relevant)),
        **asdict(score_paths(paths, path_goals, truth)),
        "regret": _regret(model, paths, path_goals, truth, reward, random),
    }


def _some(states: Int[np.ndarray, " states"], most: int, random: np.random.Generator) -> Int[np.ndarray, " some"]:
    return np.sort(random.choice(states, most, replace=False)) if len(states) > most else states


def _regret(
    model: ObstacleGrid,
    paths: Sequence[Int[np.ndarray, " _"]],
    goals: Int[np.ndarray, " paths"],
    truth: Grid,
    reward: Reward,
    random: np.random.Generator,
) -> float | None:
    """The mean over all pairs that have a way; of paths that are not legal, a sample is followed."""
    lengths, shortest = path_lengths(paths, goals, truth)
    possible = np.isfinite(shortest)
    if not possible.any():
        return None
    legal = possible & np.isfinite(lengths)
    bumping = np.flatnonzero(possible & ~legal)
    followed = [
        length_with_bumps(model, truth, int(paths[index][0]), int(goals[index]), reward) - shortest[index]
        for index in _some(bumping, MOST_FOLLOWED, random)
    ]
    total = np.sum(lengths[legal] - shortest[legal]) + (len(bumping) * np.mean(followed) if followed else 0.0)
    return float(total / possible.sum()) if np.isfinite(total) else None


def length_with_bumps(model: ObstacleGrid, truth: Grid, start: int, goal: int, reward: Reward) -> float:
    """How far a robot goes in the true world that plans in a learned map, and again whenever it bumps into something.

    In cell sides, with moves that failed; infinite if it never arrives because the learned map is sure of an obstacle
    that is not there.
    """
    needed, walls = moves_into(truth), np.append(truth.known.reshape(-1) != Cell.FREE, False)
    change, task = truth.steps, reward.reach(truth.forget(), goal)
    known, here, length = np.array(model.known), start, 0.0
    for _ in range(1 + int(walls.sum())):
        planned = plan(eqx.tree_at(lambda model: model.known, model, jnp.asarray(known)), task)
        if not bool(reachable(planned.solution.values[here])):
            return np.inf
        for after in planned.path_from(here)[1:]:
            step = np.array(np.divmod(after, truth.shape[1])) - np.divmod(here, truth.shape[1])
            action = int(np.flatnonzero((change == step).all(axis=1))[0])
            length += float(np.linalg.norm(step))
            bumped = [cell for cell in needed[here, action] if walls[cell]]
            if bumped:
                known.flat[bumped] = Cell.OCCUPIED
                break
            here = int(after)
        else:
            return length if here == goal else np.inf
    return np.inf


def plan_paths(
    model: TransitionModel,
    grid: Grid,
    starts: Int[np.ndarray, " starts"],
    goals: Int[np.ndarray, " goals"],
    reward: Reward,
) -> tuple[Sequence[Int[np.ndarray, " _"]], Int[np.ndarray, " paths"]]:
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
) -> list[Int[np.ndarray, " _"]]:
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
