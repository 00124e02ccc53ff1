"""Saving and loading a learned map, and folders without one."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.maps.learned_map import LearnedMap, load_map
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.reward import Reward

BLOCKED = np.array([[0.0, 0.25, 1.0], [0.5, 1e-7, 0.999]])
KNOWN = np.where(BLOCKED == 0, Cell.FREE, np.where(BLOCKED == 1, Cell.OCCUPIED, Cell.UNKNOWN)).astype(int)
GRID = Grid(KNOWN, resolution=0.05, origin=(1.5, -2.0, 0.3), connectivity=8)
VISITED = np.array([[0, 4], [3, 4]])
LEARNED = LearnedMap(GRID, BLOCKED, VISITED, Reward(0.9, 2.5))
SUMMARY = {
    "command": "learn",
    "connectivity": 8,
    "cells_without_evidence": None,
    "settings": {"reward": {"discount": 0.9, "step_cost": 2.5}, "unknown_below": 0.0},
}
NATS = np.array([[0.0, 0.02, 0.0], [0.01, 0.7, 0.05]])
"""Of the three cells with less than 0.06 nats, the walks visited one."""


@pytest.fixture
def folder(tmp_path):
    LEARNED.save(tmp_path, command="learn")
    return tmp_path


def test_load_map_returns_what_was_saved(folder):
    loaded = load_map(folder)
    np.testing.assert_array_equal(loaded.blocked, BLOCKED)
    np.testing.assert_array_equal(loaded.visited, VISITED)
    np.testing.assert_array_equal(loaded.grid.known, KNOWN)
    assert (loaded.grid.resolution, loaded.grid.origin, loaded.grid.connectivity) == (0.05, (1.5, -2.0, 0.3), 8)
    assert loaded.reward == Reward(0.9, 2.5)
    np.testing.assert_array_equal(loaded.unknown, [[False, True, False], [True, True, True]])
    assert json.loads((folder / "summary.json").read_text()) == SUMMARY


def test_load_map_returns_the_information_that_was_saved(folder):
    assert load_map(folder).information is None
    replace(LEARNED, information=NATS, unknown_below=0.06).save(folder)
    loaded = load_map(folder)
    assert loaded.information is not None
    np.testing.assert_array_equal(loaded.information, NATS)
    assert loaded.unknown_below == 0.06
    np.testing.assert_array_equal(loaded.without_evidence, [[False, True, False], [False, False, True]])
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["cells_without_evidence"], summary["settings"]["unknown_below"]) == (2, 0.06)
    # probabilities and plans are those of blocked.npy
    np.testing.assert_array_equal(loaded.blocked, BLOCKED)
    np.testing.assert_array_equal(loaded.model.blocked, LEARNED.model.blocked)
    LEARNED.save(folder)
    assert load_map(folder).information is None


def test_load_map_of_an_earlier_version_has_no_unknown_cells(folder):
    summary = {"connectivity": 8, "settings": {"reward": SUMMARY["settings"]["reward"]}}
    (folder / "summary.json").write_text(json.dumps(summary))
    loaded = load_map(folder)
    assert (loaded.information, loaded.unknown_below) == (None, 0.0)
    assert not loaded.without_evidence.any()


BAD_NATS = [np.zeros((3, 2)), *(np.full((2, 3), value) for value in (-0.1, np.nan, "a", 1))]


@pytest.mark.parametrize("array", BAD_NATS)
def test_load_map_refuses_information_that_does_not_fit(folder, array):
    np.save(folder / "information.npy", array)
    with pytest.raises(InputError, match=r"information\.npy"):
        load_map(folder)


def test_model_of_a_loaded_map_has_its_probabilities(folder):
    np.testing.assert_allclose(load_map(str(folder)).model.blocked, BLOCKED, rtol=1e-9)


FILES = ("summary.json", "map.yaml", "map.pgm", "blocked.npy", "visited.npy")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("content", [None, b"", b"{]garbage: [", bytes(range(128, 256))])
def test_load_map_names_a_missing_or_invalid_file(folder, name, content):
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(content)
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        load_map(folder)


BAD_BLOCKED = [np.zeros((3, 2)), *(np.full((2, 3), value) for value in (1.5, np.nan, "a", 0j))]
BAD_VISITED = [np.zeros(4, dtype=int), np.zeros((4, 3), dtype=int), [[0, 6]], [[-1, 0]], [[0.5, 1.0]], [["a", "b"]]]
BAD_ARRAYS = [*(("blocked.npy", bad) for bad in BAD_BLOCKED), *(("visited.npy", bad) for bad in BAD_VISITED)]


@pytest.mark.parametrize(("name", "array"), BAD_ARRAYS)
def test_load_map_refuses_arrays_that_do_not_fit(folder, name, array):
    np.save(folder / name, array)
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        load_map(folder)


@pytest.mark.parametrize("summary", [
    [],
    {},
    {"settings": None},
    {"settings": {"reward": {"discount": 0.9, "step_cost": None}}},
    {"connectivity": 8, "settings": {"reward": {"discount": 0.9}}},
    {"connectivity": 5, "settings": {"reward": {"discount": 0.9, "step_cost": None}}},
    {"connectivity": 4, "settings": {"reward": {"discount": "much", "step_cost": None}}},
    {"connectivity": 4, "settings": {"reward": {"discount": 1.5, "step_cost": None}}},
    {"connectivity": 4, "settings": {"reward": {"discount": 0.9, "step_cost": -1.0}}},
    {"connectivity": 4, "settings": {"reward": {"discount": 0.9, "step_cost": "a"}}},
    {"connectivity": 4, "settings": {"reward": {"discount": 0.9, "step_cost": None}, "unknown_below": -1}},
    {"connectivity": 4, "settings": {"reward": {"discount": 0.9, "step_cost": None}, "unknown_below": "a"}},
])  # fmt: skip
def test_load_map_refuses_invalid_summaries(folder, summary):
    (folder / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match=r"summary\.json"):
        load_map(folder)
