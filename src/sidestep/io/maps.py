"""Maps as ROS `map_server` and Nav2 read them: a YAML file beside a PGM or PNG image.

Every pixel is a cell and row 0 is the top. A pixel of gray value v has occupancy p = (255 − v)/255, or v/255 where the
YAML has `negate: 1`; p above `occupied_thresh` is occupied, below `free_thresh` free, anything else unknown. In `raw`
mode v itself is the occupancy in percent, and above 100 unknown.

A map from a robot's own sensors has P(occupied) of each cell. It is in mode `scale` or `raw`, as mappers save it: the
occupancy of a pixel *is* the probability, and the thresholds have no meaning. Transparent pixels (`scale`) and values
above 100 (`raw`) are unknown.
"""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sidestep._arguments import to_finite, to_mask
from sidestep._files import read_array, read_whole, write_whole
from sidestep.errors import InputError, check, check_choice, check_instance, input_errors, to_path
from sidestep.tabular.grid import Cell, Connectivity, Grid

MOST_PIXELS = 100_000_000
"""Images with more pixels are refused before they are decoded."""

OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.196
"""The thresholds written into learned maps, those of nearly every ROS map.

Nav2 ignores them in `raw` mode, where a value is the occupancy in percent. `read_map` uses them.
"""
UNKNOWN_PIXEL = 205
"""The gray of unknown cells in the maps that mappers write; in `raw` mode all above 100 is unknown."""

_ORIGIN_TOLERANCE = 1e-3
"""Two corners are the same within this distance in cell sides (and within rounding)."""


class Raster(NamedTuple):
    """The contents of the two files of a ROS map, without an interpretation.

    Attributes:
        occupancy: Of each cell, row 0 at the top, from 0 to 1; NaN where the map has none.
        mode: Trinary, scale or raw.
        resolution: The side of a cell in metres.
        origin: X, y (metres) and yaw (radians) of the lower-left corner.
        occupied_above: The threshold for occupied cells.
        free_below: The threshold for free cells.
    """

    occupancy: Float[np.ndarray, "rows columns"]
    mode: str
    resolution: float
    origin: tuple[float, float, float]
    occupied_above: float
    free_below: float


def read_map(path: str | Path, connectivity: Connectivity = 4) -> Grid:
    """Return the grid of a ROS map: geometry from the YAML file (metres, radians), known cells from the image.

    Args:
        path: The YAML file.
        connectivity: 4 or 8, of the moves on the map; it is not in the file.

    Raises:
        InputError: As `read_raster` does.

    Example:
        >>> grid = read_map("office.yaml")  # doctest: +SKIP
    """
    check_choice(connectivity, (4, 8), "connectivity")
    raster = read_raster(path)
    with np.errstate(invalid="ignore"):
        free = np.where(raster.occupancy < raster.free_below, Cell.FREE, Cell.UNKNOWN)
        known = np.where(raster.occupancy > raster.occupied_above, Cell.OCCUPIED, free)
    return Grid(known, raster.resolution, raster.origin, connectivity)


def read_map_like(path: str | Path, grid: Grid) -> Grid:
    """Return the grid of another ROS map of the same place, with the connectivity of `grid`.

    Args:
        path: The YAML file.
        grid: The map of the same place.

    Raises:
        InputError: As `read_raster` does, and for another size, resolution or origin than that of `grid`.
    """
    other = read_map(path, connectivity=grid.connectivity)
    check_geometry(path, other.shape, other.resolution, other.origin, grid)
    return other


def check_geometry(
    path: object, shape: tuple[int, ...], resolution: float, origin: tuple[float, float, float], grid: Grid
) -> None:
    """Raise `InputError` if the map in `path` has another size, resolution or origin than `grid`.

    Args:
        path: The file, for the error.
        shape: Its numbers of rows and columns.
        resolution: The side of a cell in metres.
        origin: x, y (metres) and yaw (radians) of the lower-left corner.
        grid: The map to which it belongs.

    Raises:
        InputError: Naming the file and the field that differs.
    """
    message = f"expected the map's {grid.resolution} metres a cell, found {resolution}"
    check(np.isclose(resolution, grid.resolution), message, source=path, field="resolution")
    same = np.allclose(origin, grid.origin, atol=_ORIGIN_TOLERANCE * grid.resolution)
    check(same, f"expected the map's {grid.origin}, found {origin}", source=path, field="origin")
    expected, actual = (" × ".join(map(str, each)) for each in (grid.shape, shape))
    check(shape == grid.shape, f"expected the map's {expected} cells, found {actual}", source=path, field="image")


def read_raster(path: str | Path) -> Raster:
    """Return the contents of the files of a ROS map.

    The image is PGM or PNG, of 8 or 16 bits, gray or in color (then the mean of the channels counts); cells under fully
    transparent pixels are unknown.

    Args:
        path: The YAML file.

    Raises:
        InputError: Naming file and key, for YAML that cannot be read, lacks keys or has values of the wrong kind, and
            for an image that is outside the folder of the YAML file, has more than `MOST_PIXELS` or cannot be decoded.
    """
    path = to_path(path)
    settings = _settings(path)
    keys = ("resolution", "occupied_thresh", "free_thresh")
    resolution, occupied, free = (_number(settings[key], key, path) for key in keys)
    check(resolution > 0, f"expected metres above 0, found {resolution}", source=path, field="resolution")
    for key, threshold in (("occupied_thresh", occupied), ("free_thresh", free)):
        check(0 <= threshold <= 1, f"expected a number from 0 to 1, found {threshold}", source=path, field=key)
    message = f"expected less than occupied_thresh ({occupied}), found {free}"
    check(free < occupied, message, source=path, field="free_thresh")
    origin, negate, mode = settings["origin"], settings["negate"], settings.get("mode", "trinary")
    message = f"expected three numbers [x, y, yaw], found {origin!r}"
    check(isinstance(origin, list) and len(origin) == 3, message, source=path, field="origin")
    x, y, yaw = (_number(value, "origin", path) for value in origin)
    check(negate in (0, 1), f"expected 0 or 1, found {negate!r}", source=path, field="negate")
    message = f"expected trinary, scale or raw, found {mode!r}"
    check(mode in ("trinary", "scale", "raw"), message, source=path, field="mode")
    gray, transparent = _gray(_image_path(settings["image"], path))
    occupancy = gray / 255 if negate else (255 - gray) / 255
    if mode == "raw":  # `negate` has no meaning here, as in Nav2.
        percent = np.rint(gray)
        occupancy = np.where(percent <= 100, percent / 100, np.nan)
    occupancy[transparent] = np.nan
    return Raster(occupancy, mode, resolution, (x, y, yaw), occupied, free)


def read_sensor_map(path: str | Path, grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """Return P(occupied) of each cell of a grid, row 0 at the top; NaN where the sensors have no reading.

    Args:
        path: The YAML file of a ROS map.
        grid: The map to which it belongs.

    Raises:
        InputError: As `read_raster` does, and, naming file and field, for a map in mode `trinary`, which has no
            probabilities, or of another size, resolution or origin than the grid.

    Example:
        >>> occupied = read_sensor_map("sensed.yaml", grid)  # doctest: +SKIP
    """
    check_instance(grid, Grid, "grid")
    raster = read_raster(path)
    message = "expected scale or raw: a trinary map has no probabilities"
    check(raster.mode != "trinary", message, source=path, field="mode")
    check_geometry(path, raster.occupancy.shape, raster.resolution, raster.origin, grid)
    return raster.occupancy


def read_sensor_variance(path: str | Path, grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """Return the variance of the logit of each cell's P(occupied), from a `.npy` file; see `sensor_prior`.

    Args:
        path: The file, with rows top first; NaN or infinite where nothing is known.
        grid: The map to which it belongs.

    Raises:
        InputError: For a file without an array of the grid's shape, and for numbers that are not above 0.

    Example:
        >>> variance = read_sensor_variance("variance.npy", grid)  # doctest: +SKIP
    """
    check_instance(grid, Grid, "grid")
    variance, field = read_array(to_path(path), kinds="fiu").astype(np.float64), "sensor variance"
    message = f"expected the map's {grid.shape} rows and columns, found {variance.shape}"
    check(variance.shape == grid.shape, message, source=path, field=field)
    wrong = np.argwhere(variance <= 0)
    if len(wrong):
        row, column = wrong[0]
        message = f"expected numbers above 0, found {variance[row, column]:g} in column {column + 1}"
        raise InputError(message, source=path, row=int(row) + 1, field=field)
    return variance


def write_map(
    path: str | Path,
    blocked: Float[np.ndarray, "rows columns"] | Sequence[Sequence[float]],
    grid: Grid,
    *,
    unknown: Bool[np.ndarray, "_ _"] | Sequence[Sequence[bool]] | None = None,
) -> None:
    """Write P(blocked) as a ROS map in `raw` mode: `NAME.yaml` and `NAME.pgm`.

    A pixel is P(blocked) in percent, rounded, or 205 where a cell is unknown: so `map_server` publishes the percentages
    of an OccupancyGrid, and −1. Mode `scale` would lose more: it has 0 below `free_thresh` and 100 above
    `occupied_thresh`. Resolution and origin are those of the grid, to the last digit. Both files appear atomically, the
    image first.

    Args:
        path: A name that ends in .yaml or .yml.
        blocked: P(blocked) of each cell, from 0 to 1.
        grid: The geometry of the map.
        unknown: The cells that are written as unknown; by default none.

    Raises:
        InputError: For another ending, arrays of another shape than the grid, and values outside 0…1.

    Example:
        >>> write_map("learned.yaml", blocked, grid)  # doctest: +SKIP
    """
    import yaml
    from PIL import Image

    path = to_path(path)
    message = f"expected a file name that ends in .yaml or .yml, found {path.name!r}"
    check(path.suffix.lower() in (".yaml", ".yml"), message, source=path)
    check_instance(grid, Grid, "grid")
    probabilities = to_finite(blocked, "blocked", grid.shape, least=0, most=1)
    is_unknown = np.zeros(grid.shape, bool) if unknown is None else to_mask(unknown, "unknown", grid.shape)
    image = path.with_suffix(".pgm")
    place = {"resolution": float(grid.resolution), "origin": [float(number) for number in grid.origin]}
    meaning = {"negate": 0, "occupied_thresh": OCCUPIED_ABOVE, "free_thresh": FREE_BELOW}
    settings = {"image": image.name, "mode": "raw", **place, **meaning}
    pixels = Image.fromarray(np.where(is_unknown, UNKNOWN_PIXEL, np.rint(100 * probabilities)).astype(np.uint8))
    text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)
    write_whole(image, lambda file: pixels.save(file, format="PPM"))
    write_whole(path, lambda file: file.write(text.encode()))


def _settings(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file, with all keys that are required."""
    import yaml

    content = read_whole(path)
    try:
        settings = yaml.safe_load(content)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"expected YAML: {' '.join(str(error).split())}", source=path) from error
    check(isinstance(settings, dict), "expected YAML with keys such as 'image: map.pgm'", source=path)
    for key in ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"):
        check(settings.get(key) is not None, "the key is missing", source=path, field=key)
    return settings


def _number(value: object, key: str, path: Path) -> float:
    """Return a finite number, also from text: 5e-2 is text in YAML and a number in ROS."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    check(math.isfinite(number), f"expected a finite number, found {value!r}", source=path, field=key)
    return number


def _image_path(name: Any, path: Path) -> Path:
    """Return the path of the image, which must be in the folder of the YAML file or below, links followed."""
    check(isinstance(name, str) and name, f"expected the name of an image, found {name!r}", source=path, field="image")
    with input_errors("expected the name of an image", OSError, RuntimeError, ValueError, source=path, field="image"):
        folder = path.parent.resolve()
        image = (folder / name).resolve()
    message = f"expected an image inside the folder of the YAML file, found {name!r}"
    check(not Path(name).is_absolute() and image.is_relative_to(folder), message, source=path, field="image")
    check(image.is_file(), f"there is no image {name!r}", source=path, field="image")
    return path.parent / name


def _gray(path: Path) -> tuple[Float[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """Return the gray value of each pixel on a scale of 0 to 255, and which pixels are fully transparent."""
    from PIL import Image

    # decoders raise errors of any kind on broken files; Pillow warns of large images and of odd headers without a name
    reading = input_errors("expected an image in PGM or PNG format", Exception, source=path)
    with reading, warnings.catch_warnings(action="ignore"), Image.open(path, formats=("PPM", "PNG")) as image:
        width, height = image.size
        if not 0 < width * height <= MOST_PIXELS:
            raise ValueError(f"{width:,} by {height:,} pixels, but from 1 to {MOST_PIXELS:,} can be read")
        if image.mode == "F":
            raise ValueError("the pixels are fractions, as in PFM")
        sixteen_bits = image.mode.startswith("I")
        if not sixteen_bits and (image.mode not in ("1", "L") or "transparency" in image.info):
            channels = np.asarray(image.convert("RGBA"))
            return channels[..., :3].mean(axis=-1), channels[..., 3] == 0
        gray = np.asarray(image if sixteen_bits else image.convert("L"), dtype=np.float64)
        return gray * (255 / 65535) if sixteen_bits else gray, np.zeros(gray.shape, dtype=bool)
