"""Demonstrations on a grid, from walks in metres."""

import numpy as np
from jaxtyping import Int

from sidestep.errors import InputError, check
from sidestep.io.gridding import Moves, grid_walks
from sidestep.io.walks import Walks
from sidestep.tabular.demonstrations import Demonstrations, gather
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.tasks import reach


def demonstrations_from_walks(
    walks: Walks, grid: Grid, *, discount: float = 0.95, step_cost: float | None = None
) -> Demonstrations:
    """Return demonstrations on a grid from walks in metres, with one task for every goal.

    Args:
        walks: positions and goals in metres.
        grid: the map; moves are 4- or 8-connected as the grid is.
        discount: γ in (0, 1], as in `reach`.
        step_cost: the cost of a step of one cell side, as in `reach`.

    Raises:
        InputError: as `grid_walks` and `demonstrations_from_moves` do.

    Example:
        >>> import pyarrow as pa
        >>> from sidestep.io.walks import walks_from_table
        >>> walks = walks_from_table(pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 2.5], "y": [0.5, 0.5]}))
        >>> demonstrations_from_walks(walks, Grid.unknown(rows=1, columns=3)).next_states.tolist()
        [1, 2]
    """
    return demonstrations_from_moves(grid_walks(walks, grid), grid, discount=discount, step_cost=step_cost)


def demonstrations_from_moves(
    moves: Moves, grid: Grid, *, discount: float = 0.95, step_cost: float | None = None
) -> Demonstrations:
    """Return demonstrations on a grid from gridded walks, with one task for every goal.

    Moves after a walk has reached its goal are left out, and so are walks that start at their goal.

    Args:
        moves: from `grid_walks`.
        grid: the map.
        discount: γ in (0, 1], as in `reach`.
        step_cost: the cost of a step of one cell side, as in `reach`.

    Raises:
        InputError: if no move is left, or for a goal that known obstacles wall off.
    """
    region = connected_regions(grid)
    walled_off = region[moves.states] != region[moves.goals[moves.walk]]
    if walled_off.any():
        message = "the goal cannot be reached from here: known obstacles wall it off"
        raise InputError(message, source=moves.source, row=int(moves.rows[np.argmax(walled_off)]))
    moves = moves.before_goal()
    check(len(moves), "every walk starts at its goal: expected moves towards one", source=moves.source)
    goals, task = np.unique(moves.goals[np.unique(moves.walk)], return_inverse=True)
    tasks = [reach(grid, int(state), discount=discount, step_cost=step_cost) for state in goals]
    return gather(moves.trajectories(task.tolist()), tasks)


def connected_regions(grid: Grid) -> Int[np.ndarray, " states"]:
    """Return the number of the region of each state; walks are possible within a region, around known obstacles."""
    if not (grid.known == Cell.OCCUPIED).any():
        return np.zeros(grid.size, dtype=np.int64)
    from scipy.sparse.csgraph import connected_components

    return connected_components(walkable_graph(grid.passable()), directed=False)[1]
