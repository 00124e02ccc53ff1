"""Unknown goals: the posterior over candidates, and what is learned with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.goals import fit_goals, goal_posterior, weighted_demonstrations
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid, tabular_model, true_model
from sidestep.tabular.planning import plan
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach

pytestmark = pytest.mark.slow

BEHAVIOR = Behavior(BoltzmannAverage(), 30.0)
WALL = np.zeros((6, 7), dtype=int)
WALL[1:5, 3] = 1
WORLD = true_model(Grid(WALL))
BLANK = Grid.unknown(6, 7)
GOALS = (0, 6, 35, 41)
TASKS = [reach(BLANK, goal) for goal in GOALS]


def trajectories(cut=0):
    """Paths around the wall to one of four corners, without the last `cut` moves of each."""
    free = np.flatnonzero(WALL.ravel() == 0)
    starts = [np.random.default_rng(goal).choice(np.setdiff1d(free, GOALS), 8) for goal in GOALS]
    whole = simulate(jax.random.key(0), WORLD, TASKS, starts, BEHAVIOR)
    return [
        Trajectory(walk.states[: len(walk.states) - cut], walk.actions[: len(walk.actions) - cut], walk.task)
        for walk in whole
        if len(walk.actions) > cut
    ]


def test_goal_posterior_is_bayes_rule():
    seen, probabilities = trajectories(cut=2), np.array([0.4, 0.3, 0.2, 0.1])
    posterior, log_likelihood = goal_posterior(WORLD, seen, TASKS, BEHAVIOR, probabilities)
    policies = [np.asarray(plan(WORLD, task, BEHAVIOR).policy) for task in TASKS]
    total = 0.0
    for walk, row in zip(seen, posterior, strict=True):
        joint = probabilities * [
            0.0 if goal in walk.states[:-1] else policy[walk.states[:-1], walk.actions].prod()
            for goal, policy in zip(GOALS, policies, strict=True)
        ]
        np.testing.assert_allclose(row, joint / joint.sum(), rtol=1e-6, atol=1e-12)
        total += np.log(joint.sum())
    assert log_likelihood == pytest.approx(total, rel=1e-8)


def test_weighted_demonstrations_count_as_copies():
    seen = trajectories()[:3]
    posterior = np.zeros((3, 4))
    posterior[[0, 1, 2], [0, 0, 1]] = 1.0, 0.5, 2.0
    weighted = log_likelihood(WORLD, weighted_demonstrations(seen, TASKS, posterior), BEHAVIOR)
    separate = [
        log_likelihood(WORLD, gather([walk._replace(task=task)], TASKS), BEHAVIOR)
        for walk, task in zip(seen, (0, 0, 1), strict=True)
    ]
    for term in ("actions", "transitions"):
        expected = sum(
            weight * float(getattr(one, term)) for weight, one in zip((1.0, 0.5, 2.0), separate, strict=True)
        )
        assert float(getattr(weighted, term)) == pytest.approx(expected, rel=1e-9)


def test_fit_goals_learns_goals_and_the_wall_from_truncated_paths():
    seen = trajectories(cut=1)
    result = fit_goals(
        ObstacleGrid(BLANK, -1.0), seen, TASKS, BEHAVIOR, lambda model, demos: fit(model, demos, BEHAVIOR)
    )
    assert result.converged
    assert (np.diff(result.log_likelihoods) > -0.5).all()
    assert np.mean(result.posterior.argmax(axis=1) == [walk.task for walk in seen]) >= 0.9
    assert result.goal_probabilities.sum() == pytest.approx(1)
    blocked = np.asarray(result.fit.model.blocked).ravel()
    assert blocked[WALL.ravel() == 1].min() > blocked[WALL.ravel() == 0].max()


def test_fit_goals_of_one_round_has_not_converged_though_its_fit_has():
    fits = []

    def learn(model, demos):
        fits.append(fit(model, demos, BEHAVIOR))
        return fits[-1]

    result = fit_goals(ObstacleGrid(BLANK, -1.0), trajectories(cut=1), TASKS, BEHAVIOR, learn, rounds=1)
    assert fits[-1].converged
    assert not result.converged
    assert not result.fit.converged
    assert result.fit.message.startswith("the goals still changed by up to")


def test_goal_posterior_of_a_path_past_all_candidates_raises():
    states = np.array([1, 0, 1])
    walk = Trajectory(states, np.array([2, 3]), 0)
    with pytest.raises(InputError, match=r"trajectory, row 2: continues after the terminal states of all candidates"):
        goal_posterior(WORLD, [trajectories()[0], walk], TASKS[:1], BEHAVIOR)


def test_goal_posterior_by_a_behavior_model_is_that_of_its_behavior():
    seen, learned = trajectories(cut=2), behavior_model(BEHAVIOR, learn=["beta"])
    log_beta = jnp.full(1, np.log(3.0))
    learned = learned.with_parameters(learned.parameters._replace(log_beta=log_beta))
    posterior, log_likelihood = goal_posterior(WORLD, seen, TASKS, learned)
    expected, total = goal_posterior(WORLD, seen, TASKS, Behavior(BoltzmannAverage(), 3.0))
    np.testing.assert_allclose(posterior, expected, rtol=1e-9)
    assert log_likelihood == pytest.approx(total)


def test_goal_posterior_by_a_behavior_model_with_persons_is_refused():
    persons = behavior_model(BEHAVIOR, learn=["beta"], person=np.arange(len(TASKS)))
    with pytest.raises(InputError, match="persons"):
        goal_posterior(WORLD, trajectories(), TASKS, persons)


def test_fit_goals_with_a_learned_sharpness_has_the_posterior_by_what_was_learned():
    seen, agents = trajectories(cut=2), behavior_model(Behavior(BoltzmannAverage(), 3.0), learn=["beta"])

    def learn(model, shown):
        return fit(model, shown, agents)

    result = fit_goals(
        tabular_model(WORLD.graph, WORLD.probabilities(), known=True), seen, TASKS, agents, learn, rounds=2
    )
    behavior = result.fit.behavior.behavior_of()
    assert float(behavior.beta) > 6  # the walks have a sharpness of 30
    expected, total = goal_posterior(WORLD, seen, TASKS, behavior, result.goal_probabilities)
    np.testing.assert_allclose(result.posterior, expected, rtol=1e-9)
    assert result.log_likelihoods[-1] == pytest.approx(total)
