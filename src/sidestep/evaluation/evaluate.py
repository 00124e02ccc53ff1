"""The evaluation of a learned map: its cells, and the paths that a robot plans and executes, against the true map.

On small maps paths are planned between all pairs of free cells, on large maps between a random sample. A method without
a map is evaluated by its paths only, a method without a planner by its cells only.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._arguments import to_finite, to_mask, to_states
from sidestep.errors import check_function, check_instance, to_count
from sidestep.evaluation.metrics import MapScores, PathScores, path_lengths, score_lengths, score_map, shortest_lengths
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.robots.planners import GoalPlan, Planner, grid_environment
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid

MAX_PLACES = 150
"""The most starts, and the most goals, of planned paths."""
MAX_EXECUTED = 200
"""The most paths that are executed for the regret."""
MAX_CELLS = 40_000_000
"""The most cells of all plans together, one plan per goal: maps above 200,000 cells have fewer goals."""
MIN_PLANS = 10
"""The fewest goals, and the fewest executed paths, on any map."""

StageCallback = Callable[[str, int, int], None]
"""Called with the name of a stage, the number of steps that are done, and their total number."""


class SampleSizes(NamedTuple):
    """The most starts and goals of planned paths, and the most executed paths."""

    starts: int
    goals: int
    executed: int


def sample_sizes(cells: int) -> SampleSizes:
    """Return the sample sizes for a map: the time of a plan grows with the number of cells.

    Args:
        cells: The number of cells, at least 1.

    Example:
        >>> sample_sizes(10_000)
        SampleSizes(starts=150, goals=150, executed=200)
    """
    plans = max(MIN_PLANS, MAX_CELLS // cells)
    return SampleSizes(MAX_PLACES, min(MAX_PLACES, plans), min(MAX_EXECUTED, plans))


@dataclass(frozen=True)
class Evaluation(PathScores, MapScores):
    """All scores of a learned map and its planner; None where a mean has nothing to average.

    Attributes:
        regret: The mean length of executed paths less that of the shortest paths, in cell sides. None also if a robot
            does not arrive: it has a false known obstacle, or moves in a cycle.
        arriving_fraction: The fraction of executed paths that arrive.

    `MapScores` and `PathScores` describe the other attributes.
    """

    regret: float | None = None
    arriving_fraction: float | None = None

    def to_dict(self) -> dict[str, float | None]:
        """Return the scores by name."""
        return asdict(self)


def evaluate(
    planner: Planner | None,
    ranking: Float[np.ndarray, "rows columns"] | None,
    truth: Grid,
    scored: Bool[np.ndarray, "rows columns"],
    visited: Int[np.ndarray, "visits 2"],
    seed: int = 0,
    callback: StageCallback = lambda *_: None,
    goals: Int[np.ndarray, " goals"] | None = None,
    sample: SampleSizes | None = None,
) -> Evaluation:
    """Evaluate a learned map and the paths planned in it against the true map.

    A robot that bumps into an obstacle stays in place at the cost of the move, remembers the obstacle and goes on by
    its planner.

    Args:
        planner: The robot's planner; None to score cells only.
        ranking: P(blocked), or any numbers that are higher for obstacles; None to score paths only.
        truth: The true map.
        scored: The cells to score: those that had to be learned.
        visited: The (state, goal) pairs of the walks (`Demonstrations.visited_state_goals`). They decide which
            obstacles are relevant.
        seed: The seed that draws starts, goals and executed paths where there are more than `sample` allows.
        callback: The progress callback.
        goals: The goals of paths; by default all free cells.
        sample: The sample sizes; by default `sample_sizes` of the map.

    Returns:
        All scores; those of cells are None without `ranking`, those of paths without `planner`.

    Raises:
        InputError: For arrays that do not fit the map.
        NotConverged: If the values of a plan do not converge.

    Example:
        >>> truth = Grid(np.array([[0, 1, 0], [0, 0, 0]]))
        >>> blocked = np.array([[0.1, 0.9, 0.2], [0.1, 0.1, 0.1]])
        >>> everywhere, visited = np.ones((2, 3), dtype=bool), np.array([[0, 2]])
        >>> evaluate(None, blocked, truth, everywhere, visited).auc_relevant
        1.0
    """
    check_instance(truth, Grid, "truth")
    check_instance(planner, (Planner, type(None)), "planner")
    check_function(callback, "callback")
    to_count(seed, "seed", 0)
    visited, scored = to_states(visited, truth.size, "visited", ("visits", 2)), to_mask(scored, "scored", truth.shape)
    if goals is not None:
        goals = to_states(goals, truth.size, "goals")
    if ranking is not None:
        ranking = to_finite(ranking, "ranking", truth.shape)
    callback("relevant obstacles", 0, 1)
    relevant = relevant_obstacles(truth, visited[:, 0], visited[:, 1])
    callback("relevant obstacles", 1, 1)
    scores = {} if ranking is None else asdict(score_map(ranking, truth, scored, relevant))
    if planner is None:
        return Evaluation(**scores)
    # no path is planned to a cell that the learned map knows to be occupied
    free = np.flatnonzero((truth.known == Cell.FREE) & planner.goal_mask())
    random, sample = np.random.default_rng(seed), sample or sample_sizes(truth.size)
    graph = walkable_graph(truth)
    starts, ends = _draw(free, sample.starts, random), free if goals is None else np.intersect1d(free, goals)
    ends = _draw(ends, sample.goals, random)
    starts, goals = np.tile(starts, len(ends)), np.repeat(ends, len(starts))
    shortest = shortest_lengths(graph, starts, goals)
    connected = np.isfinite(shortest) & (starts != goals)
    starts, goals, shortest = starts[connected], goals[connected], shortest[connected]
    lengths = np.zeros(len(goals))
    for own, plan in _plans(planner, goals, "planned paths", callback):
        lengths[own] = path_lengths(graph, plan.paths_from(starts[own]), goals[own])
    scores |= asdict(score_lengths(lengths, shortest))
    if not len(lengths):
        return Evaluation(**scores)
    # the execution of a legal path is the path itself; of the others a sample is executed
    legal = np.isfinite(lengths)
    bumping = np.flatnonzero(~legal)
    executed = _draw(bumping, sample.executed, random)
    environment, excess = grid_environment(truth), -shortest[executed]
    for own, plan in _plans(planner, goals[executed], "executed paths", callback):
        excess[own] += plan.executed_lengths(environment, starts[executed][own])
    arriving = legal.sum() + (len(bumping) * np.isfinite(excess).mean() if len(excess) else 0.0)
    total = np.sum(lengths[legal] - shortest[legal]) + (len(bumping) * excess.mean() if len(excess) else 0.0)
    regret = float(total / len(lengths)) if np.isfinite(total) else None
    return Evaluation(**scores, regret=regret, arriving_fraction=float(arriving / len(lengths)))


def plan_paths(
    planner: Planner,
    starts: Int[np.ndarray, " starts"] | Sequence[int],
    goals: Int[np.ndarray, " goals"] | Sequence[int],
) -> tuple[Sequence[Int[np.ndarray, " _"]], Int[np.ndarray, " paths"]]:
    """Return the intended paths of a robot from every start to every other goal, and the goal of each path.

    Args:
        planner: The robot's planner.
        starts: The start states.
        goals: The goal states.

    Returns:
        The states along each path, and the goals. A path that never arrives ends before the first repeated state.

    Raises:
        NotConverged: If the values of a plan do not converge.

    Example:
        >>> from sidestep.robots.planners import PolicyPlanner
        >>> always_right = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
        >>> planner = PolicyPlanner(Grid.unknown(rows=1, columns=3), lambda goal: always_right)
        >>> paths, goals = plan_paths(planner, np.array([0, 1]), np.array([2]))
        >>> [path.tolist() for path in paths]
        [[0, 1, 2], [1, 2]]
    """
    check_instance(planner, Planner, "planner")
    states = planner.goal_mask().size
    paths, path_goals, places = [], [], to_states(starts, states, "starts")
    for goal in to_states(goals, states, "goals"):
        others = places[places != goal]
        paths += planner.plan_to(int(goal)).paths_from(others)
        path_goals += [int(goal)] * len(others)
    return paths, np.asarray(path_goals, dtype=np.int64)


def _draw(states: Int[np.ndarray, " states"], most: int, random: np.random.Generator) -> Int[np.ndarray, " drawn"]:
    return np.sort(random.choice(states, most, replace=False)) if len(states) > most else states


def _plans(
    planner: Planner, goals: Int[np.ndarray, " paths"], stage: str, callback: StageCallback
) -> Iterator[tuple[Bool[np.ndarray, " paths"], GoalPlan]]:
    """Yield the plan to each different goal of paths, and which paths have it; only one plan is in memory."""
    for goal in np.unique(goals):
        callback(stage, int((goals < goal).sum()), len(goals))
        yield goals == goal, planner.plan_to(int(goal))
    callback(stage, len(goals), len(goals))
