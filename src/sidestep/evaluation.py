"""How good a learned map is: its cells and the paths planned in it, against the truth.

`scoring` compares arrays and paths; here the paths are planned, between all pairs of free cells where the map is
small and between sampled ones where it is large.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from sidestep.replanning import lengths_with_bumps, world_of
from sidestep.scoring import (
    path_lengths,
    relevant_obstacles,
    score_lengths,
    score_map,
    shortest_lengths,
    walkable_graph,
)
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, TransitionModel
from sidestep.tabular.planning import plan
from sidestep.tasks import Task, reach

MOST_PLACES = 150
"""The most starts, and the most goals, that paths are planned between; on larger maps they are drawn at random."""
MOST_FOLLOWED = 200
"""The most paths with bumps that are followed to the end for the regret."""
MOST_CELLS = 40_000_000
"""The most cells, of all goals' plans together: on maps of more than 200,000 cells fewer paths are planned."""
FEWEST = 10
"""The fewest goals, and the fewest paths with bumps, whatever the map."""

Report = Callable[[str, int, int], None]
"""Is told what is being done, how much of it is done, and how much there is to do."""


@dataclass(frozen=True)
class Reward:
    """The reward that planned paths pursue: `discount` and `step_cost` as in `reach`."""

    discount: float = 0.95
    step_cost: float | None = None

    def reach(self, grid: Grid, goal: int) -> Task:
        """The task of reaching a state."""
        return reach(grid, goal, discount=self.discount, step_cost=self.step_cost)


class Sample(NamedTuple):
    """How many starts and goals paths are planned between, and how many paths with bumps are followed, at most."""

    starts: int
    goals: int
    followed: int


def sample_for(cells: int) -> Sample:
    """How many on a map of so many cells: a plan takes time in proportion to them, a start hardly any.

    >>> sample_for(10_000)
    Sample(starts=150, goals=150, followed=200)
    """
    plans = max(FEWEST, MOST_CELLS // cells)
    return Sample(MOST_PLACES, min(MOST_PLACES, plans), min(MOST_FOLLOWED, plans))


class _Pairs(NamedTuple):
    """Starts and goals (states) with a way between them, by ascending goal, and the length of the shortest one."""

    starts: Int[np.ndarray, " pairs"]
    goals: Int[np.ndarray, " pairs"]
    shortest: Float[np.ndarray, " pairs"]


def evaluate(
    model: ObstacleGrid,
    truth: Grid,
    scored: Bool[np.ndarray, "rows columns"],
    visited: Int[np.ndarray, "visits 2"],
    reward: Reward,
    seed: int = 0,
    report: Report = lambda *_: None,
    ranking: Float[np.ndarray, "rows columns"] | None = None,
) -> Mapping[str, float | None]:
    """All scores of a learned map, by name: those of `scoring.MapScores` and `scoring.PathScores`, and `regret`.

    - `scored`: the cells that had to be learned.
    - `visited`: (state, goal) of the moves that were learned from; they tell which obstacles matter.
    - `ranking`: what cells are ranked by, higher for obstacles, where that is not the model's P(blocked).
    - `reward`: what planned paths pursue. `seed` draws their starts and goals on maps too large for all pairs (see
      `sample_for`).

    The regret is by how much a robot that follows the plans goes farther than the shortest way, on average and in cell
    sides: where it bumps into something it stays, having gone the length of the move, notes the obstacle and plans
    again. Values are `None` where there is nothing to average; the regret also where the map is so wrong about cells
    that it takes for known that the robot never arrives.
    """
    report("finding the obstacles that matter", 0, 1)
    blocked = np.asarray(model.blocked, dtype=np.float64)
    relevant = relevant_obstacles(truth, visited[:, 0], visited[:, 1])
    report("finding the obstacles that matter", 1, 1)
    # nobody can plan to where the learned map is known to be occupied, whatever the truth says
    free = np.flatnonzero((truth.known == Cell.FREE) & (blocked < 1))
    random, sample = np.random.default_rng(seed), sample_for(truth.size)
    graph = walkable_graph(truth)
    pairs = _pairs_with_a_way(_some(free, sample.starts, random), _some(free, sample.goals, random), graph)
    lengths = _planned_lengths(model, pairs, truth, graph, reward, report)
    return {
        **asdict(score_map(blocked if ranking is None else ranking, truth, scored, relevant)),
        **asdict(score_lengths(lengths, pairs.shortest)),
        "regret": _regret(model, pairs, lengths, truth, reward, sample.followed, random, report),
    }


def _some(states: Int[np.ndarray, " states"], most: int, random: np.random.Generator) -> Int[np.ndarray, " some"]:
    return np.sort(random.choice(states, most, replace=False)) if len(states) > most else states


def _pairs_with_a_way(starts: Int[np.ndarray, " starts"], goals: Int[np.ndarray, " goals"], graph: csr_array) -> _Pairs:
    """All pairs of a start and another place as the goal that the graph has a way between."""
    own_starts, own_goals = np.tile(starts, len(goals)), np.repeat(goals, len(starts))
    shortest = shortest_lengths(graph, own_starts, own_goals)
    kept = np.isfinite(shortest) & (own_starts != own_goals)
    return _Pairs(own_starts[kept], own_goals[kept], shortest[kept])


def _planned_lengths(
    model: ObstacleGrid, pairs: _Pairs, truth: Grid, graph: csr_array, reward: Reward, report: Report
) -> Float[np.ndarray, " pairs"]:
    """The lengths of the paths planned between pairs, infinite for those that are not legal.

    Only the paths to one goal are held at a time: all together may take gigabytes.
    """
    geometry, lengths = truth.forget(), np.full(len(pairs.goals), np.inf)
    goals = np.unique(pairs.goals)
    for done, goal in enumerate(goals):
        report(_PLANNING, done, len(goals))
        own = pairs.goals == goal
        paths = plan(model, reward.reach(geometry, int(goal))).follow(pairs.starts[own])
        lengths[own] = path_lengths(graph, paths, pairs.goals[own])
    report(_PLANNING, len(goals), len(goals))
    return lengths


_PLANNING, _FOLLOWING = "planning to goals", "following paths that bump"


def _regret(
    model: ObstacleGrid,
    pairs: _Pairs,
    lengths: Float[np.ndarray, " pairs"],
    truth: Grid,
    reward: Reward,
    most: int,
    random: np.random.Generator,
    report: Report,
) -> float | None:
    """The mean over all pairs; of paths that are not legal, a sample is followed."""
    if not len(lengths):
        return None
    legal = np.isfinite(lengths)
    bumping = np.flatnonzero(~legal)
    followed = _some(bumping, most, random)
    excess = _followed_lengths(model, pairs, followed, truth, reward, report) - pairs.shortest[followed]
    total = np.sum(lengths[legal] - pairs.shortest[legal]) + (len(bumping) * excess.mean() if len(excess) else 0.0)
    return float(total / len(lengths)) if np.isfinite(total) else None


def _followed_lengths(
    model: ObstacleGrid,
    pairs: _Pairs,
    followed: Int[np.ndarray, " followed"],
    truth: Grid,
    reward: Reward,
    report: Report,
) -> Float[np.ndarray, " followed"]:
    """How far a robot goes between some of the pairs; those to the same goal share the plan that it sets out with."""
    world, geometry, lengths = world_of(truth), truth.forget(), np.zeros(len(followed))
    goals = pairs.goals[followed]
    for goal in np.unique(goals):
        report(_FOLLOWING, int((goals < goal).sum()), len(followed))
        task = reward.reach(geometry, int(goal))
        lengths[goals == goal] = lengths_with_bumps(
            model, world, task, int(goal), pairs.starts[followed][goals == goal]
        )
    report(_FOLLOWING, len(followed), len(followed))
    return lengths


def plan_paths(
    model: TransitionModel,
    grid: Grid,
    starts: Int[np.ndarray, " starts"],
    goals: Int[np.ndarray, " goals"],
    reward: Reward,
) -> tuple[Sequence[Int[np.ndarray, " _"]], Int[np.ndarray, " paths"]]:
    """The optimal paths under a model from every start to every other goal, and the goal of each.

    A path that never arrives ends before the first state that would repeat. Raises `NotConverged` if a plan's values
    did not converge.
    """
    geometry = grid.forget()
    paths, path_goals = [], []
    for goal in goals:
        others = starts[starts != goal]
        paths += plan(model, reward.reach(geometry, int(goal))).follow(others)
        path_goals += [int(goal)] * len(others)
    return paths, np.asarray(path_goals, dtype=np.int64)
