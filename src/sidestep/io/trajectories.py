"""From trajectories on a grid to walks in metres: what a simulated walker would leave in a file."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from sidestep.io.walks import Walks, walks_of_table
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.grid import Grid


def walks_of_trajectories(trajectories: Sequence[Trajectory], goals: Sequence[int], grid: Grid) -> Walks:
    """Walks through the centres of the cells that trajectories visit.

    - `goals`: the goal (a state) of each task.

    A move that left a walker in its cell becomes a row with `failed_x`, `failed_y`, the centre of the cell aimed at.
    """
    lengths = [len(trajectory.states) for trajectory in trajectories]
    states = np.concatenate([trajectory.states for trajectory in trajectories])
    goal = np.repeat([goals[trajectory.task] for trajectory in trajectories], lengths)
    # the action that led to each row; none led to a walk's first
    actions = np.concatenate([np.append(-1, trajectory.actions) for trajectory in trajectories])
    failed = (actions >= 0) & (states == np.append(-1, states[:-1]))
    centre, goal_centre = grid.centres(states), grid.centres(goal)
    row_down, column = grid.steps[actions].T
    aimed = grid.to_metres(grid.to_cell_units(centre) + np.stack([column, -row_down], axis=-1))
    columns = {
        "walk": np.repeat(np.arange(len(lengths)), lengths),
        "step": np.concatenate([np.arange(length) for length in lengths]),
        "x": centre[:, 0],
        "y": centre[:, 1],
        "goal_x": goal_centre[:, 0],
        "goal_y": goal_centre[:, 1],
    }
    if failed.any():
        empty = ~failed
        columns["failed_x"] = pa.array(aimed[:, 0], mask=empty)
        columns["failed_y"] = pa.array(aimed[:, 1], mask=empty)
    return walks_of_table(pa.table(columns), source="trajectories")
