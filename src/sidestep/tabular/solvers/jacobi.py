"""Jacobi value iteration with a local Newton step, in JAX, on any device.

The textbook method (value iteration, Bellman 1957; Puterman, *Markov Decision Processes*, 1994, section 6.3) replaces
all values at once by their backups. This one differs:

1. Each state's own equation is solved by a Newton step instead of a backup (see `base`).
2. At discount 1 values are computed outwards from the terminal states, as in a shortest-path search: as long as a state
   has no value yet, an outcome that leads there counts as staying. States without a finite value are known beforehand
   (`reachability`), and have no part in the sweeps.
3. Sweeps are damped where they oscillate. Under the Boltzmann average neighbors may alternately be worth more, so that
   values oscillate for ever, and an adjoint grows. So where the largest change has not become smaller for a thousand
   sweeps but changes alternate in sign, the solve starts anew with half the step; then with a quarter, and so on. That
   moves no fixed point. It does not help where a cycle of states leads away from the fixed point with any step; then
   the solve does not converge.
4. The gradient is that of the fixed point, by the adjoint equation, solved by the same iteration.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Backup, Gradient
from sidestep.tabular.solvers import base
from sidestep.tabular.solvers.base import BellmanEquation, Region, Values, WarmStart
from sidestep.tabular.solvers.reachability import finite_states

ByAction = Float[Array, "actions states"]

_STALLED = 1_000
"""The number of sweeps without progress after which an oscillating solve starts anew.

Or the number of states, if it is larger: news from one end of the world takes a sweep a state to the other.
"""
_PROGRESS = 0.999
"""The part of the smallest change so far that a change may be to count as smaller."""
_MOST_FACTORIZED = 1_000
"""The number of states up to which a linear equation is solved by a factorization: faster than sweeps, but cubic."""
_OSCILLATIONS, _LARGE = 4, 0.1
"""The number of these sweeps in which a large change must alternate in sign; large as a part of the largest."""


class Jacobi(base.Solver):
    """Jacobi value iteration with a local Newton step: all states at once, on any device.

    Attributes:
        tolerance: The relative change at which to stop, above 0; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
        max_sweeps: When to stop without convergence.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(3, 4)
        >>> options = ss.SolveOptions(solver=ss.Jacobi(tolerance=1e-6))
        >>> solution = ss.solve(ss.ObstacleGrid(grid), ss.reach(grid, 0), ss.Behavior(ss.HardMax()), options=options)
        >>> bool(solution.converged)
        True

    References:
        Puterman, *Markov Decision Processes* (1994), section 6.3.
    """

    tolerance: base.Tolerance = None
    max_sweeps: int = eqx.field(default=20_000, static=True)

    def cold_start(self, states: int, dtype: jnp.dtype) -> WarmStart:
        """Return a start without values and adjoint; an order is not used."""
        values, adjoint = np.full(states, -np.inf, dtype), np.zeros(states, dtype)
        return WarmStart(to_jax(values), to_jax(adjoint), to_jax(np.zeros(0, np.int32)))

    def values(self, equation: BellmanEquation, start: WarmStart, region: Region) -> base.SolveResult:
        """Return V of the fixed point, of all states whatever the region."""
        del region
        process, backup, beta = equation
        exits, finite = _exits(process), finite_states(process)
        is_safe = jnp.all(finite[exits.successors] | (exits.discounted_probs == 0), axis=1)
        usable = is_safe & process.available.T
        reward = jnp.broadcast_to(process.reward, process.successors.shape[:2]).T
        available = None if (mask := process.available_actions()) is None else mask.T

        def sweep(values: Values) -> tuple[Values, Values]:
            after = values[exits.successors]
            is_known = base.is_reachable(after)
            probs = jnp.where(is_known, exits.discounted_probs, 0)
            expected = jnp.sum(probs * jnp.where(is_known, after, 0), axis=1)
            exit_values = jnp.where(usable, reward + expected, -jnp.inf)
            exit_weights = exits.one_minus_discount + probs.sum(axis=1)
            choices = exit_values, exit_weights, available
            solved = process.with_terminal_rewards(_solve_states(backup, beta, *choices, values))
            largest = jnp.where(usable, jnp.abs(reward + expected), 0).max(axis=0)
            return solved, jnp.maximum(jnp.where(base.is_reachable(solved), jnp.abs(solved), 0), largest)

        known = jnp.where(base.is_reachable(start.values), start.values, base.lower_bound(process))
        begun = jnp.where(finite, process.with_terminal_rewards(known), -jnp.inf)
        return self._iterate(sweep, begun, start.order)

    def vjp(
        self, equation: BellmanEquation, gradient: Gradient, cotangent: Values, start: WarmStart, region: Region
    ) -> tuple[base.Cotangents, base.SolveResult]:
        """Return the gradient by all that the values depend on: the adjoint, and one backup pulled back by JAX."""
        del region
        process, values = equation.process, start.values
        live, exits = equation.is_live(values), _exits(process)
        weights, diagonal, divisor = _weights(equation, values, gradient, exits)
        jacobian = jnp.where(live, weights.T, 0)[:, None] * exits.discounted_probs
        largest = jnp.abs(cotangent).max()

        def sweep(adjoint: Values) -> tuple[Values, Values]:
            arriving = jnp.zeros_like(adjoint).at[exits.successors].add(jacobian * adjoint)
            solved = (cotangent + arriving + (divisor - diagonal) * adjoint) / divisor
            return solved, jnp.maximum(jnp.abs(solved), largest)

        result = self._iterate(sweep, jnp.nan_to_num(start.adjoint, nan=0), start.order)
        adjoint = jnp.where(result.converged, result.values, jnp.nan)
        by = jax.vjp(lambda by: equation.at(by).backed_up(values, gradient), equation.inputs)[1](adjoint)[0]
        # what the adjoint had no part in would stay 0
        by = jax.tree.map(lambda leaf: jnp.where(result.converged, leaf, jnp.nan), by)
        return by, result._replace(values=adjoint)

    def solve_linear(
        self, equation: BellmanEquation, values: Values, right: Values, *, transposed: bool = False
    ) -> Values:
        """Return x of x − Wx = `right`, W = ∂F/∂V at the fixed point `values`; NaN where it does not converge.

        It can be differentiated any number of times.

        Args:
            equation: The equation of the fixed point.
            values: The fixed point.
            right: The right-hand side.
            transposed: Solve x − Wᵀx = `right` instead.
        """
        exits, live = _exits(equation.process), equation.is_live(values)
        weights, diagonal, divisor = jax.lax.stop_gradient(_weights(equation, values, "exact", exits))

        def forward(x: Values) -> Values:
            return x - jax.jvp(equation.backed_up, (values,), (x,))[1]

        def backward(x: Values) -> Values:
            return x - jax.vjp(equation.backed_up, values)[1](x)[0]

        def iterate(matrix: Callable[[Values], Values], right: Values) -> Values:
            largest = jnp.abs(right).max()

            def sweep(x: Values) -> tuple[Values, Values]:
                solved = x + (right - matrix(x)) / divisor
                return solved, jnp.maximum(jnp.abs(solved), largest)

            result = self._iterate(sweep, jnp.zeros_like(right), jnp.zeros(0, jnp.int32))
            return jnp.where(result.converged, result.values, jnp.nan)

        solvers = iterate, iterate
        if len(values) <= _MOST_FACTORIZED:
            states = jnp.arange(len(values))
            jacobian = jnp.where(live, weights.T, 0)[:, None] * exits.discounted_probs
            matrix = jnp.diag(diagonal).at[states, exits.successors].add(-jacobian)
            factors = jax.scipy.linalg.lu_factor(jax.lax.stop_gradient(matrix))
            solvers = [lambda _, x, by=by: jax.scipy.linalg.lu_solve(factors, x, trans=by) for by in (0, 1)]
        matrix, order = (backward, -1) if transposed else (forward, 1)
        solve, transpose_solve = solvers[::order]
        return jax.lax.custom_linear_solve(matrix, right, solve, transpose_solve=transpose_solve)

    def _iterate(
        self, sweep: Callable[[Array], tuple[Array, Array]], start: Values, order: Int[Array, " ordered"]
    ) -> base.SolveResult:
        """Sweep until no change is large beside the sizes that `sweep` returns with its values."""
        tolerance = self.tolerance_for(start.dtype)
        most_stalled = max(_STALLED, len(start))
        smallest_size = jnp.finfo(start.dtype).tiny / tolerance

        def is_unfinished(state: _LoopState) -> Bool[Array, ""]:
            result = state.result
            return ~result.converged & (result.sweeps < self.max_sweeps) & ~jnp.isnan(result.residual)

        def step(state: _LoopState) -> _LoopState:
            old = state.result.values
            values, size = sweep(old)
            # a state may have no value yet, or never have one
            moved = jnp.where(jnp.isneginf(values) & jnp.isneginf(old), 0, values - old)
            change = moved / jnp.maximum(size, smallest_size)
            residual = jnp.abs(change).max()
            alternates = jnp.any((change * state.change < 0) & (jnp.abs(state.change) > _LARGE * residual))
            smaller = residual < _PROGRESS * state.smallest
            stalled = jnp.where(smaller, 0, state.stalled + 1)
            oscillations = jnp.where(smaller, 0, state.oscillations + alternates)
            # numbers that have grown too large end in NaN
            diverged = jnp.isnan(residual) & jnp.isfinite(state.smallest)
            restart = diverged | ((stalled >= most_stalled) & (oscillations >= _OSCILLATIONS))
            # there is no half step to or from a state that has no value yet
            damping = jnp.where(jnp.isneginf(values) | jnp.isneginf(old), 1, state.damping)
            damped = jnp.where(damping < 1, old + damping * moved, values)
            left = jnp.where(diverged, jnp.inf, residual)
            sweeps = state.result.sweeps + 1
            return _LoopState(
                base.SolveResult(jnp.where(restart, start, damped), order, sweeps, left, left <= tolerance),
                jnp.where(restart, 0, change),
                jnp.where(restart, state.damping / 2, state.damping),
                jnp.where(restart, jnp.inf, jnp.where(smaller, residual, state.smallest)),
                jnp.where(restart, 0, stalled),
                jnp.where(restart, 0, oscillations),
            )

        zero, infinite = jnp.asarray(0), jnp.asarray(jnp.inf, start.dtype)
        result = base.SolveResult(start, order, zero, infinite, jnp.asarray(False))
        begun = _LoopState(result, jnp.zeros_like(start), jnp.ones_like(infinite), infinite, zero, zero)
        return jax.lax.while_loop(is_unfinished, step, begun).result


class _LoopState(NamedTuple):
    """The state of the iteration.

    Attributes:
        result: The values so far.
        change: The change of each value in the last sweep, relative as in `residual`, with its sign.
        damping: The part of the step that a state takes, in (0, 1].
        smallest: The smallest residual since the solve started anew.
        stalled: The number of sweeps since then.
        oscillations: The number of these in which a large change alternated in sign.
    """

    result: base.SolveResult
    change: Float[Array, " states"]
    damping: Float[Array, ""]
    smallest: Float[Array, ""]
    stalled: Int[Array, ""]
    oscillations: Int[Array, ""]


class _Exits(NamedTuple):
    """The outcomes that leave their state: γP, 0 for self-loops; states last, contiguous in memory."""

    successors: Int[Array, "actions outcomes states"]
    discounted_probs: Float[Array, "actions outcomes states"]
    one_minus_discount: Float[Array, ""]


def _exits(process: base.DecisionProcess) -> _Exits:
    successors = jnp.moveaxis(process.successors, 0, -1)
    probabilities = jnp.moveaxis(process.probabilities, 0, -1)
    is_self_loop = successors == jnp.arange(len(process.successors))
    leaving = jnp.where(is_self_loop, 0, probabilities)
    return _Exits(successors, process.discount * leaving, 1 - process.discount)


def _weights(
    equation: BellmanEquation, values: Values, gradient: Gradient, exits: _Exits
) -> tuple[Float[Array, "states actions"], Values, Values]:
    """Return the weights ∂V/∂Q, the diagonal Σ w l of the adjoint's matrix, and the divisor of its iteration."""
    process, backup, beta = equation
    live = equation.is_live(values)
    q = jnp.where(live[:, None], process.action_values(values), 0)
    policy = backup.fixed_policy_weights(q, beta)
    weights = backup.weights(q, beta) if gradient == "exact" else policy
    exit_weights = exits.one_minus_discount + exits.discounted_probs.sum(axis=1)
    diagonal = jnp.where(live, jnp.sum(weights.T * exit_weights, axis=0), 1)
    return weights, diagonal, jnp.where(live, _divisor(weights, policy, exit_weights), 1)


def _solve_states(
    backup: Backup,
    beta: base.Beta,
    exit_values: ByAction,
    exit_weights: ByAction,
    available: Bool[Array, "actions states"] | None,
    old: Values,
) -> Values:
    """Return one Newton step on each state's own equation, kept on the right side of the repeat-action value."""
    never = jnp.isneginf(exit_values) | (exit_weights <= 0)
    repeated = jnp.where(never, -jnp.inf, exit_values / jnp.where(exit_weights > 0, exit_weights, 1))
    repeat_value = repeated.max(axis=0)
    lost = jnp.isneginf(repeat_value)
    above = jnp.where(lost, 0, repeat_value)
    bounded = jnp.maximum if backup.above_maximum else jnp.minimum
    start = jnp.where(base.is_reachable(old), bounded(old, above), above)
    of_states = None if available is None else available.T

    def advantage(values: Values) -> Float[Array, "states actions"]:
        return jnp.where(lost, 0, exit_values - exit_weights * values).T

    now = advantage(start)
    divisor = _divisor(backup.weights(now, beta), backup.fixed_policy_weights(now, beta), exit_weights)
    value = backup.value(now, beta, of_states)
    if backup.above_maximum:
        # from above its root, a convex function's tangent leads below it, and two neighbors that alternate in that
        # never converge: take the secant, which ends above it
        too_high = (value < 0) & (start > above)
        secant = backup.value(advantage(above), beta, of_states) - value
        divisor = jnp.where(too_high, secant / jnp.where(too_high, start - above, 1), divisor)
    return jnp.where(lost, -jnp.inf, bounded(start + value / divisor, above))


def _divisor(
    weights: Float[Array, "states actions"], policy: Float[Array, "states actions"], exit_weights: ByAction
) -> Values:
    """Return the divisor of the Newton step: Σ w l, and never less than Σ π l, so that no step is too long.

    For a state that no action leaves it is 1: the state gives nothing to its neighbors and takes nothing from them.
    """
    divisor = jnp.maximum(jnp.sum(weights.T * exit_weights, axis=0), jnp.sum(policy.T * exit_weights, axis=0))
    return jnp.where(divisor > 0, divisor, 1)
