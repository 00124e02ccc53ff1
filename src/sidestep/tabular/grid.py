"""Occupancy grids: the position of cells in the world, what is known of them, and the moves between them.

A grid is a rectangle of square cells. Row 0 is the *top* row, as in an image; cell (row, column) is the state
`row * columns + column`. Positions are in metres in the map's frame: the lower-left corner of the grid lies at
`origin = (x, y, yaw)`, and for yaw 0 the centre of column c, row r counted from the bottom, is at
`origin + ((c + .5), (r + .5)) * resolution`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from sidestep._arguments import to_finite, to_floats, to_integers, to_states
from sidestep._repr import short_repr
from sidestep.errors import InputError, check, check_choice, to_count, to_number

Connectivity = Literal[4, 8]
Positions = Sequence[Sequence[float]]
"""x and y of points, as lists."""

STEPS = np.array([[-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [-1, 1], [1, -1], [1, 1]])
"""Row and column change of each action: up, down, left, right, then the four diagonals."""


class Cell(IntEnum):
    """The state of a cell on a map.

    Example:
        >>> int(Cell.UNKNOWN)
        -1
    """

    UNKNOWN = -1
    FREE = 0
    OCCUPIED = 1


@short_repr("shape", "resolution", "origin", "connectivity", "known")
@dataclass(frozen=True, eq=False)
class Grid:
    """The geometry of a map, what is known of its cells, and the moves on it.

    Attributes:
        known: A `Cell` value for each cell, row 0 at the top.
        resolution: The side of a cell, in metres.
        origin: x, y (metres) and yaw (radians) of the lower-left corner.
        connectivity: 4 (up, down, left, right) or 8 (and diagonals).

    Raises:
        InputError: For a grid without cells or of more than two axes, values that are not `Cell`s, a resolution that
            is not positive, an origin that is not finite, or another connectivity.

    Example:
        >>> grid = Grid.unknown(rows=2, columns=3)
        >>> int(grid.states(np.array([[0.5, 0.5]]))[0])  # the lower-left cell: row 1, column 0
        3
    """

    known: Int[np.ndarray, "rows columns"]
    resolution: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    connectivity: Connectivity = 4

    def __post_init__(self) -> None:
        known = to_integers(self.known, "known", ("rows", "columns"), least=-1, most=1, what="cells")
        check(known.size, "expected at least one cell, found none", field="known")
        origin = to_finite(self.origin, "origin", (3,)).tolist()
        check_choice(self.connectivity, (4, 8), "connectivity")
        # one byte for each cell: maps may have ten million
        object.__setattr__(self, "known", known.astype(np.int8))
        object.__setattr__(self, "resolution", to_number(self.resolution, "resolution", above=0))
        object.__setattr__(self, "origin", tuple(origin))

    @classmethod
    def unknown(cls, rows: int, columns: int, connectivity: Connectivity = 4) -> "Grid":
        """Return a grid of which nothing is known, with cells of one metre and its lower-left corner at (0, 0).

        Args:
            rows: Their number, at least 1.
            columns: Their number, at least 1.
            connectivity: 4, or 8 with diagonals.

        Raises:
            InputError: For numbers below 1 and another connectivity.
        """
        rows, columns = to_count(rows, "rows"), to_count(columns, "columns")
        return cls(np.full((rows, columns), Cell.UNKNOWN, dtype=np.int8), connectivity=connectivity)

    @property
    def shape(self) -> tuple[int, int]:
        """Return the numbers of rows and columns."""
        return self.known.shape[0], self.known.shape[1]

    @property
    def size(self) -> int:
        """Return the number of cells, which is the number of states."""
        return self.known.size

    @property
    def steps(self) -> Int[np.ndarray, "actions 2"]:
        """Return the row and column change of each action: up, down, left, right, then the diagonals if any."""
        return STEPS[: self.connectivity]

    @property
    def lengths(self) -> Float[np.ndarray, " actions"]:
        """Return the length of each action, in cell sides: 1, and √2 for diagonals."""
        return np.linalg.norm(self.steps, axis=1)

    def forget(self) -> "Grid":
        """Return the same grid with nothing known."""
        return replace(self, known=np.full_like(self.known, Cell.UNKNOWN))

    def passable(self) -> "Grid":
        """Return the same grid with everything free that is not known to be occupied."""
        return replace(self, known=np.where(self.known == Cell.OCCUPIED, Cell.OCCUPIED, Cell.FREE))

    def contains(self, positions: Float[np.ndarray, "points 2"] | Positions) -> Bool[np.ndarray, " points"]:
        """Return whether each position (metres) lies on the grid; a position that is not finite does not.

        Args:
            positions: x, y of each point in metres.

        Raises:
            InputError: For positions that are not pairs of numbers.
        """
        rows, columns = self.shape
        with np.errstate(invalid="ignore"):
            column, row_up = self.to_cell_units(positions).T
            slack = 1e-9 * max(rows, columns)
            return (column >= -slack) & (column <= columns + slack) & (row_up >= -slack) & (row_up <= rows + slack)

    def states(self, positions: Float[np.ndarray, "points 2"] | Positions) -> Int[np.ndarray, " points"]:
        """Return the state of the cell at each position.

        Args:
            positions: x, y of each point in metres.

        Raises:
            InputError: For a position outside the grid.
        """
        points = to_floats(positions, "positions", ("points", 2))
        inside = self.contains(points)
        if not inside.all():
            index = int(np.argmin(inside))
            message = f"expected a position on the map, {self.extent()}, found {points[index].tolist()}"
            raise InputError(message, row=index + 1)
        rows, columns = self.shape
        # a position on a border, but for rounding, belongs to the cell above or to the right of it; one on the outer
        # edge to the cell inside it
        column, row_up = np.floor(self.to_cell_units(points) + 1e-9).astype(np.int64).T
        return (rows - 1 - np.clip(row_up, 0, rows - 1)) * columns + np.clip(column, 0, columns - 1)

    def state(self, position: tuple[float, float]) -> int:
        """Return the state of the cell at one position.

        Args:
            position: x, y in metres.

        Raises:
            InputError: For a position outside the grid.
        """
        return int(self.states(to_floats(position, "position", (2,))[None])[0])

    def centers(self, states: Integer[np.ndarray, " points"] | Sequence[int]) -> Float[np.ndarray, "points 2"]:
        """Return the position (metres) of the center of each state's cell.

        Args:
            states: The states, in 0…size − 1.

        Raises:
            InputError: For anything but a list of such states.
        """
        rows, columns = self.shape
        row, column = np.divmod(to_states(states, self.size, "states"), columns)
        return self.to_metres(np.stack([column + 0.5, rows - row - 0.5], axis=-1))

    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Return the corners of the map in metres, the lower left one first."""
        rows, columns = self.shape
        return self.to_metres(np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], dtype=np.float64))

    def extent(self) -> str:
        """Return the ranges of x and y on the map, for messages."""
        (left, bottom), (right, top) = self.corners().min(axis=0), self.corners().max(axis=0)
        return f"x in {left:g} to {right:g} m and y in {bottom:g} to {top:g} m"

    def to_cell_units(self, positions: Float[np.ndarray, "points 2"] | Positions) -> Float[np.ndarray, "points 2"]:
        """Return positions in metres as (columns from the left, rows from the *bottom*), not rounded.

        Args:
            positions: x, y of each point in metres.

        Raises:
            InputError: For positions that are not pairs of numbers.
        """
        offset = to_floats(positions, "positions", ("points", 2)) - np.asarray(self.origin[:2])
        return offset @ _rotation(self.origin[2]) / self.resolution

    def to_metres(self, cell_units: Float[np.ndarray, "points 2"] | Positions) -> Float[np.ndarray, "points 2"]:
        """Return positions in metres; the inverse of `to_cell_units`.

        Args:
            cell_units: Columns from the left and rows from the bottom of each point.

        Raises:
            InputError: For anything but pairs of numbers.
        """
        return to_floats(cell_units, "cell_units", ("points", 2)) * self.resolution @ _rotation(
            self.origin[2]
        ).T + np.asarray(self.origin[:2])


def _rotation(yaw: float) -> Float[np.ndarray, "2 2"]:
    """Return the matrix R that turns a vector by `yaw`; row vectors turn forward by `v @ R.T` and back by `v @ R`."""
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
