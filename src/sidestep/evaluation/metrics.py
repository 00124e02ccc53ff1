"""Scores of a learned map, cell by cell, and of planned paths.

Walks cannot reveal every obstacle: what lies behind a wall or far from all walks leaves no trace. So cells are scored
twice, with all obstacles and with the relevant ones only (`sidestep.evaluation.relevance`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.sparse import csr_array

from sidestep._arguments import to_finite, to_mask, to_states
from sidestep.errors import check, check_instance, describe
from sidestep.evaluation.reliability import brier_score, log_loss, reliability, scored_probabilities
from sidestep.tabular.graph import free_cells, walkable_graph
from sidestep.tabular.grid import Cell, Grid

_Cells = Bool[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class MapScores:
    """Scores of a learned map; None where a mean or a ranking has no cells.

    Attributes:
        auc: The area under the ROC curve of P(blocked), obstacles against free cells.
        average_precision: The average precision of the same ranking.
        auc_relevant: The area under the ROC curve with the relevant obstacles as the only obstacles.
        average_precision_relevant: The average precision with these.
        calibration_error: The expected calibration error of P(blocked) in ten bins (`sidestep.evaluation.reliability`).
            This and the next two are None also for a ranking with numbers outside [0, 1], which is no probability.
        brier_score: The mean squared error of P(blocked).
        log_loss: The mean of −ln P over cells, P being the probability of what a cell is, in nats.
        recall: The fraction of obstacles with P(blocked) of at least 1/2.
        mean_obstacle: The mean of P(blocked) over obstacles.
        mean_free: The mean of P(blocked) over free cells.
        max_probability: The maximum of P(blocked) over both.
    """

    auc: float | None = None
    average_precision: float | None = None
    auc_relevant: float | None = None
    average_precision_relevant: float | None = None
    calibration_error: float | None = None
    brier_score: float | None = None
    log_loss: float | None = None
    recall: float | None = None
    mean_obstacle: float | None = None
    mean_free: float | None = None
    max_probability: float | None = None


@dataclass(frozen=True)
class PathScores:
    """Scores of planned paths; None where a mean has no paths.

    Attributes:
        legal_fraction: The fraction of paths that arrive by legal moves, of those with a reachable goal.
        excess_length: The mean length of legal paths less that of the shortest path, in cell sides.
    """

    legal_fraction: float | None = None
    excess_length: float | None = None


def score_map(blocked: Float[np.ndarray, "rows columns"], truth: Grid, scored: _Cells, relevant: _Cells) -> MapScores:
    """Score a learned map against the true map.

    Args:
        blocked: P(blocked) of each cell, or any finite numbers that rank obstacles above free cells.
        truth: The true map. Cells that it does not know are left out.
        scored: The cells to score, such as those that were not known beforehand.
        relevant: The relevant obstacles (`relevant_obstacles`).

    Returns:
        Scores in [0, 1] if `blocked` has probabilities, but for the log loss, which is 0 or more; None where a mean or
        a ranking has no cells.

    Raises:
        InputError: For arrays of another shape than the map and for numbers that are not finite.
    """
    check_instance(truth, Grid, "truth")
    blocked = to_finite(blocked, "blocked", truth.shape)
    scored, relevant = to_mask(scored, "scored", truth.shape), to_mask(relevant, "relevant", truth.shape)
    obstacle = scored & (truth.known == Cell.OCCUPIED)
    free = scored & (truth.known == Cell.FREE)
    on_obstacles, on_free = blocked[obstacle], blocked[free]
    ranking = *ranking_scores(on_obstacles, on_free), *ranking_scores(blocked[obstacle & relevant], on_free)
    highest = float(blocked[obstacle | free].max()) if (obstacle | free).any() else None
    calibration, cells = (None, None, None), scored_probabilities(blocked, truth, scored)
    if cells is not None:
        calibration = reliability(*cells).calibration_error, brier_score(*cells), log_loss(*cells)
    return MapScores(*ranking, *calibration, _mean(on_obstacles >= 0.5), _mean(on_obstacles), _mean(on_free), highest)


def ranking_scores(
    positives: Float[np.ndarray, " positives"], negatives: Float[np.ndarray, " negatives"]
) -> tuple[float | None, float | None]:
    """Return the area under the ROC curve and the average precision of scores; None if a class is empty.

    Equal to scikit-learn's `roc_auc_score` and `average_precision_score`, which take a second to import.

    Args:
        positives: The scores of the positive class.
        negatives: The scores of the negative class.
    """
    if not len(positives) or not len(negatives):
        return None, None
    thresholds = np.unique(np.concatenate([positives, negatives]))
    # how many of each class reach each threshold, from the lowest on; none above the highest
    true, false = (
        np.append(len(scores) - np.searchsorted(np.sort(scores), thresholds), 0) for scores in (positives, negatives)
    )
    recall, false_rate = true / len(positives), false / len(negatives)
    average_precision = -np.sum(np.diff(recall) * (true[:-1] / (true + false)[:-1]))
    # scikit-learn leaves out the inner points of straight segments; without them the sums round alike
    inner = np.flatnonzero((np.diff(true[:-1], 2) == 0) & (np.diff(false[:-1], 2) == 0)) + 1
    auc = np.trapezoid(np.delete(recall, inner)[::-1], np.delete(false_rate, inner)[::-1])
    return float(auc), float(average_precision)


def score_paths(
    paths: Sequence[Integer[np.ndarray, " _"]], goals: Sequence[int] | Integer[np.ndarray, " paths"], truth: Grid
) -> PathScores:
    """Score planned paths against the true map.

    Args:
        paths: The states along each path, the start first. A path that repeats a state in place is not legal.
        goals: The goal (a state) of each path.
        truth: The true map.

    Returns:
        A fraction in [0, 1] and a length in cell sides; None where a mean has no paths.

    Raises:
        InputError: For a path without states, for a number of goals that differs from that of paths, and for states
            that are not on the map.

    Example:
        >>> truth = Grid(np.array([[0, 1, 0], [0, 0, 0]]))
        >>> score_paths([np.array([0, 3, 4, 5, 2]), np.array([0, 1, 2])], [2, 2], truth)
        PathScores(legal_fraction=0.5, excess_length=0.0)
    """
    check_instance(truth, Grid, "truth")
    check(isinstance(paths, Sequence), f"expected a list of paths, found {describe(paths)}", field="paths")
    ends = to_states(goals, truth.size, "goals", (len(paths),))
    if not len(paths):
        return PathScores()
    walked = [to_states(path, truth.size, f"paths[{place}]") for place, path in enumerate(paths)]
    for row, path in enumerate(walked, start=1):
        check(len(path), "expected at least one state, found none", source="path", row=row)
    graph = walkable_graph(truth)
    starts = np.array([path[0] for path in walked])
    # a single state in an obstacle has no move that could be illegal
    shortest = np.where(free_cells(truth)[starts], shortest_lengths(graph, starts, ends), np.inf)
    return score_lengths(path_lengths(graph, walked, ends), shortest)


def score_lengths(lengths: Float[np.ndarray, " paths"], shortest: Float[np.ndarray, " paths"]) -> PathScores:
    """Score planned paths by their lengths (`path_lengths`) and those of the shortest paths (`shortest_lengths`).

    Args:
        lengths: The length of each path in cell sides; infinite if it is not legal.
        shortest: The length of the shortest path in its place; infinite if there is none.

    Returns:
        A fraction in [0, 1] and a length in cell sides; None where a mean has no paths.
    """
    possible = np.isfinite(shortest)
    legal = possible & np.isfinite(lengths)
    return PathScores(_mean(legal[possible]), _mean(lengths[legal] - shortest[legal]))


def path_lengths(
    graph: csr_array, paths: Sequence[Integer[np.ndarray, " _"]], goals: Integer[np.ndarray, " paths"]
) -> Float[np.ndarray, " paths"]:
    """Return the length of each path in cell sides; infinite if it does not arrive or has a move not in the graph.

    Args:
        graph: The legal moves (`walkable_graph`).
        paths: The states along each path, at least one.
        goals: The goal of each path.
    """
    states = np.concatenate(paths)
    ends = np.cumsum([len(path) for path in paths])
    last, first = ends - 1, np.append(0, ends[:-1])
    # indices with two axes give a matrix in every version of SciPy
    length = graph[states[None, :-1], states[None, 1:]].toarray()[0]
    length = np.append(np.where(length > 0, length, np.inf), 0.0)
    length[last] = 0.0  # there is no move from the end of one path to the start of the next
    return np.where(states[last] == goals, np.add.reduceat(length, first), np.inf)


def shortest_lengths(
    graph: csr_array, starts: Integer[np.ndarray, " paths"], goals: Integer[np.ndarray, " paths"]
) -> Float[np.ndarray, " paths"]:
    """Return the length of the shortest path from each start to its goal in cell sides; infinite if there is none.

    Args:
        graph: The legal moves (`walkable_graph`).
        starts: The start states.
        goals: The goal of each start. Dijkstra's algorithm runs once for each different goal.
    """
    from scipy.sparse.csgraph import dijkstra

    shortest = np.full(len(starts), np.inf)
    for goal in np.unique(goals):
        own = goals == goal
        shortest[own] = dijkstra(graph, indices=int(goal))[starts[own]]
    return shortest


def visit_ranking(
    visited: Integer[np.ndarray, " visits"], grid: Grid, weights: Float[np.ndarray, " visits"] | None = None
) -> Float[np.ndarray, "rows columns"]:
    """Return minus the number of visits of each cell: a baseline that ranks rarely visited cells highest.

    Args:
        visited: The visited states.
        grid: The map.
        weights: How often each visit counts; by default once.

    Raises:
        InputError: For numbers that are not states of the map, and weights that are not finite numbers from 0, one for
            each visit.
    """
    check_instance(grid, Grid, "grid")
    states = to_states(visited, grid.size, "visited")
    if weights is not None:
        weights = to_finite(weights, "weights", (len(states),), least=0)
    return -np.bincount(states, weights, minlength=grid.size).reshape(grid.shape).astype(np.float64)


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None
