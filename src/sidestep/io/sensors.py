"""What a robot's own sensors have seen: P(occupied) of each cell, and how surely each is known.

The map is a ROS map in mode `scale` or `raw`, as mappers save them: a pixel's occupancy *is* the probability, and its
thresholds count for nothing. Unknown is what lies under transparent pixels (`scale`) or above 100 (`raw`).
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sidestep._files import read_array
from sidestep.errors import InputError
from sidestep.io.maps import read_raster
from sidestep.tabular.grid import Grid

_CLOSE = 1e-3
"""How far, in cell sides, the corner of a sensor's map may lie from that of the map that it belongs to."""


def read_sensor_map(path: str | Path, grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """P(occupied) of each cell of a grid, row 0 at the top; NaN where the sensors saw nothing.

    Raises `InputError`, naming file and field, as `read_raster` does, and for a map in mode `trinary`, which holds no
    probabilities, or of another shape, resolution or origin than the grid.
    """
    found = read_raster(path)
    if found.mode == "trinary":
        raise InputError("expected scale or raw: a trinary map holds no probabilities", source=path, field="mode")
    if found.occupancy.shape != grid.shape:
        raise _of_another_map(path, "image", "rows and columns", grid.shape, found.occupancy.shape)
    if not np.isclose(found.resolution, grid.resolution):
        raise _of_another_map(path, "resolution", "metres a cell", grid.resolution, found.resolution)
    if not np.allclose(found.origin, grid.origin, rtol=0, atol=_CLOSE * grid.resolution):
        raise _of_another_map(path, "origin", "metres and radians", grid.origin, found.origin)
    return found.occupancy


def read_sensor_variance(path: str | Path, grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """The variance of each cell's logit from a `.npy` file, rows top first (see `sensor_prior`).

    NaN or infinite where nothing is known. Raises `InputError` for a file that holds no array of the grid's shape, and
    for numbers that are not above 0.
    """
    found = read_array(path, kinds="fiu").astype(np.float64)
    if found.shape != grid.shape:
        raise _of_another_map(path, "sensor variance", "rows and columns", grid.shape, found.shape)
    wrong = np.argwhere(found <= 0)
    if len(wrong):
        row, column = wrong[0]
        message = f"expected numbers above 0, found {found[row, column]:g} in column {column + 1}"
        raise InputError(message, source=path, row=int(row) + 1, field="sensor variance")
    return found


def _of_another_map(path: str | Path, field: str, unit: str, expected: object, found: object) -> InputError:
    return InputError(f"expected the map's {expected} {unit}, found {found}", source=path, field=field)
