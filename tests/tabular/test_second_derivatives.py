"""Second derivatives of values: beside automatic differentiation of plain value iteration, and by linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, PROBLEMS, generic_task, plain_values
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions, decision_process, solve
from sidestep.tabular.solvers.base import BellmanEquation
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach

PROBLEM = PROBLEMS["4-connected"]
BETA, ENOUGH = 3.0, 400
SOLVERS = {"jacobi": Jacobi(), "gauss_seidel": GaussSeidel()}
STATES, ACTIONS = np.array([3, 2, 5, 5, 11]), np.array([2, 2, 0, 3, 1])
"""The choices that count."""
LARGE = 33
"""Rows and columns of more states than are solved by a factorization."""
STEPS = gather(
    [Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [reach(Grid.unknown(1, 3), 2, discount=0.9)]
)


def plain_hessian(name, task):
    """Of Σ log π(a | s) by (θ, ln β), through every sweep of value iteration."""

    def log_policies(x):
        beta = jnp.exp(x[-1])
        _, q = plain_values(name, PROBLEM.dense(x[:-1]), task, beta, ENOUGH)
        return jax.nn.log_softmax(beta * q, axis=-1)[STATES, ACTIONS].sum()

    return jax.hessian(log_policies)(point())


def point():
    return jnp.append(PROBLEM.model.parameters, jnp.log(BETA))


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", ["Boltzmann", "log-sum-exp", "hard max"])
def test_hessian_of_log_policies_is_that_of_plain_value_iteration(name, solver):
    task, options = generic_task(PROBLEM, 0.9), SolveOptions(solver=SOLVERS[solver])

    def log_policies(x):
        behavior = Behavior(BACKUPS[name], jnp.exp(x[-1]))
        solution = solve(PROBLEM.model.with_parameters(x[:-1]), task, behavior, options=options)
        return behavior.log_policy(solution.action_values)[STATES, ACTIONS].sum()

    np.testing.assert_allclose(jax.hessian(log_policies)(point()), plain_hessian(name, task), atol=1e-7)


@pytest.mark.slow
def test_hessian_of_log_likelihood_is_the_same_by_reverse_and_by_forward_differentiation():
    model = ObstacleGrid(Grid.unknown(1, 3), np.array([-1.0, -2.0, 0.5]))

    def total(parameters):
        return log_likelihood(model.with_parameters(parameters), STEPS, Behavior(BoltzmannAverage(), BETA)).total

    forward = jax.hessian(total)(model.parameters)
    np.testing.assert_allclose(jax.jacrev(jax.grad(total))(model.parameters), forward, atol=1e-9)
    assert float(jnp.abs(forward).max()) > 0.01


def test_hessian_by_the_fixed_policy_gradient_raises():
    model, options = ObstacleGrid(Grid.unknown(1, 3)), SolveOptions(gradient="fixed_policy")

    def total(parameters):
        behavior = Behavior(BoltzmannAverage(), BETA)
        return log_likelihood(model.with_parameters(parameters), STEPS, behavior, options=options).total

    with pytest.raises(InputError, match=r"'gradient': .*no second derivatives"):
        jax.hessian(total)(model.parameters)


@pytest.mark.parametrize("size", [4, LARGE])
def test_solve_linear_solves_the_equation_of_the_matrix_and_of_its_transpose(size):
    grid, random = Grid.unknown(size, size), np.random.default_rng(0)
    model, task = ObstacleGrid(grid, random.normal(-2, 1, grid.size)), reach(grid, 0, discount=0.9)
    behavior, options = Behavior(BoltzmannAverage(), BETA), SolveOptions(solver=Jacobi())
    values = solve(model, task, behavior, options=options).values
    process = decision_process(model, model.probabilities(), task)
    equation = BellmanEquation(process, behavior.backup, behavior.beta)
    right = jnp.asarray(random.normal(size=grid.size))
    x, y = (Jacobi().solve_linear(equation, values, right, transposed=each) for each in (False, True))
    np.testing.assert_allclose(x - jax.jvp(equation.backed_up, (values,), (x,))[1], right, atol=1e-8)
    np.testing.assert_allclose(y - jax.vjp(equation.backed_up, values)[1](y)[0], right, atol=1e-8)
