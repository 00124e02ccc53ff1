"""The paper's dynamic program for gradients beside the adjoint equation."""

import jax
import jax.numpy as jnp
import pytest

from helpers.problems import BACKUPS, PROBLEMS, generic_task, relative_error
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior
from sidestep.tabular.forward_gradients import forward_gradient
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.jacobi import Jacobi

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("name", "gradient"),
    [("hard max", "exact"), ("Boltzmann", "exact"), ("Boltzmann", "fixed_policy"), ("mellowmax", "fixed_policy")],
)
def test_forward_gradient_equals_the_adjoint_gradient(name, gradient):
    problem = PROBLEMS["4-connected"]
    task, behavior = generic_task(problem, 0.9), Behavior(BACKUPS[name], 4.0)
    options = SolveOptions(gradient=gradient, solver=Jacobi(tolerance=1e-12))

    def solved(parameters):
        model = problem.model.with_parameters(parameters)
        solution = solve(model, task, behavior, options=options)
        return solution.values, solution.action_values

    expected = jax.jit(jax.jacrev(solved))(problem.model.parameters)
    result = jax.jit(lambda: forward_gradient(problem.model, task, behavior, options=options))()
    assert result.converged
    assert relative_error(result.value_gradient, expected[0]) < 1e-8
    assert relative_error(result.action_value_gradient, expected[1]) < 1e-8


def test_forward_gradient_with_too_few_sweeps_has_not_converged():
    problem = PROBLEMS["tabular"]
    result = forward_gradient(problem.model, generic_task(problem, 0.9), Behavior(BACKUPS["hard max"]), max_sweeps=3)
    assert result.sweeps == 3
    assert not result.converged
    assert jnp.isfinite(result.value_gradient).all()


def test_forward_gradient_with_a_horizon_raises():
    problem = PROBLEMS["tabular"]
    task, behavior = generic_task(problem, 0.9), Behavior(BACKUPS["hard max"])
    with pytest.raises(InputError, match="horizon"):
        forward_gradient(problem.model, task, behavior, options=SolveOptions(horizon=3))
