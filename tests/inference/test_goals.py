"""Goals that nobody named: the posterior over candidates, and what is learned with it."""

import jax
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.goals import fit_goals, goal_posterior, weighted
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.planning import plan
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach

PEOPLE = Behavior(BoltzmannAverage(), 30.0)
WALL = np.zeros((6, 7), dtype=int)
WALL[1:5, 3] = 1
WORLD = true_model(Grid(WALL))
BLANK = Grid.unknown(6, 7)
GOALS = (0, 6, 35, 41)
TASKS = [reach(BLANK, goal) for goal in GOALS]


def walks(cut=0):
    """People who walk round the wall to one of four corners; the last `cut` moves of each are not seen."""
    free = np.flatnonzero(WALL.ravel() == 0)
    starts = [np.random.default_rng(goal).choice(np.setdiff1d(free, GOALS), 8) for goal in GOALS]
    seen = simulate(jax.random.key(0), WORLD, TASKS, starts, PEOPLE)
    return [
        Trajectory(walk.states[: len(walk.states) - cut], walk.actions[: len(walk.actions) - cut], walk.task)
        for walk in seen
        if len(walk.actions) > cut
    ]


def test_the_posterior_is_bayes_rule():
    seen, shares = walks(cut=2), np.array([0.4, 0.3, 0.2, 0.1])
    posterior, evidence = goal_posterior(WORLD, seen, TASKS, PEOPLE, shares)
    policies = [np.asarray(plan(WORLD, task, PEOPLE).policy) for task in TASKS]
    total = 0.0
    for walk, found in zip(seen, posterior, strict=True):
        joint = shares * [
            0.0 if goal in walk.states[:-1] else policy[walk.states[:-1], walk.actions].prod()
            for goal, policy in zip(GOALS, policies, strict=True)
        ]
        np.testing.assert_allclose(found, joint / joint.sum(), rtol=1e-6, atol=1e-12)
        total += np.log(joint.sum())
    assert evidence == pytest.approx(total, rel=1e-8)


def test_weights_count_as_so_many_copies():
    seen = walks()[:3]
    posterior = np.zeros((3, 4))
    posterior[[0, 1, 2], [0, 0, 1]] = 1.0, 0.5, 2.0
    found = log_likelihood(WORLD, weighted(seen, TASKS, posterior), PEOPLE)
    alone = [
        log_likelihood(WORLD, gather([walk._replace(task=task)], TASKS), PEOPLE)
        for walk, task in zip(seen, (0, 0, 1), strict=True)
    ]
    for term in ("actions", "transitions"):
        expected = sum(weight * float(getattr(one, term)) for weight, one in zip((1.0, 0.5, 2.0), alone, strict=True))
        assert float(getattr(found, term)) == pytest.approx(expected, rel=1e-9)


def test_goals_and_the_wall_are_found_from_walks_that_break_off():
    seen = walks(cut=1)
    found = fit_goals(ObstacleGrid(BLANK, -1.0), seen, TASKS, PEOPLE, lambda model, shown: fit(model, shown, PEOPLE))
    assert found.converged
    assert (np.diff(found.evidence) > -0.5).all()
    assert np.mean(found.posterior.argmax(axis=1) == [walk.task for walk in seen]) >= 0.9
    assert found.shares.sum() == pytest.approx(1)
    blocked = np.asarray(found.fit.model.blocked).ravel()
    assert blocked[WALL.ravel() == 1].min() > blocked[WALL.ravel() == 0].max()


def test_a_walk_that_passes_all_candidates_is_refused():
    states = np.array([1, 0, 1])
    walk = Trajectory(states, np.array([2, 3]), 0)
    with pytest.raises(InputError, match=r"walk, row 2: goes on after it has reached each of the candidates"):
        goal_posterior(WORLD, [walks()[0], walk], TASKS[:1], PEOPLE)
