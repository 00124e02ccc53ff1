"""The loop of sweeps in Jacobi iteration: when sweeps are damped, when a direct step follows, and when to stop.

1. Sweeps go on until no value changes by more than the tolerance.
2. Where the largest change has not become smaller for a thousand sweeps but changes alternate in sign, they start anew
   with half the step; then with a quarter, and so on.
3. In small worlds, a step on all equations at once (`direct`) follows after max(states, 200) sweeps, and where the
   bound of the error (`bounds`) is too large. Sweeps go on from there; to a smaller tolerance, if the error is too
   large.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sidestep.tabular.solvers.base import SolveResult, Values
from sidestep.tabular.solvers.bounds import largest_error
from sidestep.tabular.solvers.direct import MOST_STATES, DirectStep, sweeps_before

_STALLED = 1_000
"""The number of sweeps without progress after which an oscillating solve starts anew.

Or the number of states, if it is larger: news from one end of the world takes a sweep a state to the other.
"""
_PROGRESS = 0.999
"""The part of the smallest change so far that a change may be to count as smaller."""
_OSCILLATIONS, _LARGE = 4, 0.1
"""The number of these sweeps in which a large change must alternate in sign; large as a part of the largest."""
_FINER = 0.1
"""The factor between the tolerances of sweeps where the error is too large."""


class Iteration(NamedTuple):
    """What is iterated, and when to stop.

    Attributes:
        sweep: Returns the next values, and the size that a change of each is relative to.
        tolerance: The relative change at which to stop.
        max_sweeps: When to stop without convergence.
        step_all: Takes a step on all equations; None for none.
        error: Returns a bound of the error from the values, the largest change and the error allowed; None for none.
    """

    sweep: Callable[[Values], tuple[Values, Values]]
    tolerance: Float[Array, ""] | float
    max_sweeps: int
    step_all: Callable[[Values], DirectStep] | None = None
    error: Callable[[Values, Float[Array, ""], Float[Array, ""]], Float[Array, ""]] | None = None

    @property
    def is_direct(self) -> bool:
        """Whether there are direct steps, by the size of the world."""
        return self.step_all is not None


class _State(NamedTuple):
    """The state of the iteration.

    Attributes:
        values: The values so far.
        sweeps: Their number.
        residual: The largest relative change in the last sweep.
        moved: The largest change in it.
        change: The change of each value, relative as in `residual`, with its sign.
        damping: The part of the step that a state takes, in (0, 1].
        smallest: The smallest residual since the solve started anew.
        stalled: The number of sweeps since then.
        oscillations: The number of these in which a large change alternated in sign.
        tolerance: Of the sweeps.
        direct_error: That of the last direct step; ∞ before the first.
        error: The bound of the values' error, or an estimate.
        is_near: Whether it is small enough.
    """

    values: Values
    sweeps: Int[Array, ""]
    residual: Float[Array, ""]
    moved: Float[Array, ""]
    change: Values
    damping: Float[Array, ""]
    smallest: Float[Array, ""]
    stalled: Int[Array, ""]
    oscillations: Int[Array, ""]
    tolerance: Float[Array, ""]
    direct_error: Float[Array, ""]
    error: Float[Array, ""]
    is_near: Bool[Array, ""]


def iterate(
    iteration: Iteration, start: Values, order: Int[Array, " ordered"], earlier: SolveResult | None = None
) -> SolveResult:
    """Return the values at which sweeps stop.

    Args:
        iteration: What is iterated.
        start: The values to start from; −∞ where they are unknown or infinite.
        order: Passed on.
        earlier: The result of another solver that `start` is from; nothing is done if it has converged.
    """
    dtype, eps = start.dtype, jnp.finfo(start.dtype).eps
    if len(start) > MOST_STATES:
        iteration = iteration._replace(step_all=None)
    begun = _begin(start, jnp.asarray(iteration.tolerance, dtype))
    most = sweeps_before(len(start)) if iteration.is_direct else iteration.max_sweeps

    def is_sweeping(state: _State) -> Bool[Array, ""]:
        return (state.residual > state.tolerance) & (state.sweeps < iteration.max_sweeps)

    def is_unfinished(state: _State) -> Bool[Array, ""]:
        may_be_finer = (state.tolerance >= eps) | (state.tolerance >= iteration.tolerance)
        may_go_on = (state.sweeps < iteration.max_sweeps) & may_be_finer
        return ~state.is_near & may_go_on & ~jnp.isnan(state.residual)

    def go_on(state: _State) -> _State:
        if iteration.is_direct:
            # a loop of one pass at most: under `vmap` a condition would take both branches
            once = state, state.sweeps > 0
            step = partial(_step_directly, iteration, begun)
            state, _ = jax.lax.while_loop(lambda pair: pair[1], lambda pair: (step(pair[0]), ~pair[1]), once)
        end = state.sweeps + most
        step = partial(_sweep_once, iteration, start)
        state = jax.lax.while_loop(lambda state: is_sweeping(state) & (state.sweeps < end), step, state)
        return _judge(iteration, state)

    first = begun
    if earlier is not None:
        first = begun._replace(sweeps=earlier.sweeps, error=earlier.error, is_near=earlier.converged)
        first = first._replace(residual=jnp.where(earlier.converged, earlier.residual, jnp.inf))
    last = jax.lax.while_loop(is_unfinished, go_on, first)
    return SolveResult(last.values, order, last.sweeps, last.residual, last.error, last.is_near)


def _begin(start: Values, tolerance: Array) -> _State:
    zero, infinite = jnp.asarray(0), jnp.asarray(jnp.inf, start.dtype)
    one = jnp.ones_like(infinite)
    changes = infinite, infinite, jnp.zeros_like(start), one, infinite, zero, zero
    return _State(start, zero, *changes, tolerance, infinite, infinite, jnp.asarray(False))


def _sweep_once(iteration: Iteration, start: Values, state: _State) -> _State:
    old = state.values
    values, size = iteration.sweep(old)
    # a state may have no value yet, or never have one
    moved = jnp.where(jnp.isneginf(values) & jnp.isneginf(old), 0, values - old)
    limits = jnp.finfo(old.dtype)
    change = moved / jnp.maximum(size, limits.tiny / jnp.maximum(iteration.tolerance, limits.eps))
    residual = jnp.abs(change).max()
    alternates = jnp.any((change * state.change < 0) & (jnp.abs(state.change) > _LARGE * residual))
    smaller = residual < _PROGRESS * state.smallest
    stalled = jnp.where(smaller, 0, state.stalled + 1)
    oscillations = jnp.where(smaller, 0, state.oscillations + alternates)
    # numbers that have grown too large end in NaN
    diverged = jnp.isnan(residual) & jnp.isfinite(state.smallest)
    is_stalled = (stalled >= max(_STALLED, len(start))) & (oscillations >= _OSCILLATIONS)
    restart = diverged | is_stalled
    # there is no half step to or from a state that has no value yet
    damping = jnp.where(jnp.isneginf(values) | jnp.isneginf(old), 1, state.damping)
    damped = jnp.where(damping < 1, old + damping * moved, values)
    return state._replace(
        values=jnp.where(restart, start, damped),
        sweeps=state.sweeps + 1,
        residual=jnp.where(diverged, jnp.inf, residual),
        moved=jnp.abs(moved).max(),
        change=jnp.where(restart, 0, change),
        damping=jnp.where(restart, state.damping / 2, state.damping),
        smallest=jnp.where(restart, jnp.inf, jnp.where(smaller, residual, state.smallest)),
        stalled=jnp.where(restart, 0, stalled),
        oscillations=jnp.where(restart, 0, oscillations),
    )


def _step_directly(iteration: Iteration, begun: _State, state: _State) -> _State:
    """Return the state after a step on all equations, from where sweeps begin anew; the same if none was taken."""
    assert iteration.step_all is not None
    values, error = iteration.step_all(state.values)
    taken = jnp.any(values != state.values)
    anew = begun._replace(values=values, sweeps=state.sweeps, damping=state.damping, tolerance=state.tolerance)
    return jax.tree.map(partial(jnp.where, taken), anew, state)._replace(direct_error=error)


def _judge(iteration: Iteration, state: _State) -> _State:
    """Return the state with its error; with a smaller tolerance if that is too large although changes are small."""
    is_small = state.residual <= state.tolerance
    if iteration.error is None:
        return state._replace(error=jnp.zeros_like(state.residual), is_near=is_small)
    allowed = largest_error(iteration.tolerance, state.values)
    error = jnp.minimum(iteration.error(state.values, state.moved, allowed), state.direct_error)
    is_known = jnp.isfinite(error) | iteration.is_direct
    is_near = is_small & (~is_known | (error <= allowed))
    tolerance = jnp.where(is_small & ~is_near, _FINER * state.tolerance, state.tolerance)
    return state._replace(error=error, is_near=is_near, tolerance=tolerance)
