"""Flats: two or three rooms in a row, walls one cell thick between them, and a door in each wall."""

import numpy as np

from sidestep.errors import InputError
from sidestep.tabular.grid import Cell, Connectivity, Grid


def two_rooms(rows: int, columns: int, door: int, connectivity: Connectivity = 4) -> Grid:
    """Two rooms side by side, the wall in the middle column; fully known, cells of one metre.

    - `door`: the row of the free cell in the wall, 0 at the top.

    Raises `InputError` for fewer than 3 columns, no row, and a door outside the wall.

    >>> two_rooms(3, 5, door=2).known.tolist()
    [[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]]
    """
    return _in_a_row(rows, columns, (door,), connectivity)


def three_rooms(rows: int, columns: int, doors: tuple[int, int], connectivity: Connectivity = 4) -> Grid:
    """Three rooms side by side, as wide as one another but for a column; fully known, cells of one metre.

    - `doors`: the rows of the free cells in the left and in the right wall, 0 at the top.

    Raises `InputError` for fewer than 5 columns, no row, and doors outside the walls.

    >>> three_rooms(2, 5, doors=(0, 1)).known.tolist()
    [[0, 0, 0, 1, 0], [0, 1, 0, 0, 0]]
    """
    return _in_a_row(rows, columns, doors, connectivity)


def _in_a_row(rows: int, columns: int, doors: tuple[int, ...], connectivity: Connectivity) -> Grid:
    if columns < 2 * len(doors) + 1:
        raise InputError(f"expected at least {2 * len(doors) + 1}, found {columns}", field="columns")
    if rows < 1:
        raise InputError(f"expected at least 1, found {rows}", field="rows")
    cells = np.full((rows, columns), int(Cell.FREE))
    walls = np.arange(1, len(doors) + 1) * (columns + 1) // (len(doors) + 1) - 1
    for wall, door in zip(walls, doors, strict=True):
        if not 0 <= door < rows:
            raise InputError(f"expected a row in 0…{rows - 1}, found {door}", field="door")
        cells[:, wall] = Cell.OCCUPIED
        cells[door, wall] = Cell.FREE
    return Grid(cells, connectivity=connectivity)
