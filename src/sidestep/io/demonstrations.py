"""From walks in metres to demonstrations on a grid."""

import numpy as np
from jaxtyping import Bool
from scipy.sparse.csgraph import connected_components

from sidestep.errors import InputError
from sidestep.io.gridding import Moves, grid_walks
from sidestep.io.walks import Walks
from sidestep.tabular.demonstrations import Demonstrations, flat_moves
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import reach, stack_tasks


def demonstrations_from_walks(
    walks: Walks, grid: Grid, *, discount: float = 0.95, step_cost: float | None = None
) -> Demonstrations:
    """Demonstrations on a grid from walks in metres, one task for every goal.

    The walks are gridded (`sidestep.io.gridding`); `discount` and `step_cost` are those of `reach`. Raises `InputError`
    as the gridding and `demonstrations_from_moves` do.
    """
    return demonstrations_from_moves(grid_walks(walks, grid), grid, discount=discount, step_cost=step_cost)


def demonstrations_from_moves(
    moves: Moves, grid: Grid, *, discount: float = 0.95, step_cost: float | None = None
) -> Demonstrations:
    """Demonstrations on a grid from gridded walks, one task for every goal.

    What a walk does after it has reached its goal cell is left out, and so is a walk that starts there. Raises
    `InputError` if no move is left, or for a goal that known obstacles wall off.
    """
    _refuse_walled_off(moves, grid)
    pursuing = pursuing_moves(moves)
    if not pursuing.any():
        raise InputError("every walk starts at its goal: expected moves towards one", source=moves.source)
    goals, task = np.unique(moves.goals[moves.walk][pursuing], return_inverse=True)
    _, trajectory = np.unique(moves.walk[pursuing], return_inverse=True)
    tasks = [reach(grid, int(state), discount=discount, step_cost=step_cost) for state in goals]
    return Demonstrations(
        states=flat_moves([moves.states[pursuing]]),
        actions=flat_moves([moves.actions[pursuing]]),
        next_states=flat_moves([moves.next_states[pursuing]]),
        task=flat_moves([task]),
        trajectory=flat_moves([trajectory]),
        tasks=stack_tasks(tasks),
    )


def pursuing_moves(moves: Moves) -> Bool[np.ndarray, " moves"]:
    """Which moves were made before their walk had reached its goal cell."""
    arrivals = np.cumsum(moves.states == moves.goals[moves.walk])
    before_walk = np.searchsorted(moves.walk, moves.walk)
    return arrivals == np.append(0, arrivals)[before_walk]


def _refuse_walled_off(moves: Moves, grid: Grid) -> None:
    """Nobody can be on the way to a goal that known obstacles wall off."""
    part = connected_components(walkable_graph(grid.passable()), directed=False)[1]
    stranded = part[moves.states] != part[moves.goals[moves.walk]]
    if stranded.any():
        row = int(moves.rows[np.argmax(stranded)])
        raise InputError(
            "the goal cannot be reached from here: known obstacles wall it off", source=moves.source, row=row
        )
