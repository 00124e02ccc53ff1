"""Discount 1 where some states have no way out: their value is −∞, and all others are as if nothing led there."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, dense, plain_values, solve_with
from sidestep.tabular.backups import Behavior
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, TabularModel, TransitionModel, road_network
from sidestep.tabular.planning import plan
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task, reach, task

SOLVERS = {"Jacobi": Jacobi(), "Gauss-Seidel": GaussSeidel()}
each_backup = pytest.mark.parametrize("backup", BACKUPS)
each_solver = pytest.mark.parametrize("solver", SOLVERS)
MELLOW = "mellowmax"


def corridor(length: int, success: float, with_trap: bool) -> tuple[TransitionModel, Task]:
    """A corridor in which a step ahead succeeds with a probability and otherwise goes back; beside it, a trap."""
    goal, trap, states = length, length + 1, length + 2
    ahead = np.array([[min(s + 1, goal), max(s - 1, 0)] for s in range(length + 1)] + [[trap, trap]])
    actions = [ahead, np.full_like(ahead, trap)] if with_trap else [ahead]
    successors = np.stack(actions, axis=1)
    logits = jnp.broadcast_to(jnp.log(jnp.asarray([success, 1 - success])), successors.shape)
    cost = task(np.full((states, len(actions)), -1.0), 1.0, np.arange(states) == goal)
    return TabularModel(graph(successors), logits), cost


@each_backup
@each_solver
def test_solve_of_a_corridor_beside_a_trap_equals_that_without_it(backup, solver):
    """The expected number of steps is known; the mellowmax counts the action that is never taken, log(2)/β a step."""
    length, success, beta = 40, 0.7, 50.0
    model, cost = corridor(length, success, with_trap=True)
    solution = solve_with(SOLVERS[solver], model, cost, Behavior(BACKUPS[backup], beta))
    ratio = (1 - success) / success
    drift = 2 * success - 1
    steps = length / drift - (1 - ratio**length) * (1 - success) / drift**2
    each = 1 + (np.log(2) / beta if backup == MELLOW else 0)
    assert bool(solution.converged)
    assert float(solution.values[0]) == pytest.approx(-each * steps, rel=1e-6)
    assert np.isneginf(solution.values[-1])
    assert np.isneginf(solution.action_values[:length, 1]).all()


@each_backup
@each_solver
def test_solve_of_states_that_may_always_fall_into_a_trap_is_minus_infinity(backup, solver):
    """State 0 leads to the goal or the trap, state 1 to state 0; state 2 has a sure way."""
    successors = np.array([[[3, 4]], [[0, 0]], [[3, 3]], [[3, 3]], [[4, 4]]])
    model = TabularModel(graph(successors), jnp.zeros(successors.shape))
    cost = task(-np.ones((5, 1)), 1.0, np.arange(5) == 3)
    solution = solve_with(SOLVERS[solver], model, cost, Behavior(BACKUPS[backup], 4.0))
    assert bool(solution.converged)
    assert int(solution.sweeps) <= 3
    assert solution.values.tolist() == [-np.inf, -np.inf, -1.0, 0.0, -np.inf]


ONE_WAY = np.array([[0, 1], [0, 2], [1, 3], [2, 3], [2, 4], [3, 5], [1, 6], [5, 6], [6, 7], [3, 8], [8, 0], [4, 9]])
"""Turns of ten roads; the roads 4, 7 and 9 lead nowhere."""


@each_backup
@each_solver
def test_solve_of_one_way_roads_with_dead_ends_equals_the_dense_reference(backup, solver):
    model = road_network(ONE_WAY, np.linspace(1.0, 2.0, 10), np.linspace(-3, -1, 10))
    goal = reach(model.graph, 6, discount=1.0, step_cost=1.0)
    solution = solve_with(SOLVERS[solver], model, goal, Behavior(BACKUPS[backup], 2.0))
    dead = np.isin(np.arange(10), [4, 7, 9])
    leads_to_dead = np.isin(np.asarray(model.graph.successors), [4, 7, 9]).any(axis=-1)
    available = np.asarray(model.graph.available)
    usable = jnp.asarray(np.where(dead[:, None], True, available & ~leads_to_dead))
    # the mellowmax counts the turn into the dead end, which is available
    counted = available.sum(axis=1) / np.maximum(np.asarray(usable).sum(axis=1), 1)
    lost = np.log(counted) / 2.0 if backup == MELLOW else np.zeros(10)
    cost = Task(goal.reward - lost[:, None], goal.terminal_reward, goal.terminal, goal.discount)
    values, _ = plain_values(backup, dense(model), cost, 2.0, 2_000, usable)
    assert bool(solution.converged)
    np.testing.assert_array_equal(np.isneginf(solution.values), dead)
    np.testing.assert_allclose(solution.values[~dead], values[~dead], rtol=1e-8)


@each_solver
@pytest.mark.parametrize("logit", [28.5, 29.0, 40.0, 80.0])
def test_solve_in_32_bits_with_an_improbable_way_reaches_the_goal(solver, logit):
    """Whether the goal can be reached is a matter of what is possible, not of sizes."""
    grid = Grid.unknown(1, 3)
    model = ObstacleGrid(grid, jnp.asarray([-3.0, logit, -3.0], jnp.float32))
    goal = reach(grid, 2, discount=1.0, step_cost=1.0)
    solution = solve_with(SOLVERS[solver], model, goal, Behavior(BACKUPS["hard max"], 5.0))
    assert bool(solution.converged)
    assert float(solution.values[0]) == pytest.approx(-np.exp(logit), rel=1e-3)
    assert plan(model, goal).path_from(0).tolist() == [0, 1, 2]


@each_solver
def test_solve_gradient_beside_a_trap_is_that_without_it(solver):
    """The trap has no part in the gradient, whatever its outcome's probability."""

    def value(with_trap, logits):
        model, cost = corridor(6, 0.8, with_trap)
        model = model.with_parameters(model.parameters + logits)
        behavior = Behavior(BACKUPS["Boltzmann"], 3.0)
        return solve_with(SOLVERS[solver], model, cost, behavior).values[0]

    beside, without = (jax.grad(lambda x, t=t: value(t, x))(jnp.zeros((8, 2 if t else 1, 2))) for t in (True, False))
    np.testing.assert_allclose(beside[:, 0], without[:, 0], rtol=1e-7)
    assert (beside[:, 1] == 0).all()


def test_plan_from_a_state_without_a_way_is_uniform():
    """No action is better than another there, and none of them is unavailable."""
    successors = np.array([[[2], [1], [1]], [[1], [1], [1]], [[2], [2], [2]]])
    available = np.array([[True, True, False], [True, False, True], [True, True, True]])
    model = TabularModel(graph(successors, available), jnp.zeros(successors.shape))
    made = plan(model, task(-np.ones((3, 3)), 1.0, np.arange(3) == 2), Behavior(BACKUPS["Boltzmann"], 2.0))
    assert made.policy[0].tolist() == [1.0, 0.0, 0.0]
    np.testing.assert_allclose(made.policy[1], [0.5, 0, 0.5])


def test_solve_of_two_traps_in_a_row_removes_states_one_after_another():
    """A state is lost if what it leads to is lost, however long the row and whatever the numbers of the states."""
    states = 30
    for order in (np.arange(states), np.arange(states)[::-1], np.random.default_rng(0).permutation(states)):
        successors = np.zeros((states, 1, 2), int)
        for i, after in product(range(states - 2), (1,)):
            successors[order[i], 0] = order[i + after], order[i + 2]
        successors[order[states - 2], 0] = order[states - 2]
        successors[order[states - 1], 0] = order[states - 1]
        model = TabularModel(graph(successors), jnp.zeros(successors.shape))
        cost = task(-np.ones((states, 1)), 1.0, np.arange(states) == order[states - 1])
        for solver in SOLVERS.values():
            solution = solve_with(solver, model, cost, Behavior(BACKUPS["hard max"], 1.0))
            assert np.isneginf(solution.values[order[: states - 1]]).all()
            assert solution.values[order[states - 1]] == 0
