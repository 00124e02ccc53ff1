"""The true map that a learned one is compared with."""

from pathlib import Path

import numpy as np

from sidestep.errors import InputError
from sidestep.io.maps import read_map
from sidestep.tabular.grid import Grid


def read_truth(path: Path, grid: Grid) -> Grid:
    """The true map of the same place; raises `InputError` for one of another size, resolution or origin."""
    truth = read_map(path, connectivity=grid.connectivity)
    if truth.shape != grid.shape:
        expected, found = (" × ".join(map(str, each.shape)) for each in (grid, truth))
        raise InputError(f"expected the map's {expected} cells, found {found}", source=path)
    if not np.isclose(truth.resolution, grid.resolution):
        raise InputError(
            f"expected the map's {grid.resolution} metres a cell, found {truth.resolution}",
            source=path,
            field="resolution",
        )
    if not np.allclose(truth.origin, grid.origin):
        raise InputError(f"expected the map's {grid.origin}, found {truth.origin}", source=path, field="origin")
    return truth
