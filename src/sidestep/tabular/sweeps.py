"""Solvers of the Bellman equation and of its adjoint, by sweeps over all states at once.

**Values.** With P the outcomes' probabilities and B a backup,

    Q(s, a) = R(s, a) + γ Σ_k P(s, a, k) V(succ(s, a, k)),      V(s) = B(Q(s, ·)),      V(terminal) = final reward.

A move that mostly fails leads mostly back to its own state, and plain sweeps then crawl. So every sweep solves each
state's own equation with its neighbours' values held. With p(a) the probability of staying,
c(a) = R + γ Σ_{elsewhere} P V and l(a) = 1 − γ p(a), the advantage of an action over the state's value v is A(a) =
c(a) − l(a) v, and since every backup moves with a constant, V = B(Q) reads B(A) = 0. A Newton step on it is

    v ← v + B(A) / Σ_a w(a) l(a),          w = the backup's weights at A.

The *escape*, max_a c(a)/l(a), is the best that one action tried for ever can give. It bounds the root: from above for
backups that never exceed the best action, from below for the log-sum-exp. Steps start and end on the root's side of it;
otherwise a state whose value was too high would seem best off trying an action that never leaves. A state not reached
yet starts from its escape. 1 − γp is summed as (1 − γ) + γ Σ_{elsewhere} P, so that nothing cancels in a trapped state.

The Boltzmann average may have several fixed points. Dividing by no less than Σ π l keeps the steps short where B(A)
grows with v, so that the sweeps end in a stable one.

**Adjoint.** For a scalar function with gradient g with respect to V, λ solves λ = g + Wᵀλ, where
W(s, s′) = γ Σ_a w(a) Σ_{k → s′} P(s, a, k) and w are the weights of the gradient that is asked for (exact or fixed
policy). Self-loops are divided out as above. Both iterations have the same spectrum at the fixed point (for the exact
gradient), so the adjoint converges where the values did.

At discount 1 the values of states that cannot reach a terminal state are −∞; they are held at `lowest(dtype)`, so low
that an action which may lead there is never taken. Sweeps start from such values everywhere, and reach outwards from
the terminal states as a shortest-path search does; until that is done, an outcome that leads to a state not reached
yet counts as staying.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Scalar

from sidestep.tabular.backups import Backup, Gradient

Beta = Float[Scalar, ""]


class DecisionProcess(eqx.Module):
    """A task under a model: all that a solver needs to know (fields as in `Graph`, `TransitionModel` and `Task`)."""

    successors: Int[Array, "states actions outcomes"]
    probabilities: Float[Array, "states actions outcomes"]
    reward: Float[Array, "#states #actions"]
    final_reward: Float[Array, "#states"]
    terminal: Bool[Array, " states"]
    discount: Float[Array, ""]

    def action_values(self, values: Float[Array, " states"]) -> Float[Array, "states actions"]:
        """Q(s, a) = R(s, a) + γ Σ T V (eq. 4).

        Summed as differences from V(s), so that the rounding of probabilities that are nearly 1 does not meet values
        that are large: where moves mostly fail it would drown the gradient.
        """
        differences = values[self.successors] - values[:, None, None]
        expected = values[:, None] + jnp.sum(self.probabilities * differences, axis=-1)
        return self.reward + self.discount * expected

    def end(self, values: Float[Array, " states"]) -> Float[Array, " states"]:
        """The values with those of terminal states put in."""
        return jnp.where(self.terminal, self.final_reward, values)


class Sweeps(NamedTuple):
    """What a solver found, and how it went.

    `residual` is the largest change in the last sweep relative to the value itself (or to what its actions are worth
    without staying, where that is larger), so that small values far from a goal count as much as large ones;
    `converged` says that it is within the tolerance. The error is larger than the residual by up to 1/(1 − rate of
    convergence).
    """

    values: Float[Array, " states"]
    sweeps: Int[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]


class Jacobi(eqx.Module):
    """Sweeps over all states at once, on any device.

    - `tolerance`: relative change at which to stop; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
    - `max_sweeps`: when to give up (and say so).
    """

    tolerance: float | None = eqx.field(default=None, static=True)
    max_sweeps: int = eqx.field(default=20_000, static=True)

    def values(self, process: DecisionProcess, backup: Backup, beta: Beta) -> Sweeps:
        """V of the fixed point."""
        split = _split(process)
        reward = jnp.broadcast_to(process.reward, process.successors.shape[:2]).T

        def sweep(values: Float[Array, " states"]) -> tuple[Float[Array, " states"], Float[Array, " states"]]:
            after = values[split.successors]
            moves = _moves_so_far(split, values, after)
            elsewhere = reward + jnp.sum(moves * after, axis=1)
            leaving = split.ending + moves.sum(axis=1)
            solved = process.end(_own_equation(backup, beta, elsewhere, leaving, values))
            return solved, jnp.maximum(jnp.abs(solved), jnp.abs(elsewhere).max(axis=0))

        return self._iterate(sweep, process.end(_start(process)))

    def adjoint(
        self,
        process: DecisionProcess,
        weights: Float[Array, "states actions"],
        policy: Float[Array, "states actions"],
        live: Bool[Array, " states"],
        cotangent: Float[Array, " states"],
    ) -> Sweeps:
        """λ = g + Wᵀλ for the gradient g = `cotangent`; `values` of what it returns is λ.

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

        return self._iterate(sweep, jnp.zeros_like(cotangent))

    def _iterate(self, sweep: Callable[[Array], tuple[Array, Array]], start: Float[Array, " states"]) -> Sweeps:
        """Sweeps until no change is large beside the sizes that `sweep` gives with its values."""
        tolerance = self.tolerance or (1e-10 if start.dtype == jnp.float64 else 1e-5)

        def unfinished(state: Sweeps) -> Bool[Array, ""]:
            return ~state.converged & (state.sweeps < self.max_sweeps) & ~jnp.isnan(state.residual)

        def step(state: Sweeps) -> Sweeps:
            values, size = sweep(state.values)
            change = jnp.abs(values - state.values) / jnp.maximum(size, jnp.finfo(values.dtype).tiny / tolerance)
            residual = jnp.max(change)
            return Sweeps(values, state.sweeps + 1, residual, residual <= tolerance)

        none = Sweeps(start, jnp.asarray(0), jnp.asarray(jnp.inf, start.dtype), jnp.asarray(False))
        return jax.lax.while_loop(unfinished, step, none)


def finite_horizon(
    process: DecisionProcess, backup: Backup, beta: Beta, horizon: int, gradient: Gradient
) -> Float[Array, " states"]:
    """V after `horizon` backups from nothing: what is worth having within that many actions.

    Differentiable by JAX itself; `gradient` chooses the exact one or that of the policies held fixed.
    """

    def step(values: Float[Array, " states"], _: None) -> tuple[Float[Array, " states"], None]:
        q = process.action_values(values)
        if gradient == "exact":
            return process.end(backup.value(q, beta)), None
        return process.end(at_fixed_policy(backup, beta, q)), None

    start = process.end(jnp.zeros(process.terminal.shape, process.probabilities.dtype))
    return jax.lax.scan(step, start, length=horizon)[0]


def lowest(dtype: jnp.dtype) -> float:
    """The stand-in for −∞: so low that a step cost more makes no difference to it."""
    return -1e200 if dtype == jnp.float64 else -1e25


def reachable(values: Float[Array, "*states"]) -> Bool[Array, "*states"]:
    """Whether a terminal state can be reached, by values at discount 1: whether they are not a share of `lowest`."""
    return values > -((-lowest(values.dtype)) ** 0.5)


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
    known = reachable(after)
    frontier = ~reachable(values) & jnp.any(known & (split.elsewhere > 0), axis=(0, 1))
    return jnp.where(known | ~frontier.any(), split.elsewhere, 0)


def _start(process: DecisionProcess) -> Float[Array, " states"]:
    """A lower bound of the values: below discount 1, the best action of the worst state for ever."""
    dtype = process.probabilities.dtype
    best = jnp.broadcast_to(process.reward.max(axis=-1), process.terminal.shape)
    worst = jnp.where(process.terminal, jnp.inf, best).min()
    worst = jnp.where(jnp.isfinite(worst), worst, 0)
    remaining = 1 - process.discount
    bound = jnp.where(remaining > 0, worst / jnp.where(remaining > 0, remaining, 1), lowest(dtype))
    return jnp.broadcast_to(bound.astype(dtype), process.terminal.shape)


def _own_equation(
    backup: Backup,
    beta: Beta,
    elsewhere: Float[Array, "actions states"],
    leaving: Float[Array, "actions states"],
    old: Float[Array, " states"],
) -> Float[Array, " states"]:
    """One Newton step on each state's own equation, from its old value, kept on the right side of the escape."""
    bottom = lowest(old.dtype)
    escapes = jnp.where(leaving > 0, elsewhere / jnp.where(leaving > 0, leaving, 1), bottom)
    escape = jnp.maximum(escapes.max(axis=0), bottom)
    toward = jnp.maximum if backup.above_maximum else jnp.minimum
    start = jnp.where(reachable(old), toward(old, escape), escape)
    advantage = (elsewhere - leaving * start).T
    divisor = _divisor(backup.weights(advantage, beta), backup.fixed_policy_weights(advantage, beta), leaving)
    solved = toward(start + backup.value(advantage, beta) / divisor, escape)
    return jnp.where(reachable(escape), jnp.maximum(solved, bottom), bottom)


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


def at_fixed_policy(backup: Backup, beta: Beta, q: Float[Array, "states actions"]) -> Float[Array, " states"]:
    """The backup's value with the gradient of the average under its policy, held fixed (eqs. 9 and 10)."""
    weights, value = jax.lax.stop_gradient((backup.fixed_policy_weights(q, beta), backup.value(q, beta)))
    return value + jnp.sum(weights * (q - jax.lax.stop_gradient(q)), axis=-1)
