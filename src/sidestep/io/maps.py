"""Maps as ROS `map_server` and Nav2 read them: a YAML file beside a PGM or PNG image.

Every pixel is a cell and row 0 is the top. A pixel of grey value v stands for occupancy p = (255 − v)/255,
or v/255 where the YAML says `negate: 1`; p above `occupied_thresh` is occupied, below `free_thresh` free,
anything else unknown. In `raw` mode v itself is the occupancy in percent, and above 100 unknown.
"""

import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from jaxtyping import Bool, Float
from PIL import Image

from sidestep._files import read_whole, write_whole
from sidestep.errors import InputError
from sidestep.tabular.grid import Cell, Connectivity, Grid

MOST_PIXELS = 100_000_000
"""Images with more pixels are refused before they are decoded."""

OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.196
"""The thresholds written into learned maps.

They are those of nearly every ROS map. In `scale` mode Nav2 spreads the occupancy between them over 0…100
and sets everything above 0.65 to 100, the only value that its default costmap treats as a wall
(`lethal_cost_threshold: 100`). With a threshold of 1 no learned wall, however sure, would ever stop a
robot.
"""


class Raster(NamedTuple):
    """What a ROS map's two files say, before anything is made of it.

    - `occupancy`: of each cell, row 0 at the top, from 0 to 1; NaN where the map does not say.
    - `mode`: trinary, scale or raw. `resolution`: metres. `origin`: metres and radians, of the lower-left corner.
    - `occupied_above`, `free_below`: the thresholds.
    """

    occupancy: Float[np.ndarray, "rows columns"]
    mode: str
    resolution: float
    origin: tuple[float, float, float]
    occupied_above: float
    free_below: float


def read_map(path: str | Path, connectivity: Connectivity = 4) -> Grid:
    """The grid of a ROS map: geometry from its YAML file (metres, radians), known cells from its image.

    `connectivity` (4 or 8) is the walker's, no part of the file. Raises `InputError` as `read_raster` does.

    >>> grid = read_map("office.yaml")  # doctest: +SKIP
    """
    found = read_raster(path)
    with np.errstate(invalid="ignore"):
        free = np.where(found.occupancy < found.free_below, Cell.FREE, Cell.UNKNOWN)
        known = np.where(found.occupancy > found.occupied_above, Cell.OCCUPIED, free)
    return Grid(known, found.resolution, found.origin, connectivity)


def read_raster(path: str | Path) -> Raster:
    """What a ROS map's files say.

    The image is PGM or PNG, of 8 or 16 bits, grey or in colour (then the mean of the channels counts); cells under
    fully transparent pixels are unknown. Raises `InputError`, naming file and key, for YAML that cannot be read, lacks
    keys or holds values of the wrong kind, and for an image that lies outside the YAML's folder, has more than
    `MOST_PIXELS` or cannot be decoded.
    """
    path = Path(path)
    settings = _settings(path)
    resolution, occupied, free = (
        _number(_entry(settings, key, path), key, path) for key in ("resolution", "occupied_thresh", "free_thresh")
    )
    if resolution <= 0:
        raise InputError(f"expected metres above 0, found {resolution}", source=path, field="resolution")
    for key, threshold in (("occupied_thresh", occupied), ("free_thresh", free)):
        if not 0 <= threshold <= 1:
            raise InputError(f"expected a number from 0 to 1, found {threshold}", source=path, field=key)
    if free >= occupied:
        message = f"expected less than occupied_thresh ({occupied}), found {free}"
        raise InputError(message, source=path, field="free_thresh")
    origin, negate, mode = _origin(settings, path), _negate(settings, path), _mode(settings, path)
    grey, transparent = _grey(_image_path(settings, path))
    occupancy = _occupancy(grey, negate, mode)
    occupancy[transparent] = np.nan
    return Raster(occupancy, mode, resolution, origin, occupied, free)


def write_map(path: str | Path, blocked: Float[np.ndarray, "rows columns"], grid: Grid) -> None:
    """Write P(blocked), one value from 0 to 1 a cell, as a ROS map in `scale` mode: `NAME.yaml` and
    `NAME.pgm`.

    A pixel is 255·(1 − p) rounded; resolution and origin are the grid's, to the last digit. Both files
    appear whole or not at all, the image first. Raises `InputError` for a name that does not end in .yaml
    or .yml, an array of another shape than the grid, and values outside 0…1.
    """
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError("expected a file whose name ends in .yaml or .yml", source=path)
    if blocked.shape != grid.shape:
        raise InputError(f"expected an array of shape {grid.shape}, found {blocked.shape}", field="blocked")
    if not ((blocked >= 0) & (blocked <= 1)).all():
        raise InputError("expected probabilities from 0 to 1 in every cell", field="blocked")
    image = path.with_suffix(".pgm")
    settings = {
        "image": image.name,
        "mode": "scale",
        "resolution": float(grid.resolution),
        "origin": [float(number) for number in grid.origin],
        "negate": 0,
        "occupied_thresh": OCCUPIED_ABOVE,
        "free_thresh": FREE_BELOW,
    }
    pixels = Image.fromarray(np.rint(255 * (1 - blocked)).astype(np.uint8))
    text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)
    write_whole(image, lambda file: pixels.save(file, format="PPM"))
    write_whole(path, lambda file: file.write(text.encode()))


def _settings(path: Path) -> dict[str, Any]:
    """The mapping that a YAML file holds."""
    content = read_whole(path)
    try:
        settings = yaml.safe_load(content)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"expected YAML: {' '.join(str(error).split())}", source=path) from error
    if not isinstance(settings, dict):
        raise InputError("expected YAML with keys such as 'image: map.pgm'", source=path)
    return settings


def _entry(settings: dict[str, Any], key: str, path: Path) -> Any:
    """The value of a required key."""
    if settings.get(key) is None:
        raise InputError("the key is missing", source=path, field=key)
    return settings[key]


def _number(value: object, key: str, path: Path) -> float:
    """A finite number; also from text, for YAML takes 5e-2 for text where ROS takes it for a number."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"expected a finite number, found {value!r}", source=path, field=key)
    return number


def _origin(settings: dict[str, Any], path: Path) -> tuple[float, float, float]:
    """x, y (metres) and yaw (radians) of the lower-left corner."""
    origin = _entry(settings, "origin", path)
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError(f"expected three numbers [x, y, yaw], found {origin!r}", source=path, field="origin")
    x, y, yaw = (_number(value, "origin", path) for value in origin)
    return x, y, yaw


def _negate(settings: dict[str, Any], path: Path) -> bool:
    """Whether white stands for occupied."""
    negate = _entry(settings, "negate", path)
    if negate not in (0, 1):
        raise InputError(f"expected 0 or 1, found {negate!r}", source=path, field="negate")
    return bool(negate)


def _mode(settings: dict[str, Any], path: Path) -> str:
    """How pixels are read."""
    mode = settings.get("mode", "trinary")
    if mode not in ("trinary", "scale", "raw"):
        raise InputError(f"expected trinary, scale or raw, found {mode!r}", source=path, field="mode")
    return mode


def _image_path(settings: dict[str, Any], path: Path) -> Path:
    """Where the image lies, which has to be in the YAML's own folder or below, links followed."""
    name = _entry(settings, "image", path)
    if not isinstance(name, str) or not name:
        raise InputError(f"expected the name of an image, found {name!r}", source=path, field="image")
    try:
        folder = path.parent.resolve()
        image = (folder / name).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"expected the name of an image: {error}", source=path, field="image") from error
    if Path(name).is_absolute() or not image.is_relative_to(folder):
        message = f"expected an image inside the folder of the YAML file, found {name!r}"
        raise InputError(message, source=path, field="image")
    if not image.is_file():
        raise InputError(f"there is no image {name!r}", source=path, field="image")
    return path.parent / name


def _grey(path: Path) -> tuple[Float[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """The grey value of each pixel on a scale of 0 to 255, and which pixels are fully transparent."""
    try:
        # Pillow warns of large images and of oddities in headers without naming the file.
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=("PPM", "PNG")) as image:
            _refuse_absurd_size(image.size, path)
            return _grey_of_image(image)
    except InputError:
        raise
    except Image.DecompressionBombError as error:
        raise InputError(f"expected at most {MOST_PIXELS:,} pixels, found far more", source=path) from error
    except Exception as error:  # Decoders raise errors of any kind on broken files.
        raise InputError(f"expected an image in PGM or PNG format: {error}", source=path) from error


def _refuse_absurd_size(size: tuple[int, int], path: Path) -> None:
    """Refuse images that no map needs, or that hold nothing."""
    width, height = size
    if not 0 < width * height <= MOST_PIXELS:
        message = f"expected from 1 to {MOST_PIXELS:,} pixels, found {width:,} by {height:,}"
        raise InputError(message, source=path)


def _grey_of_image(
    image: Image.Image,
) -> tuple[Float[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """`_grey` of an opened image."""
    if image.mode.startswith("I"):  # 16 bits a pixel
        grey = np.asarray(image, dtype=np.float64) * (255 / 65535)
        return grey, np.zeros(grey.shape, dtype=bool)
    if image.mode in ("1", "L") and "transparency" not in image.info:
        grey = np.asarray(image.convert("L"), dtype=np.float64)
        return grey, np.zeros(grey.shape, dtype=bool)
    if image.mode == "F":
        raise ValueError("the pixels are fractions, as in PFM")
    channels = np.asarray(image.convert("RGBA"))
    return channels[..., :3].mean(axis=-1), channels[..., 3] == 0


def _occupancy(grey: Float[np.ndarray, "rows columns"], negate: bool, mode: str) -> Float[np.ndarray, "rows columns"]:
    """How occupied each cell is, from 0 to 1; NaN where the map does not say."""
    if mode == "raw":  # `negate` has no meaning here, as in Nav2.
        percent = np.rint(grey)
        return np.where(percent <= 100, percent / 100, np.nan)
    return grey / 255 if negate else (255 - grey) / 255
