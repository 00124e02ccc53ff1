"""Walks along given lines, walks at random, and grids from drawings, for the tests of walks and gridding."""

import numpy as np
import pyarrow as pa
from hypothesis import strategies as st

from sidestep.io.walks import walks_from_table
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
        columns |= dict(zip(("goal_x", "goal_y"), np.repeat(goals, lengths, axis=0).T, strict=True))
    if failed:
        targets = np.full((len(positions), 2), NAN)
        for (walk, position), target in failed.items():
            targets[sum(lengths[:walk]) + position] = target
        columns |= {"failed_x": targets[:, 0], "failed_y": targets[:, 1]}
    return walks_from_table(pa.table(columns), source="walks.csv")


def grid_of(*drawing, connectivity: Connectivity = 4):
    """A grid drawn with # for occupied, . for free and ? for unknown cells, the top row first."""
    cells = {"#": Cell.OCCUPIED, ".": Cell.FREE, "?": Cell.UNKNOWN}
    known = np.array([[cells[sign] for sign in row] for row in drawing], dtype=np.int64)
    return Grid(known, connectivity=connectivity)


def assert_same_walks(one, other):
    """All fields of two walks are equal but the names of their sources."""
    assert one.labels == other.labels
    for field in ("offsets", "goals", "positions", "failed_moves", "steps", "rows"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field))
    assert one.metadata.to_pydict() == other.metadata.to_pydict()


position = st.floats(-1e9, 1e9, allow_nan=False)


@st.composite
def walk_tables(draw):
    """Tables of up to four walks, with goals, failed moves and notes."""
    lengths = draw(st.lists(st.integers(2, 4), min_size=1, max_size=4))
    count = sum(lengths)
    column = st.lists(position, min_size=count, max_size=count)
    goals = draw(st.lists(st.tuples(position, position), min_size=len(lengths), max_size=len(lengths)))
    failed = draw(st.lists(st.none() | st.tuples(position, position), min_size=count, max_size=count))
    text = st.text("ab\"',\n é0", max_size=4)
    return pa.table(
        {
            "walk": np.repeat(np.arange(len(lengths)), lengths),
            "step": np.concatenate([np.arange(length) for length in lengths]),
            "x": draw(column),
            "y": draw(column),
            "goal_x": np.repeat([x for x, _ in goals], lengths),
            "goal_y": np.repeat([y for _, y in goals], lengths),
            "failed_x": pa.array([pair and pair[0] for pair in failed], pa.float64()),
            "failed_y": pa.array([pair and pair[1] for pair in failed], pa.float64()),
            "note": ["note " + draw(text) for _ in range(count)],
        }
    )
