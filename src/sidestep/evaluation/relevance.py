"""The obstacles that walks can reveal: those that lengthen the shortest path from a visited state to its goal.

An obstacle is relevant if the shortest path from some visited state s to its goal g would be shorter without it. A
path through an opened cell x has length d(s, x) + d(x, g), so all obstacles are tested with two runs of Dijkstra's
algorithm per goal: one from the goal for d(·, g), and one for min_s d(s, ·) − d(s, g) from an additional source that is
connected to every visited state.
"""

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.sparse import csr_array, vstack

from sidestep._arguments import to_states
from sidestep.errors import check_instance
from sidestep.tabular.graph import clear_cells, clear_moves, free_cells, moves_into, walkable_graph
from sidestep.tabular.grid import Cell, Grid

_Lengths = Float[np.ndarray, " states"]
_Moves = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Moves that become possible when one cell is opened: origin, target, length, opened cell."""
_TOLERANCE = 1e-9
"""The least difference of path lengths in cell sides: more than rounding, less than a detour."""


def relevant_obstacles(
    truth: Grid, visited: Integer[np.ndarray, " moves"], goals: Integer[np.ndarray, " moves"]
) -> Bool[np.ndarray, "rows columns"]:
    """Return the obstacles without which the shortest path from a visited state to its goal would be shorter.

    A path to a goal that is out of reach otherwise counts as shorter.

    Args:
        truth: The true map.
        visited: The visited states.
        goals: The goal (a state) of each of them.

    Raises:
        InputError: For arrays of different lengths and for states that are not on the map.

    Example:
        >>> truth = Grid(np.array([[0, 1, 0], [0, 0, 0]]))
        >>> relevant_obstacles(truth, np.array([0]), np.array([2])).tolist()
        [[False, True, False], [False, False, False]]
    """
    from scipy.sparse.csgraph import dijkstra

    check_instance(truth, Grid, "truth")
    visited = to_states(visited, truth.size, "visited")
    goals = to_states(goals, truth.size, "goals", visited.shape)
    graph = walkable_graph(truth)
    through, past = _moves_of_closed_cells(truth), _prevented_diagonals(truth)
    relevant = np.zeros(truth.size, dtype=bool)
    for goal in np.unique(goals):
        to_goal = dijkstra(graph, indices=int(goal))
        from_visited = _relative_distances(graph, to_goal, np.unique(visited[goals == goal]))
        relevant |= _changes_by_opening(from_visited, to_goal, through, past) < -_TOLERANCE
    return (relevant & (truth.known.reshape(-1) == Cell.OCCUPIED)).reshape(truth.shape)


def _moves_of_closed_cells(truth: Grid) -> _Moves:
    """Return the moves out of each cell that is not free, were it free; reversed, they are the moves into it."""
    required = moves_into(truth)
    state, action = np.nonzero(clear_moves(truth, required) & ~free_cells(truth)[:, None])
    return state, required[state, action, 0], truth.lengths[action], state


def _prevented_diagonals(truth: Grid) -> _Moves:
    """Return the diagonals between free cells that a single cell beside them prevents."""
    required = moves_into(truth)
    prevented = ~clear_cells(truth)[required[..., 1:]]
    ends_free = clear_moves(truth, required[..., :1]) & free_cells(truth)[:, None]
    state, action = np.nonzero(ends_free & (prevented.sum(axis=-1) == 1))
    cell = required[state, action, 1 + np.argmax(prevented[state, action], axis=-1)]
    return state, required[state, action, 0], truth.lengths[action], cell


def _changes_by_opening(from_visited: _Lengths, to_goal: _Lengths, through: _Moves, past: _Moves) -> _Lengths:
    """Return the length of the best new path that opening each cell allows, less that of the present path.

    A new path leads through the opened cell or takes one diagonal past it: two such diagonals are longer than the two
    straight moves through the cell.
    """
    path_in, path_out, (_, target, length, opened) = from_visited.copy(), to_goal.copy(), through
    np.minimum.at(path_in, opened, from_visited[target] + length)
    np.minimum.at(path_out, opened, length + to_goal[target])
    origin, target, length, opened = past
    change = path_in + path_out
    np.minimum.at(change, opened, from_visited[origin] + length + to_goal[target])
    return change


def _relative_distances(graph: csr_array, to_goal: _Lengths, visited: Integer[np.ndarray, " visited"]) -> _Lengths:
    """Return min_s d(s, x) − d(s, goal) over visited states s for each state x; infinite where none can reach x.

    Plus d(x, goal), this is below 0 where s → x → goal is shorter than the present path. In the component of a visited
    state that cannot reach the goal it is so small that any path counts as shorter.
    """
    from scipy.sparse.csgraph import dijkstra

    arriving = visited[np.isfinite(to_goal[visited])]
    stranded = visited[np.isinf(to_goal[visited])]
    states = len(to_goal)
    result = np.full(states, np.inf)
    if len(arriving):
        # the shift makes all lengths positive: 0 means "no edge"
        shift = 1.0 + to_goal[arriving].max()
        source = csr_array((shift - to_goal[arriving], arriving, [0, len(arriving)]), shape=(1, states))
        extended = vstack([graph, source], format="csr")
        extended.resize((states + 1, states + 1))
        result = dijkstra(extended, indices=states)[:states] - shift
    if len(stranded):
        longer_than_any_path = 4.0 * (states + 1)
        result[np.isfinite(dijkstra(graph, indices=stranded, min_only=True))] = -longer_than_any_path
    return result
