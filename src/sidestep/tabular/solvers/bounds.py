"""Bounds of values, and of their errors.

**Errors.** If a sweep, V ← F(V), has changed no value by more than δ, then |V − V*| ≤ δ N, where N bounds the expected
number of moves until a task ends, each discounted. N is at most 1/(1 − γ). Where every move costs at least c, and
ending is worth at most e ≥ 0, it is at most (e − min V)/c too, because V ≤ e − c N. So the change alone says little
where N is large.

The bound holds for backups that are convex with weights of at least 0: the hard maximum, the mellowmax, and the
log-sum-exp, where the entropy bonus log(actions)/β makes a move cheaper. Bertsekas (*Dynamic Programming and Optimal
Control* II, 2012, section 2.2) has such bounds for the first. For the Boltzmann average it is an estimate: an action
that is worse by more than 1/β lowers a state's value where it becomes better. Rounding adds ε max |V| to a change.
Where a few states are nearly closed the bound may be far too large, because these take most of the moves, and others
most of the changes; `direct` has a better estimate.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep.tabular.backups import Backup
from sidestep.tabular.solvers.base import Beta, DecisionProcess, Values, is_reachable


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


def error_bound(process: DecisionProcess, costs: MoveCosts, values: Values, change: Float[Array, ""]) -> Array:
    """Return the bound of the values' error after a sweep; ∞ where none is known.

    Args:
        process: The decision process.
        costs: Of its moves.
        values: V after the sweep.
        change: The largest change of a value in it.
    """
    lowest, size = jnp.where(is_reachable(values), values, jnp.inf).min(), largest_value(values)
    by_cost = costs.least / jnp.maximum(costs.ending - lowest, jnp.finfo(values.dtype).tiny)
    error = change + jnp.finfo(values.dtype).eps * size
    return error / jnp.maximum(jnp.maximum(by_cost, 0), 1 - process.discount)


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
