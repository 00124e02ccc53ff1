"""κ is 1 for independent steps, and smaller for dependent ones."""

import jax
import numpy as np
import pytest

from sidestep.inference.calibration import ScoreStatistics, effective_sample_ratio, score_statistics
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import true_model
from sidestep.tabular.planning import plan
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach

pytestmark = pytest.mark.slow

GRID = Grid.unknown(rows=6, columns=6)
WORLD = true_model(GRID.passable())
TASK = reach(GRID, 35)
BEHAVIOR = Behavior(BoltzmannAverage(), 20.0, 0.1)


@pytest.fixture(scope="module")
def demonstrations():
    starts = np.random.default_rng(0).integers(35, size=600)
    return gather(simulate(jax.random.key(0), WORLD, [TASK], [starts], BEHAVIOR), [TASK])


def test_score_statistics_equal_central_differences_by_log_beta(demonstrations):
    statistics = score_statistics(WORLD, demonstrations, BEHAVIOR)
    q = plan(WORLD, TASK, BEHAVIOR).solution.action_values[demonstrations.states]
    width, moves = 1e-6, np.arange(len(demonstrations))
    up, down = (
        np.asarray(Behavior(BoltzmannAverage(), 20.0 * np.exp(sign * width), 0.1).log_policy(q)) for sign in (1, -1)
    )
    differences = (up - down) / (2 * width)
    np.testing.assert_allclose(statistics.score, differences[moves, demonstrations.actions], rtol=1e-5, atol=1e-8)
    policy = np.asarray(plan(WORLD, TASK, BEHAVIOR).policy)[np.asarray(demonstrations.states)]
    np.testing.assert_allclose(statistics.information, (policy * differences**2).sum(axis=1), rtol=1e-5)
    np.testing.assert_allclose(statistics.log_policy, np.log(policy[moves, demonstrations.actions]), rtol=1e-8)


def test_effective_sample_ratio_of_independent_steps_is_one(demonstrations):
    """The standard error of κ from 600 trajectories is √(2/600), some 6 %."""
    ratio = effective_sample_ratio([score_statistics(WORLD, demonstrations, BEHAVIOR)])
    assert ratio == pytest.approx(1, abs=0.2)


def test_effective_sample_ratio_of_repeated_steps_is_smaller(demonstrations):
    """Each step four times within its trajectory: four times the information, sixteen times the variation."""
    once = score_statistics(WORLD, demonstrations, BEHAVIOR)
    often = ScoreStatistics(*(np.repeat(part, 4) for part in once))
    assert effective_sample_ratio([often]) == pytest.approx(effective_sample_ratio([once]) / 4, rel=1e-9)


def test_score_statistics_leave_out_moves_of_weight_0(demonstrations):
    some = np.arange(demonstrations.trajectories) % 3 == 0
    statistics = score_statistics(WORLD, demonstrations.with_only(some), BEHAVIOR)
    np.testing.assert_array_equal(np.unique(statistics.trajectory), np.flatnonzero(some))


def test_effective_sample_ratio_of_optimal_paths_is_above_one():
    """The behavior of optimal agents is more regular than that of β = 5."""
    starts = np.random.default_rng(1).integers(35, size=200)
    optimal = gather(simulate(jax.random.key(1), WORLD, [TASK], [starts]), [TASK])
    ratio = effective_sample_ratio([score_statistics(WORLD, optimal, Behavior(BoltzmannAverage(), 5.0))])
    assert ratio > 1 + 3 * (2 / 200) ** 0.5
