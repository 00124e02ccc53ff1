"""What a robot's sensors have seen, as a prior of `sidestep learn`."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sidestep.inference.priors import Normal, sensor_prior
from sidestep.io.sensors import read_sensor_map, read_sensor_variance
from sidestep.tabular.grid import Cell, Grid


class Sensor(NamedTuple):
    """A map of what sensors have seen, and how surely they saw it.

    `variance` is that of each cell's logit: one number, or a `.npy` file of one a cell.
    """

    map_file: Path
    variance: float | Path = 0.5

    def told(self) -> dict[str, str | float]:
        """What a summary says of it."""
        variance = self.variance
        return {"map": str(self.map_file), "variance": str(variance) if isinstance(variance, Path) else variance}


class Known(NamedTuple):
    """What is known of cells before anybody walks.

    - `prior`: of each cell's logit.
    - `seen`: P(occupied) of the unknown cells that sensors have seen; NaN for all others.
    """

    prior: Normal
    seen: Float[np.ndarray, "rows columns"]


def known_by(sensor: Sensor | None, grid: Grid, elsewhere: Normal) -> Known:
    """What sensors tell of a grid's unknown cells; `elsewhere` is the prior of those that they have not seen.

    Raises `InputError` for files that do not fit the grid.
    """
    if sensor is None:
        return Known(elsewhere, np.full(grid.shape, np.nan))
    probability, variance = read_sensor_map(sensor.map_file, grid), sensor.variance
    if isinstance(variance, Path):
        variance = read_sensor_variance(variance, grid)
    seen = np.isfinite(variance) & (grid.known == Cell.UNKNOWN)
    return Known(sensor_prior(probability, variance, elsewhere), np.where(seen, probability, np.nan))
