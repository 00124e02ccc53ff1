"""Walks along given lines and grids from drawings, for the tests of gridding."""

import numpy as np
import pyarrow as pa

from sidestep.io.walks import walks_of_table
from sidestep.tabular.grid import Cell, Connectivity, Grid

SIZE = 7
NAN = float("nan")


def walk_along(*lines, goals=None, failed=None):
    """Walks along lists of positions (metres); `failed`: where a move at (walk, position) did not lead."""
    lengths = [len(line) for line in lines]
    positions = np.concatenate([np.asarray(line, dtype=float) for line in lines])
    columns = {
        "walk": np.repeat(np.arange(len(lines)), lengths),
        "step": np.concatenate([np.arange(length) for length in lengths]),
        "x": positions[:, 0],
        "y": positions[:, 1],
    }
    if goals is not None:
        columns |= {
            "goal_x": np.repeat([x for x, _ in goals], lengths),
            "goal_y": np.repeat([y for _, y in goals], lengths),
        }
    if failed:
        targets = np.full((len(positions), 2), NAN)
        for (walk, position), target in failed.items():
            targets[sum(lengths[:walk]) + position] = target
        columns |= {"failed_x": targets[:, 0], "failed_y": targets[:, 1]}
    return walks_of_table(pa.table(columns), source="walks.csv")


def grid_of(*drawing, connectivity: Connectivity = 4):
    """A grid drawn with # for occupied, . for free and ? for unknown cells, the top row first."""
    cells = {"#": Cell.OCCUPIED, ".": Cell.FREE, "?": Cell.UNKNOWN}
    return Grid(
        np.array([[cells[sign] for sign in row] for row in drawing], dtype=np.int64),
        connectivity=connectivity,
    )
