"""Grid traversal: the cells that a path visits, and the length of the path in each.

The grid traversal of Amanatides and Woo (1987) follows one ray from one cell border to the next. This one differs:

1. All crossings of all segments with the lines of the grid are computed at once and sorted along each segment.
2. A visit needs a length: a cell is not visited if the path only touches its corner or side.
3. A path along a border is in the cell that is not known to be occupied.

Positions are in cell units, (columns from the left, rows from the bottom), as `Grid.to_cell_units` returns them.

References:
    J. Amanatides and A. Woo. A fast voxel traversal algorithm for ray tracing. Eurographics, 1987.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

Occupied = Bool[np.ndarray, "rows columns"]
Points = Float[np.ndarray, "points 2"]
Cells = Int[np.ndarray, "points 2"]
_Crossings = tuple[Int[np.ndarray, " crossings"], Float[np.ndarray, " crossings"]]

TOUCH = 1e-9
"""A shorter path in a cell, in cell sides, only touches a corner or a side, up to rounding."""


@dataclass(frozen=True, eq=False)
class Visits:
    """The cells that paths visit, in order, walk after walk; successive visits of a walk are to different cells.

    Attributes:
        walk: The index of the walk.
        cell: Row and column, row 0 at the top.
        length: The length of the path inside the cell during the visit, in cell sides.
        arrival: The index of the first position at or after the moment of entry.
    """

    walk: Int[np.ndarray, " visits"]
    cell: Int[np.ndarray, "visits 2"]
    length: Float[np.ndarray, " visits"]
    arrival: Int[np.ndarray, " visits"]

    def __getitem__(self, index: Bool[np.ndarray, " visits"] | Int[np.ndarray, " selected"]) -> "Visits":
        """Return the visits that a mask or an array of indices selects."""
        return Visits(self.walk[index], self.cell[index], self.length[index], self.arrival[index])


def visited_cells(points: Points, offsets: Int[np.ndarray, " boundaries"], occupied: Occupied) -> Visits:
    """Return the cells on the straight lines between successive points of each walk.

    Every walk has a visit, even if it stands still. Successive visits are to cells that share a side, or only a corner
    where the line runs through that corner (closer than `TOUCH`). A line along the border of two cells is in the upper
    or right one, unless that is known to be occupied.

    Args:
        points: Positions on the grid in cell units.
        offsets: Points `offsets[i]` to `offsets[i + 1]`, at least two, are those of walk i.
        occupied: The cells that are known to be occupied.
    """
    walks = len(offsets) - 1
    start = np.delete(np.arange(len(points)), offsets[1:] - 1)
    walk = np.delete(np.repeat(np.arange(walks), np.diff(offsets)), offsets[1:] - 1)
    segment, begin, end = _pieces(points[start], points[start + 1])
    origin, along = points[start][segment], (points[start + 1] - points[start])[segment]
    middle = origin + (0.5 * (begin + end))[:, None] * along
    length = (end - begin) * np.hypot(along[:, 0], along[:, 1])
    visits = _merged(Visits(walk[segment], cells_at(middle, occupied), length, (start + 1)[segment]))
    lasting = visits.length >= TOUCH
    moving = np.zeros(walks, dtype=bool)
    moving[visits.walk[lasting]] = True
    first = np.diff(visits.walk, prepend=-1) != 0
    return _merged(visits[lasting | (first & ~moving[visits.walk])])


def cells_at(points: Points, occupied: Occupied) -> Cells:
    """Return row and column of the cell of each point; on a border, as `visited_cells` does.

    Args:
        points: Positions on the grid in cell units, shape (points, 2).
        occupied: The cells that are known to be occupied.
    """
    rows, columns = occupied.shape

    def cells(shift_right: float, shift_up: float) -> Cells:
        column, row_up = np.floor(points + np.array([shift_right, shift_up])).astype(np.int64).T
        return np.stack([rows - 1 - np.clip(row_up, 0, rows - 1), np.clip(column, 0, columns - 1)], axis=1)

    result = cells(TOUCH, TOUCH)
    for shifts in ((-TOUCH, TOUCH), (TOUCH, -TOUCH), (-TOUCH, -TOUCH)):
        blocked = np.flatnonzero(occupied[result[:, 0], result[:, 1]])
        if blocked.size:
            result[blocked] = cells(*shifts)[blocked]
    return result


def _pieces(
    start: Float[np.ndarray, "segments 2"], end: Float[np.ndarray, "segments 2"]
) -> tuple[Int[np.ndarray, " pieces"], Float[np.ndarray, " pieces"], Float[np.ndarray, " pieces"]]:
    """Cut segments at every line of the grid; return the segment of each piece and the fractions of its two ends."""
    crossed = [_crossings(start[:, axis], end[:, axis]) for axis in (0, 1)]
    segment = np.concatenate([np.arange(len(start)), *(segments for segments, _ in crossed)])
    begin = np.concatenate([np.zeros(len(start)), *(fractions for _, fractions in crossed)])
    order = np.lexsort((begin, segment))
    segment, begin = segment[order], begin[order]
    return segment, begin, np.where(np.diff(segment, append=len(start)) != 0, 1.0, np.append(begin[1:], 1.0))


def _crossings(start: Float[np.ndarray, " segments"], end: Float[np.ndarray, " segments"]) -> _Crossings:
    """Return where segments cross whole numbers on one axis: the segment, and the fraction of it before."""
    first = np.floor(np.minimum(start, end)) + 1
    count = np.maximum(np.ceil(np.maximum(start, end)) - first, 0).astype(np.int64)
    segment = np.repeat(np.arange(len(start)), count)
    rank = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    return segment, (first[segment] + rank - start[segment]) / (end - start)[segment]


def _merged(visits: Visits) -> Visits:
    """Join successive visits to the same cell."""
    changes = (np.diff(visits.walk) != 0) | (np.diff(visits.cell, axis=0) != 0).any(axis=1)
    first = np.flatnonzero(np.concatenate([[True], changes]))
    return Visits(visits.walk[first], visits.cell[first], np.add.reduceat(visits.length, first), visits.arrival[first])
