"""Rooms in a row, with walls one cell thick between them, and a door in each wall."""

import numpy as np

from sidestep._arguments import to_integers
from sidestep.errors import check, to_count
from sidestep.tabular.grid import Cell, Connectivity, Grid


def rooms_in_a_row(rows: int, columns: int, doors: tuple[int, ...], connectivity: Connectivity = 4) -> Grid:
    """Return a fully known map of rooms of equal width, up to a column, in cells of one meter.

    Args:
        rows: The number of rows, 1 or more.
        columns: The number of columns, enough for each room to have one.
        doors: The row of the free cell in each wall from left to right, 0 at the top; there is one room more.
        connectivity: The number of directions, 4 or 8.

    Returns:
        A map of shape (rows, columns) without unknown cells.

    Raises:
        InputError: For too few columns or rows, or a door outside its wall.

    Example:
        >>> rooms_in_a_row(3, 5, doors=(2,)).known.tolist()
        [[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]]
    """
    rows, columns = to_count(rows, "rows"), to_count(columns, "columns")
    own = to_integers(doors, "doors", ("doors",), least=0, most=rows - 1, what="rows").tolist()
    check(columns >= 2 * len(doors) + 1, f"expected at least {2 * len(doors) + 1}, found {columns}", field="columns")
    cells = np.full((rows, columns), int(Cell.FREE))
    walls = np.arange(1, len(doors) + 1) * (columns + 1) // (len(doors) + 1) - 1
    for wall, door in zip(walls, own, strict=True):
        cells[:, wall] = Cell.OCCUPIED
        cells[door, wall] = Cell.FREE
    return Grid(cells, connectivity=connectivity)
