"""Blocks: an open floor with random obstacles of a few cells each, all free cells connected."""

import numpy as np
from jaxtyping import Bool, Int
from numpy.random import Generator
from scipy import ndimage

from sidestep._arguments import to_integers
from sidestep.errors import check, check_count, to_count, to_number
from sidestep.tabular.grid import Cell, Connectivity, Grid

_SIDES = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
_TRIES = 100
"""The number of failures in a row after which the floor counts as full."""


def blocks(
    rows: int,
    columns: int,
    seed: int,
    density: float = 0.2,
    sizes: tuple[int, int] = (2, 5),
    touching: bool = False,
    connectivity: Connectivity = 4,
) -> Grid:
    """Return an open floor with random obstacles of two to five cells, in cells of one metre, fully known.

    Obstacles are polyominoes, as tetrominoes are: cells that are connected by their sides. A shape grows from a cell by
    random neighbors. It is placed at random where it neither overlaps another, nor touches one at a side or corner, nor
    separates free cells.

    Args:
        rows: The number of rows, at least 3.
        columns: The number of columns, at least 3.
        seed: The seed; equal seeds give equal floors.
        density: The fraction of cells that are obstacles, above 0 and below 1; less where no more have room, which is
            above about .3 (.6 where they may touch).
        sizes: The least and the greatest number of cells of an obstacle, at least 1.
        touching: Whether obstacles may touch.
        connectivity: The number of moves, 4 or 8.

    Returns:
        A map of shape (rows, columns) without unknown cells.

    Raises:
        InputError: For too few rows or columns, and a density or sizes out of range.

    Example:
        >>> blocks(20, 30, seed=0).shape
        (20, 30)
    """
    rows, columns = to_count(rows, "rows"), to_count(columns, "columns")
    check_count(seed, 0, "seed")
    check(rows >= 3 and columns >= 3, f"expected at least 3 rows and 3 columns, found {rows} and {columns}")
    to_number(density, "density", above=0, below=1)
    least, greatest = to_integers(sizes, "sizes", (2,), least=1).tolist()
    check(least <= greatest, f"expected two numbers in order, found {sizes}", field="sizes")
    random = np.random.default_rng(seed)
    occupied, failures = np.zeros((rows, columns), dtype=bool), 0
    while occupied.sum() < density * occupied.size and failures < _TRIES:
        shape = polyomino(int(random.integers(least, greatest + 1)), random)
        places = shape + np.array([random.integers(rows), random.integers(columns)])
        fits = _fits(occupied, places, touching)
        if fits:
            occupied[tuple(places.T)] = True
        failures = 0 if fits else failures + 1
    return Grid(np.where(occupied, int(Cell.OCCUPIED), int(Cell.FREE)), connectivity=connectivity)


def polyomino(size: int, random: Generator) -> Int[np.ndarray, "size 2"]:
    """Return the rows and columns of a random polyomino, which grows from cell (0, 0) by random neighbors.

    Args:
        size: The number of cells, at least 1.
        random: The generator.

    Example:
        >>> polyomino(1, np.random.default_rng(0)).tolist()
        [[0, 0]]
    """
    cells = [(0, 0)]
    while len(cells) < size:
        row, column = np.array(cells[random.integers(len(cells))]) + random.choice(_SIDES)
        if (row, column) not in cells:
            cells.append((int(row), int(column)))
    return np.array(cells)


def _fits(occupied: Bool[np.ndarray, "rows columns"], places: Int[np.ndarray, "cells 2"], touching: bool) -> bool:
    """Return whether an obstacle may stand in some places: on the map, apart from others, and free cells connected."""
    if (places < 0).any() or (places >= occupied.shape).any():
        return False
    own = np.zeros_like(occupied)
    own[tuple(places.T)] = True
    near = own if touching else ndimage.binary_dilation(own, np.ones((3, 3), dtype=bool))
    parts = np.zeros(occupied.shape, dtype=np.int32)
    ndimage.label(~(occupied | own), output=parts)
    return not (occupied & near).any() and int(parts.max()) == 1
