"""Adjoints beside dense solutions of λ = g + Wᵀλ, where they do not converge, and beside states without values."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, NAMES, generic_task, plain_policy, random_problem
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions, decision_process, solve
from sidestep.tabular.solvers.base import BellmanEquation
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach, task

SOLVERS = {"Jacobi": Jacobi(max_sweeps=900), "Gauss-Seidel": GaussSeidel(max_sweeps=900)}
each_solver = pytest.mark.parametrize("solver", SOLVERS)

# Two states whose worse actions leave them more often: Σ w l of the Boltzmann average is then far below Σ π l.
BETA, GAMMA = 7.0, 0.99
CHANCES = np.array([
    [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
    [[0.05, 0.82, 0.13], [0.0, 0.93, 0.07]],
    [[0.1, 0.11, 0.79], [0.01, 0.0, 0.99]],
])  # fmt: skip
REWARD = np.array([[0.0, 0.0], [-0.56, 0.0], [-0.47, 0.0]])
SLOPES = np.array([0.0, 1.0, -0.4])
"""The derivatives of what is differentiated by the values."""


@each_solver
def test_adjoint_where_full_steps_diverge_equals_the_dense_solution(solver):
    """Steps divided by Σ w l lead away from the solution; divided by no less than Σ π l they lead there."""
    possible = np.where(CHANCES > 0, CHANCES, 1)
    model = TabularModel(
        graph(np.tile(np.arange(3), (3, 2, 1))), jnp.log(jnp.asarray(possible)), jnp.asarray(CHANCES > 0)
    )
    goal = task(REWARD, GAMMA, np.arange(3) == 0)

    def total(reward):
        own, options = replace(goal, reward=reward), SolveOptions(solver=SOLVERS[solver])
        solution = solve(model, own, Behavior(BoltzmannAverage(), BETA), options=options)
        return jnp.sum(SLOPES * solution.values), solution

    slope, solution = jax.grad(total, has_aux=True)(jnp.asarray(REWARD))
    assert bool(solution.converged)
    q = REWARD + GAMMA * CHANCES @ np.asarray(solution.values)
    policy = np.asarray(plain_policy(q, BETA))
    average = (policy * q).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(solution.values[1:], average[1:, 0], rtol=1e-9)
    weights = np.where(np.arange(3)[:, None] > 0, policy * (1 + BETA * (q - average)), 0)
    jacobian = GAMMA * np.einsum("sa,sat->st", weights, CHANCES)
    adjoint = np.linalg.solve(np.eye(3) - jacobian.T, SLOPES)
    np.testing.assert_allclose(slope, adjoint[:, None] * weights, rtol=1e-7, atol=1e-9)

    # the world is one in which full steps diverge
    leaving = 1 - GAMMA * np.diagonal(CHANCES, axis1=0, axis2=2).T
    exact, held = ((part * leaving).sum(axis=1)[1:] for part in (weights, policy))
    own = jacobian[1:, 1:] - np.diag(np.diagonal(jacobian)[1:])
    full = own.T / exact[:, None]
    assert np.abs(np.linalg.eigvals(full)).max() > 1.5
    assert (held > exact).all()


@pytest.mark.parametrize("kind", [Jacobi, GaussSeidel])
def test_gradients_of_an_adjoint_that_did_not_converge_are_nan(kind):
    """All of them, β's too, which has no part in the hard maximum; and the adjoint that the next solve would use."""
    problem = random_problem(states=30)
    goal, model = generic_task(problem, 0.9), problem.model
    whole = solve(model, goal, Behavior(HardMax()), options=SolveOptions(solver=kind()))
    few = SolveOptions(solver=kind(max_sweeps=3))

    def total(theta, beta, adjoint):
        start = whole.start._replace(adjoint=adjoint)
        behavior = Behavior(HardMax(), beta)
        solution = solve(model.with_parameters(theta), goal, behavior, options=few, start=start)
        return solution.values.sum(), solution.converged

    arguments = model.parameters, jnp.asarray(2.0), jnp.zeros(problem.states)
    gradients, converged = jax.grad(total, argnums=(0, 1, 2), has_aux=True)(*arguments)
    assert bool(converged)
    for gradient in gradients:
        assert np.isnan(gradient).all()


def test_solve_linear_of_many_states_that_does_not_converge_is_nan():
    """Beyond a thousand states it is solved by sweeps, which take a sweep a state to the end of a corridor."""
    grid = Grid.unknown(1, 1_010)
    goal, model, right = reach(grid, 0, discount=0.999), ObstacleGrid(grid, -9.0), jnp.ones(grid.size)
    process = decision_process(model, model.probabilities(), goal)
    equation = BellmanEquation(process, HardMax(), jnp.asarray(1.0))
    distance = jnp.arange(grid.size)
    success = 1 / (1 + np.exp(-9.0))
    ratio = 0.999 * success / (1 - 0.999 * (1 - success))
    values = ratio**distance
    assert np.isnan(Jacobi(max_sweeps=20).solve_linear(equation, values, right)).all()
    solved = Jacobi().solve_linear(equation, values, right)
    # x = 1 + γ(p x′ + (1 − p) x), and 1 at the goal
    each = 1 / (1 - 0.999 * (1 - success))
    limit = each / (1 - ratio)
    np.testing.assert_allclose(solved, limit + (1 - limit) * values, rtol=1e-7)


# State 2 is a trap, and state 1 may fall into it.
TRAP = graph(np.array([[[3, 0], [1, 1]], [[0, 2], [2, 2]], [[2, 2], [2, 2]], [[3, 3], [3, 3]]]))
COST = task(-np.ones((4, 2)), 1.0, np.arange(4) == 3)
LOGITS = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2, 2)))


@each_solver
@pytest.mark.parametrize("backup", NAMES)
def test_gradient_of_all_values_is_that_of_the_finite_ones(solver, backup):
    """Also where values of −∞ are among what is differentiated."""
    behavior, options = Behavior(BACKUPS[backup], 3.0), SolveOptions(solver=SOLVERS[solver])

    def values(logits):
        return solve(TabularModel(TRAP, logits), COST, behavior, options=options).values

    assert np.isneginf(values(LOGITS)).tolist() == [False, True, True, False]
    slope = jax.grad(lambda logits: values(logits).sum())(LOGITS)
    np.testing.assert_allclose(slope, jax.grad(lambda logits: values(logits)[0])(LOGITS), rtol=1e-9)
    assert np.abs(slope[0, 0]).min() > 0.01


def test_gradient_of_all_values_where_those_without_are_left_out_is_that_of_the_finite_ones():
    """Leaving a state without a value out of the solve costs nothing."""
    behavior, options = Behavior(BoltzmannAverage(), 3.0), SolveOptions(solver=SOLVERS["Gauss-Seidel"])
    start = solve(TabularModel(TRAP, LOGITS), COST, behavior, options=options).start
    region = jnp.asarray([True, True, False, True])

    def values(logits):
        return solve(TabularModel(TRAP, logits), COST, behavior, options=options, start=start, region=region).values

    slope = jax.grad(lambda logits: values(logits).sum())(LOGITS)
    np.testing.assert_allclose(slope, jax.grad(lambda logits: values(logits)[0])(LOGITS), rtol=1e-9)
    assert np.abs(slope[0, 0]).min() > 0.01
