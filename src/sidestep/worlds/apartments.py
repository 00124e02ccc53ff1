"""Random apartments: rooms by recursive division, with a door in each wall, all free cells connected."""

import numpy as np
from jaxtyping import Int
from numpy.random import Generator

from sidestep.errors import check, check_count, to_count
from sidestep.tabular.grid import Cell, Connectivity, Grid

_Room = Int[np.ndarray, "_ _"]
_SMALLEST = 5
_NARROWEST = 3
"""The least number of rows and columns of a room, if the apartment has as many."""
_LARGEST = 8
"""Rooms with more rows or columns are always divided."""
_DIVIDED = 0.5
"""The probability that a smaller room is divided where it is large enough."""


def apartment(rows: int, columns: int, seed: int, connectivity: Connectivity = 4) -> Grid:
    """Return a random apartment with cells of one metre, fully known.

    A wall runs around it. What is inside is divided into two rooms by a wall one cell thick with a door, and so is each
    of the two, until rooms are small: most have three to eight rows and columns. No wall ends at a door.

    Args:
        rows: The number of rows, at least 5.
        columns: The number of columns, at least 5.
        seed: The seed; equal seeds give equal apartments.
        connectivity: The number of moves, 4 or 8.

    Returns:
        A map of shape (rows, columns) without unknown cells.

    Raises:
        InputError: For too few rows or columns.

    Example:
        >>> apartment(20, 30, seed=0).shape
        (20, 30)
    """
    rows, columns = to_count(rows, "rows"), to_count(columns, "columns")
    check_count(seed, 0, "seed")
    message = f"expected at least {_SMALLEST} rows and {_SMALLEST} columns, found {rows} and {columns}"
    check(rows >= _SMALLEST and columns >= _SMALLEST, message)
    random = np.random.default_rng(seed)
    cells = np.full((rows, columns), int(Cell.OCCUPIED), dtype=np.int64)
    cells[1:-1, 1:-1] = Cell.FREE
    rooms = [cells]
    while rooms:
        rooms += _divide(rooms.pop(), random)
    return Grid(cells, connectivity=connectivity)


def _divide(room: _Room, random: Generator) -> list[_Room]:
    """Build a wall with a door through a room, seen with the walls around it; return the parts, seen likewise."""
    rows, columns = room.shape
    if max(rows, columns) - 2 <= _LARGEST and random.random() >= _DIVIDED:
        return []
    across = room if rows > columns or (rows == columns and random.random() < 0.5) else room.T
    # a wall across the longer side, with rooms on both sides and no door at either end
    possible = np.arange(_NARROWEST + 1, len(across) - _NARROWEST - 1)
    possible = possible[(across[possible][:, [0, -1]] == Cell.OCCUPIED).all(axis=1)]
    if not len(possible):
        return []
    wall = int(random.choice(possible))
    across[wall] = Cell.OCCUPIED
    across[wall, random.integers(1, across.shape[1] - 1)] = Cell.FREE
    return [across[: wall + 1], across[wall:]]
