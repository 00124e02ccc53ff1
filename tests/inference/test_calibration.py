"""How much the steps of walks say: κ is 1 for independent steps, and less where they go wrong together."""

import jax
import numpy as np
import pytest

from sidestep.inference.calibration import Scores, doubtful, effective_sample_ratio, scores
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import true_model
from sidestep.tabular.planning import plan
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach

GRID = Grid.unknown(rows=6, columns=6)
WORLD = true_model(GRID.passable())
TASK = reach(GRID, 35)
PEOPLE = Behavior(BoltzmannAverage(), 20.0, 0.1)


@pytest.fixture(scope="module")
def walks():
    starts = np.random.default_rng(0).integers(35, size=600)
    return gather(simulate(jax.random.key(0), WORLD, [TASK], [starts], PEOPLE), [TASK])


def test_scores_are_the_slope_of_the_log_policy_by_log_sharpness(walks):
    found = scores(WORLD, walks, PEOPLE)
    q = plan(WORLD, TASK, PEOPLE).solution.action_values[walks.states]
    width, moves = 1e-6, np.arange(len(walks))
    up, down = (
        np.asarray(Behavior(BoltzmannAverage(), 20.0 * np.exp(sign * width), 0.1).log_policy(q)) for sign in (1, -1)
    )
    slopes = (up - down) / (2 * width)
    np.testing.assert_allclose(found.score, slopes[moves, walks.actions], rtol=1e-5, atol=1e-8)
    policy = np.asarray(plan(WORLD, TASK, PEOPLE).policy)[np.asarray(walks.states)]
    np.testing.assert_allclose(found.information, (policy * slopes**2).sum(axis=1), rtol=1e-5)
    np.testing.assert_allclose(found.log_policy, np.log(policy[moves, walks.actions]), rtol=1e-8)


def test_steps_drawn_one_by_one_are_worth_themselves(walks):
    """600 walks: κ is off by √(2/600), some 6 %."""
    share = effective_sample_ratio([scores(WORLD, walks, PEOPLE)])
    assert share == pytest.approx(1, abs=0.2)
    assert doubtful(share, 600, 3.0) == (False, False)


def test_steps_that_are_copies_of_each_other_are_worth_one_of_them(walks):
    """Each step counted four times within its walk: four times the information, sixteen times the variation."""
    once = scores(WORLD, walks, PEOPLE)
    often = Scores(*(np.repeat(part, 4) for part in once))
    assert effective_sample_ratio([often]) == pytest.approx(effective_sample_ratio([once]) / 4, rel=1e-9)


def test_only_moves_that_count_are_scored(walks):
    some = np.arange(walks.trajectories) % 3 == 0
    found = scores(WORLD, walks.with_only(some), PEOPLE)
    np.testing.assert_array_equal(np.unique(found.trajectory), np.flatnonzero(some))


def test_people_who_err_less_than_they_are_taken_to_are_more_regular():
    starts = np.random.default_rng(1).integers(35, size=200)
    optimal = gather(simulate(jax.random.key(1), WORLD, [TASK], [starts]), [TASK])
    share = effective_sample_ratio([scores(WORLD, optimal, Behavior(BoltzmannAverage(), 5.0))])
    assert doubtful(share, 200, 3.0) == (False, True)
