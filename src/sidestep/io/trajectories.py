"""Walks in metres, from simulated trajectories on a grid."""

from collections.abc import Sequence

import numpy as np

from sidestep.io.walks import Walks, walks_from_table
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
    import pyarrow as pa

    lengths = [len(trajectory.states) for trajectory in trajectories]
    states = np.concatenate([trajectory.states for trajectory in trajectories])
    goal = np.repeat([goals[trajectory.task] for trajectory in trajectories], lengths)
    # the action before each row; -1 for the first row of a walk
    actions = np.concatenate([np.append(-1, trajectory.actions) for trajectory in trajectories])
    failed = (actions >= 0) & (states == np.append(-1, states[:-1]))
    center, goal_center = grid.centers(states), grid.centers(goal)
    row_down, column = grid.steps[actions].T
    intended = grid.to_metres(grid.to_cell_units(center) + np.stack([column, -row_down], axis=-1))
    columns = {
        "walk": np.repeat(np.arange(len(lengths)), lengths),
        "step": np.concatenate([np.arange(length) for length in lengths]),
        "x": center[:, 0],
        "y": center[:, 1],
        "goal_x": goal_center[:, 0],
        "goal_y": goal_center[:, 1],
    }
    if failed.any():
        columns["failed_x"], columns["failed_y"] = (pa.array(values, mask=~failed) for values in intended.T)
    return walks_from_table(pa.table(columns), source="trajectories")
