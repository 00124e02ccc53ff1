"""`mean_field_barriers`: beside the exact posterior, its equation, the same bits again, and what it refuses."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit

from helpers.barrier_worlds import COSTLY, DISCOUNTED, RIGHT, UP, BarrierWorld, all_maps, corridor, room, world
from sidestep.errors import ImproperTask, InputError
from sidestep.inference.chain_evidence import PASSING
from sidestep.inference.checkpoints import Checkpoint
from sidestep.inference.coordinate_ascent import BarrierMeanField, mean_field_barriers, prior_mean_field
from sidestep.inference.enumeration import enumerate_barriers
from sidestep.inference.maximize import Status
from sidestep.inference.mrf import BinaryMRF, expected_shapes, shape_counts
from sidestep.tabular.backups import Behavior, HardMax, LogSumExp
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid, walled_grid
from sidestep.tabular.models.barriers import barriers_of, with_closed

WORLDS = {
    "4 moves": world(),
    "8 moves": world("8 moves", COSTLY, HardMax(), beta=1.0),
    "borders": world("borders", DISCOUNTED, LogSumExp(), lapse=0.05),
}


def ascended(one: BarrierWorld, **settings: Any) -> BarrierMeanField:
    return mean_field_barriers(*one.problem, **{"prior": one.prior, **settings})


def two_walls() -> BarrierWorld:
    """Return walks from corner to corner and back around one of two walls; the prior hardly allows both."""
    grid = Grid.unknown(2, 3)
    there = Trajectory(np.array([0, 3, 4, 5, 2]), np.array([1, RIGHT, RIGHT, UP]), task=0)
    back = Trajectory(np.array([2, 5, 4, 3, 0]), np.array([1, 2, 2, UP]), task=1)
    shown = gather([there, back] * 3, [DISCOUNTED.reach(grid, goal) for goal in (2, 0)])
    return BarrierWorld(walled_grid(grid), shown, Behavior(LogSumExp(), beta=30.0), BinaryMRF(np.full(7, -12.0)))


# Beside the exact posterior


@pytest.mark.parametrize("name", WORLDS)
def test_mean_field_barriers_is_near_the_exact_probabilities(name):
    one = WORLDS[name]
    exact = enumerate_barriers(*one.problem, one.prior).closed
    result = ascended(one)
    open_questions = (exact > 0) & (exact < 1)
    assert np.abs(result.closed - exact)[open_questions].mean() < 0.06
    assert result.converged


def test_mean_field_barriers_of_a_single_barrier_is_exact():
    known = room().known.copy()
    known[0, 1], known[0, 2], known[3, :3] = Cell.OCCUPIED, Cell.FREE, Cell.FREE
    one = world()
    model = ObstacleGrid(Grid(known))
    exact = enumerate_barriers(model, one.demonstrations, one.behavior, one.prior).closed
    result = mean_field_barriers(model, one.demonstrations, one.behavior, prior=one.prior, starts=1)
    assert result.inferred.sum() == 1
    np.testing.assert_allclose(result.closed[result.inferred], exact[result.inferred], atol=1e-3)


def test_mean_field_barriers_mixes_two_walls_that_explain_the_same_detour():
    one = two_walls()
    exact = enumerate_barriers(*one.problem, one.prior).closed
    single, mixed = ascended(one, starts=1), ascended(one, starts=8)
    assert len(single.parts) == 1
    assert sorted(single.closed)[-2:] == pytest.approx([0, 1], abs=0.1)
    assert len(mixed.parts) == 2
    np.testing.assert_allclose(mixed.weights, 0.5, atol=0.05)
    np.testing.assert_allclose(mixed.closed, exact, atol=0.05)
    walls = np.argsort(exact)[-2:]
    drawn = mixed.sample(jax.random.key(0), 400)[:, walls]
    assert (drawn.sum(axis=1) == 1).mean() > 0.95
    assert 0.4 < drawn[:, 0].mean() < 0.6


# The equation


def test_mean_field_barriers_at_its_end_satisfies_its_equation():
    """P(closed) of each barrier from whole solves with the others at their means."""
    one = world()
    result = ascended(one, starts=1)
    known = barriers_of(one.model).known

    def objective(closed: np.ndarray) -> float:
        passing = (1 - closed) * PASSING[0] + closed * PASSING[1]
        model = with_closed(one.model, np.clip(1 - passing, 1e-9, 1 - 1e-9))
        likelihood = log_likelihood(model, one.demonstrations, one.behavior)
        shapes = expected_shapes(np.pad(closed.reshape(4, 4), 1))
        return float(sum(likelihood)) + float(one.prior.field @ closed + one.prior.weights @ shapes)

    for i in np.flatnonzero(result.inferred):
        shut, opened = result.closed.copy(), result.closed.copy()
        shut[i], opened[i] = 1.0, 0.0
        implied = expit(objective(shut) - objective(opened))
        assert result.closed[i] == pytest.approx(implied, abs=5e-3), i
    np.testing.assert_array_equal(result.closed[known == Cell.OCCUPIED], 1.0)


def test_expected_shapes_equals_the_sum_over_all_maps():
    closed = np.random.default_rng(0).random((3, 3))
    maps = np.array(list(all_maps(9)), bool)
    chances = np.where(maps, closed.ravel(), 1 - closed.ravel()).prod(axis=1)
    expected = chances @ shape_counts(maps.reshape(-1, 3, 3))
    np.testing.assert_allclose(expected_shapes(np.pad(closed, 1)), expected)


@pytest.mark.parametrize("start", [0.0, 0.5, 1.0])
def test_prior_mean_field_satisfies_its_equation(start):
    prior = BinaryMRF(np.linspace(-1, 0.5, 12), (3, 4), lines=0.5, pairs=0.3, blocks=-1.0, isolated=-0.4)
    known = np.full(12, int(Cell.UNKNOWN))
    known[0], known[7] = Cell.OCCUPIED, Cell.FREE
    means = prior_mean_field(prior, known, np.full(12, start))
    assert (means[0], means[7]) == (1.0, 0.0)

    def objective(closed: np.ndarray) -> float:
        return float(prior.field @ closed + prior.weights @ expected_shapes(np.pad(closed.reshape(3, 4), 1)))

    for i in np.flatnonzero(known == Cell.UNKNOWN):
        shut, opened = means.copy(), means.copy()
        shut[i], opened[i] = 1.0, 0.0
        assert means[i] == pytest.approx(expit(objective(shut) - objective(opened)), abs=2e-3), i


def test_prior_mean_field_of_another_size_raises():
    with pytest.raises(InputError, match=r"'known'.*expected 3 barriers, found 4"):
        prior_mean_field(BinaryMRF(np.zeros(3)), np.full(4, -1), np.zeros(4))


# Runs


def assert_equal(one: BarrierMeanField, other: BarrierMeanField) -> None:
    np.testing.assert_array_equal(one.parts, other.parts)
    np.testing.assert_array_equal(one.weights, other.weights)
    assert one.history == other.history


def test_mean_field_barriers_resumed_is_the_same_to_the_bit(tmp_path):
    one, file = world(), Checkpoint(tmp_path / "ascent", min_interval=0.0, max_fraction=1.0)

    class Interrupt(Exception):
        pass

    def stop(progress) -> None:
        if progress.iteration == 3:
            raise Interrupt

    with pytest.raises(Interrupt):
        ascended(one, checkpoint=file, report=stop)
    resumed = ascended(one, checkpoint=file, resume=True)
    assert_equal(resumed, ascended(one))
    with pytest.raises(InputError, match="other settings"):
        ascended(one, checkpoint=file, resume=True, seed=1)


def test_mean_field_barriers_stopped_at_max_sweeps_continues(tmp_path):
    one, file = world(), Checkpoint(tmp_path / "ascent", min_interval=0.0, max_fraction=1.0)
    ascended(one, checkpoint=file, max_sweeps=2)
    assert_equal(ascended(one, checkpoint=file, resume=True), ascended(one))


def test_mean_field_barriers_reports_each_sweep():
    reports = []
    result = ascended(world(), starts=1, report=reports.append)
    assert [each._replace(total=0) for each in reports] == [each._replace(total=0) for each in result.history]
    assert reports[0].total == 100
    assert result.final.gap <= 1e-3 < result.history[0].gap
    assert f"{len(reports)} sweeps" in result.description


def test_mean_field_barriers_at_max_sweeps_has_not_converged():
    result = ascended(world(), max_sweeps=1)
    assert result.status is Status.MAX_ITERATIONS
    assert not result.converged
    assert not result.summary()["converged"]


def test_mean_field_barriers_tempered_by_actions_alone_is_near_the_exact_probabilities():
    one = world("borders", beta=9.0)
    settings: dict[str, Any] = {"tempering": 0.3, "terms": ("actions",)}
    part, whole = (enumerate_barriers(*one.problem, one.prior, **each).closed for each in (settings, {}))
    assert np.abs(ascended(one, **settings).closed - part).mean() < 0.06
    assert np.abs(part - whole).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["slips", "turns"])
def test_mean_field_barriers_of_other_models_is_near_the_exact_probabilities(kind):
    one = world(kind)
    exact = enumerate_barriers(*one.problem, one.prior).closed
    assert np.abs(ascended(one).closed - exact).mean() < 0.06


def test_mean_field_barriers_of_a_known_map_is_the_map():
    grid, one = room().passable(), world()
    result = mean_field_barriers(ObstacleGrid(grid), one.demonstrations, one.behavior, prior=one.prior)
    np.testing.assert_array_equal(result.closed, grid.known.ravel())
    assert result.converged


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"starts": 0}, "starts"),
        ({"max_sweeps": 0}, "max_sweeps"),
        ({"tempering": 0.0}, "tempering"),
        ({"prior": BinaryMRF(np.zeros(3))}, "prior"),
    ],
)
def test_mean_field_barriers_with_settings_out_of_range_raises(settings, field):
    with pytest.raises(InputError, match=f"'{field}'"):
        ascended(world(), **settings)


def test_mean_field_barriers_of_agents_with_a_discount_is_that_of_discounted_tasks():
    """Without costs, the task at discount 1 has no values of its own."""
    one = corridor()
    undiscounted = eqx.tree_at(lambda demos: demos.tasks.discount, one.demonstrations, jnp.ones(1))
    agents = behavior_model(one.behavior, ["discount"], discount=DISCOUNTED.discount)
    with pytest.raises(ImproperTask):
        mean_field_barriers(one.model, undiscounted, one.behavior, prior=one.prior)
    result = mean_field_barriers(one.model, undiscounted, agents, prior=one.prior)
    np.testing.assert_allclose(result.closed, ascended(one).closed, rtol=1e-6)
