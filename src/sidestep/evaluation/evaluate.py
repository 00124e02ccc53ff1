"""How good a learned map is: its cells and the paths planned in it, against the truth.

`scoring` compares arrays and paths; here the paths are planned, between all pairs of free cells where the map is
small and between sampled ones where it is large. What has no map, but says what to do, is scored by its paths alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from sidestep.evaluation.metrics import (
    MapScores,
    path_lengths,
    relevant_obstacles,
    score_lengths,
    score_map,
    shortest_lengths,
)
from sidestep.robots.planners import Planner
from sidestep.robots.replanning import world_of
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid

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
    planner: Planner,
    ranking: Float[np.ndarray, "rows columns"] | None,
    truth: Grid,
    scored: Bool[np.ndarray, "rows columns"],
    visited: Int[np.ndarray, "visits 2"],
    seed: int = 0,
    report: Report = lambda *_: None,
    goals: Int[np.ndarray, " goals"] | None = None,
) -> Mapping[str, float | None]:
    """All scores, by name: those of `scoring.MapScores` and `scoring.PathScores`, `regret` and `arriving_share`.

    - `ranking`: what cells are ranked by, higher for obstacles: P(blocked), where there is such a thing; None where
      cells are not ranked.
    - `scored`: the cells that had to be learned.
    - `visited`: (state, goal) of what people passed (`Demonstrations.visited_state_goals`); they tell which obstacles
      matter.
    - `seed` draws starts and goals of paths on maps too large for all pairs (see `sample_for`).
    - `goals`: the states that paths lead to, where these are not all free cells.

    The regret is by how much a robot goes farther than the shortest way, on average and in cell sides: where it bumps
    into something it stays, having gone the length of the move, notes the obstacle and goes on as its planner has it.
    `arriving_share` is the share of pairs between which it arrives. Values are `None` where there is nothing to
    average; the regret also where a robot never arrives: for it is so wrong about cells that it takes for known, or
    goes round in circles.
    """
    report("finding the obstacles that matter", 0, 1)
    relevant = relevant_obstacles(truth, visited[:, 0], visited[:, 1])
    report("finding the obstacles that matter", 1, 1)
    # nobody can plan to where the learned map is known to be occupied, whatever the truth says
    free = np.flatnonzero((truth.known == Cell.FREE) & planner.possible())
    random, sample = np.random.default_rng(seed), sample_for(truth.size)
    graph = walkable_graph(truth)
    starts, ends = _some(free, sample.starts, random), free if goals is None else np.intersect1d(free, goals)
    pairs = _pairs_with_a_way(starts, _some(ends, sample.goals, random), graph)
    lengths = _planned_lengths(planner, pairs, graph, report)
    cells = MapScores() if ranking is None else score_map(ranking, truth, scored, relevant)
    bumps = _followed_with_bumps(planner, pairs, lengths, truth, sample.followed, random, report)
    return {**asdict(cells), **asdict(score_lengths(lengths, pairs.shortest)), **bumps}


def _some(states: Int[np.ndarray, " states"], most: int, random: np.random.Generator) -> Int[np.ndarray, " some"]:
    return np.sort(random.choice(states, most, replace=False)) if len(states) > most else states


def _pairs_with_a_way(starts: Int[np.ndarray, " starts"], goals: Int[np.ndarray, " goals"], graph: csr_array) -> _Pairs:
    """All pairs of a start and another place as the goal that the graph has a way between."""
    own_starts, own_goals = np.tile(starts, len(goals)), np.repeat(goals, len(starts))
    shortest = shortest_lengths(graph, own_starts, own_goals)
    kept = np.isfinite(shortest) & (own_starts != own_goals)
    return _Pairs(own_starts[kept], own_goals[kept], shortest[kept])


def _planned_lengths(planner: Planner, pairs: _Pairs, graph: csr_array, report: Report) -> Float[np.ndarray, " pairs"]:
    """The lengths of the paths planned between pairs, infinite for those that are not legal.

    Only the paths to one goal are held at a time: all together may take gigabytes.
    """
    lengths, goals = np.full(len(pairs.goals), np.inf), np.unique(pairs.goals)
    for done, goal in enumerate(goals):
        report(_PLANNING, done, len(goals))
        own = pairs.goals == goal
        lengths[own] = path_lengths(graph, planner.plan_to(int(goal)).follow(pairs.starts[own]), pairs.goals[own])
    report(_PLANNING, len(goals), len(goals))
    return lengths


_PLANNING, _FOLLOWING = "planning to goals", "following paths that bump"


def _followed_with_bumps(
    planner: Planner,
    pairs: _Pairs,
    lengths: Float[np.ndarray, " pairs"],
    truth: Grid,
    most: int,
    random: np.random.Generator,
    report: Report,
) -> dict[str, float | None]:
    """The regret and the share that arrives, over all pairs; of paths that are not legal, a sample is followed."""
    if not len(lengths):
        return {"regret": None, "arriving_share": None}
    legal = np.isfinite(lengths)
    bumping = np.flatnonzero(~legal)
    followed = _some(bumping, most, random)
    excess = _followed_lengths(planner, pairs, followed, truth, report) - pairs.shortest[followed]
    arriving = legal.sum() + (len(bumping) * np.isfinite(excess).mean() if len(excess) else 0.0)
    total = np.sum(lengths[legal] - pairs.shortest[legal]) + (len(bumping) * excess.mean() if len(excess) else 0.0)
    regret = float(total / len(lengths)) if np.isfinite(total) else None
    return {"regret": regret, "arriving_share": float(arriving / len(lengths))}


def _followed_lengths(
    planner: Planner, pairs: _Pairs, followed: Int[np.ndarray, " followed"], truth: Grid, report: Report
) -> Float[np.ndarray, " followed"]:
    """How far a robot goes between some of the pairs; those to the same goal share the plan that it sets out with."""
    world, lengths, goals = world_of(truth), np.zeros(len(followed)), pairs.goals[followed]
    for goal in np.unique(goals):
        report(_FOLLOWING, int((goals < goal).sum()), len(followed))
        own = goals == goal
        lengths[own] = planner.plan_to(int(goal)).lengths_with_bumps(world, pairs.starts[followed][own])
    report(_FOLLOWING, len(followed), len(followed))
    return lengths


def plan_paths(
    planner: Planner, starts: Int[np.ndarray, " starts"], goals: Int[np.ndarray, " goals"]
) -> tuple[Sequence[Int[np.ndarray, " _"]], Int[np.ndarray, " paths"]]:
    """The paths that a robot means to take from every start to every other goal, and the goal of each.

    A path that never arrives ends before the first state that would repeat. Raises `NotConverged` if a plan's values
    did not converge.
    """
    paths, path_goals = [], []
    for goal in goals:
        others = starts[starts != goal]
        paths += planner.plan_to(int(goal)).follow(others)
        path_goals += [int(goal)] * len(others)
    return paths, np.asarray(path_goals, dtype=np.int64)
