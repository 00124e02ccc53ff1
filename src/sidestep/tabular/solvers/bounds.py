"""Bounds of values, and of their errors.

**By the largest change.** If a sweep, V ← F(V), has changed no value by more than δ, then |V − V*| ≤ δ N, where N
bounds the expected number of moves until a task ends, each discounted. N is at most 1/(1 − γ). Where every move costs
at least c, and ending is worth at most e ≥ 0, it is at most (e − min V)/c too, because V ≤ e − c N. So the change alone
says little where N is large. Rounding adds ε max |V| to a change. Bertsekas (*Dynamic Programming and Optimal Control*
II, 2012, section 2.2) has such bounds for the hard maximum.

**By a potential.** Where a few states are nearly closed, that bound is far too large: these states take most of the
moves, but few exits. A second bound compares values. F is monotone, so V* ≤ U for all U with F(U) ≤ U, and V* ≥ U for
all U with F(U) ≥ U (Bertsekas and Tsitsiklis, *An analysis of stochastic shortest path problems*, 1991). Try
U = V ± t u, with a potential u ≥ 0. With A the advantages at V, and d(s, a) = u(s) − γ Σ P u the fall of the potential,
F(U) − U is B(A ∓ t d). The bound is t max u for a t where that has the right sign in every state. Rounding moves each
advantage by less than some ε times the terms of its sum, and the sign has to be right for both ends of that interval.

The potential is u = log(1 + X/c), X = e − V. It is concave in X, so d(s, a) ≥ c/(c + X) for moves that cost c and lead
on as V says, and d(s, a) < 0 only for actions that are worse than the best by at least c. One exit of a nearly closed
state has a large fall. Where a move may cost nothing it is u = 1, and the bound is that by 1/(1 − γ), state by state.

Newton's method finds t. It starts from 0, with steps of twice the length: B is convex, so single ones would end below
the root. Where a few steps do not find any t, only the first bound is known. The second takes a few passes over all
states, so it is computed only where the first does not suffice; and not by `Jacobi` in small worlds, where `direct` has
an estimate.

**For which backups.** The bounds hold for backups that are convex with weights of at least 0: the hard maximum, the
mellowmax, and the log-sum-exp, where the entropy bonus log(actions)/β makes a move cheaper. For the Boltzmann average
they are estimates: an action that is worse by more than 1/β lowers a state's value where it becomes better. The first
bound takes a Newton step of a state's own equation for its solution.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep.tabular.backups import Backup
from sidestep.tabular.solvers.base import BellmanEquation, Beta, DecisionProcess, Values, is_reachable
from sidestep.tabular.solvers.direct import MOST_STATES, step_divisor

MOST_STEPS, STEP_LENGTH = 4, 2.0
"""The most steps to t, the factor of the potential; and their length, in steps of Newton's method."""
ROUNDINGS = 4
"""How often a term of an advantage is rounded, apart from the sum over outcomes."""


class MoveCosts(NamedTuple):
    """What bounds the number of moves.

    Attributes:
        least: The least cost of a move that does not surely end the task, less the backup's bonus.
        ending: The most that ending is worth, and at least 0.
    """

    least: Float[Array, ""]
    ending: Float[Array, ""]


def lower_bound(process: DecisionProcess) -> Float[Array, ""]:
    """Return a lower bound of the values: below discount 1, the best action of the worst state for ever; else −∞."""
    dtype = process.probabilities.dtype
    best = jnp.where(process.available, process.reward, -jnp.inf).max(axis=-1)
    worst = jnp.where(process.terminal, jnp.inf, jnp.broadcast_to(best, process.terminal.shape)).min()
    worst = jnp.where(jnp.isfinite(worst), worst, 0)
    one_minus_discount = 1 - process.discount
    is_discounted = one_minus_discount > 0
    bound = jnp.where(is_discounted, worst / jnp.where(is_discounted, one_minus_discount, 1), -jnp.inf)
    return bound.astype(dtype)


def move_costs(process: DecisionProcess, backup: Backup, beta: Beta) -> MoveCosts:
    """Return what bounds the number of moves of a task under a model.

    Args:
        process: The decision process.
        backup: Of the agents.
        beta: Their inverse temperature.
    """
    reward, dtype = process.reward, process.probabilities.dtype
    going_on, gain = process.available, jnp.zeros((), dtype)
    if len(reward) > 1:
        # rewards that differ between states may be those of arriving
        arrives = process.terminal[process.successors] | (process.probabilities == 0)
        acting = process.available & ~process.terminal[:, None]
        ends = acting & jnp.all(arrives, axis=-1)
        going_on, gain = acting & ~ends, jnp.where(ends, reward, 0).max()
    actions = process.successors.shape[1]
    bonus = backup.bonus(jnp.log(jnp.asarray(actions, dtype)), actions, beta)
    least = -jnp.where(going_on, reward, -jnp.inf).max() - jnp.maximum(bonus, 0)
    worth = jnp.where(process.terminal, process.terminal_reward, 0).max()
    return MoveCosts(least, jnp.maximum(worth, 0) + jnp.maximum(gain, 0))


def error_bound(
    equation: BellmanEquation,
    costs: MoveCosts,
    values: Values,
    change: Float[Array, ""],
    allowed: Float[Array, ""],
) -> Array:
    """Return the bound of the values' error after a sweep; ∞ where none is known.

    Args:
        equation: The Bellman equation.
        costs: Of the moves.
        values: V after the sweep.
        change: The largest change of a value in it.
        allowed: The error that values may have; in large worlds, there is a second bound where the first is larger.
    """
    lowest, size = jnp.where(is_reachable(values), values, jnp.inf).min(), largest_value(values)
    by_cost = costs.least / jnp.maximum(costs.ending - lowest, jnp.finfo(values.dtype).tiny)
    error = change + jnp.finfo(values.dtype).eps * size
    bound = error / jnp.maximum(jnp.maximum(by_cost, 0), 1 - equation.process.discount)
    if len(values) <= MOST_STATES:
        return bound
    is_needed = jnp.isfinite(bound) & (bound > allowed)
    return jnp.minimum(bound, _bound_by_potential(equation, costs, values, is_needed))


def _bound_by_potential(equation: BellmanEquation, costs: MoveCosts, values: Values, is_needed: Array) -> Array:
    """Return the bound by a potential; ∞ where it is not needed or no factor is found."""
    process, backup, beta = equation
    live, limits = equation.is_live(values), jnp.finfo(values.dtype)
    is_dear = costs.least > 0
    above = jnp.where(is_reachable(values), jnp.maximum(costs.ending - values, 0), 0)
    potential = jnp.where(is_dear, jnp.log1p(above / jnp.where(is_dear, costs.least, 1)), 1)

    def excess(factor: Array) -> Array:
        """Return by how much the factor is too small, to first order: at most 0 if it suffices."""
        moves, staying = process.discount * process.probabilities, 1 - process.discount
        own = jnp.where(live[:, None], process.advantages(values), 0)
        here, after = (jnp.where(is_reachable(v), v, 0) for v in (values[:, None, None], values[process.successors]))
        spread = jnp.sum(moves * jnp.abs(after - here), axis=-1)
        terms = jnp.abs(process.reward) + spread + staying * jnp.abs(here[..., 0])
        rounding = (ROUNDINGS + moves.shape[-1]) * limits.eps * terms
        fall = jnp.sum(moves * (potential[:, None, None] - potential[process.successors]), axis=-1)
        fall = fall + staying * potential[:, None]
        most = jnp.where(jnp.isneginf(own), 0, rounding - factor * fall)
        ends = jnp.stack([own + most, own - most])
        gains = backup.value(ends, beta, process.available_actions())
        slope = step_divisor(backup.weights(ends[0], beta), backup.fixed_policy_weights(ends[0], beta), fall.T)
        return jnp.where(live, jnp.maximum(gains[0], -gains[1]) / slope, 0).max(initial=0)

    def is_unfinished(state: tuple[Array, Array, Array]) -> Array:
        steps, _, left = state
        return is_needed & (left > 0) & (steps <= MOST_STEPS)

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        steps, factor, left = state
        factor = jnp.where(steps > 0, factor + STEP_LENGTH * left, factor)
        return steps + 1, factor, excess(factor)

    begun = jnp.asarray(0), jnp.zeros((), values.dtype), jnp.asarray(jnp.inf, values.dtype)
    _, factor, left = jax.lax.while_loop(is_unfinished, step, begun)
    return jnp.where(left <= 0, factor * jnp.where(live, potential, 0).max(), jnp.inf)


def largest_error(tolerance: Float[Array, ""] | float, values: Values) -> Array:
    """Return the error that values with such a tolerance may have: its root, or that of ε, times the largest value.

    Args:
        tolerance: The relative change at which sweeps stop.
        values: V.
    """
    return jnp.sqrt(jnp.maximum(tolerance, jnp.finfo(values.dtype).eps)) * largest_value(values)


def largest_value(values: Values) -> Array:
    """Return max |V| of the finite values."""
    return jnp.where(is_reachable(values), jnp.abs(values), 0).max()
