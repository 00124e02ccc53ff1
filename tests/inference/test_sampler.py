"""`sample_barriers`: beside the exact posterior, the same bits again, resumed, and what it refuses."""

import os
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

from helpers.barrier_worlds import (
    COSTLY,
    DISCOUNTED,
    RIGHT,
    UP,
    BarrierWorld,
    corridor,
    room,
    walks_of,
    world,
)
from helpers.problems import PROBLEMS
from sidestep.errors import InputError
from sidestep.inference.checkpoints import Checkpoint
from sidestep.inference.enumeration import enumerate_barriers
from sidestep.inference.maximize import Status
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.sampler import BarrierPosterior, dropped_sweeps, heat, rounds, sample_barriers
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, walled_grid
from sidestep.tabular.models.barriers import barriers_of

WORLDS = {
    "4 moves": world(),
    "8 moves": world("8 moves", COSTLY, HardMax(), beta=1.0),
    "borders": world("borders", DISCOUNTED, LogSumExp(), lapse=0.05),
}


def sampled(one: BarrierWorld, **settings) -> BarrierPosterior:
    return sample_barriers(*one.problem, **{"prior": one.prior, "sweeps": 24} | settings)


def assert_equal(one: BarrierPosterior, other: BarrierPosterior) -> None:
    np.testing.assert_array_equal(one.samples, other.samples)
    np.testing.assert_array_equal(one.closed, other.closed)
    assert one.history == other.history


# Beside the exact posterior


def assert_close(result: BarrierPosterior, exact: np.ndarray) -> None:
    """Check for errors of .03 on average, and of what so many independent samples leave (four standard errors)."""
    errors, open_questions = np.abs(result.closed - exact), (exact > 0) & (exact < 1)
    assert errors[open_questions].mean() < 0.03
    standard_errors = np.sqrt(np.maximum(exact * (1 - exact), 0) / result.effective_sizes)
    assert (errors < 4 * standard_errors + 0.002).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_sample_barriers_has_the_exact_probabilities(name):
    one = WORLDS[name]
    exact = enumerate_barriers(*one.problem, one.prior).closed
    result = sampled(one, sweeps=1200)
    assert_close(result, exact)
    assert result.status is Status.MIXED
    assert result.converged


def test_sample_barriers_without_a_grid_exchanges_walls_that_explain_the_same_detour():
    """Walks from corner to corner and back go around one of two walls; the prior hardly allows both."""
    grid = Grid.unknown(2, 3)
    there = Trajectory(np.array([0, 3, 4, 5, 2]), np.array([1, RIGHT, RIGHT, UP]), task=0)
    back = Trajectory(np.array([2, 5, 4, 3, 0]), np.array([1, 2, 2, UP]), task=1)
    shown = gather([there, back] * 3, [DISCOUNTED.reach(grid, goal) for goal in (2, 0)])
    problem = walled_grid(grid), shown, Behavior(LogSumExp(), beta=30.0)
    prior = BinaryMRF(np.full(7, -12.0))
    exact = enumerate_barriers(*problem, prior).closed
    assert sorted(exact)[-2:] == pytest.approx([0.5, 0.5], abs=0.01)
    result = sample_barriers(*problem, prior=prior, sweeps=3000)
    assert_close(result, exact)
    assert result.converged


@pytest.mark.slow
def test_sample_barriers_tempered_has_the_exact_probabilities():
    """By actions alone, with a part of their weight; all of it moves some by more than the tolerance."""
    one = world("borders", beta=9.0)
    part, whole = (
        enumerate_barriers(*one.problem, one.prior, tempering=kappa, terms=("actions",)).closed for kappa in (0.3, 1.0)
    )
    assert_close(sampled(one, sweeps=1200, tempering=0.3, terms=("actions",)), part)
    assert np.abs(whole - part).max() > 0.1


def test_sample_barriers_with_a_bump_makes_the_cell_probable():
    one = corridor()
    grid, task = Grid.unknown(2, 4), DISCOUNTED.reach(Grid.unknown(2, 4), 7)
    bumps = Trajectory(np.array([4, 4, 5, 6, 7]), np.array([0, RIGHT, RIGHT, RIGHT]), task=0)
    prior = BinaryMRF(np.full(8, -1.0), (2, 4))
    model = ObstacleGrid(grid)
    by_moves = sample_barriers(model, gather([bumps], [task]), one.behavior, prior=prior, terms=("transitions",))
    assert by_moves.closed[0] > 0.95
    np.testing.assert_allclose(by_moves.closed[1:4], 1 / (1 + np.e), atol=0.1)
    assert (by_moves.closed[4:] < 0.01).all()


def test_sample_barriers_closed_is_a_smoothed_mean_and_known_cells_are_certain():
    one = world()
    result = sampled(one)
    known = barriers_of(one.model).known
    assert result.samples.shape == (2, 16, 16)
    unknown = known == Cell.UNKNOWN
    means = (result.samples.sum(axis=(0, 1)) + 0.5) / 33
    np.testing.assert_allclose(result.closed, np.where(unknown, means, known == Cell.OCCUPIED))
    np.testing.assert_allclose(np.asarray(result.model.blocked).ravel(), result.closed, atol=1e-6)


def test_sample_barriers_without_open_questions_has_mixed():
    """A map that is known, and walks on it."""
    grid = room().passable()
    model, one = ObstacleGrid(grid), world()
    result = sample_barriers(model, one.demonstrations, one.behavior, prior=one.prior, sweeps=12)
    np.testing.assert_array_equal(result.closed, grid.known.ravel())
    assert result.status is Status.MIXED


def stuck_world() -> BarrierWorld:
    """Return a world with four cells that are all open or all closed, with 60 nats between."""
    grid = Grid(np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, -1, -1, 0], [0, -1, -1, 0]]))
    walk = Trajectory(np.arange(4), np.array([RIGHT] * 3), task=0)
    shown = gather([walk], [DISCOUNTED.reach(grid, 3)])
    prior = BinaryMRF(np.full(16, -60.0), (4, 4), pairs=60.0)
    return BarrierWorld(ObstacleGrid(grid), shown, Behavior(BoltzmannAverage()), prior)


def test_sample_barriers_that_cannot_mix_says_so():
    result = sampled(stuck_world(), chains=4)
    ends = result.samples[:, -1, [9, 10, 13, 14]].sum(axis=-1)
    assert set(ends) == {0, 4}
    assert result.status is Status.NOT_MIXED
    assert not result.converged
    assert not np.isfinite(result.rhat).all()
    assert result.summary()["largest_rhat"] is None


@pytest.mark.parametrize("name", WORLDS)
def test_sample_barriers_continues_until_chains_have_mixed(name):
    """The sweeps of a shorter run, and as many more as the check asks for."""
    one = WORLDS[name]
    ended = [sampled(one, sweeps=12, most_sweeps=most) for most in rounds(12, 400)]
    last = ended[-1]
    assert last.status is Status.MIXED
    assert len(last.history) in {len(each.history) for each in ended}
    assert last.samples.shape[1] == len(last.history) - dropped_sweeps(len(last.history))
    for each in ended:
        mixed = each.status is Status.MIXED
        assert (len(each.history) == len(last.history)) is mixed
        assert [sweep.objective for sweep in each.history] == [
            sweep.objective for sweep in last.history[: len(each.history)]
        ]


def test_sample_barriers_that_cannot_mix_stops_at_the_most_sweeps():
    stuck = stuck_world()
    assert len(sampled(stuck, sweeps=12, most_sweeps=30, chains=4).history) == 30


@pytest.mark.parametrize(("sweeps", "most", "expected"), [
    (200, 200, [200]),
    (200, 201, [200, 201]),
    (200, 400, [200, 400]),
    (200, 1000, [200, 400, 800, 1000]),
])  # fmt: skip
def test_rounds_double_up_to_the_most(sweeps, most, expected):
    assert rounds(sweeps, most) == expected


# What a result says


def test_sample_draws_maps_of_the_samples():
    result = sampled(world())
    drawn = result.sample(jax.random.key(0), 50)
    every = {each.tobytes() for each in result.samples.reshape(-1, 16)}
    assert drawn.shape == (50, 16)
    assert {each.tobytes() for each in drawn} <= every
    assert len({each.tobytes() for each in drawn}) > 1
    np.testing.assert_array_equal(drawn, result.sample(jax.random.key(0), 50))
    assert (drawn != result.sample(jax.random.key(1), 50)).any()
    with pytest.raises(InputError, match="count"):
        result.sample(jax.random.key(0), 0)
    with pytest.raises(InputError, match="most"):
        result.thinned(1)


@pytest.mark.parametrize("most", [2, 5, 8, 31, 32, 400])
def test_thinned_keeps_at_most_so_many_of_each_chain_alike(most):
    result = sampled(world())
    kept = result.thinned(most)
    assert kept.shape[1:] == (16,)
    assert 0 < len(kept) <= most
    assert len(kept) > min(most, 32) / 4
    if most >= 32:
        np.testing.assert_array_equal(kept, result.samples.reshape(-1, 16))


def test_summary_and_history_say_what_was_sampled():
    one = world()
    reports = []
    result = sampled(one, report=reports.append, chains=3)
    assert tuple(reports) == result.history
    assert [each.iteration for each in reports] == [*range(1, 25)]
    assert all(each.total == 24 for each in reports)
    assert all(0 <= each.accepted <= 1 for each in reports)
    for each in reports:
        assert each.objective == pytest.approx(each.actions + each.transitions + each.prior)
    kept = reports[8:]
    summary = result.summary()
    expected = {"chains": 3, "draws": 16, "iterations": 24, "converged": result.converged}
    assert expected.items() <= summary.items()
    assert summary["objective"] == pytest.approx(np.mean([each.objective for each in kept]))
    assert summary["log_prior"] == pytest.approx(np.mean([each.prior for each in kept]))
    assert "16 samples of each of 3 chains" in result.description
    densities = [one.prior.log_density(each) for each in result.samples[:, -1]]
    assert reports[-1].prior == pytest.approx(np.mean(densities))


def test_heat_falls_from_4_to_1_over_the_first_third():
    assert [dropped_sweeps(count) for count in (12, 13, 300)] == [4, 5, 100]
    heats = [heat(number, 300) for number in range(300)]
    assert heats[0] == 4
    assert heats[50] == pytest.approx(2)
    assert (np.diff(heats[:101]) < 0).all()
    assert heats[100:] == [1.0] * 200


# The same bits


def test_sample_barriers_with_the_same_seed_has_the_same_bits():
    first = sampled(world(), seed=3)
    assert_equal(first, sampled(world(), seed=3))
    assert (first.samples != sampled(world(), seed=4).samples).any()


PROGRAM = """
import hashlib, os, sys
os.sched_setaffinity(0, {int(core) for core in sys.argv[1].split(",")})
import jax
jax.config.update("jax_enable_x64", True)
from helpers.barrier_worlds import world
from sidestep.inference.sampler import sample_barriers
from sidestep.tabular.solvers.native import cores
one = world()
result = sample_barriers(*one.problem, prior=one.prior, sweeps=30, chains=3)
print(cores(), hashlib.sha256(result.samples.tobytes() + repr(result.history).encode()).hexdigest())
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system does not bind processes to cores")
def test_sample_barriers_on_one_core_equals_several():
    own = sorted(os.sched_getaffinity(0))
    every = sorted(range(os.cpu_count() or 1))
    places = os.pathsep.join(path for path in sys.path if path)
    printed = {}
    for name, chosen in {"one": own[:1], "all": every}.items():
        command = [sys.executable, "-c", PROGRAM, ",".join(str(core) for core in chosen)]
        environment = os.environ | {"PYTHONPATH": places}
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 0, done.stderr
        printed[name] = done.stdout.split()
    assert [int(count) for count, _ in printed.values()] == [1, len(every)]
    assert printed["one"][1] == printed["all"][1]


# Checkpoints


@pytest.fixture
def checkpoint(tmp_path):
    """A checkpoint that is saved after every sweep."""
    return Checkpoint(tmp_path / "fit.checkpoint", min_interval=0, max_fraction=1)


def interrupted_at(sweep):
    def report(progress):
        if progress.iteration == sweep:
            raise KeyboardInterrupt

    return report


@pytest.mark.parametrize("name", WORLDS)
def test_sample_barriers_resumed_equals_uninterrupted(checkpoint, name):
    one, sweeps = WORLDS[name], []
    expected = sampled(one)
    for sweep in (3, 13, 13):
        with pytest.raises(KeyboardInterrupt):
            sampled(one, report=interrupted_at(sweep), checkpoint=checkpoint, resume=True)
    resumed = sampled(
        one, report=lambda progress: sweeps.append(progress.iteration), checkpoint=checkpoint, resume=True
    )
    assert sweeps == [*range(13, 25)]
    assert_equal(resumed, expected)


def test_sample_barriers_continued_and_resumed_equals_uninterrupted(checkpoint):
    one, settings = stuck_world(), {"sweeps": 12, "most_sweeps": 40, "chains": 4}
    expected = sampled(one, **settings)
    for sweep in (5, 12, 30):
        with pytest.raises(KeyboardInterrupt):
            sampled(one, **settings, report=interrupted_at(sweep), checkpoint=checkpoint, resume=True)
    resumed = sampled(one, **settings, checkpoint=checkpoint, resume=True)
    assert len(resumed.history) == 40
    assert_equal(resumed, expected)


def test_sample_barriers_resumed_at_the_end_returns_the_same(checkpoint):
    expected = sampled(world(), checkpoint=checkpoint)
    resumed = sampled(world(), checkpoint=checkpoint, resume=True, report=lambda _: pytest.fail("it had ended"))
    assert_equal(resumed, expected)


def test_sample_barriers_without_resume_starts_again(checkpoint):
    sweeps = []
    with pytest.raises(KeyboardInterrupt):
        sampled(world(), report=interrupted_at(5), checkpoint=checkpoint)
    sampled(world(), report=lambda progress: sweeps.append(progress.iteration), checkpoint=checkpoint)
    assert sweeps[0] == 1


OTHERS = {
    "seed": {"seed": 1},
    "sweeps": {"sweeps": 25},
    "most sweeps": {"most_sweeps": 48},
    "chains": {"chains": 3},
    "tempering": {"tempering": 0.5},
    "terms": {"terms": ("actions",)},
    "prior": {"prior": replace(world().prior, lines=0.6)},
    "world": {"one": world(lapse=0.1)},
    "reward": {"one": world(reward=COSTLY)},
    "backup": {"one": world(backup=HardMax())},
}


@pytest.mark.parametrize("name", OTHERS)
def test_sample_barriers_of_another_problem_does_not_resume(checkpoint, name):
    with pytest.raises(KeyboardInterrupt):
        sampled(world(), report=interrupted_at(4), checkpoint=checkpoint)
    before = checkpoint.path.read_bytes()
    with pytest.raises(InputError, match="belongs to a fit of other data or with other settings"):
        sampled(**{"one": world()} | OTHERS[name], checkpoint=checkpoint, resume=True)
    assert checkpoint.path.read_bytes() == before


def test_sample_barriers_of_a_large_map_with_one_other_number_does_not_resume(checkpoint):
    """Texts of large arrays leave numbers out; a fingerprint does not."""
    grid, field = Grid.unknown(40, 40), np.full(1600, -2.0)
    shown = gather([Trajectory(np.array([0, 1]), np.array([RIGHT]), task=0)], [DISCOUNTED.reach(grid, 1)])
    one = BarrierWorld(ObstacleGrid(grid), shown, Behavior(BoltzmannAverage()), BinaryMRF(field, (40, 40)))
    with pytest.raises(KeyboardInterrupt):
        sampled(one, report=interrupted_at(2), checkpoint=checkpoint)
    other = np.where(np.arange(1600) == 800, -2.0 + 1e-12, field)
    with pytest.raises(InputError, match="other data"):
        sampled(one, prior=BinaryMRF(other, (40, 40)), checkpoint=checkpoint, resume=True)


def test_sample_barriers_to_resume_without_a_checkpoint_raises():
    with pytest.raises(InputError, match="resume"):
        sampled(world(), resume=True)


# Refusals


@pytest.mark.parametrize(("settings", "field"), [
    ({"sweeps": 11}, "sweeps"),
    ({"most_sweeps": 23}, "most_sweeps"),
    ({"chains": 1}, "chains"),
    ({"tempering": 0.0}, "tempering"),
    ({"tempering": 1.1}, "tempering"),
    ({"tempering": float("nan")}, "tempering"),
    ({"prior": BinaryMRF(np.zeros(15))}, "prior"),
    ({"prior": BinaryMRF(np.zeros(16), (2, 8))}, "prior"),
])  # fmt: skip
def test_sample_barriers_with_bad_settings_raises(settings, field):
    with pytest.raises(InputError, match=f"'{field}'"):
        sampled(world(), **settings)


def test_sample_barriers_of_a_model_without_barriers_raises():
    table, one = PROBLEMS["tabular"].model, world()
    with pytest.raises(InputError, match="model"):
        sample_barriers(table, one.demonstrations, one.behavior, prior=BinaryMRF(np.zeros(7)))


def test_walks_of_a_room_reach_their_goals():
    """The worlds of these tests are what their pictures say."""
    for kind in ("4 moves", "borders"):
        assert [int(walk.states[-1]) for walk in walks_of(kind)] == [3, 3, 0]
