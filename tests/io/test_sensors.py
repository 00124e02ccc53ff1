"""Maps of what sensors saw: probabilities, what is unknown, and files that belong to another map."""

import numpy as np
import pytest
import yaml
from PIL import Image

from sidestep.errors import InputError
from sidestep.io.maps import read_sensor_map, read_sensor_variance, write_map
from sidestep.tabular.grid import Grid

GRID = Grid(np.full((2, 3), -1), resolution=0.05, origin=(1.0, -2.0, 0.5))
SETTINGS = {
    "image": "seen.png",
    "mode": "scale",
    "resolution": 0.05,
    "origin": [1.0, -2.0, 0.5],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.25,
}


def sensor_map(folder, pixels, **changes):
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(folder / "seen.png")
    (folder / "seen.yaml").write_text(yaml.safe_dump(SETTINGS | changes))
    return folder / "seen.yaml"


GREY = [[0, 51, 102], [153, 204, 255]]


def test_read_sensor_map_ignores_thresholds(tmp_path):
    expected = [[1, 0.8, 0.6], [0.4, 0.2, 0]]
    np.testing.assert_allclose(read_sensor_map(sensor_map(tmp_path, GREY), GRID), expected)
    path = sensor_map(tmp_path, GREY, negate=1, occupied_thresh=0.5, free_thresh=0.1)
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
    np.testing.assert_allclose(read_sensor_map(tmp_path / "learned.yaml", GRID), blocked, atol=0.5 / 255)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"mode": "trinary"}, r"seen.yaml, field 'mode': expected scale or raw"),
        ({"resolution": 0.1}, r"seen.yaml, field 'resolution': expected the map's 0.05 metres a cell, found 0.1"),
        ({"origin": [1.0, -2.05, 0.5]}, r"seen.yaml, field 'origin': expected the map's \(1.0, -2.0, 0.5\).*-2.05"),
        ({"origin": [1.0, -2.0, 0.0]}, r"seen.yaml, field 'origin'"),
        ({"image": "other.png"}, r"seen.yaml, field 'image': there is no image"),
    ],
)
def test_read_sensor_map_of_another_map_raises(tmp_path, changes, match):
    with pytest.raises(InputError, match=match):
        read_sensor_map(sensor_map(tmp_path, GREY, **changes), GRID)


def test_read_sensor_map_of_another_shape_raises(tmp_path):
    with pytest.raises(InputError, match=r"seen.yaml, field 'image': expected the map's 2 × 3 cells, found 3 × 2"):
        read_sensor_map(sensor_map(tmp_path, np.transpose(GREY)), GRID)


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
