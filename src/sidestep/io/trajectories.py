"""Walks in metres, from simulated trajectories on a grid."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from sidestep.io.walks import Walks, position_columns, walks_from_table
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.grid import Grid


def walks_from_trajectories(trajectories: Sequence[Trajectory], goals: Sequence[int], grid: Grid) -> Walks:
    """Return walks through the centers of the cells that trajectories visit.

    A move that did not leave its cell becomes a row with `failed_x`, `failed_y`, the center of the intended cell.

    Args:
        trajectories: states and actions on the grid.
        goals: the goal (a state) of each task.
        grid: the map.
    """
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
