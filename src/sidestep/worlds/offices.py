"""Random offices: rooms with doors on both sides of corridors, all free cells connected."""

from itertools import pairwise

import numpy as np
from jaxtyping import Int
from numpy.random import Generator

from sidestep.errors import check, check_count, to_count
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Connectivity, Grid

_SMALLEST = (10, 8)
_WING = 18
"""Rows from one outer wall to the next, with rooms, a corridor and rooms between them."""
_BETWEEN_CROSSINGS = 40
"""Columns from one crossing corridor to the next."""
_CANDIDATES = 16


def office(rows: int, columns: int, seed: int, connectivity: Connectivity = 4) -> Grid:
    """Return a random office with cells of one metre, fully known.

    Corridors run from left to right with rooms above and below. Each room has a door to the corridor, and some have
    one to the next room. Several corridors are crossed by others.

    Args:
        rows: The number of rows, at least 10.
        columns: The number of columns, at least 8.
        seed: The seed; equal seeds give equal offices.
        connectivity: The number of moves, 4 or 8.

    Returns:
        A map of shape (rows, columns) without unknown cells.

    Raises:
        InputError: For too few rows or columns.

    Example:
        >>> office(20, 30, seed=0).shape
        (20, 30)
    """
    rows, columns = to_count(rows, "rows"), to_count(columns, "columns")
    check_count(seed, 0, "seed")
    message = f"expected at least {_SMALLEST[0]} rows and {_SMALLEST[1]} columns, found {rows} and {columns}"
    check(rows >= _SMALLEST[0] and columns >= _SMALLEST[1], message)
    random = np.random.default_rng(seed)
    cells = np.full((rows, columns), int(Cell.OCCUPIED), dtype=np.int64)
    wings = max(1, round((rows - 1) / _WING))
    crossings = _crossings(wings, columns, random)
    for top, bottom in pairwise(np.linspace(0, rows - 1, wings + 1).round().astype(int).tolist()):
        _add_wing(cells, top, bottom, crossings, random)
    for left in crossings:
        cells[1:-1, left : left + 2] = Cell.FREE
    return Grid(cells, connectivity=connectivity)


def places(grid: Grid, count: int, seed: int) -> Int[np.ndarray, " count"]:
    """Return random free cells (states) that are connected and far from each other.

    Each cell is the one with the longest path to the cells before it, of 16 random cells of the largest connected
    component.

    Args:
        grid: The map.
        count: The number of cells, at least 1.
        seed: The seed.

    Returns:
        The cells (states) in the order of choice.

    Raises:
        InputError: For a count below 1 or above the size of the component.
    """
    from scipy.sparse.csgraph import dijkstra

    graph = walkable_graph(grid)
    candidates = connected_cells(grid)
    count = to_count(count, "count", 1, len(candidates))
    check_count(seed, 0, "seed")
    random = np.random.default_rng(seed)
    chosen = [int(random.choice(candidates))]
    distance = dijkstra(graph, indices=chosen[0])
    while len(chosen) < count:
        remaining = candidates[distance[candidates] > 0]
        drawn = random.choice(remaining, size=min(_CANDIDATES, len(remaining)), replace=False)
        chosen.append(int(drawn[np.argmax(distance[drawn])]))
        distance = np.minimum(distance, dijkstra(graph, indices=chosen[-1]))
    return np.array(chosen)


def connected_cells(grid: Grid) -> Int[np.ndarray, " cells"]:
    """Return the free cells (states) of the largest connected component of a map.

    Args:
        grid: The map.

    Returns:
        The states in ascending order.
    """
    from scipy.sparse.csgraph import connected_components

    label = connected_components(walkable_graph(grid), directed=False)[1]
    free = grid.known.reshape(-1) == Cell.FREE
    return np.flatnonzero(free & (label == np.argmax(np.bincount(label, weights=free))))


def _crossings(wings: int, columns: int, random: Generator) -> list[int]:
    """Return the left columns of the corridors that cross the wings; a single wing has none."""
    if wings == 1:
        return []
    count = max(1, round(columns / _BETWEEN_CROSSINGS))
    spacing = columns / count
    drawn = spacing * (np.arange(count) + random.uniform(0.3, 0.7, size=count))
    # three columns from the outer walls, so that the outermost rooms have a floor
    return np.clip(drawn.astype(int), 3, columns - 5).tolist()


def _add_wing(cells: np.ndarray, top: int, bottom: int, crossings: list[int], random: Generator) -> None:
    """Clear a corridor and the rooms beside it, between the walls in rows `top` and `bottom`."""
    height = 2 if bottom - top > 12 else 1
    corridor = top + (bottom - top - height) // 2 + int(random.integers(0, 2))
    cells[corridor : corridor + height, 1:-1] = Cell.FREE
    below = corridor + height
    _add_rooms(cells, slice(top + 1, corridor - 1), corridor - 1, crossings, random)
    _add_rooms(cells, slice(below + 1, bottom), below, crossings, random)


def _add_rooms(cells: np.ndarray, rows: slice, door_row: int, crossings: list[int], random: Generator) -> None:
    """Clear a line of rooms in some rows, each with a door in the wall at `door_row`."""
    # a crossing corridor has a wall on either side, and the rooms end there
    ends = [0, *(column for left in crossings for column in (left - 1, left + 2)), cells.shape[1] - 1]
    for left, right in zip(ends[::2], ends[1::2], strict=True):
        # the walls of a row of rooms, 3 to 8 columns of floor between them if possible
        walls = [left]
        while right - walls[-1] > 9:
            walls.append(walls[-1] + int(random.integers(4, min(9, right - walls[-1] - 4) + 1)))
        walls.append(right)
        for west, east in pairwise(walls):
            cells[rows, west + 1 : east] = Cell.FREE
            cells[door_row, random.integers(west + 1, east)] = Cell.FREE
        for wall in walls[1:-1]:
            if random.random() < 0.3:
                cells[random.integers(rows.start, rows.stop), wall] = Cell.FREE
