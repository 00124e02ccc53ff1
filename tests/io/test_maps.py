"""ROS maps, of sensors too: what is read, what is refused, and that a learned map comes back as it was written."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from helpers.drawn import grid_of
from sidestep.errors import InputError
from sidestep.io.maps import read_map, read_sensor_map, read_sensor_variance, write_map
from sidestep.tabular.grid import Cell, Grid

DATA = Path(__file__).parents[3] / "shared" / "data"
SETTINGS = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [1.0, -2.5, 0.25],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}
FREE, UNKNOWN, OCCUPIED = int(Cell.FREE), int(Cell.UNKNOWN), int(Cell.OCCUPIED)


def make_map(folder, pixels, **changes):
    """A map in `folder`; a setting changed to None is left out."""
    settings = {key: value for key, value in (SETTINGS | changes).items() if value is not None}
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(np.asarray(pixels))
    image.save(folder / settings.get("image", "map.pgm"))
    (folder / "map.yaml").write_text(yaml.safe_dump(settings))
    return folder / "map.yaml"


def gray(*values):
    return np.array([values], dtype=np.uint8)


def test_read_map_reads_geometry_and_orientation(tmp_path):
    grid = read_map(make_map(tmp_path, np.array([[0, 254], [205, 254], [254, 254]], dtype=np.uint8)), connectivity=8)
    assert (grid.resolution, grid.origin, grid.connectivity) == (0.05, (1.0, -2.5, 0.25), 8)
    np.testing.assert_array_equal(grid.known, [[OCCUPIED, FREE], [UNKNOWN, FREE], [FREE, FREE]])


@pytest.mark.parametrize("mode", [None, "trinary", "scale"])
def test_read_map_thresholds_are_strict(tmp_path, mode):
    path = make_map(tmp_path, gray(203, 204, 205, 50, 51, 52), mode=mode, free_thresh=0.2, occupied_thresh=0.8)
    assert read_map(path).known.tolist() == [[UNKNOWN, UNKNOWN, FREE, OCCUPIED, UNKNOWN, UNKNOWN]]


PALETTE = Image.fromarray(gray(0, 1))
PALETTE.putpalette([255, 255, 255, 0, 0, 0])
PERCENT = gray(0, 19, 20, 65, 66, 100, 101, 255)
COLOR = gray([255, 0, 0], [255, 255, 250], [0, 0, 0])
TRANSPARENT = gray([0, 0, 0, 0], [0, 0, 0, 255], [255, 255, 255, 255])
SIXTEEN_BITS = np.array([[0, 65535, 205 * 257]], dtype=np.uint16)
IMAGES = {  # pixels, settings, and the cells: free (.), occupied (#) or unknown (?)
    "negated": (gray(0, 255, 128), {"negate": 1}, ".#?"),
    "negated by true": (gray(0, 255, 128), {"negate": True}, ".#?"),
    "percent": (PERCENT, {"mode": "raw"}, "..??##??"),
    "percent, negated": (PERCENT, {"mode": "raw", "negate": 1}, "..??##??"),
    "the mean of channels": (COLOR, {"image": "map.png"}, "#.#"),
    "transparent color": (TRANSPARENT, {"image": "map.png"}, "?#."),
    "transparent gray": (Image.fromarray(gray([0, 0], [0, 255], [255, 255]), "LA"), {"image": "map.png"}, "?#."),
    "palette": (PALETTE, {"image": "map.png"}, ".#"),
    "sixteen bits in PNG": (SIXTEEN_BITS, {"image": "map.png"}, "#.?"),
    "sixteen bits in PGM": (SIXTEEN_BITS, {}, "#.?"),
    "one bit": (Image.fromarray(gray(0, 255)).convert("1"), {"image": "map.png"}, "#."),
}


@pytest.mark.parametrize("name", IMAGES)
def test_read_map_of_an_image_format_returns_its_cells(tmp_path, name):
    pixels, settings, cells = IMAGES[name]
    np.testing.assert_array_equal(read_map(make_map(tmp_path, pixels, **settings)).known, grid_of(cells).known)


def test_read_map_reads_numbers_that_yaml_reads_as_text(tmp_path):
    path = make_map(tmp_path, gray(0))
    path.write_text(path.read_text().replace("resolution: 0.05", "resolution: 5e-2"))
    assert read_map(path).resolution == 0.05


@pytest.mark.parametrize("key", sorted(SETTINGS))
def test_read_map_without_a_key_names_it(tmp_path, key):
    with pytest.raises(InputError, match=rf"map\.yaml, field '{key}': the key is missing"):
        read_map(make_map(tmp_path, gray(0), **{key: None}))


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("resolution", "wide", "a finite number"),
        ("resolution", float("nan"), "a finite number"),
        ("resolution", [1], "a finite number"),
        ("resolution", True, "a finite number"),
        ("resolution", 0.0, "metres above 0"),
        ("resolution", -1, "metres above 0"),
        ("origin", 3, "three numbers"),
        ("origin", [0, 0], "three numbers"),
        ("origin", [0, 0, float("inf")], "a finite number"),
        ("negate", 2, "0 or 1"),
        ("negate", "no", "0 or 1"),
        ("occupied_thresh", 1.5, "a number from 0 to 1"),
        ("free_thresh", -0.1, "a number from 0 to 1"),
        ("free_thresh", 0.65, "less than occupied_thresh"),
        ("mode", "fancy", "trinary, scale or raw"),
        ("mode", ["raw"], "trinary, scale or raw"),
    ],
)
def test_read_map_of_a_wrong_value_names_it(tmp_path, key, value, expected):
    with pytest.raises(InputError, match=rf"map\.yaml, field '{key}': expected {expected}"):
        read_map(make_map(tmp_path, gray(0), **{key: value}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image: [", "expected YAML"),
        ("- 1\n- 2", "expected YAML with keys"),
        ("just words", "expected YAML with keys"),
        ("\x07", "expected YAML"),
        ("when: 2020-13-45", "expected YAML"),
        ("[" * 5000, "expected YAML"),
        ("image: ÿ", "expected YAML"),  # in Latin-1 no text in UTF-8
        ("", "the file is empty"),
    ],
)
def test_read_map_of_other_text_raises(tmp_path, text, message):
    (tmp_path / "map.yaml").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=rf"map\.yaml: {message}"):
        read_map(tmp_path / "map.yaml")


@pytest.mark.parametrize("image", ["../map.pgm", "below/../../map.pgm", "link.pgm", "{absolute}"])
def test_read_map_of_an_image_outside_the_folder_raises(tmp_path, image):
    Image.fromarray(gray(0)).save(tmp_path / "map.pgm")
    folder = tmp_path / "folder"
    folder.mkdir()
    path = make_map(folder, gray(0))
    (folder / "link.pgm").symlink_to(tmp_path / "map.pgm")
    settings = SETTINGS | {"image": image.format(absolute=folder / "map.pgm")}
    path.write_text(yaml.safe_dump(settings))
    with pytest.raises(InputError, match=r"map\.yaml, field 'image': expected an image inside the folder"):
        read_map(path)


def test_read_map_of_an_image_in_a_subfolder(tmp_path):
    (tmp_path / "images").mkdir()
    assert read_map(make_map(tmp_path, gray(0), image="images/map.pgm")).shape == (1, 1)


@pytest.mark.parametrize("image", ["absent.pgm", "circular.pgm", ".", 3, "nul\0.pgm", ""])
def test_read_map_without_an_image_raises(tmp_path, image):
    path = make_map(tmp_path, gray(0))
    (tmp_path / "circular.pgm").symlink_to("circular.pgm")
    path.write_text(yaml.safe_dump(SETTINGS | {"image": image}))
    with pytest.raises(InputError, match=r"map\.yaml, field 'image'"):
        read_map(path)


FRACTIONS = b"Pf\n1 1\n-1.0\n" + np.float32(0.5).tobytes()
BROKEN = [b"not an image", b"P5\n4 4\n255\nab", b"P2\n2 1\n255\nx y\n", b"\x89PNG\r\n\x1a\n", b"P5\n0 0\n255\n"]


@pytest.mark.parametrize("content", [*BROKEN, FRACTIONS])
def test_read_map_of_a_broken_image_raises(tmp_path, content):
    path = make_map(tmp_path, gray(0))
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(InputError, match=r"map\.pgm: expected"):
        read_map(path)


@pytest.mark.parametrize("size", ["10001 10000", "30000 30000"])
def test_read_map_of_a_huge_image_raises_before_decoding(tmp_path, size):
    path = make_map(tmp_path, gray(0))
    (tmp_path / "map.pgm").write_bytes(f"P5\n{size}\n255\n".encode())
    with pytest.raises(InputError, match=r"map\.pgm: expected an image in PGM or PNG format: .*pixels"):
        read_map(path)


def as_occupancy_grid(path):
    """The OccupancyGrid that Nav2's `map_server` publishes of a map, row 0 at the top: percent, and -1 for unknown."""
    settings = yaml.safe_load(path.read_text())
    pixels = np.asarray(Image.open(path.parent / settings["image"])).astype(int)
    occupancy = pixels / 255 if settings["negate"] else 1 - pixels / 255
    if settings["mode"] == "raw":
        return np.where(pixels <= 100, pixels, -1)
    low, high = settings["free_thresh"], settings["occupied_thresh"]
    between = np.rint((occupancy - low) / (high - low) * 100) if settings["mode"] == "scale" else -1
    return np.where(occupancy > high, 100, np.where(occupancy < low, 0, between))


numbers = st.floats(-1e6, 1e6, allow_nan=False)


@given(
    st.integers(1, 5).flatmap(
        lambda columns: st.lists(st.lists(st.floats(0, 1), min_size=columns, max_size=columns), min_size=1)
    ),
    st.floats(1e-6, 1e3),
    st.tuples(numbers, numbers, numbers),
)
def test_write_map_is_read_back(tmp_path_factory, rows, resolution, origin):
    folder, blocked = tmp_path_factory.mktemp("maps"), np.array(rows)
    grid = Grid(np.full(blocked.shape, -1), resolution, origin)
    write_map(folder / "learned.yaml", blocked, grid)
    read = read_map(folder / "learned.yaml")
    assert (read.resolution, read.origin) == (resolution, origin)
    percent = as_occupancy_grid(folder / "learned.yaml")
    assert np.abs(percent - 100 * blocked).max() <= 0.5 + 1e-9
    sure = np.abs(blocked[..., None] - [0.65, 0.196]).min(axis=-1) > 0.01
    expected = np.where(blocked > 0.65, OCCUPIED, np.where(blocked < 0.196, FREE, UNKNOWN))
    np.testing.assert_array_equal(read.known[sure], expected[sure])


@given(
    st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=8),
)
def test_write_map_unknown_cells_are_minus_one_and_others_lose_half_a_percent(tmp_path_factory, cells):
    folder = tmp_path_factory.mktemp("maps")
    blocked, unknown = np.array([[p for p, _ in cells]]), np.array([[hidden for _, hidden in cells]])
    write_map(folder / "learned.yaml", blocked, Grid.unknown(*blocked.shape), unknown=unknown)
    percent = as_occupancy_grid(folder / "learned.yaml")
    np.testing.assert_array_equal(percent == -1, unknown)
    assert (np.abs(percent - 100 * blocked)[~unknown] <= 0.5 + 1e-9).all()
    assert (np.asarray(Image.open(folder / "learned.pgm"))[unknown] == 205).all()
    assert (read_map(folder / "learned.yaml").known[unknown] == UNKNOWN).all()


def test_write_map_writes_the_keys_of_nav2(tmp_path):
    write_map(tmp_path / "new" / "learned.yaml", np.array([[0.0, 1.0]]), Grid.unknown(1, 2))
    settings = yaml.safe_load((tmp_path / "new" / "learned.yaml").read_text())
    assert settings == SETTINGS | {"image": "learned.pgm", "mode": "raw", "resolution": 1.0, "origin": [0.0] * 3}
    assert np.asarray(Image.open(tmp_path / "new" / "learned.pgm")).tolist() == [[0, 100]]


@pytest.mark.parametrize("value", [-0.01, 1.01, float("nan")])
def test_write_map_of_other_values_raises(tmp_path, value):
    with pytest.raises(InputError, match="'blocked': expected finite numbers from 0 to 1"):
        write_map(tmp_path / "map.yaml", np.array([[value]]), Grid.unknown(1, 1))
    assert not list(tmp_path.iterdir())


def test_write_map_of_another_shape_or_name_raises(tmp_path):
    with pytest.raises(InputError, match=r"expected numbers of shape \(1, 1\), found shape \(1, 2\)"):
        write_map(tmp_path / "map.yaml", np.zeros((1, 2)), Grid.unknown(1, 1))
    with pytest.raises(InputError, match=r"'unknown': expected booleans of shape \(1, 1\), found shape \(1, 2\)"):
        write_map(tmp_path / "map.yaml", np.zeros((1, 1)), Grid.unknown(1, 1), unknown=np.zeros((1, 2), bool))
    with pytest.raises(InputError, match=r"ends in \.yaml"):
        write_map(tmp_path / "map.pgm", np.zeros((1, 1)), Grid.unknown(1, 1))


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the data folder beside the checkout")
def test_read_map_reads_maps_of_nav2():
    depot, warehouse = read_map(DATA / "maps" / "depot.yaml"), read_map(DATA / "maps" / "warehouse.yaml")
    assert (depot.shape, warehouse.shape) == ((307, 604), (1674, 1006))
    assert warehouse.origin == (-15.1, -25.0, 0.0)
    assert (warehouse.known == Cell.UNKNOWN).sum() == 230801


GRAY = [[0, 51, 102], [153, 204, 255]]
GRID = Grid(np.full((2, 3), -1), resolution=0.05, origin=(1.0, -2.5, 0.25))


def sensor_map(folder, pixels, **changes):
    return make_map(folder, np.asarray(pixels, dtype=np.uint8), **{"mode": "scale", "image": "map.png"} | changes)


def test_read_sensor_map_ignores_thresholds(tmp_path):
    expected = [[1, 0.8, 0.6], [0.4, 0.2, 0]]
    np.testing.assert_allclose(read_sensor_map(sensor_map(tmp_path, GRAY), GRID), expected)
    path = sensor_map(tmp_path, GRAY, negate=1, occupied_thresh=0.5, free_thresh=0.1)
    np.testing.assert_allclose(read_sensor_map(path, GRID), 1 - np.array(expected))


def test_read_sensor_map_transparent_pixels_are_nan(tmp_path):
    pixels = np.stack([np.full((2, 3), 51)] * 3 + [[[255, 0, 255], [0, 255, 255]]], axis=-1)
    found = read_sensor_map(sensor_map(tmp_path, pixels), GRID)
    np.testing.assert_allclose(found, [[0.8, np.nan, 0.8], [np.nan, 0.8, 0.8]])


def test_read_sensor_map_raw_mode_is_percent(tmp_path):
    path = sensor_map(tmp_path, [[0, 35, 100], [101, 255, 50]], mode="raw")
    np.testing.assert_allclose(read_sensor_map(path, GRID), [[0, 0.35, 1], [np.nan, np.nan, 0.5]])


def test_read_sensor_map_reads_a_learned_map(tmp_path):
    blocked = np.random.default_rng(0).random((2, 3))
    write_map(tmp_path / "learned.yaml", blocked, GRID)
    np.testing.assert_allclose(read_sensor_map(tmp_path / "learned.yaml", GRID), blocked, atol=0.005)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"mode": "trinary"}, r"map.yaml, field 'mode': expected scale or raw"),
        ({"resolution": 0.1}, r"map.yaml, field 'resolution': expected the map's 0.05 metres a cell, found 0.1"),
        ({"origin": [1.0, -2.55, 0.25]}, r"map.yaml, field 'origin': expected the map's \(1.0, -2.5, 0.25\).*-2.55"),
        ({"origin": [1.0, -2.5, 0.0]}, r"map.yaml, field 'origin'"),
    ],
)
def test_read_sensor_map_of_another_map_raises(tmp_path, changes, match):
    with pytest.raises(InputError, match=match):
        read_sensor_map(sensor_map(tmp_path, GRAY, **changes), GRID)


def test_read_sensor_map_of_another_shape_raises(tmp_path):
    with pytest.raises(InputError, match=r"map.yaml, field 'image': expected the map's 2 × 3 cells, found 3 × 2"):
        read_sensor_map(sensor_map(tmp_path, np.transpose(GRAY)), GRID)


def test_read_sensor_variance_reads_numbers(tmp_path):
    given = np.array([[1.0, np.nan, 2.0], [np.inf, 0.5, 3.0]])
    np.save(tmp_path / "variance.npy", given)
    np.testing.assert_array_equal(read_sensor_variance(tmp_path / "variance.npy", GRID), given)
    np.save(tmp_path / "whole.npy", np.full((2, 3), 4))
    np.testing.assert_array_equal(read_sensor_variance(tmp_path / "whole.npy", GRID), np.full((2, 3), 4.0))


@pytest.mark.parametrize(
    ("array", "match"),
    [
        (np.ones((3, 2)), r"variance.npy, field 'sensor variance': expected the map's \(2, 3\) rows and columns"),
        (np.array([[1, 1, 1], [1, 1, 0]]), r"variance.npy, row 2, field 'sensor variance'.*found 0 in column 3"),
        (np.array([[1, -np.inf, 1], [1, 1, 1]]), r"variance.npy, row 1.*column 2"),
        (np.full((2, 3), "much"), r"variance.npy: expected a NumPy array of numbers"),
    ],
)
def test_read_sensor_variance_of_other_arrays_raises(tmp_path, array, match):
    np.save(tmp_path / "variance.npy", array)
    with pytest.raises(InputError, match=match):
        read_sensor_variance(tmp_path / "variance.npy", GRID)
