"""What a robot's sensors have seen, as a prior of the cells."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sidestep.inference.priors import Normal, sensor_arrays, sensor_prior
from sidestep.io.maps import read_sensor_map, read_sensor_variance
from sidestep.maps.config import PriorConfig
from sidestep.tabular.grid import Cell, Grid


@dataclass(frozen=True, eq=False)
class SensorMap:
    """P(occupied) of each cell as sensors saw it, and the certainty of it.

    Attributes:
        probability: P(occupied), row 0 at the top; NaN where the sensors saw nothing.
        variance: The variance of each cell's logit, above 0; one number or one a cell.
        source: The file of the map, for the summary.
        variance_source: The file of the variances, for the summary.

    Example:
        >>> SensorMap(np.array([[0.9, np.nan]])).variance
        0.5
    """

    probability: Float[np.ndarray, "rows columns"]
    variance: float | Float[np.ndarray, "rows columns"] = 0.5
    source: str | None = None
    variance_source: str | None = None

    def __post_init__(self) -> None:
        sensor_arrays(self.probability, self.variance)

    def summary(self) -> dict[str, Any]:
        """Return the entries of `summary.json`: the file of the map, and the variance or its file.

        Returns:
            Plain numbers and texts.
        """
        variance = float(self.variance) if isinstance(self.variance, float | int) else self.variance_source
        return {"map": self.source, "variance": variance}


def read_sensor(map_file: str | Path, grid: Grid, variance: float | str | Path = 0.5) -> SensorMap:
    """Read what sensors saw of a grid.

    Args:
        map_file: A ROS map in mode `scale` or `raw`, of the grid's size, resolution and origin.
        grid: The grid.
        variance: The variance of each logit, above 0, or a `.npy` file with one number a cell.

    Returns:
        P(occupied) of each cell, NaN where the sensors saw nothing, and the variance of the logits.

    Raises:
        InputError: For files that do not fit the grid.

    Example:
        >>> import tempfile
        >>> from sidestep.io.maps import write_map
        >>> grid = Grid.unknown(rows=1, columns=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "seen.yaml"
        ...     write_map(path, np.array([[0.9, 0.1]]), grid)
        ...     read_sensor(path, grid).probability.round(1).tolist()
        [[0.9, 0.1]]
    """
    probability = read_sensor_map(map_file, grid)
    if isinstance(variance, float | int):
        return SensorMap(probability, float(variance), str(map_file))
    return SensorMap(probability, read_sensor_variance(variance, grid), str(map_file), str(variance))


def seen_cells(sensor: SensorMap | None, known: Int[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Return P(occupied) of the unknown cells that sensors have seen, and NaN elsewhere.

    Args:
        sensor: What sensors saw, if anything.
        known: The `Cell` value of each cell.
    """
    if sensor is None:
        return np.full(known.shape, np.nan)
    seen = np.isfinite(sensor.variance) & (known == Cell.UNKNOWN)
    return np.where(seen, sensor.probability, np.nan)


def cell_prior(sensor: SensorMap | None, config: PriorConfig) -> Normal:
    """Return the normal prior of the cells' logits; unseen cells have that of the configuration.

    Args:
        sensor: What sensors saw, if anything.
        config: The prior of unseen cells.
    """
    elsewhere = Normal(config.mean, config.variance)
    return elsewhere if sensor is None else sensor_prior(sensor.probability, sensor.variance, elsewhere)


def cell_field(
    sensor: SensorMap | None, known: Int[np.ndarray, "rows columns"], config: PriorConfig
) -> Float[np.ndarray, "rows columns"]:
    """Return the field of the binary prior: the log-odds of P(occupied) where sensors saw, and η elsewhere.

    A sensor's logit x has a variance v. The field is that of E[σ(x)] ≈ σ(x/√(1 + πv/8)) (MacKay 1992, *The evidence
    framework applied to classification networks*).

    Args:
        sensor: What sensors saw, if anything.
        known: The `Cell` value of each cell.
        config: The prior of unseen cells.
    """
    field = np.full(known.shape, config.first_logit)
    if sensor is None:
        return field
    seen = sensor_prior(sensor.probability, sensor.variance, Normal(0.0, 1.0))
    mean, variance = (np.asarray(each).reshape(known.shape) for each in (seen.mean, seen.variance))
    observed = np.isfinite(seen_cells(sensor, known))
    return np.where(observed, mean / np.sqrt(1 + np.pi * variance / 8), field)


def first_logits(
    sensor: SensorMap | None, known: Int[np.ndarray, "rows columns"], config: PriorConfig
) -> Float[np.ndarray, " cells"]:
    """Return the logit of P(blocked) of each cell at which a fit starts: the mean or field of the prior.

    Args:
        sensor: What sensors saw, if anything.
        known: The `Cell` value of each cell.
        config: The prior.
    """
    if config.kind == "binary":
        return cell_field(sensor, known, config).ravel()
    return np.array(np.broadcast_to(np.asarray(cell_prior(sensor, config).mean, np.float64), known.size))
