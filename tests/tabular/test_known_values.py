"""The solver of known values: derivatives at a solution, from what an earlier solve of it has left."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
from sidestep.tabular.solvers.known import Known

WORLD = ss.graph(np.array([[[1, 0], [2, 0]], [[2, 1], [0, 1]], [[2, 2], [2, 2]]]))
LOGITS = jnp.asarray(np.random.default_rng(1).normal(size=(3, 2, 2)))
GOAL = ss.task(np.outer(np.arange(3) != 2, [-1.0, -1.3]), 0.9, np.arange(3) == 2)
SOFT = ss.Behavior("boltzmann", 2.0)


def weighted_values(logits, start, solver):
    """A scalar of the values, and the solution."""
    options = ss.SolveOptions(solver=solver)
    solution = ss.solve(ss.TabularModel(WORLD, logits), GOAL, SOFT, options=options, start=start)
    return solution.values @ jnp.array([1.0, 2.0, 0.0]), solution


@pytest.fixture(scope="module")
def known():
    """The values and the adjoint at the logits, by a solve."""
    cold = ss.Jacobi().cold_start(3, LOGITS.dtype)

    def by_adjoint(adjoint):
        return weighted_values(LOGITS, cold._replace(adjoint=adjoint), ss.Jacobi())

    adjoint, solution = jax.grad(by_adjoint, has_aux=True)(cold.adjoint)
    return solution.start._replace(adjoint=adjoint)


def test_known_values_and_their_derivatives_are_those_of_a_solve(known):
    def own(flat):
        return weighted_values(flat.reshape(LOGITS.shape), known, Known())[0]

    def solved(flat):
        return weighted_values(flat.reshape(LOGITS.shape), None, ss.Jacobi())[0]

    np.testing.assert_array_equal(weighted_values(LOGITS, known, Known())[1].values, known.values)

    def hessian(function):
        return lambda at: jax.vmap(jax.linearize(jax.grad(function), at)[1])(jnp.eye(at.size))

    for derivative in (jax.grad, hessian):
        np.testing.assert_allclose(
            derivative(own)(LOGITS.ravel()), derivative(solved)(LOGITS.ravel()), rtol=1e-7, atol=1e-9
        )


def test_known_adjoint_that_has_not_converged_gives_a_gradient_of_nan(known):
    for nowhere in (Known().cold_start(3, LOGITS.dtype), known._replace(adjoint=known.adjoint.at[1].set(jnp.nan))):
        gradient = jax.grad(lambda logits, start=nowhere: weighted_values(logits, start, Known())[0])(LOGITS)
        assert jnp.isnan(gradient).all()
