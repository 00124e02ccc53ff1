"""Unknown goals of walks of one choice each, where Bayes' rule and its fixed point are known."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.goals import fit_goals, goal_posterior
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.graph import graph
from sidestep.tabular.models import TabularModel
from sidestep.tabular.solve import SolveOptions
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


@pytest.mark.parametrize(("wrong", "found"), [
    ([1.0, 1.0], "a sum of 2"), ([0.1, 0.1], "a sum of 0.2"), ([0.0, 0.0], "a sum of 0"), ([1.5, -0.5], "-0.5"),
])  # fmt: skip
def test_goal_posterior_of_probabilities_that_are_no_distribution_raises(wrong, found):
    with pytest.raises(InputError, match=f"'goal_probabilities': expected probabilities.*found.*{found}"):
        goal_posterior(MODEL, [FIRST, SECOND], TASKS, AGENTS, wrong)


# From state 0 action 0 leads to 1, from where 3 is reached, and action 1 to 2, a trap.
TRAP = TabularModel(graph(np.array([[[1], [2]], [[3], [3]], [[2], [2]], [[3], [3]]])), jnp.zeros((4, 2, 1)))
OUT = [task(np.where(np.arange(4) == end, 0.0, -1.0), 1.0, np.arange(4) == end) for end in (3, 0)]
INTO_TRAP = Trajectory(np.array([0, 2]), np.array([1]), 0)


@pytest.mark.parametrize(("ends", "prior", "words"), [
    ([0], [1.0], "probability 0 for 1 of 1 candidates, such as one into a state from which the goal is out of reach:"),
    ([0, 1], [0.5, 0.5], "probability 0 for 1 of 2 .*; it continues after the terminal states of 1 others:"),
    ([0, 1], [0.0, 1.0], "continues after the terminal states of all candidates"),
])  # fmt: skip
def test_goal_posterior_of_a_walk_without_a_goal_says_why(ends, prior, words):
    with pytest.raises(InputError, match=f"trajectory, row 1: .*{words}"):
        goal_posterior(TRAP, [INTO_TRAP], [OUT[end] for end in ends], AGENTS, prior)


def test_goal_posterior_after_an_end_without_its_action_elsewhere_is_zero():
    """State 0, where the moves after an end are looked up, lacks the action of such a move."""
    only = graph(np.array([[[1], [2]], [[1], [1]], [[2], [2]]]), available=np.array([[1, 0], [1, 1], [1, 1]], bool))
    walk = Trajectory(np.array([0, 1, 1]), np.array([0, 1]), 0)
    goes_on = task(np.zeros((3, 2)), 0.9, np.array([False, False, True]))
    posterior, total = goal_posterior(TabularModel(only, MODEL.parameters), [walk], [TASKS[0], goes_on], AGENTS)
    assert posterior.tolist() == [[0.0, 1.0]]
    assert total == pytest.approx(np.log(0.5 * 1.0 * 0.5), rel=1e-9)


# Actions lead from state 0 to 1 or 2, and from both to 3. Task 0 pays for 1 at once, task 1 for 3 after 1 or 2 alike.
LATER = TabularModel(graph(np.array([[[1], [2]], [[3], [3]], [[3], [3]], [[3], [3]]])), jnp.zeros((4, 2, 1)))
PAID = np.zeros((2, 4, 2))
PAID[0, 0] = 1.0, 0.0
PAID[1, 1] = 5.0  # what an agent that looks one action ahead does not see
SOON, LATE = (task(pays, 0.9, np.arange(4) == 3) for pays in PAID)
MYOPIC = SolveOptions(horizon=1)


def test_goal_posterior_with_a_horizon_is_that_of_agents_who_look_as_far():
    """Of one action ahead, π is ¾ for what pays at once, and ½ where nothing does."""
    posterior, total = goal_posterior(LATER, [FIRST], [SOON, LATE], AGENTS, options=MYOPIC)
    np.testing.assert_allclose(posterior, [[0.6, 0.4]], rtol=1e-9)
    assert total == pytest.approx(np.log(0.5 * (0.75 + 0.5)), rel=1e-9)
    ahead, _ = goal_posterior(LATER, [FIRST], [SOON, LATE], AGENTS)
    both = np.array([0.75, 1 / (1 + 3.0 ** (-0.9 * 5))])
    np.testing.assert_allclose(ahead[0], both / both.sum(), rtol=1e-9)


@pytest.mark.parametrize("options", [None, MYOPIC])
def test_fit_goals_has_the_values_of_the_fit(options):
    """The share p of task 0 is the most likely: a walk's probability is ½ + p/4, and of the other one ½ − p/4."""
    walks = [FIRST] * 3 + [SECOND] * 2

    def learn(model, shown):
        return fit(model, shown, AGENTS, terms=("actions",), options=MYOPIC)

    result = fit_goals(LATER, walks, [SOON, LATE], AGENTS, learn, tolerance=1e-5, rounds=200, options=options)
    assert result.converged
    np.testing.assert_allclose(result.goal_probabilities[0], 0.4, atol=1e-3)
    np.testing.assert_allclose(result.posterior[0, 0], 0.4 * 0.75 / 0.6, atol=1e-3)
    first = goal_posterior(LATER, walks, [SOON, LATE], AGENTS, options=options)[1]
    assert result.log_likelihoods[0] == pytest.approx(first)
    assert result.log_likelihoods[-1] == pytest.approx(3 * np.log(0.6) + 2 * np.log(0.4), rel=1e-6)
