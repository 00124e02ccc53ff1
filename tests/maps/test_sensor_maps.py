"""`sidestep learn --sensor-map`: what sensors saw is the prior, and behavior tells of the rest."""

from dataclasses import replace

import jax
import numpy as np
import pyarrow.csv
import pytest
from PIL import Image
from scipy.optimize import brentq
from scipy.special import expit, logit

from helpers.office import WALL, call, summary, write_office, written
from sidestep.io.maps import read_map, write_map
from sidestep.io.trajectories import walks_from_trajectories
from sidestep.io.walks import write_walks
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import true_model
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach
from sidestep.worlds.rooms import two_rooms

NORMAL = ("--prior-mean", 0.5, "--prior-variance", 4, "--wall-prior", 0)
"""Each cell for itself: then what a sensor says of one cell moves no other."""

SEEN = np.rint(255 * np.random.default_rng(3).uniform(0.05, 0.95, (5, 5))) / 255
"""P(occupied) in whole grey levels."""


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """The office, walks in it, and what sensors saw of it: noise, so that it cannot be taken for the walls."""
    folder = write_office(tmp_path_factory.mktemp("office"))
    write_map(folder / "seen.yaml", SEEN, read_map(folder / "blank.yaml"))
    simulate = ("simulate", folder / "true.yaml", "--out", folder / "walks.csv", "--walks", 30, "--goals", 3)
    assert call(*simulate) == 0
    return folder


def learn(office, out, *options):
    return call("learn", office / "walks.csv", "--map", office / "blank.yaml", "--out", out, *NORMAL, *options)


def passed(office):
    """How often somebody came into each cell or set out from it."""
    table = pyarrow.csv.read_csv(office / "walks.csv")
    grid = read_map(office / "blank.yaml")
    states = grid.states(np.stack([table["x"].to_numpy(), table["y"].to_numpy()], axis=1))
    return np.bincount(states, minlength=25).reshape(5, 5)


def posterior(times, mean, variance):
    """P(blocked) of a cell that was passed so often: where −n p − (θ − b)/σ² is 0."""
    return expit(brentq(lambda logit: times * expit(logit) + (logit - mean) / variance, -50, 50))


def test_where_nobody_went_the_posterior_is_the_map(office, tmp_path):
    """By transitions alone, which say nothing of cells that nobody passed, and elsewhere only how often."""
    assert learn(office, tmp_path, "--terms", "transitions", "--sensor-map", office / "seen.yaml") == 0
    blocked, times = np.load(tmp_path / "blocked.npy"), passed(office)
    np.testing.assert_allclose(blocked[WALL], SEEN[WALL], atol=1e-6)
    expected = [posterior(n, logit(p), 0.5) for n, p in zip(times[~WALL], SEEN[~WALL], strict=True)]
    np.testing.assert_allclose(blocked[~WALL], expected, atol=1e-4)
    told = summary(tmp_path)
    assert told["data"]["sensed_cells"] == 25
    assert told["sensor"] == f"{office / 'seen.yaml'}, variance 0.5"


def test_how_surely_each_cell_is_known(office, tmp_path):
    """A variance a cell; what has none is as if no sensor had looked."""
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
    told = summary(tmp_path / "out")
    assert told["data"]["sensed_cells"] == seen.sum() == 17
    assert told["sensor"].endswith(str(tmp_path / "variance.npy"))


def test_what_the_map_knows_stays_known_whatever_the_sensors_say(office, tmp_path):
    arguments = ("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", tmp_path)
    assert call(*arguments, *NORMAL, "--terms", "transitions", "--sensor-map", office / "seen.yaml") == 0
    blocked = np.load(tmp_path / "blocked.npy")
    assert (blocked[0, 2], blocked[4, 0]) == (1, 0)
    assert summary(tmp_path)["data"]["sensed_cells"] == 23


def test_sensors_of_another_map_are_refused(office, tmp_path, capsys):
    """One line that names file and field, and nothing written."""
    np.save(tmp_path / "small.npy", np.ones((2, 2)))
    np.save(tmp_path / "zero.npy", np.zeros((5, 5)))
    write_map(tmp_path / "small.yaml", np.full((2, 2), 0.5), Grid.unknown(2, 2))
    write_map(tmp_path / "far.yaml", SEEN, replace(read_map(office / "blank.yaml"), origin=(0.0, 2.0, 0.0)))
    seen = ("--sensor-map", office / "seen.yaml", "--sensor-variance")
    for options, expected in (
        (("--sensor-map", tmp_path / "none.yaml"), "none.yaml: cannot be read"),
        (("--sensor-map", tmp_path / "small.yaml"), "small.yaml, field 'image'"),
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


FLAT = two_rooms(13, 9, door=12)
UPPER, LOWER = slice(0, 5), slice(7, 12)
"""The rows that sensors saw, and those of the wall that people walk around."""


def test_half_of_a_wall_is_sensed_and_the_other_half_found_by_behavior(tmp_path):
    """Sensors saw the upper rows of two rooms; people live in the lower ones."""
    goals = [7 * 9 + 3, 7 * 9 + 5, 11 * 9, 11 * 9 + 8]
    tasks, random = [reach(FLAT, goal) for goal in goals], np.random.default_rng(0)
    lower = np.array([row * 9 + column for row in range(7, 13) for column in range(9) if column != 4])
    starts = [random.choice(np.setdiff1d(lower, [goal]), 15) for goal in goals]
    walks = simulate(jax.random.key(0), true_model(FLAT), tasks, starts)
    write_walks(tmp_path / "walks.csv", walks_from_trajectories(walks, goals, FLAT))
    write_map(tmp_path / "blank.yaml", np.full(FLAT.shape, 0.5), FLAT)
    write_map(tmp_path / "seen.yaml", np.where(FLAT.known == Cell.OCCUPIED, 0.9, 0.1), FLAT)
    variance = np.full(FLAT.shape, np.nan)
    variance[UPPER] = 0.5
    np.save(tmp_path / "variance.npy", variance)
    arguments = ("learn", tmp_path / "walks.csv", "--map", tmp_path / "blank.yaml", *NORMAL, "--out")
    assert call(*arguments, tmp_path / "alone") == 0
    options = ("--sensor-map", tmp_path / "seen.yaml", "--sensor-variance", tmp_path / "variance.npy")
    assert call(*arguments, tmp_path / "both", *options) == 0
    alone, both = (np.load(tmp_path / name / "blocked.npy") for name in ("alone", "both"))
    wall = FLAT.known == Cell.OCCUPIED
    np.testing.assert_allclose(alone[UPPER], expit(0.5), atol=0.01)  # nobody's walks tell of it
    assert min(alone[LOWER][wall[LOWER]].min(), both[LOWER][wall[LOWER]].min()) > 0.9
    np.testing.assert_allclose(both[UPPER][wall[UPPER]], 0.9, atol=0.01)
    np.testing.assert_allclose(both[UPPER][~wall[UPPER]], 0.1, atol=0.01)
    picture = [np.asarray(Image.open(tmp_path / name / "learned.png").convert("L")) for name in ("alone", "both")]
    assert picture[0].shape == picture[1].shape
    assert (picture[0] != picture[1])[:, : picture[0].shape[1] // 4].any()  # what was known is drawn
