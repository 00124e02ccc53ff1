"""Jacobi value iteration with a local Newton step, in JAX, on any device.

The textbook method (value iteration, Bellman 1957; Puterman, *Markov Decision Processes*, 1994, section 6.3) replaces
all values at once by their backups. This one differs:

1. Each state's own equation is solved by a Newton step instead of a backup (see `base`).
2. At discount 1 values are computed outwards from the terminal states, as in a shortest-path search: as long as a state
   has no value yet, an outcome that leads there counts as staying. States without a finite value are known beforehand
   (`reachability`), and have no part in the sweeps.
3. Sweeps are damped where they oscillate (`jacobi_loop`). Under the Boltzmann average neighbors may alternately be
   worth more, so that values oscillate for ever, and an adjoint grows. Shorter steps move no fixed point. They do not
   help where a cycle of states leads away from the fixed point with any step; then the solve does not converge.
4. The gradient is that of the fixed point, by the adjoint equation, solved by the same iteration.
5. Worlds of up to a thousand states are solved directly where sweeps are slow, as at discounts near 1: by Newton steps
   on all equations at once (`direct`). With the hard maximum that is policy iteration. The sweeps that follow decide
   whether the values have converged.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Backup, Gradient
from sidestep.tabular.solvers import base
from sidestep.tabular.solvers.base import BellmanEquation, Region, Values, WarmStart
from sidestep.tabular.solvers.bounds import error_bound, lower_bound, move_costs
from sidestep.tabular.solvers.direct import (
    MOST_STATES,
    Exits,
    adjoint_error,
    adjoint_step,
    linearize,
    newton_step,
    step_divisor,
)
from sidestep.tabular.solvers.jacobi_loop import Iteration, iterate
from sidestep.tabular.solvers.reachability import finite_states

ByAction = Float[Array, "actions states"]


class Jacobi(base.Solver):
    """Jacobi value iteration with a local Newton step: all states at once, on any device.

    Attributes:
        tolerance: The relative change at which to stop, from 0; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
        max_sweeps: When to stop without convergence, at least 1.

    Raises:
        InputError: For a tolerance below 0 and fewer sweeps than 1.

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

    def __check_init__(self) -> None:
        self.check_settings()

    def cold_start(self, states: int, dtype: jnp.dtype) -> WarmStart:
        """Return a start without values and adjoint; an order is not used."""
        values, adjoint = np.full(states, -np.inf, dtype), np.zeros(states, dtype)
        return WarmStart(to_jax(values), to_jax(adjoint), to_jax(np.zeros(0, np.int32)))

    def values(self, equation: BellmanEquation, start: WarmStart, region: Region) -> base.SolveResult:
        """Return V of the fixed point, of all states whatever the region."""
        del region
        return self.go_on(equation, start)

    def go_on(
        self, equation: BellmanEquation, start: WarmStart, earlier: base.SolveResult | None = None
    ) -> base.SolveResult:
        """Return V of the fixed point, from where another solver has ended.

        Args:
            equation: What is solved.
            start: Where to start from.
            earlier: The result that `start` is from; if it has converged, it is returned as it is.
        """
        process, backup, beta = equation
        exits, finite = Exits.of(process), finite_states(process)
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

        known = jnp.where(base.is_reachable(start.values), start.values, lower_bound(process))
        begun = jnp.where(finite, process.with_terminal_rewards(known), -jnp.inf)
        error = partial(error_bound, equation, move_costs(process, backup, beta))
        iteration = self._iteration(sweep, begun.dtype, partial(newton_step, equation), error)
        return iterate(iteration, begun, start.order, earlier)

    def vjp(
        self, equation: BellmanEquation, gradient: Gradient, cotangent: Values, start: WarmStart, region: Region
    ) -> tuple[base.Cotangents, base.SolveResult]:
        """Return the gradient by all that the values depend on: the adjoint, and one backup pulled back by JAX."""
        del region
        values = start.values
        linear = linearize(equation, values, gradient)
        largest = jnp.abs(cotangent).max()

        def sweep(adjoint: Values) -> tuple[Values, Values]:
            staying = (linear.divisor - linear.diagonal) * adjoint
            solved = (cotangent + linear.arriving(adjoint) + staying) / linear.divisor
            return solved, jnp.maximum(jnp.abs(solved), largest)

        begun = jnp.nan_to_num(start.adjoint, nan=0)

        def error(adjoint: Values, *_: Array) -> Array:
            # sums over many states are too large to say much
            own = adjoint_error(linear, cotangent, adjoint, equation.process.discount)
            return own if len(adjoint) <= MOST_STATES else jnp.zeros_like(own)

        rules = partial(adjoint_step, linear, cotangent), error
        result = iterate(self._iteration(sweep, begun.dtype, *rules), begun, start.order)
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
        linear = jax.lax.stop_gradient(linearize(equation, values, "exact"))

        def forward(x: Values) -> Values:
            return x - jax.jvp(equation.backed_up, (values,), (x,))[1]

        def backward(x: Values) -> Values:
            return x - jax.vjp(equation.backed_up, values)[1](x)[0]

        def by_sweeps(matrix: Callable[[Values], Values], right: Values) -> Values:
            largest = jnp.abs(right).max()

            def sweep(x: Values) -> tuple[Values, Values]:
                solved = x + (right - matrix(x)) / linear.divisor
                return solved, jnp.maximum(jnp.abs(solved), largest)

            result = iterate(self._iteration(sweep, right.dtype), jnp.zeros_like(right), jnp.zeros(0, jnp.int32))
            return jnp.where(result.converged, result.values, jnp.nan)

        solvers = by_sweeps, by_sweeps
        if len(values) <= MOST_STATES:
            factors = jax.scipy.linalg.lu_factor(linear.dense())
            solvers = [lambda _, x, by=by: jax.scipy.linalg.lu_solve(factors, x, trans=by) for by in (0, 1)]
        matrix, order = (backward, -1) if transposed else (forward, 1)
        solve, transpose_solve = solvers[::order]
        return jax.lax.custom_linear_solve(matrix, right, solve, transpose_solve=transpose_solve)

    def _iteration(self, sweep: Callable[[Values], tuple[Values, Values]], dtype: jnp.dtype, *rules: Any) -> Iteration:
        return Iteration(sweep, self.tolerance_for(dtype), self.max_sweeps, *rules)


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
    divisor = step_divisor(backup.weights(now, beta), backup.fixed_policy_weights(now, beta), exit_weights)
    value = backup.value(now, beta, of_states)
    if backup.above_maximum:
        # from above its root, a convex function's tangent leads below it, and two neighbors that alternate in that
        # never converge: take the secant, which ends above it
        too_high = (value < 0) & (start > above)
        secant = backup.value(advantage(above), beta, of_states) - value
        divisor = jnp.where(too_high, secant / jnp.where(too_high, start - above, 1), divisor)
    return jnp.where(lost, -jnp.inf, bounded(start + value / divisor, above))
