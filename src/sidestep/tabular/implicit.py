"""The fixed point V = F(V, φ) as a function of φ that can be differentiated twice.

First derivatives are those of the adjoint method: for a scalar with gradient g by V, a solver computes λ = g + Wᵀλ and
λᵀ ∂F/∂φ, where W = ∂F/∂V (`sidestep.tabular.solvers.base`). Second derivatives are the directional derivatives of
these. Along dφ,

    dV = W dV + ∂F/∂φ dφ,        dλ = Wᵀ dλ + dg + d(∂F/∂V)ᵀ λ,        d(λᵀ ∂F/∂φ) = dλᵀ ∂F/∂φ + λᵀ d(∂F/∂φ),

where the d of ∂F is that along (dV, dφ) with λ held. So a product of a Hessian with a vector costs two linear solves
beside the gradient. They are those of `Jacobi`, by sweeps in JAX, whatever the solver (Christianson 1994 has the same
recursion, "reverse over forward"). First derivatives run none of this.

This differs from the textbook in one thing: the fixed-policy gradient has no second derivatives, because it need not be
the gradient of a function.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep.errors import InputError
from sidestep.tabular.backups import Backup, Gradient
from sidestep.tabular.solvers import base
from sidestep.tabular.solvers.jacobi import Jacobi

Rows = Float[Array, "visited actions outcomes"]
Constants = tuple
"""What is not differentiated.

Successors, terminal states, available actions; the solver, its order, the region, the visited states.
"""


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def fixed_point(
    backup: Backup, gradient: Gradient, constants: Constants, inputs: base.Cotangents, values: Array, adjoint: Array
) -> tuple[base.Values, Rows]:
    """Return the solution V of V = F(V, φ), φ = `inputs`, with its derivatives.

    Also return the probabilities of the visited states. Their gradient is added in place to the one by the values: two
    arrays of the model's size would take longer to make and to add than most of the rest.

    Args:
        backup: The backup of F.
        gradient: Which gradient is asked for.
        constants: What is not differentiated.
        inputs: φ.
        values: The solution.
        adjoint: Where the solve of the adjoint starts. It has no influence, so its gradient is free to carry the new
            adjoint out of the backward pass.
    """
    del adjoint
    return _with_tangents(backup, gradient, constants, inputs, values)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _with_tangents(
    backup: Backup, gradient: Gradient, constants: Constants, inputs: base.Cotangents, values: Array
) -> tuple[base.Values, Rows]:
    """Return the same as `fixed_point`; its derivatives are directional ones."""
    del backup, gradient
    return values, constants[3].gather_rows(inputs.probabilities, constants[-1])


@_with_tangents.defjvp
def _values_jvp(backup: Backup, gradient: Gradient, primals: tuple, tangents: tuple):
    constants, inputs, values = primals
    values, rows = _with_tangents(backup, gradient, *primals)
    equation = _second_order(backup, gradient, constants, inputs)
    _, explicit = jax.jvp(lambda by: equation.at(by).backed_up(values), (inputs,), (tangents[1],))
    d_values = _linear_solver(constants).solve_linear(equation, values, explicit)
    return (values, rows), (d_values, tangents[1].probabilities[constants[-1]])


def _forward(
    backup: Backup, gradient: Gradient, constants: Constants, inputs: base.Cotangents, values: Array, adjoint: Array
):
    values, rows = _with_tangents(backup, gradient, constants, inputs, values)
    return (values, rows), (constants, inputs, values, adjoint)


def _backward(backup: Backup, gradient: Gradient, saved: tuple, cotangents: tuple[Array, Array]):
    constants, inputs, values, adjoint = saved
    cotangent, adjoint = _pull_back(backup, gradient, constants, inputs, values, cotangents[0], adjoint)
    probabilities = cotangent.probabilities.at[constants[-1]].add(cotangents[1])
    return None, cotangent._replace(probabilities=probabilities), jnp.zeros_like(values), adjoint


fixed_point.defvjp(_forward, _backward)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _pull_back(
    backup: Backup,
    gradient: Gradient,
    constants: Constants,
    inputs: base.Cotangents,
    values: Array,
    cotangent: Array,
    adjoint: Array,
) -> tuple[base.Cotangents, base.Values]:
    """Return λᵀ ∂F/∂φ and λ."""
    solver, order, region = constants[3:6]
    equation, start = _equation(backup, constants, inputs), base.WarmStart(values, adjoint, order)
    by, result = solver.vjp(equation, gradient, cotangent, start, region)
    return by, result.values


@_pull_back.defjvp
def _pull_back_jvp(backup: Backup, gradient: Gradient, primals: tuple, tangents: tuple):
    constants, inputs, values = primals[:3]
    by, adjoint = _pull_back(backup, gradient, *primals)
    equation = _second_order(backup, gradient, constants, inputs)
    along = tangents[1], tangents[2]

    def pulled(inputs: base.Cotangents, values: Array, adjoint: Array) -> tuple[base.Cotangents, Array]:
        return jax.vjp(lambda by, values: equation.at(by).backed_up(values), inputs, values)[1](adjoint)

    _, (_, d_pulled) = jax.jvp(lambda by, v: pulled(by, v, adjoint), (inputs, values), along)
    d_adjoint = _linear_solver(constants).solve_linear(equation, values, tangents[3] + d_pulled, transposed=True)
    _, (d_by, _) = jax.jvp(pulled, (inputs, values, adjoint), (*along, d_adjoint))
    return (by, adjoint), (d_by, d_adjoint)


def _equation(backup: Backup, constants: Constants, inputs: base.Cotangents) -> base.BellmanEquation:
    successors, terminal, available = constants[:3]
    process = base.DecisionProcess(successors, *inputs[:3], terminal, available, inputs.discount)
    return base.BellmanEquation(process, backup, inputs.beta)


def _second_order(
    backup: Backup, gradient: Gradient, constants: Constants, inputs: base.Cotangents
) -> base.BellmanEquation:
    if gradient != "exact":
        raise InputError("the fixed-policy gradient has no second derivatives: expected 'exact'", field="gradient")
    return _equation(backup, constants, inputs)


def _linear_solver(constants: Constants) -> Jacobi:
    return Jacobi(tolerance=constants[3].tolerance)
