"""κ and the scores of a small room, beside central differences and sums written out."""

from itertools import product

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import dense, plain_policy, plain_values
from sidestep.errors import InputError, NotConverged
from sidestep.inference.calibration import ScoreStatistics, effective_sample_ratio, score_statistics
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import true_model
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach

ROOM = Grid(np.zeros((2, 3), dtype=int))
WORLD, BETA, LAPSE = true_model(ROOM), 2.0, 0.1
TASKS = [reach(ROOM, goal) for goal in (2, 5)]
WALKS = [
    Trajectory(np.array([3, 4, 5]), np.array([3, 3]), task=1),
    Trajectory(np.array([4, 1, 2]), np.array([0, 3]), task=0),
    Trajectory(np.array([0, 3, 4]), np.array([1, 3]), task=1),
]
SHOWN = gather(WALKS, TASKS)
AGENTS = Behavior(BoltzmannAverage(), BETA, LAPSE)


def test_score_statistics_of_a_room_equal_differences_of_the_dense_policy():
    """The score is the derivative by ln β at fixed Q."""
    statistics, width, numbers = score_statistics(WORLD, SHOWN, AGENTS), 1e-5, {0: [], 1: []}
    for task, table in zip(TASKS, numbers.values(), strict=True):
        _, q = plain_values("Boltzmann", dense(WORLD), task, BETA, sweeps=400)
        for by in (width, -width, 0.0):
            table.append(np.log((1 - LAPSE) * np.asarray(plain_policy(q, BETA * np.exp(by))) + LAPSE / 4))
    expected = []
    for number, walk in enumerate(WALKS):
        up, down, middle = numbers[walk.task]
        scores = (up - down) / (2 * width)
        for state, action in zip(walk.states[:-1], walk.actions, strict=True):
            information = (np.exp(middle[state]) * scores[state] ** 2).sum()
            expected.append((scores[state, action], information, middle[state, action], number, 1.0))
    np.testing.assert_allclose(np.transpose(list(statistics)), expected, rtol=1e-5, atol=1e-9)


def test_score_statistics_with_a_deadline_raises():
    with pytest.raises(InputError, match="deadline"):
        score_statistics(WORLD, SHOWN, AGENTS, options=SolveOptions(horizon=3, deadline=True))
    assert len(score_statistics(WORLD, SHOWN, AGENTS, options=SolveOptions(horizon=3)).score) == 6


def test_score_statistics_of_values_that_do_not_converge_raises():
    with pytest.raises(NotConverged, match="smaller β"):
        score_statistics(WORLD, SHOWN, AGENTS, options=SolveOptions(solver=Jacobi(max_sweeps=1)))


def statistics(score, information, trajectory, weight=None):
    weight = np.ones(len(score)) if weight is None else weight
    return ScoreStatistics(*map(np.asarray, (score, information, np.zeros(len(score)), trajectory, weight)))


def test_effective_sample_ratio_sums_scores_within_trajectories():
    first = statistics([1.0, 2.0, -4.0], [0.5, 0.25, 1.0], [0, 0, 1])
    second = statistics([3.0, 0.5], [0.75, 2.0], [3, 3])
    mean = 2.5 / 5
    sums = np.array([3.0 - 2 * mean, -4.0 - mean, 3.5 - 2 * mean])
    assert effective_sample_ratio([first, second]) == pytest.approx(4.5 / (sums**2).sum(), rel=1e-12)


NUMBERS = [1.0, 2.0, -4.0, 3.0, 0.5], [0.5, 0.25, 1.0, 0.75, 2.0]
OF = [0, 0, 1, 2, 2]


def ratio_of(*weights):
    return effective_sample_ratio([statistics(*NUMBERS, OF, np.array(weights, float))])


def test_effective_sample_ratio_of_a_walk_of_weight_two_is_that_of_the_walk_twice():
    score, information = ([*part, *part[3:]] for part in NUMBERS)
    expected = effective_sample_ratio([statistics(score, information, [*OF, 3, 3])])
    assert ratio_of(1, 1, 1, 2, 2) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("weight", [0.01, 3.0])
def test_effective_sample_ratio_of_equal_weights_is_that_of_weight_one(weight):
    assert ratio_of(*[weight] * 5) == pytest.approx(ratio_of(1, 1, 1, 1, 1), rel=1e-12)


def test_effective_sample_ratio_of_weights_0_and_1_is_that_of_the_moves_that_count():
    some = [0, 2, 3, 4]
    without = statistics(*(np.array(part)[some] for part in (*NUMBERS, OF)))
    assert ratio_of(1, 0, 1, 1, 1) == pytest.approx(effective_sample_ratio([without]), rel=1e-12)
    assert ratio_of(1, 1e-9, 1, 1, 1) == pytest.approx(effective_sample_ratio([without]), rel=1e-6)


def test_effective_sample_ratio_of_independent_steps_is_one_whatever_the_weights():
    """Two walks of two steps, each a fair coin of score ±1: the mean of J over all of them is I, with ū = 0."""
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    weights = np.array([1.0, 0.2, 3.0])
    pairs = [(sign, -sign) for sign in signs]  # whose mean score is 0
    scores = np.array([np.concatenate(pair) for pair in pairs])
    walks, weight = np.arange(len(scores))[:, None] * 2 + np.repeat([0, 1], 3), np.tile(weights, (len(scores), 2))
    every = statistics(scores.ravel(), np.ones(scores.size), walks.ravel(), weight.ravel())
    assert effective_sample_ratio([every]) == pytest.approx(1, rel=1e-12)


def test_score_statistics_have_the_weight_of_each_move():
    weights = np.array([1.0, 1.0, 0.01, 0.01, 0.0, 2.0])
    weighted = eqx.tree_at(lambda each: each.weights, SHOWN, jnp.asarray(weights))
    every, some = score_statistics(WORLD, SHOWN, AGENTS), score_statistics(WORLD, weighted, AGENTS)
    assert some.weight.tolist() == weights[weights > 0].tolist()
    np.testing.assert_allclose(some.score, every.score[weights > 0], rtol=1e-12)


def test_effective_sample_ratio_of_constant_scores_is_infinite_and_of_none_raises():
    assert effective_sample_ratio([statistics([2.0, 2.0], [1.0, 1.0], [0, 1])]) == np.inf
    with pytest.raises(InputError, match="at least one move"):
        effective_sample_ratio([statistics(np.zeros(0), np.zeros(0), np.zeros(0, int))])
