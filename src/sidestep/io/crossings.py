"""Which cells a path visits, and for how long: the geometry under `sidestep.io.gridding`.

Here positions are in cell units, (columns from the left, rows from the bottom), as `Grid.to_cell_units`
gives them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

TOUCH = 1e-9
"""Visits with a shorter path, in cells, only touch a corner or an edge, up to rounding; they do not count."""


@dataclass(frozen=True, eq=False)
class Visits:
    """The cells that paths visit, in order, walk after walk; successive visits of a walk are to different
    cells.

    - `walk`: the index of the walk.
    - `cell`: row and column, row 0 at the top.
    - `length`: the length of the path inside the cell during this visit, in cells.
    - `arrival`: the index of the first position at or after the moment of entry.
    """

    walk: Int[np.ndarray, " visits"]
    cell: Int[np.ndarray, "visits 2"]
    length: Float[np.ndarray, " visits"]
    arrival: Int[np.ndarray, " visits"]

    def __getitem__(self, chosen: Bool[np.ndarray, " visits"] | Int[np.ndarray, " chosen"]) -> "Visits":
        """The visits that a mask or an array of indices chooses."""
        return Visits(self.walk[chosen], self.cell[chosen], self.length[chosen], self.arrival[chosen])


def visits_of(
    points: Float[np.ndarray, "points 2"],
    offsets: Int[np.ndarray, " boundaries"],
    occupied: Bool[np.ndarray, "rows columns"],
) -> Visits:
    """The cells that straight lines between successive points of each walk pass through.

    Points of walk i are `offsets[i]` to `offsets[i + 1]`, at least two, all on the grid. Every walk has a
    visit, even if it stands still. Successive visits are to cells that share a side, or, where the line
    runs through a corner (closer than `TOUCH`), only that corner. A line that runs along the border of two
    cells is in the upper or right one, unless that is known to be occupied.
    """
    walks = len(offsets) - 1
    start = np.delete(np.arange(len(points)), offsets[1:] - 1)
    walk = np.delete(np.repeat(np.arange(walks), np.diff(offsets)), offsets[1:] - 1)
    segment, begin, end = _pieces(points[start], points[start + 1])
    origin, along = points[start][segment], (points[start + 1] - points[start])[segment]
    middle = origin + (0.5 * (begin + end))[:, None] * along
    length = (end - begin) * np.hypot(along[:, 0], along[:, 1])
    visits = _merged(Visits(walk[segment], cells_of(middle, occupied), length, (start + 1)[segment]))
    lasting = visits.length >= TOUCH
    moving = np.zeros(walks, dtype=bool)
    moving[visits.walk[lasting]] = True
    first = np.diff(visits.walk, prepend=-1) != 0
    return _merged(visits[lasting | (first & ~moving[visits.walk])])


def cells_of(
    points: Float[np.ndarray, "points 2"], occupied: Bool[np.ndarray, "rows columns"]
) -> Int[np.ndarray, "points 2"]:
    """Row and column of the cell that holds each point; see `visits_of` for points on a border."""
    rows, columns = occupied.shape

    def cells(shift_right: float, shift_up: float) -> Int[np.ndarray, "points 2"]:
        column, row_up = np.floor(points + np.array([shift_right, shift_up])).astype(np.int64).T
        return np.stack([rows - 1 - np.clip(row_up, 0, rows - 1), np.clip(column, 0, columns - 1)], axis=1)

    chosen = cells(TOUCH, TOUCH)
    for shifts in ((-TOUCH, TOUCH), (TOUCH, -TOUCH), (-TOUCH, -TOUCH)):
        blocked = np.flatnonzero(occupied[chosen[:, 0], chosen[:, 1]])
        if blocked.size:
            chosen[blocked] = cells(*shifts)[blocked]
    return chosen


def _pieces(
    start: Float[np.ndarray, "segments 2"], end: Float[np.ndarray, "segments 2"]
) -> tuple[Int[np.ndarray, " pieces"], Float[np.ndarray, " pieces"], Float[np.ndarray, " pieces"]]:
    """Segments cut at every border of cells: the segment of each piece, and the fractions of its two ends."""
    crossed = [_crossings(start[:, axis], end[:, axis]) for axis in (0, 1)]
    segment = np.concatenate([np.arange(len(start)), *(segments for segments, _ in crossed)])
    begin = np.concatenate([np.zeros(len(start)), *(fractions for _, fractions in crossed)])
    order = np.lexsort((begin, segment))
    segment, begin = segment[order], begin[order]
    last = np.diff(segment, append=len(start)) != 0
    return segment, begin, np.where(last, 1.0, np.append(begin[1:], 1.0))


def _crossings(
    start: Float[np.ndarray, " segments"], end: Float[np.ndarray, " segments"]
) -> tuple[Int[np.ndarray, " crossings"], Float[np.ndarray, " crossings"]]:
    """Where segments cross whole numbers on one axis: the segment, and the fraction of it before."""
    first = np.floor(np.minimum(start, end)) + 1
    count = np.maximum(np.ceil(np.maximum(start, end)) - first, 0).astype(np.int64)
    segment = np.repeat(np.arange(len(start)), count)
    rank = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    return segment, (first[segment] + rank - start[segment]) / (end - start)[segment]


def _merged(visits: Visits) -> Visits:
    """Successive visits to the same cell as one."""
    changes = (np.diff(visits.walk) != 0) | (np.diff(visits.cell, axis=0) != 0).any(axis=1)
    first = np.flatnonzero(np.concatenate([[True], changes]))
    length = np.add.reduceat(visits.length, first)
    return Visits(visits.walk[first], visits.cell[first], length, visits.arrival[first])
