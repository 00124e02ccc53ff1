"""Unknown goals in a small room, where the posterior is quickly written down: Bayes' rule over dense policies."""

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import dense, plain_policy, plain_values
from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.goals import fit_goals, goal_posterior, weighted_demonstrations
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.tasks import reach

ROOM = Grid(np.zeros((2, 3), dtype=int))
WORLD, GOALS, BETA = true_model(ROOM), (0, 2, 5), 2.0
TASKS = [reach(ROOM, goal) for goal in GOALS]
AGENTS = Behavior(BoltzmannAverage(), BETA)
RIGHT, DOWN, LEFT = 3, 1, 2
WALKS = [
    Trajectory(np.array([3, 4, 5]), np.array([RIGHT, RIGHT]), task=0),
    Trajectory(np.array([4, 1, 2]), np.array([0, RIGHT]), task=0),
    Trajectory(np.array([1, 0, 3]), np.array([LEFT, DOWN]), task=0),  # beyond goal 0
    Trajectory(np.array([4, 1]), np.array([0]), task=0),
]
PASSES = [(walk, goal) for walk in range(4) for goal in range(3) if GOALS[goal] in WALKS[walk].states[:-1]]


def likelihoods():
    """Π π of each walk for each goal, 0 where it goes on after the goal."""
    columns = []
    for task in TASKS:
        _, q = plain_values("Boltzmann", dense(WORLD), task, BETA, sweeps=400)
        policy = np.asarray(plain_policy(q, BETA))
        columns.append([policy[walk.states[:-1], walk.actions].prod() for walk in WALKS])
    table = np.transpose(columns)
    for walk, goal in PASSES:
        table[walk, goal] = 0
    return table


@pytest.mark.parametrize("prior", [None, [0.6, 0.3, 0.1], np.array([0.0, 0.5, 0.5])])
def test_goal_posterior_of_a_room_is_bayes_rule(prior):
    posterior, log_likelihood = goal_posterior(WORLD, WALKS, TASKS, AGENTS, prior)
    joint = likelihoods() * (np.full(3, 1 / 3) if prior is None else np.asarray(prior))
    np.testing.assert_allclose(posterior, joint / joint.sum(axis=1, keepdims=True), rtol=1e-6, atol=1e-12)
    assert log_likelihood == pytest.approx(np.log(joint.sum(axis=1)).sum(), rel=1e-8)
    assert PASSES == [(2, 0)]


@pytest.mark.parametrize("prior", [[-0.1, 0.6, 0.5], [0.5, 1.5, 0.0], [0.5, 0.5], [np.nan, 0.5, 0.5]])
def test_goal_posterior_of_wrong_probabilities_raises(prior):
    with pytest.raises(InputError, match="goal_probabilities"):
        goal_posterior(WORLD, WALKS, TASKS, AGENTS, prior)


def test_goal_posterior_names_the_first_walk_beyond_all_candidates():
    with pytest.raises(InputError, match=r"trajectory, row 3: continues after"):
        goal_posterior(WORLD, WALKS, TASKS[:1], AGENTS)
    beyond = WALKS[2]._replace(states=np.array([1, 0, 1, 2]), actions=np.array([LEFT, RIGHT, RIGHT]))
    with pytest.raises(InputError, match=r"trajectory, row 2: continues after"):
        goal_posterior(WORLD, [WALKS[0], beyond, WALKS[2]], TASKS[:1], AGENTS)


def test_weighted_demonstrations_have_a_copy_for_each_possible_goal():
    posterior = np.array([[0.2, 0.0, 0.8], [0.0, 1.0, 0.0], [0.0, 1e-300, 0.5], [0.1, 0.2, 0.7]])
    demos = weighted_demonstrations(WALKS, TASKS, posterior)
    expected = [
        (WALKS[walk].states[move], WALKS[walk].actions[move], goal, posterior[walk, goal])
        for walk, goal in np.argwhere(posterior > 0)
        for move in range(len(WALKS[walk].actions))
    ]
    moves = zip(demos.states, demos.actions, demos.task, demos.weights, strict=True)
    assert [(int(s), int(a), int(g), float(w)) for s, a, g, w in moves] == expected


@pytest.fixture(scope="module")
def learned():
    """Rounds of expectation maximization until the goals change by less than a tolerance, and only one round."""
    model = ObstacleGrid(Grid(np.array([[0, -1, 0], [0, 0, 0]])), jnp.full(6, -3.0))

    def learn(model, shown):
        return fit(model, shown, AGENTS, terms=("transitions",))

    walks = [WALKS[0], WALKS[3]]
    several = [fit_goals(model, walks, TASKS, AGENTS, learn, tolerance=tolerance) for tolerance in (0.005, 0.1)]
    return walks, *several, fit_goals(model, walks, TASKS, AGENTS, learn, rounds=1, tolerance=0.0)


def test_fit_goals_ends_at_a_fixed_point_of_bayes_rule_and_the_mean_posterior(learned):
    walks, result, loose, _ = learned
    posterior, log_likelihood = goal_posterior(result.fit.model, walks, TASKS, AGENTS, result.goal_probabilities)
    np.testing.assert_allclose(result.posterior, posterior)
    assert result.log_likelihoods[-1] == pytest.approx(log_likelihood)
    assert result.converged
    np.testing.assert_allclose(result.goal_probabilities, result.posterior.mean(axis=0), atol=0.005)
    # both walks may have the corner at the lower right as their goal, and neither goes to the upper left
    assert result.posterior[0].argmax() == 2
    assert 2 <= len(loose.log_likelihoods) < len(result.log_likelihoods)
    assert (np.diff(result.log_likelihoods[1:]) > -1e-9).all()


def test_fit_goals_after_its_last_round_says_so(learned):
    *_, result = learned
    assert len(result.log_likelihoods) == 2  # before the round and after it
    assert not result.converged
    assert "in the last of 1 rounds" in result.fit.message


@pytest.mark.parametrize("wrong", [{"rounds": 0}, {"tolerance": -1e-3}, {"tolerance": np.nan}])
def test_fit_goals_of_wrong_settings_raises(wrong):
    arguments = {"learn": lambda model, shown: fit(model, shown, AGENTS), **wrong}
    with pytest.raises(InputError, match=next(iter(wrong))):
        fit_goals(WORLD, WALKS, TASKS, AGENTS, **arguments)
