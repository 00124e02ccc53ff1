"""Policies of agents that look one action ahead, which are known from rewards alone; and values without an end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import choice_log_likelihood, choices_of, log_likelihood, log_policies
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task, reach, task, with_outcome_reward

BETA = 2.0
MYOPIC = SolveOptions(horizon=1)
AGENTS = Behavior(LogSumExp(), BETA)
SUCCESSORS = np.array([[[1, 0], [2, 3]], [[2, 1], [0, 1]], [[3, 2], [1, 2]], [[3, 3], [3, 3]]])
MODEL = TabularModel(graph(SUCCESSORS), jnp.asarray(np.random.default_rng(0).normal(size=(4, 2, 2))))
WALKS = [
    Trajectory(np.array([0, 1, 2, 2, 3]), np.array([0, 0, 1, 0]), 0),
    Trajectory(np.array([1, 0, 2, 1]), np.array([1, 1, 1]), 1),
]


def rewards_of(seed):
    """R(s, a) and R(s, a, s′), different everywhere."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(4, 2)), rng.normal(size=(4, 2, 2))


def paying(seed) -> Task:
    own, of_outcomes = rewards_of(seed)
    return with_outcome_reward(task(own, 0.9, np.arange(4) == 3), of_outcomes)


def log_policy_by_hand(seed):
    """ln π of every action: Q is the expected reward, because nothing follows."""
    own, of_outcomes = rewards_of(seed)
    odds = np.exp(np.asarray(MODEL.parameters))
    q = own + (odds / odds.sum(axis=-1, keepdims=True) * of_outcomes).sum(axis=-1)
    return BETA * q - np.log(np.exp(BETA * q).sum(axis=-1, keepdims=True))


def test_log_policies_of_myopic_agents_are_by_the_rewards_of_each_state():
    demos = gather(WALKS, [paying(1), paying(2)])
    expected = [log_policy_by_hand(1 + walk.task)[walk.states[:-1], walk.actions] for walk in WALKS]
    np.testing.assert_allclose(log_policies(MODEL, demos, AGENTS, options=MYOPIC), np.concatenate(expected), rtol=1e-12)


def test_choice_log_likelihood_of_myopic_agents_is_by_the_rewards_of_each_state():
    demos = gather(WALKS, [paying(1), paying(2)])
    choices, start = choices_of(demos), Jacobi().cold_start(4, jnp.dtype("float64"))
    for index, walk in enumerate(WALKS):
        own = jax.tree.map(lambda leaf, index=index: leaf[index], choices)
        total, _ = choice_log_likelihood(MODEL, paying(1 + index), own, AGENTS, start, options=MYOPIC)
        expected = log_policy_by_hand(1 + index)[walk.states[:-1], walk.actions].sum()
        assert float(total) == pytest.approx(expected, rel=1e-12)


def test_choice_log_likelihood_where_the_first_action_is_not_available_is_finite():
    """What fills up a task's choices is action 0 of state 0, which counts nothing."""
    world = graph(np.array([[[0], [1], [1]], [[1], [1], [1]]]), np.array([[False, True, True], [True, True, True]]))
    model, reward = TabularModel(world, jnp.zeros((2, 3, 1))), np.array([[9.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    gain = task(reward, 0.9, np.arange(2) == 1)
    demos = gather([Trajectory(np.array([0, 1]), np.array([2]), 0)], [gain])
    choices = jax.tree.map(lambda leaf: leaf[0], choices_of(demos))
    start = Jacobi().cold_start(2, jnp.dtype("float64"))

    def total(beta):
        return choice_log_likelihood(model, gain, choices, Behavior(LogSumExp(), beta), start, options=MYOPIC)[0]

    value, slope = jax.value_and_grad(total)(jnp.asarray(BETA))
    assert float(value) == pytest.approx(-np.log1p(np.exp(BETA)), rel=1e-12)
    assert float(slope) == pytest.approx(-1 / (1 + np.exp(-BETA)), rel=1e-12)


def test_likelihoods_of_values_that_did_not_converge_are_nan():
    """And so are their gradients."""
    grid, solver = Grid.unknown(3, 9), Jacobi(max_sweeps=2)
    options = SolveOptions(solver=solver)
    model = ObstacleGrid(grid, jnp.asarray(np.random.default_rng(0).normal(size=grid.size)))
    goal = reach(grid, 26, discount=0.99)
    demos = gather([Trajectory(np.array([1, 2]), np.array([3]), 0)], [goal])
    choices = jax.tree.map(lambda leaf: leaf[0], choices_of(demos))
    start = solver.cold_start(grid.size, jnp.dtype("float64"))
    assert not solve(model, goal, AGENTS, options=options).converged

    def of_choices(beta):
        return choice_log_likelihood(model, goal, choices, Behavior(LogSumExp(), beta), start, options=options)[0]

    def of_moves(beta):
        return log_likelihood(model, demos, Behavior(LogSumExp(), beta), terms=("actions",), options=options).actions

    for function in (of_choices, of_moves):
        value, slope = jax.value_and_grad(function)(jnp.asarray(BETA))
        assert np.isnan(value)
        assert np.isnan(slope)


@pytest.mark.parametrize(("cost", "converged"), [(1e305, True), (1e308, False)])
def test_solve_with_a_horizon_says_converged_of_finite_values_only(cost, converged):
    """Three times 10³⁰⁸ is beyond the largest number of 64 bits."""
    endless = task(np.array([[-cost], [-cost]]), 1.0, np.zeros(2, bool))
    model = TabularModel(graph(np.array([[[1]], [[0]]])), jnp.zeros((2, 1, 1)))
    solution = solve(model, endless, Behavior("max"), options=SolveOptions(horizon=3))
    assert bool(solution.converged) == converged
    assert bool(np.isfinite(solution.values).all()) == converged
