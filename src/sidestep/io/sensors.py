"""Maps from a robot's own sensors: P(occupied) of each cell, and its uncertainty.

The map is a ROS map in mode `scale` or `raw`, as mappers save them: the occupancy of a pixel *is* the probability, and
the thresholds have no meaning. Transparent pixels (`scale`) and values above 100 (`raw`) are unknown.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sidestep._files import read_array
from sidestep.errors import InputError, check
from sidestep.io.maps import check_geometry, read_raster
from sidestep.tabular.grid import Grid


def read_sensor_map(path: str | Path, grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """Return P(occupied) of each cell of a grid, row 0 at the top; NaN where the sensors have no reading.

    Args:
        path: the YAML file of a ROS map.
        grid: the map to which it belongs.

    Raises:
        InputError: as `read_raster` does, and, naming file and field, for a map in mode `trinary`, which has no
            probabilities, or of another size, resolution or origin than the grid.

    Example:
        >>> occupied = read_sensor_map("sensed.yaml", grid)  # doctest: +SKIP
    """
    raster = read_raster(path)
    if raster.mode == "trinary":
        raise InputError("expected scale or raw: a trinary map has no probabilities", source=path, field="mode")
    check_geometry(path, raster.occupancy.shape, raster.resolution, raster.origin, grid)
    return raster.occupancy


def read_sensor_variance(path: str | Path, grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """Return the variance of the logit of each cell's P(occupied), from a `.npy` file; see `sensor_prior`.

    Args:
        path: the file, with rows top first; NaN or infinite where nothing is known.
        grid: the map to which it belongs.

    Raises:
        InputError: for a file without an array of the grid's shape, and for numbers that are not above 0.

    Example:
        >>> variance = read_sensor_variance("variance.npy", grid)  # doctest: +SKIP
    """
    variance, field = read_array(path, kinds="fiu").astype(np.float64), "sensor variance"
    message = f"expected the map's {grid.shape} rows and columns, found {variance.shape}"
    check(variance.shape == grid.shape, message, source=path, field=field)
    wrong = np.argwhere(variance <= 0)
    if len(wrong):
        row, column = wrong[0]
        message = f"expected numbers above 0, found {variance[row, column]:g} in column {column + 1}"
        raise InputError(message, source=path, row=int(row) + 1, field=field)
    return variance
