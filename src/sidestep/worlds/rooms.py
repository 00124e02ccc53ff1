"""Two or three rooms in a row, with walls one cell thick between them, and a door in each wall."""

import numpy as np

from sidestep.errors import check
from sidestep.tabular.grid import Cell, Connectivity, Grid


def two_rooms(rows: int, columns: int, door: int, connectivity: Connectivity = 4) -> Grid:
    """Return a fully known map of two rooms with the wall in the middle column, in cells of one meter.

    Args:
        rows: 1 or more.
        columns: 3 or more.
        door: the row of the free cell in the wall, 0 at the top.
        connectivity: 4 or 8 directions.

    Raises:
        InputError: too few columns or rows, or a door outside the wall.

    Example:
        >>> two_rooms(3, 5, door=2).known.tolist()
        [[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]]
    """
    return _rooms_in_a_row(rows, columns, (door,), connectivity)


def three_rooms(rows: int, columns: int, doors: tuple[int, int], connectivity: Connectivity = 4) -> Grid:
    """Return a fully known map of three rooms of equal width, up to a column, in cells of one meter.

    Args:
        rows: 1 or more.
        columns: 5 or more.
        doors: the rows of the free cells in the left and in the right wall, 0 at the top.
        connectivity: 4 or 8 directions.

    Raises:
        InputError: too few columns or rows, or a door outside its wall.

    Example:
        >>> three_rooms(2, 5, doors=(0, 1)).known.tolist()
        [[0, 0, 0, 1, 0], [0, 1, 0, 0, 0]]
    """
    return _rooms_in_a_row(rows, columns, doors, connectivity)


def _rooms_in_a_row(rows: int, columns: int, doors: tuple[int, ...], connectivity: Connectivity) -> Grid:
    check(columns >= 2 * len(doors) + 1, f"expected at least {2 * len(doors) + 1}, found {columns}", field="columns")
    check(rows >= 1, f"expected at least 1, found {rows}", field="rows")
    cells = np.full((rows, columns), int(Cell.FREE))
    walls = np.arange(1, len(doors) + 1) * (columns + 1) // (len(doors) + 1) - 1
    for wall, door in zip(walls, doors, strict=True):
        check(0 <= door < rows, f"expected a row in 0…{rows - 1}, found {door}", field="door")
        cells[:, wall] = Cell.OCCUPIED
        cells[door, wall] = Cell.FREE
    return Grid(cells, connectivity=connectivity)
