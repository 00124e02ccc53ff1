"""`sidestep learn --sensor-map`: a map of sensors is the prior of its cells."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from PIL import Image
from scipy.optimize import brentq
from scipy.special import expit, logit

from helpers.office import OFFICE, WALL, call, simulated, summary, write_office, written
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.io.maps import write_map
from sidestep.io.walks import read_walks, write_walks
from sidestep.maps.config import MapConfig, PriorConfig
from sidestep.maps.learn import learn_map
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import true_model
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach
from sidestep.worlds.rooms import rooms_in_a_row

pytestmark = pytest.mark.slow

NORMAL = ("--prior", "normal", "--prior-mean", 0.5, "--prior-variance", 4, "--wall-prior", 0)
"""Cells are independent, so that the observation of one cell moves no other."""

SEEN = np.rint(100 * np.random.default_rng(3).uniform(0.05, 0.95, (5, 5))) / 100
"""P(occupied) in whole percent."""


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """A folder with the office, walks in it, and a sensor map of noise, so that it differs from the walls."""
    folder = write_office(tmp_path_factory.mktemp("office"))
    write_map(folder / "seen.yaml", SEEN, OFFICE)
    write_walks(folder / "walks.csv", simulated(walks=30, goals=3))
    return folder


def learn(office, out, *options):
    return call("learn", office / "walks.csv", "--map", office / "blank.yaml", "--out", out, *NORMAL, *options)


@pytest.fixture(scope="module")
def learned(office):
    """The map that transitions alone give with the sensor map."""
    out = office / "learned"
    assert learn(office, out, "--terms", "transitions", "--sensor-map", office / "seen.yaml") == 0
    return out


def left_panel(folder):
    """Return the part of a picture that shows what was known before."""
    picture = np.asarray(Image.open(folder / "learned.png").convert("L"))
    return picture[:, : picture.shape[1] // 4]


def passed(office):
    """Count the positions of all walks in each cell."""
    states = OFFICE.states(read_walks(office / "walks.csv").positions)
    return np.bincount(states, minlength=25).reshape(5, 5)


def posterior(times, mean, variance):
    """Return P(blocked) of a cell that was passed n times: where −n p − (θ − b)/σ² is 0."""
    return expit(brentq(lambda logit: times * expit(logit) + (logit - mean) / variance, -50, 50))


def test_learn_with_a_sensor_map_keeps_it_in_unvisited_cells(office, learned):
    """Transitions depend on the number of passes only."""
    blocked, times = np.load(learned / "blocked.npy"), passed(office)
    np.testing.assert_allclose(blocked[WALL], SEEN[WALL], atol=1e-6)
    expected = [posterior(n, logit(p), 0.5) for n, p in zip(times[~WALL], SEEN[~WALL], strict=True)]
    np.testing.assert_allclose(blocked[~WALL], expected, atol=1e-4)
    result = summary(learned)
    assert result["data"]["sensed_cells"] == 25
    assert result["sensor"] == {"map": str(office / "seen.yaml"), "variance": 0.5}


def test_learn_with_a_sensor_variance_file_takes_a_variance_per_cell(office, learned, tmp_path):
    """Cells without a finite variance count as unseen."""
    variance = np.random.default_rng(4).uniform(0.05, 2.5, (5, 5))
    variance[:, 3] = np.nan
    variance[1, :3] = np.inf
    np.save(tmp_path / "variance.npy", variance)
    options = ("--sensor-map", office / "seen.yaml", "--sensor-variance", tmp_path / "variance.npy")
    assert learn(office, tmp_path / "out", "--terms", "transitions", *options) == 0
    seen = np.isfinite(variance)
    means, variances = np.where(seen, logit(SEEN), 0.5), np.where(seen, variance, 4.0)
    expected = [posterior(*each) for each in zip(passed(office).flat, means.flat, variances.flat, strict=True)]
    np.testing.assert_allclose(np.load(tmp_path / "out" / "blocked.npy").ravel(), expected, atol=1e-4)
    result = summary(tmp_path / "out")
    assert result["data"]["sensed_cells"] == seen.sum() == 17
    assert result["sensor"]["variance"] == str(tmp_path / "variance.npy")
    # seen cells are drawn
    assert left_panel(tmp_path / "out").shape == left_panel(learned).shape
    assert (left_panel(tmp_path / "out") != left_panel(learned)).any()


def test_learn_with_a_sensor_map_keeps_known_cells(office, tmp_path):
    arguments = ("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", tmp_path)
    assert call(*arguments, *NORMAL, "--terms", "transitions", "--sensor-map", office / "seen.yaml") == 0
    blocked = np.load(tmp_path / "blocked.npy")
    assert (blocked[0, 2], blocked[4, 0]) == (1, 0)
    assert summary(tmp_path)["data"]["sensed_cells"] == 23


def test_learn_with_a_sensor_map_of_other_geometry_names_file_and_field(office, tmp_path, capsys):
    np.save(tmp_path / "small.npy", np.ones((2, 2)))
    np.save(tmp_path / "zero.npy", np.zeros((5, 5)))
    write_map(tmp_path / "small.yaml", np.full((2, 2), 0.5), Grid.unknown(2, 2))
    write_map(tmp_path / "far.yaml", SEEN, replace(OFFICE, origin=(0.0, 2.0, 0.0)))
    seen = ("--sensor-map", office / "seen.yaml", "--sensor-variance")
    for options, expected in (
        (("--sensor-map", tmp_path / "none.yaml"), "none.yaml: cannot be read"),
        (("--sensor-map", tmp_path / "small.yaml"), "small.yaml, field 'resolution'"),
        (("--sensor-map", tmp_path / "far.yaml"), "far.yaml, field 'origin'"),
        ((*seen, tmp_path / "none.npy"), "none.npy: cannot be read"),
        ((*seen, tmp_path / "small.npy"), "small.npy, field 'sensor variance'"),
        ((*seen, tmp_path / "zero.npy"), "zero.npy, row 1, field 'sensor variance'"),
        ((*seen, 0), "field 'sensor variance': expected numbers above 0, found 0.0"),
    ):
        assert learn(office, tmp_path / "out", *options) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert expected in lines[0]
        assert written(tmp_path / "out") == []


FLAT = rooms_in_a_row(13, 9, doors=(12,))
UPPER, LOWER = slice(0, 5), slice(7, 12)
"""The rows that sensors saw, and rows of the wall that agents walk around."""


def test_learn_with_a_sensor_map_of_one_half_infers_the_other_half_from_behavior(tmp_path):
    """Sensors saw the upper rows of two rooms; agents walk in the lower ones."""
    goals = [7 * 9 + 3, 7 * 9 + 5, 11 * 9, 11 * 9 + 8]
    tasks, random = [reach(FLAT, goal) for goal in goals], np.random.default_rng(0)
    lower = np.array([row * 9 + column for row in range(7, 13) for column in range(9) if column != 4])
    starts = [random.choice(np.setdiff1d(lower, [goal]), 15) for goal in goals]
    walks = walks_from_trajectories(simulate(jax.random.key(0), true_model(FLAT), tasks, starts), goals, FLAT)
    wall = FLAT.known == Cell.OCCUPIED
    variance = np.full(FLAT.shape, np.nan)
    variance[UPPER] = 0.5
    config = MapConfig(prior=PriorConfig("normal", mean=0.5, variance=4.0, wall_prior=0.0))
    alone = learn_map(FLAT.forget(), walks, config).blocked
    np.testing.assert_allclose(alone[UPPER], expit(0.5), atol=0.01)  # no walk depends on them
    write_walks(tmp_path / "walks.csv", walks)
    write_map(tmp_path / "blank.yaml", np.full(FLAT.shape, 0.5), FLAT)
    write_map(tmp_path / "seen.yaml", np.where(wall, 0.9, 0.1), FLAT)
    np.save(tmp_path / "variance.npy", variance)
    options = ("--sensor-map", tmp_path / "seen.yaml", "--sensor-variance", tmp_path / "variance.npy")
    files = (tmp_path / "walks.csv", "--map", tmp_path / "blank.yaml", "--out", tmp_path / "out")
    assert call("learn", *files, *NORMAL, *options) == 0
    both = np.load(tmp_path / "out" / "blocked.npy")
    assert min(alone[LOWER][wall[LOWER]].min(), both[LOWER][wall[LOWER]].min()) > 0.9
    np.testing.assert_allclose(both[UPPER][wall[UPPER]], 0.9, atol=0.01)
    np.testing.assert_allclose(both[UPPER][~wall[UPPER]], 0.1, atol=0.01)
