"""Direct steps in small worlds: the equations of all states linearized at once, and solved by a factorization.

With W = ∂F/∂V at V, a Newton step on V = F(V) is V + (I − W)⁻¹ (F(V) − V). With the hard maximum this is policy
iteration (Howard 1960; Puterman and Brumelle, *On the convergence of policy iteration in stationary dynamic
programming*, 1979). It takes a few steps at any discount, where the number of sweeps grows with 1/(1 − γ) or with the
number of moves to the end. The adjoint equation λ = g + Wᵀλ is linear: one step solves it, but for rounding.

This differs from the textbook in two points. A step is a correction by what is left of the equation, so that the next
one mends the rounding of a factorization. And it is taken only where it can be trusted. (I − W)⁻¹ 1 is the expected
number of moves of a policy that surely ends. Where it is not above 0 everywhere, the policy may never end, or the
fixed point of a Boltzmann average is not stable. No step is taken that leaves more of the equation than there was.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sidestep.tabular.backups import Gradient
from sidestep.tabular.solvers.base import BellmanEquation, DecisionProcess, Values

MOST_STATES = 1_000
"""The number of states up to which a factorization is faster than sweeps: it takes the time of a sweep for each."""
_LEAST_SWEEPS = 200
"""The least number of sweeps before a direct step."""


def sweeps_before(states: int) -> int:
    """Return the number of sweeps after which a direct step pays; it costs about as much as a sweep for each state.

    Args:
        states: Their number.
    """
    return max(_LEAST_SWEEPS, states)


class Exits(NamedTuple):
    """The outcomes that leave their state: γP, 0 for self-loops; states last, contiguous in memory."""

    successors: Int[Array, "actions outcomes states"]
    discounted_probs: Float[Array, "actions outcomes states"]
    one_minus_discount: Float[Array, ""]

    @classmethod
    def of(cls, process: DecisionProcess) -> "Exits":
        """Return those of a decision process."""
        successors = jnp.moveaxis(process.successors, 0, -1)
        probabilities = jnp.moveaxis(process.probabilities, 0, -1)
        is_self_loop = successors == jnp.arange(len(process.successors))
        leaving = jnp.where(is_self_loop, 0, probabilities)
        return cls(successors, process.discount * leaving, 1 - process.discount)

    @property
    def weights(self) -> Float[Array, "actions states"]:
        """The exit weight of each action, 1 − γ p(staying)."""
        return self.one_minus_discount + self.discounted_probs.sum(axis=1)


class Linearization(NamedTuple):
    """The matrix I − W of the equations linearized at V.

    Attributes:
        successors: As in `Exits`.
        jacobian: W without its diagonal, by outcome; 0 for states without finite values.
        diagonal: Σ w l, the matrix's diagonal.
        divisor: That of a sweep's step (see `step_divisor`).
        live: Whether each state has actions and finite values; the rows of the others are those of the identity.
    """

    successors: Int[Array, "actions outcomes states"]
    jacobian: Float[Array, "actions outcomes states"]
    diagonal: Values
    divisor: Values
    live: Bool[Array, " states"]

    def left(self, cotangent: Values, adjoint: Values) -> Values:
        """Return g + Wᵀλ − λ, which is 0 at the adjoint."""
        return cotangent + self.arriving(adjoint) - self.diagonal * adjoint

    def dense(self) -> Float[Array, "states states"]:
        """Return the matrix."""
        states = jnp.arange(len(self.diagonal))
        return jnp.diag(self.diagonal).at[states, self.successors].add(-self.jacobian)

    def sizes(self, values: Values) -> Values:
        """Return the sum of the magnitudes of the terms of V − W V."""
        size = jnp.where(self.live, jnp.abs(values), 0)
        return jnp.abs(self.diagonal) * size + jnp.sum(jnp.abs(self.jacobian) * size[self.successors], axis=(0, 1))

    def arriving(self, adjoint: Values) -> Values:
        """Return Wᵀλ without the diagonal of W."""
        return jnp.zeros_like(adjoint).at[self.successors].add(self.jacobian * adjoint)


def linearize(equation: BellmanEquation, values: Values, gradient: Gradient) -> Linearization:
    """Return the equations linearized at some values, by the gradient asked for.

    Args:
        equation: The Bellman equation.
        values: V.
        gradient: Which weights ∂V/∂Q there are.
    """
    process, backup, beta = equation
    live, exits = equation.is_live(values), Exits.of(process)
    q = jnp.where(live[:, None], process.action_values(values), 0)
    policy = backup.fixed_policy_weights(q, beta)
    weights = backup.weights(q, beta) if gradient == "exact" else policy
    diagonal = jnp.where(live, jnp.sum(weights.T * exits.weights, axis=0), 1)
    divisor = jnp.where(live, step_divisor(weights, policy, exits.weights), 1)
    jacobian = jnp.where(live, weights.T, 0)[:, None] * exits.discounted_probs
    return Linearization(exits.successors, jacobian, diagonal, divisor, live)


def step_divisor(
    weights: Float[Array, "states actions"],
    policy: Float[Array, "states actions"],
    exit_weights: Float[Array, "actions states"],
) -> Values:
    """Return the divisor of a state's own Newton step: Σ w l, and never less than Σ π l, so that no step is too long.

    For a state that no action leaves it is 1: the state gives nothing to its neighbors and takes nothing from them.

    Args:
        weights: w = ∂V/∂Q.
        policy: π, the fixed-policy weights.
        exit_weights: l.
    """
    divisor = jnp.maximum(jnp.sum(weights.T * exit_weights, axis=0), jnp.sum(policy.T * exit_weights, axis=0))
    return jnp.where(divisor > 0, divisor, 1)


class DirectStep(NamedTuple):
    """The values or the adjoint after a step, with an estimate of their error: ∞ where it cannot be trusted."""

    values: Values
    error: Float[Array, ""]


def newton_step(equation: BellmanEquation, values: Values) -> DirectStep:
    """Return the values after a Newton step on all equations, or as they are if it cannot be trusted.

    To first order, their error is (I − W)⁻¹ times what is left of the equation, and what rounding adds to that.

    Args:
        equation: The Bellman equation.
        values: V; −∞ where it is infinite.
    """
    linear = linearize(equation, values, "exact")
    gain = _gain(equation, values)
    factors = jax.scipy.linalg.lu_factor(linear.dense())
    step, moves = jax.scipy.linalg.lu_solve(factors, jnp.stack([gain, jnp.ones_like(gain)], axis=1)).T
    stepped = jnp.where(linear.live, values + step, values)
    gain_after = _gain(equation, stepped)
    is_proper = jnp.all(jnp.isfinite(step)) & jnp.all(moves > 0)
    is_better = jnp.abs(gain_after).max() < jnp.abs(gain).max()
    chosen, left = jax.tree.map(partial(jnp.where, is_proper & is_better), (stepped, gain_after), (values, gain))
    rounding = jnp.finfo(values.dtype).eps * linear.sizes(chosen)
    errors = jax.scipy.linalg.lu_solve(factors, jnp.where(linear.live, jnp.abs(left) + rounding, 0))
    return DirectStep(chosen, jnp.where(is_proper & jnp.all(errors >= 0), errors.max(), jnp.inf))


def adjoint_step(linear: Linearization, cotangent: Values, adjoint: Values) -> DirectStep:
    """Return λ after a step on all adjoint equations, or as it is if the step does not bring it nearer.

    Args:
        linear: The equations linearized at the fixed point.
        cotangent: g.
        adjoint: λ so far.
    """
    factors = jax.scipy.linalg.lu_factor(linear.dense().T)
    left = linear.left(cotangent, adjoint)
    stepped = adjoint + jax.scipy.linalg.lu_solve(factors, left)
    left_after = linear.left(cotangent, stepped)
    is_better = jnp.abs(left_after).max() < jnp.abs(left).max()
    chosen, left = jax.tree.map(partial(jnp.where, is_better), (stepped, left_after), (adjoint, left))
    return DirectStep(chosen, jnp.abs(jax.scipy.linalg.lu_solve(factors, jnp.abs(left))).max())


def adjoint_error(linear: Linearization, cotangent: Values, adjoint: Values, discount: Float[Array, ""]) -> Array:
    """Return about how far λ is off, from what is left of its equation.

    Below discount 1 that is no more than Σ |g + Wᵀλ − λ| / (1 − γ), for weights of at least 0. At discount 1 it is
    about the part of max |λ| that this sum is of Σ |g|, because λ is linear in g.

    Args:
        linear: The equations linearized at the fixed point.
        cotangent: g.
        adjoint: λ.
        discount: γ.
    """
    total, left = jnp.abs(cotangent).sum(), jnp.abs(linear.left(cotangent, adjoint)).sum()
    relative = jnp.where(total > 0, left / jnp.where(total > 0, total, 1), 0) * jnp.abs(adjoint).max()
    return jnp.where(discount < 1, left / jnp.where(discount < 1, 1 - discount, 1), relative)


def _gain(equation: BellmanEquation, values: Values) -> Values:
    """Return F(V) − V as the backup of the advantages, which is exact where values are large; 0 where V is −∞."""
    process, backup, beta = equation
    live = equation.is_live(values)
    advantages = jnp.where(live[:, None], process.advantages(values), 0)
    return jnp.where(live, backup.value(advantages, beta, process.available_actions()), 0)
