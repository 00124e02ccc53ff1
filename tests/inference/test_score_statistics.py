"""κ and the scores of a small room, beside central differences and sums written out."""

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
            expected.append((scores[state, action], information, middle[state, action], number))
    np.testing.assert_allclose(np.transpose(list(statistics)), expected, rtol=1e-5, atol=1e-9)


def test_score_statistics_with_a_deadline_raises():
    with pytest.raises(InputError, match="deadline"):
        score_statistics(WORLD, SHOWN, AGENTS, options=SolveOptions(horizon=3, deadline=True))
    assert len(score_statistics(WORLD, SHOWN, AGENTS, options=SolveOptions(horizon=3)).score) == 6


def test_score_statistics_of_values_that_do_not_converge_raises():
    with pytest.raises(NotConverged, match="smaller β"):
        score_statistics(WORLD, SHOWN, AGENTS, options=SolveOptions(solver=Jacobi(max_sweeps=1)))


def statistics(score, information, trajectory):
    return ScoreStatistics(*map(np.asarray, (score, information, np.zeros(len(score)), trajectory)))


def test_effective_sample_ratio_sums_scores_within_trajectories():
    first = statistics([1.0, 2.0, -4.0], [0.5, 0.25, 1.0], [0, 0, 1])
    second = statistics([3.0, 0.5], [0.75, 2.0], [3, 3])
    mean = 2.5 / 5
    sums = np.array([3.0 - 2 * mean, -4.0 - mean, 3.5 - 2 * mean])
    assert effective_sample_ratio([first, second]) == pytest.approx(4.5 / (sums**2).sum(), rel=1e-12)


def test_effective_sample_ratio_of_constant_scores_is_infinite_and_of_none_raises():
    assert effective_sample_ratio([statistics([2.0, 2.0], [1.0, 1.0], [0, 1])]) == np.inf
    with pytest.raises(InputError, match="at least one move"):
        effective_sample_ratio([statistics(np.zeros(0), np.zeros(0), np.zeros(0, int))])
