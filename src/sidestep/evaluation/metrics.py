"""How well a learned map matches the truth: cell by cell, and in the paths that are planned in it.

Not every obstacle can be learned from walks: what lies behind a wall, or far from where anyone went, leaves
no trace. So maps are scored twice: over all cells, and over the obstacles that *matter*, those whose opening
alone would have given somebody who walked a shorter way to the goal (`relevant_obstacles`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Integer
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from sidestep.errors import InputError
from sidestep.tabular.graph import clear_cells, clear_moves, free_cells, moves_into, walkable_graph
from sidestep.tabular.grid import Cell, Grid

_SHORTER = 1e-9
"""By how many cell sides a way must be shorter to count: more than rounding, less than a detour."""


@dataclass(frozen=True)
class MapScores:
    """A learned map against the truth; `None` where there is nothing to average or to tell apart.

    - `auc`, `average_precision`: how well P(blocked) ranks obstacles above free cells, over the scored cells.
    - `auc_relevant`, `average_precision_relevant`: the same with the obstacles that matter as the only
      obstacles.
    - `recall`: the share of scored obstacles with P(blocked) ≥ 0.5.
    - `mean_obstacle`, `mean_free`, `max_probability`: of P(blocked), over scored obstacles, free cells, and
      both.
    """

    auc: float | None = None
    average_precision: float | None = None
    auc_relevant: float | None = None
    average_precision_relevant: float | None = None
    recall: float | None = None
    mean_obstacle: float | None = None
    mean_free: float | None = None
    max_probability: float | None = None


@dataclass(frozen=True)
class PathScores:
    """Planned paths against the truth; `None` where there is nothing to average.

    - `legal_share`: the share of paths that arrive by legal moves, among those whose goal can be reached at
      all.
    - `excess_length`: by how much legal paths are longer than the shortest way, on average, in cell sides.
    """

    legal_share: float | None
    excess_length: float | None


def relevant_obstacles(
    truth: Grid, visited: Integer[np.ndarray, " moves"], goals: Integer[np.ndarray, " moves"]
) -> Bool[np.ndarray, "rows columns"]:
    """The obstacles that matter: occupied cells whose opening alone would shorten the way of a visited state.

    - `visited`, `goals`: one entry a move: the state that was visited, and the goal (a state) pursued from
      there.

    Connecting a visited state to a goal that is out of reach counts as shortening. Raises `InputError` for
    arrays of different lengths and states that are not on the map. Takes two shortest-path searches a goal,
    whatever the number of obstacles.

    >>> truth = Grid(np.array([[0, 1, 0], [0, 0, 0]]))
    >>> relevant_obstacles(truth, np.array([0]), np.array([2])).tolist()
    [[False, True, False], [False, False, False]]
    """
    if len(visited) != len(goals):
        raise InputError(f"expected {len(visited)}, one for each visited state, found {len(goals)}", field="goals")
    _check_states(visited, truth, "visited")
    _check_states(goals, truth, "goals")
    graph = walkable_graph(truth)
    components = connected_components(graph, directed=False)[1]
    through, past = _moves_through(truth), _moves_past(truth)
    relevant = np.zeros(truth.size, dtype=bool)
    for goal in np.unique(goals):
        to_goal = dijkstra(graph, indices=int(goal))
        so_far = _head_start(graph, components, to_goal, np.unique(visited[goals == goal]))
        relevant |= _shortest_by_opening(so_far, to_goal, through, past) < -_SHORTER
    return (relevant & (truth.known.reshape(-1) == Cell.OCCUPIED)).reshape(truth.shape)


def score_map(
    blocked: Float[np.ndarray, "rows columns"],
    truth: Grid,
    scored: Bool[np.ndarray, "rows columns"],
    relevant: Bool[np.ndarray, "rows columns"],
) -> MapScores:
    """Scores of a learned map.

    - `blocked`: P(blocked) of each cell; for a mere ranking (`visit_ranking`) any finite numbers, higher for
      obstacles.
    - `scored`: the cells to score, such as those that were not known beforehand; of these, the ones that
      `truth` does not know are left out.
    - `relevant`: the obstacles that matter (`relevant_obstacles`).

    Raises `InputError` for arrays of another shape than the map and for numbers that are not finite.
    """
    for field, array in (("blocked", blocked), ("scored", scored), ("relevant", relevant)):
        if array.shape != truth.shape:
            raise InputError(f"expected the map's shape {truth.shape}, found {array.shape}", field=field)
    if not np.isfinite(blocked).all():
        raise InputError("expected finite numbers", field="blocked")
    obstacle = scored & (truth.known == Cell.OCCUPIED)
    free = scored & (truth.known == Cell.FREE)
    auc, average_precision = _ranking_scores(blocked[obstacle], blocked[free])
    auc_relevant, average_precision_relevant = _ranking_scores(blocked[obstacle & relevant], blocked[free])
    return MapScores(
        auc=auc,
        average_precision=average_precision,
        auc_relevant=auc_relevant,
        average_precision_relevant=average_precision_relevant,
        recall=_mean(blocked[obstacle] >= 0.5),
        mean_obstacle=_mean(blocked[obstacle]),
        mean_free=_mean(blocked[free]),
        max_probability=float(blocked[obstacle | free].max()) if (obstacle | free).any() else None,
    )


def score_paths(
    paths: Sequence[Integer[np.ndarray, " _"]],
    goals: Sequence[int] | Integer[np.ndarray, " paths"],
    truth: Grid,
) -> PathScores:
    """Scores of planned paths.

    - `paths`: the states along each path, the start first. A path that repeats a state in place is not legal.
    - `goals`: the state that each path was planned to.

    Raises `InputError` for a path without states, a number of goals that differs from the number of paths, and states
    that are not on the map.

    >>> truth = Grid(np.array([[0, 1, 0], [0, 0, 0]]))
    >>> score_paths([np.array([0, 3, 4, 5, 2]), np.array([0, 1, 2])], [2, 2], truth)
    PathScores(legal_share=0.5, excess_length=0.0)
    """
    if len(paths) != len(goals):
        raise InputError(f"expected {len(paths)}, one for each path, found {len(goals)}", field="goals")
    if not len(paths):
        return PathScores(None, None)
    empty = [len(path) == 0 for path in paths]
    if any(empty):
        raise InputError("expected at least one state", source="path", row=empty.index(True) + 1)
    wanted = np.asarray(goals)
    _check_states(np.concatenate(paths), truth, "paths")
    _check_states(wanted, truth, "goals")
    graph = walkable_graph(truth)
    starts = np.array([path[0] for path in paths])
    # a lone start on an obstacle has made no move that could be illegal
    shortest = np.where(free_cells(truth)[starts], shortest_lengths(graph, starts, wanted), np.inf)
    return score_lengths(path_lengths(graph, paths, wanted), shortest)


def score_lengths(lengths: Float[np.ndarray, " paths"], shortest: Float[np.ndarray, " paths"]) -> PathScores:
    """Scores of planned paths by their lengths (`path_lengths`) and those of the shortest ways (`shortest_lengths`)."""
    possible = np.isfinite(shortest)
    legal = possible & np.isfinite(lengths)
    return PathScores(_mean(legal[possible]), _mean(lengths[legal] - shortest[legal]))


def path_lengths(
    graph: csr_array, paths: Sequence[Integer[np.ndarray, " _"]], goals: Integer[np.ndarray, " paths"]
) -> Float[np.ndarray, " paths"]:
    """The length of each path in cell sides, infinite where it does not arrive or makes a move not in the graph.

    `graph` is a `walkable_graph`; every path has at least one state.
    """
    states = np.concatenate(paths)
    ends = np.cumsum([len(path) for path in paths])
    last, first = ends - 1, np.append(0, ends[:-1])
    # indices with two axes give a matrix in every version of SciPy
    length = graph[states[None, :-1], states[None, 1:]].toarray()[0]
    length = np.append(np.where(length > 0, length, np.inf), 0.0)
    length[last] = 0.0  # from the end of one path to the start of the next is no move
    return np.where(states[last] == goals, np.add.reduceat(length, first), np.inf)


def shortest_lengths(
    graph: csr_array, starts: Integer[np.ndarray, " paths"], goals: Integer[np.ndarray, " paths"]
) -> Float[np.ndarray, " paths"]:
    """The length of the shortest way from each start to its goal in cell sides, infinite where there is none.

    `graph` is a `walkable_graph`. One shortest-path search for each different goal.
    """
    shortest = np.full(len(starts), np.inf)
    for goal in np.unique(goals):
        own = goals == goal
        shortest[own] = dijkstra(graph, indices=int(goal))[starts[own]]
    return shortest


def visit_ranking(visited: Integer[np.ndarray, " moves"], grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """The ranking to beat: minus the number of visits, so that cells rarely visited rank highest."""
    _check_states(visited, grid, "visited")
    return -np.bincount(visited, minlength=grid.size).reshape(grid.shape).astype(np.float64)


class _Moves(NamedTuple):
    """Moves that opening one cell would allow: from where, to where, how long, and which cell to open."""

    origin: Int[np.ndarray, " moves"]
    target: Int[np.ndarray, " moves"]
    length: Float[np.ndarray, " moves"]
    opened: Int[np.ndarray, " moves"]


def _moves_through(truth: Grid) -> _Moves:
    """The moves out of each cell that is not free, were it free; backwards they are the moves into it."""
    needed = moves_into(truth)
    state, action = np.nonzero(clear_moves(truth, needed) & ~free_cells(truth)[:, None])
    return _Moves(state, needed[state, action, 0], truth.lengths[action], state)


def _moves_past(truth: Grid) -> _Moves:
    """The diagonals between free cells that only one cell beside them prevents."""
    needed = moves_into(truth)
    prevented = ~clear_cells(truth)[needed[..., 1:]]
    ends_free = clear_moves(truth, needed[..., :1]) & free_cells(truth)[:, None]
    state, action = np.nonzero(ends_free & (prevented.sum(axis=-1) == 1))
    cell = needed[state, action, 1 + np.argmax(prevented[state, action], axis=-1)]
    return _Moves(state, needed[state, action, 0], truth.lengths[action], cell)


def _shortest_by_opening(
    so_far: Float[np.ndarray, " states"], to_goal: Float[np.ndarray, " states"], through: _Moves, past: _Moves
) -> Float[np.ndarray, " states"]:
    """The length of the best way that opening each cell would allow, less the length of the way there was.

    A new way leads through the opened cell, or takes one diagonal past it: two such diagonals are longer than
    the two straight moves through the cell.
    """
    way_in, way_out = so_far.copy(), to_goal.copy()
    np.minimum.at(way_in, through.opened, so_far[through.target] + through.length)
    np.minimum.at(way_out, through.opened, through.length + to_goal[through.target])
    shortest = way_in + way_out
    np.minimum.at(shortest, past.opened, so_far[past.origin] + past.length + to_goal[past.target])
    return shortest


def _head_start(
    graph: csr_array,
    components: Int[np.ndarray, " states"],
    to_goal: Float[np.ndarray, " states"],
    visited: Integer[np.ndarray, " visited"],
) -> Float[np.ndarray, " states"]:
    """For each state x, the least d(s, x) − d(s, goal) over visited states s; infinite out of their reach.

    A way s → x → goal is shorter than the present one where this plus d(x, goal) is below 0. Around visited
    states that cannot reach the goal it is so far below 0 that any way is shorter.
    """
    arriving = visited[np.isfinite(to_goal[visited])]
    stranded = visited[np.isinf(to_goal[visited])]
    states = len(to_goal)
    result = np.full(states, np.inf)
    if len(arriving):
        # one search from all of them: a source beyond the map, its moves made longer than 0, which is no move
        shift = 1.0 + to_goal[arriving].max()
        extended = csr_array(
            (
                np.concatenate([graph.data, shift - to_goal[arriving]]),
                np.concatenate([graph.indices, arriving]),
                np.append(graph.indptr, graph.indptr[-1] + len(arriving)),
            ),
            shape=(states + 1, states + 1),
        )
        result = dijkstra(extended, indices=states)[:states] - shift
    no_way_is_longer = 4.0 * (states + 1)
    result[np.isin(components, components[stranded])] = -no_way_is_longer
    return result


def _ranking_scores(
    positives: Float[np.ndarray, " positives"], negatives: Float[np.ndarray, " negatives"]
) -> tuple[float | None, float | None]:
    """The area under the ROC curve and the average precision of a ranking; `None` if a class is empty."""
    if not len(positives) or not len(negatives):
        return None, None
    # imported here because it takes longer to import than the rest of the library
    from sklearn.metrics import average_precision_score, roc_auc_score

    label = np.repeat([1, 0], [len(positives), len(negatives)])
    score = np.concatenate([positives, negatives])
    return float(roc_auc_score(label, score)), float(average_precision_score(label, score))


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


def _check_states(states: Integer[np.ndarray, " states"], grid: Grid, field: str) -> None:
    if len(states) and not (states.min() >= 0 and states.max() < grid.size):
        raise InputError(f"expected states in 0…{grid.size - 1}", field=field)
