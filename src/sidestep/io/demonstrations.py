"""Demonstrations on a grid from walks in metres, and walks from simulated trajectories."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from sidestep.errors import check, check_instance, to_list
from sidestep.io.gridding import Moves, grid_walks
from sidestep.io.tables import check_rows
from sidestep.io.walks import Walks, position_columns, walks_from_table
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.reward import Reward
from sidestep.tabular.tasks import reach


def demonstrations_from_walks(
    walks: Walks, grid: Grid, *, discount: float = 0.95, step_cost: float | None = None
) -> Demonstrations:
    """Return demonstrations on a grid from walks in metres, with one task for every goal.

    Args:
        walks: Positions and goals in metres.
        grid: The map; moves are 4- or 8-connected as the grid is.
        discount: γ in (0, 1], as in `reach`.
        step_cost: The cost of a step of one cell side, as in `reach`.

    Raises:
        InputError: As `grid_walks` and `demonstrations_from_moves` do.

    Example:
        >>> walks = walks_from_table(pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 2.5], "y": [0.5, 0.5]}))
        >>> demonstrations_from_walks(walks, Grid.unknown(rows=1, columns=3)).next_states.tolist()
        [1, 2]
    """
    check_instance(walks, Walks, "walks")
    check_instance(grid, Grid, "grid")
    Reward(discount, step_cost)  # checks both before the walks are gridded
    return demonstrations_from_moves(grid_walks(walks, grid), grid, discount=discount, step_cost=step_cost)


def demonstrations_from_moves(
    moves: Moves, grid: Grid, *, discount: float = 0.95, step_cost: float | None = None
) -> Demonstrations:
    """Return demonstrations on a grid from gridded walks, with one task for every goal.

    Moves after a walk has reached its goal are left out, and so are walks that start at their goal.

    Args:
        moves: From `grid_walks`.
        grid: The map.
        discount: γ in (0, 1], as in `reach`.
        step_cost: The cost of a step of one cell side, as in `reach`.

    Raises:
        InputError: If no move is left, or for a goal that known obstacles wall off.
    """
    region = connected_regions(grid)
    message = "the goal cannot be reached from here: known obstacles wall it off"
    check_rows(region[moves.states] == region[moves.goals[moves.walk]], message, moves.source, "goal_x", moves.rows)
    moves = moves.before_goal()
    check(len(moves), "every walk starts at its goal: expected moves towards one", source=moves.source)
    goals, task = np.unique(moves.goals[np.unique(moves.walk)], return_inverse=True)
    tasks = [reach(grid, int(state), discount=discount, step_cost=step_cost) for state in goals]
    return gather(moves.trajectories(task.tolist()), tasks)


def connected_regions(grid: Grid) -> Int[np.ndarray, " states"]:
    """Return the number of the region of each state; walks are possible within a region, around known obstacles.

    Args:
        grid: The map.
    """
    if not (grid.known == Cell.OCCUPIED).any():
        return np.zeros(grid.size, dtype=np.int64)
    from scipy.sparse.csgraph import connected_components

    return connected_components(walkable_graph(grid.passable()), directed=False)[1]


def walks_from_trajectories(trajectories: Sequence[Trajectory], goals: Sequence[int], grid: Grid) -> Walks:
    """Return walks through the centers of the cells that trajectories visit.

    A move that did not leave its cell becomes a row with `failed_x`, `failed_y`, the center of the intended cell.

    Args:
        trajectories: States and actions on the grid.
        goals: The goal (a state) of each task.
        grid: The map.
    """
    check_instance(grid, Grid, "grid")
    to_list(trajectories, Trajectory, "trajectories")
    lengths = [len(trajectory.states) for trajectory in trajectories]
    states = np.concatenate([trajectory.states for trajectory in trajectories])
    goal = np.repeat([goals[trajectory.task] for trajectory in trajectories], lengths)
    # the action before each row; -1 for the first row of a walk
    actions = np.concatenate([np.append(-1, trajectory.actions) for trajectory in trajectories])
    failed = (actions >= 0) & (states == np.append(-1, states[:-1]))
    row_down, column = grid.steps[actions].T
    intended = grid.to_metres(grid.to_cell_units(grid.centers(states)) + np.stack([column, -row_down], axis=-1))
    steps = np.concatenate([np.arange(length) for length in lengths])
    columns = {"walk": np.repeat(np.arange(len(lengths)), lengths), "step": steps}
    columns |= position_columns("", grid.centers(states)) | position_columns("goal_", grid.centers(goal))
    if failed.any():
        columns |= position_columns("failed_", np.where(failed[:, None], intended, np.nan))
    return walks_from_table(pa.table(columns), source="trajectories")
