"""Sweeps over all states at once, in JAX, on any device; the equations are those of `process`.

At discount 1 sweeps start from values of −∞ and reach outwards from the terminal states as a shortest-path search does;
until that is done, an outcome that leads to a state not reached yet counts as staying.

The Boltzmann average may make neighbours take turns in being worth more: values then swing for ever, and an adjoint
ever farther. So where the largest change has not become smaller for a thousand sweeps but changes turn about, a solve
begins anew, and states go only half of the way from then on; or a quarter, and so on. That moves no fixed point. It
does not help where going round leads away from the fixed point however short the steps; then a solve does not converge.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sidestep.tabular.backups import Backup, Gradient
from sidestep.tabular.solvers.base import (
    Beta,
    Cotangents,
    DecisionProcess,
    Region,
    Solver,
    SolveResult,
    Tolerance,
    WarmStart,
    at_fixed_policy,
    is_reachable,
    lower_bound,
    neg_inf,
)

_PATIENCE = 1_000
"""How many sweeps a solve may take without its largest change becoming smaller, if changes turn about.

Or as many as there are states, if these are more: news from one end of the world takes a sweep a state to the other.
"""
_PROGRESS = 0.999
"""What share of the smallest so far a change may be to count as smaller."""
_TURNS, _LARGE = 4, 0.1
"""In how many of these sweeps a large change must turn about, from up to down or back; large beside the largest."""


class Jacobi(Solver):
    """Sweeps over all states at once, on any device.

    - `tolerance`: relative change at which to stop; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
    - `max_sweeps`: when to give up (and say so).
    """

    tolerance: Tolerance = None
    max_sweeps: int = eqx.field(default=20_000, static=True)

    def cold_start(self, states: int, dtype: jnp.dtype) -> WarmStart:
        """No values, no adjoint; an order is not used."""
        return WarmStart(jnp.full(states, neg_inf(dtype), dtype), jnp.zeros(states, dtype), jnp.zeros(0, jnp.int32))

    def values(
        self, process: DecisionProcess, backup: Backup, beta: Beta, start: WarmStart, region: Region
    ) -> SolveResult:
        """V of the fixed point, of all states whatever the region."""
        del region
        split = _split(process)
        reward = jnp.broadcast_to(process.reward, process.successors.shape[:2]).T

        def sweep(values: Float[Array, " states"]) -> tuple[Float[Array, " states"], Float[Array, " states"]]:
            after = values[split.successors]
            moves = _moves_so_far(split, values, after)
            elsewhere = reward + jnp.sum(moves * after, axis=1)
            leaving = split.ending + moves.sum(axis=1)
            solved = process.end(_own_equation(backup, beta, elsewhere, leaving, values))
            return solved, jnp.maximum(jnp.abs(solved), jnp.abs(elsewhere).max(axis=0))

        known = jnp.where(is_reachable(start.values), start.values, lower_bound(process))
        return self._iterate(sweep, process.end(known), start.order)

    def vjp(
        self,
        process: DecisionProcess,
        backup: Backup,
        beta: Beta,
        gradient: Gradient,
        values: Float[Array, " states"],
        cotangent: Float[Array, " states"],
        start: WarmStart,
        region: Region,
    ) -> tuple[Cotangents, SolveResult]:
        """The gradient by all that the values depend on: the adjoint, and one backup pulled back by JAX."""
        del region
        # states that cannot reach a terminal state have no values to speak of, and no part in the gradient
        live = is_reachable(values) & ~process.terminal

        def action_values(process: DecisionProcess) -> Float[Array, "states actions"]:
            return jnp.where(live[:, None], process.action_values(values), 0)

        def one_backup(by: Cotangents) -> Float[Array, " states"]:
            varied = DecisionProcess(process.successors, *by[:3], process.terminal, by.discount)
            q = action_values(varied)
            backed_up = backup.value(q, by.beta) if gradient == "exact" else at_fixed_policy(backup, by.beta, q)
            return varied.end(jnp.where(live, backed_up, 0))

        q = action_values(process)
        policy = backup.fixed_policy_weights(q, beta)
        weights = backup.weights(q, beta) if gradient == "exact" else policy
        found = self._adjoint(process, weights, policy, live, cotangent, start)
        at = Cotangents(process.probabilities, process.reward, process.terminal_reward, process.discount, beta)
        adjoint = jnp.where(found.converged, found.values, jnp.nan)
        by = jax.vjp(one_backup, at)[1](adjoint)[0]
        # what the adjoint had no part in would stay 0
        by = jax.tree.map(lambda leaf: jnp.where(found.converged, leaf, jnp.nan), by)
        return by, found._replace(values=adjoint)

    def _adjoint(
        self,
        process: DecisionProcess,
        weights: Float[Array, "states actions"],
        policy: Float[Array, "states actions"],
        live: Bool[Array, " states"],
        cotangent: Float[Array, " states"],
        start: WarmStart,
    ) -> SolveResult:
        """λ = g + Wᵀλ for the gradient g = `cotangent`.

        `weights` are those in W, `policy` those of the policy held fixed; `live` are the states whose values pass on
        to others.
        """
        split = _split(process)
        chances = split.ending + split.elsewhere.sum(axis=1)
        spread = jnp.where(live, weights.T, 0)[:, None] * split.elsewhere
        leaving = jnp.where(live, jnp.sum(weights.T * chances, axis=0), 1)
        divisor = jnp.where(live, _divisor(weights, policy, chances), 1)
        largest = jnp.abs(cotangent).max()

        def sweep(adjoint: Float[Array, " states"]) -> tuple[Float[Array, " states"], Float[Array, " states"]]:
            arriving = jnp.zeros_like(adjoint).at[split.successors].add(spread * adjoint)
            solved = (cotangent + arriving + (divisor - leaving) * adjoint) / divisor
            return solved, jnp.maximum(jnp.abs(solved), largest)

        return self._iterate(sweep, jnp.nan_to_num(start.adjoint, nan=0), start.order)

    def _iterate(
        self,
        sweep: Callable[[Array], tuple[Array, Array]],
        start: Float[Array, " states"],
        order: Int[Array, " ordered"],
    ) -> SolveResult:
        """Sweeps until no change is large beside the sizes that `sweep` gives with its values."""
        tolerance = self.tolerance_for(start.dtype)
        patience = max(_PATIENCE, len(start))
        smallest_size = jnp.finfo(start.dtype).tiny / tolerance

        def unfinished(pace: _Pace) -> Bool[Array, ""]:
            found = pace.found
            return ~found.converged & (found.sweeps < self.max_sweeps) & ~jnp.isnan(found.residual)

        def step(pace: _Pace) -> _Pace:
            old = pace.found.values
            values, size = sweep(old)
            change = (values - old) / jnp.maximum(size, smallest_size)
            residual = jnp.abs(change).max()
            turned = jnp.any((change * pace.change < 0) & (jnp.abs(pace.change) > _LARGE * residual))
            smaller = residual < _PROGRESS * pace.smallest
            waited = jnp.where(smaller, 0, pace.waited + 1)
            turns = jnp.where(smaller, 0, pace.turns + turned)
            # numbers that have grown too large end in none
            lost = jnp.isnan(residual) & jnp.isfinite(pace.smallest)
            anew = lost | ((waited >= patience) & (turns >= _TURNS))
            # nobody goes part of the way to or from a state that has no value yet
            part = jnp.where(is_reachable(values) & is_reachable(old), pace.share, 1)
            taken = jnp.where(part < 1, old + part * (values - old), values)
            left = jnp.where(lost, jnp.inf, residual)
            found = SolveResult(jnp.where(anew, start, taken), order, pace.found.sweeps + 1, left, left <= tolerance)
            return _Pace(
                found,
                jnp.where(anew, 0, change),
                jnp.where(anew, pace.share / 2, pace.share),
                jnp.where(anew, jnp.inf, jnp.where(smaller, residual, pace.smallest)),
                jnp.where(anew, 0, waited),
                jnp.where(anew, 0, turns),
            )

        none, endless = jnp.asarray(0), jnp.asarray(jnp.inf, start.dtype)
        found = SolveResult(start, order, none, endless, jnp.asarray(False))
        begun = _Pace(found, jnp.zeros_like(start), jnp.ones_like(endless), endless, none, none)
        return jax.lax.while_loop(unfinished, step, begun).found


class _Pace(NamedTuple):
    """How a solve gets on.

    - `change`: that of each state's value in the last sweep, as in `residual`, with its sign.
    - `share`: of the way to what its own equation says that a state goes.
    - `smallest`: the last residual that counted as smaller than those before, since the solve began anew.
    - `waited`, `turns`: sweeps since then, and in how many of them a large change turned about.
    """

    found: SolveResult
    change: Float[Array, " states"]
    share: Float[Array, ""]
    smallest: Float[Array, ""]
    waited: Int[Array, ""]
    turns: Int[Array, ""]


class _Split(NamedTuple):
    """The outcomes of a process, self-loops apart; states come last, so that they are contiguous in memory."""

    successors: Int[Array, "actions outcomes states"]
    elsewhere: Float[Array, "actions outcomes states"]  # γ P of the outcomes that leave the state, 0 for the others
    ending: Float[Array, ""]  # 1 − γ


def _split(process: DecisionProcess) -> _Split:
    successors = jnp.moveaxis(process.successors, 0, -1)
    probabilities = jnp.moveaxis(process.probabilities, 0, -1)
    own = successors == jnp.arange(len(process.successors))
    moves = jnp.where(own, 0, probabilities)
    return _Split(successors, process.discount * moves, 1 - process.discount)


def _moves_so_far(
    split: _Split, values: Float[Array, " states"], after: Float[Array, "actions outcomes states"]
) -> Float[Array, "actions outcomes states"]:
    """γ P of the outcomes that leave a state, those that lead to states not reached yet counted as staying.

    Once no state can be reached any more, the states that have not been are hopeless, and whatever leads there too.
    """
    known = is_reachable(after)
    frontier = ~is_reachable(values) & jnp.any(known & (split.elsewhere > 0), axis=(0, 1))
    return jnp.where(known | ~frontier.any(), split.elsewhere, 0)


def _own_equation(
    backup: Backup,
    beta: Beta,
    elsewhere: Float[Array, "actions states"],
    leaving: Float[Array, "actions states"],
    old: Float[Array, " states"],
) -> Float[Array, " states"]:
    """One Newton step on each state's own equation, from its old value, kept on the right side of the escape."""
    bottom = neg_inf(old.dtype)
    escapes = jnp.where(leaving > 0, elsewhere / jnp.where(leaving > 0, leaving, 1), bottom)
    escape = jnp.maximum(escapes.max(axis=0), bottom)
    toward = jnp.maximum if backup.above_maximum else jnp.minimum
    start = jnp.where(is_reachable(old), toward(old, escape), escape)
    advantage = (elsewhere - leaving * start).T
    divisor = _divisor(backup.weights(advantage, beta), backup.fixed_policy_weights(advantage, beta), leaving)
    value = backup.value(advantage, beta)
    if backup.above_maximum:
        # from above its root, a convex function's tangent leads below it, and two neighbours that take turns in doing
        # so never settle: go by the chord, which ends above it
        too_high = (value < 0) & (start > escape)
        chord = backup.value((elsewhere - leaving * escape).T, beta) - value
        divisor = jnp.where(too_high, chord / jnp.where(too_high, start - escape, 1), divisor)
    solved = toward(start + value / divisor, escape)
    return jnp.where(is_reachable(escape), jnp.maximum(solved, bottom), bottom)


def _divisor(
    weights: Float[Array, "states actions"],
    policy: Float[Array, "states actions"],
    leaving: Float[Array, "actions states"],
) -> Float[Array, " states"]:
    """What a state's own equation is divided by: Σ w l, and never less than Σ π l, so that no step is too long.

    A state that no action leaves is divided by 1: it gives nothing to its neighbours and takes nothing from them.
    """
    divisor = jnp.maximum(jnp.sum(weights.T * leaving, axis=0), jnp.sum(policy.T * leaving, axis=0))
    return jnp.where(divisor > 0, divisor, 1)
