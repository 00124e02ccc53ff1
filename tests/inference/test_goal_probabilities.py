"""Unknown goals of walks of one choice each, where Bayes' rule and its fixed point are known."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.inference.fit import fit
from sidestep.inference.goals import fit_goals, goal_posterior
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.graph import graph
from sidestep.tabular.models import TabularModel
from sidestep.tabular.tasks import task

# From state 0 the actions surely lead to states 1 and 2. Each task pays 1 for one of them, so π = σ(±β).
MODEL = TabularModel(graph(np.array([[[1], [2]], [[1], [1]], [[2], [2]]])), jnp.zeros((3, 2, 1)))
TASKS = [
    task(np.array([[first, 1 - first], [0, 0], [0, 0]], float), 0.9, np.array([False, True, True])) for first in (1, 0)
]
AGENTS = Behavior(LogSumExp(), float(np.log(3)))  # π = ¾ for what pays
FIRST, SECOND = (Trajectory(np.array([0, 1 + action]), np.array([action]), 0) for action in (0, 1))


def test_goal_posterior_of_one_choice_weighs_goals_by_their_probabilities():
    """¾ · ⅕ to ¼ · ⅘ is 3 to 4 after the first action, ¼ · ⅕ to ¾ · ⅘ is 1 to 12 after the second."""
    posterior, total = goal_posterior(MODEL, [FIRST, SECOND], TASKS, AGENTS, [0.2, 0.8])
    np.testing.assert_allclose(posterior, [[3 / 7, 4 / 7], [1 / 13, 12 / 13]], rtol=1e-9)
    assert total == pytest.approx(np.log(7 / 20) + np.log(13 / 20), rel=1e-9)
    equal, _ = goal_posterior(MODEL, [FIRST, SECOND], TASKS, AGENTS)
    np.testing.assert_allclose(equal, [[3 / 4, 1 / 4], [1 / 4, 3 / 4]], rtol=1e-9)


def test_fit_goals_of_one_choice_each_learns_the_most_likely_probabilities():
    """Of 50 walks 30 take the first action: p · ¾ + (1 − p) · ¼ = 30/50 at p = 7/10."""
    walks = [FIRST] * 30 + [SECOND] * 20

    def learn(model, shown):
        return fit(model, shown, AGENTS, terms=("transitions",))

    result = fit_goals(MODEL, walks, TASKS, AGENTS, learn, tolerance=1e-4)
    assert result.converged
    np.testing.assert_allclose(result.goal_probabilities, [0.7, 0.3], atol=1e-3)
    np.testing.assert_allclose(result.posterior[0], [0.7 * 0.75 / 0.6, 0.3 * 0.25 / 0.6], atol=1e-3)
    assert result.log_likelihoods[-1] == pytest.approx(30 * np.log(0.6) + 20 * np.log(0.4), rel=1e-6)
