"""Sweeps in the order of distance, on the CPU: machine code called from JAX, the tasks of a batch side by side.

`kernels` holds the sweeps, `order` the order. A solve that starts from an earlier one takes over its order, as long as
that still serves: as long as it takes few sweeps.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import Buffer, ExecutionContext, buffer_callback
from jaxtyping import Array, Float
from numba import njit

from sidestep.errors import InputError
from sidestep.tabular.backups import Backup, BoltzmannAverage, Gradient, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.solvers.order import order_by_distance
from sidestep.tabular.solvers.passing import Given, Passing, Shares, passing_for
from sidestep.tabular.solvers.process import (
    Beta,
    DecisionProcess,
    Gradients,
    Solver,
    Start,
    Sweeps,
    Tolerance,
    lower_bound,
    lowest,
)
from sidestep.tabular.solvers.sweeping import (
    BOLTZMANN,
    HARD_MAX,
    LOG_SUM_EXP,
    MELLOWMAX,
    Marks,
    Numbered,
    Sweeping,
    sweeping_for,
)

KERNELS: dict[type[Backup], int] = {
    HardMax: HARD_MAX,
    BoltzmannAverage: BOLTZMANN,
    LogSumExp: LOG_SUM_EXP,
    Mellowmax: MELLOWMAX,
}
"""The backups that have machine code."""


class Ordered(Solver):
    """Sweeps in the order of distance from where a task ends, one state after another, on the CPU.

    - `tolerance`: relative change at which to stop; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
    - `max_sweeps`: when to give up (and say so).

    For the backups in `KERNELS`; raises `InputError` for another.
    """

    tolerance: Tolerance = None
    max_sweeps: int = eqx.field(default=5_000, static=True)

    def cold_start(self, states: int, dtype: jnp.dtype) -> Start:
        """No values, no adjoint and no order."""
        nothing = jnp.full(states, lowest(dtype), dtype)
        return Start(nothing, jnp.zeros(states, dtype), jnp.full(states, -1, jnp.int32))

    def values(self, process: DecisionProcess, backup: Backup, beta: Beta, start: Start) -> Sweeps:
        """V of the fixed point."""
        kind, tie = _machine_code(backup, start.values.dtype)
        solve = partial(_solve_values, kind, tie, self.max_sweeps)
        tolerance = self.tolerance_for(start.values.dtype)
        given = (process, lower_bound(process), beta, start.values, start.order, tolerance)
        return _on_the_host(solve, given, _sweeps_like(start.values, start.order))

    def pull_back(
        self,
        process: DecisionProcess,
        backup: Backup,
        beta: Beta,
        gradient: Gradient,
        values: Float[Array, " states"],
        cotangent: Float[Array, " states"],
        start: Start,
    ) -> tuple[Gradients, Sweeps]:
        """The gradient by all that the values depend on, in a share of the time that they took."""
        kind, tie = _machine_code(backup, values.dtype)
        solve = partial(_pull_back, kind, tie, gradient == "exact", self.max_sweeps)
        given = (process, beta, values, cotangent, start.adjoint, start.order, self.tolerance_for(values.dtype))
        by = Gradients(process.probabilities, process.reward, process.final_reward, process.discount, beta)
        return _on_the_host(solve, given, (_shapes(by), _sweeps_like(start.adjoint, start.order)))


# ------------------------------------------------------------------------------------------- from JAX to the host

_Result = TypeVar("_Result")


def _machine_code(backup: Backup, dtype: jnp.dtype) -> tuple[int, float]:
    """The number of a backup, and within which share of the best its ties lie."""
    if type(backup) not in KERNELS:
        known = ", ".join(kind.__name__ for kind in KERNELS)
        raise InputError(f"expected one that has machine code ({known}), or Jacobi() as the solver", field="backup")
    tie = max(backup.tie, 64 * float(jnp.finfo(dtype).eps)) if isinstance(backup, HardMax) else 0.0
    return KERNELS[type(backup)], tie


def _shapes(like: _Result) -> _Result:
    """Arrays as their shapes."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype), like)


def _sweeps_like(values: Float[Array, " states"], order: Array) -> Sweeps:
    """What a solve returns, as shapes."""
    residual = jax.ShapeDtypeStruct((), values.dtype)
    count = jax.ShapeDtypeStruct((), jax.dtypes.canonicalize_dtype(int))
    return Sweeps(_shapes(values), _shapes(order), count, residual, jax.ShapeDtypeStruct((), bool))


def _on_the_host(solve: Callable[..., None], given: Sequence, shapes: _Result) -> _Result:
    """What `solve` writes into NumPy arrays of the structure and shapes of `shapes`, from NumPy arrays.

    It is called with the arrays to write into and what is given; under `vmap` for every task, on all cores. Nothing is
    copied on the way.
    """
    given_leaves, given_structure = jax.tree.flatten(given)
    result_leaves, result_structure = jax.tree.flatten(shapes)
    dimensions = [jnp.ndim(leaf) for leaf in given_leaves]

    def solve_all(_: ExecutionContext, results: Sequence[Buffer], *given: Buffer) -> None:
        into = [np.asarray(result) for result in results]
        arrays = [np.asarray(leaf) for leaf in given]
        batch = into[0].shape[: into[0].ndim - len(result_leaves[0].shape)]
        cores = [array.shape[array.ndim - own :] for array, own in zip(arrays, dimensions, strict=True)]
        arrays = [np.broadcast_to(array, batch + core) for array, core in zip(arrays, cores, strict=True)]

        def solve_one(task: tuple[int, ...]) -> None:
            # the ellipsis keeps numbers arrays that can be written into
            result = jax.tree.unflatten(result_structure, [array[*task, ...] for array in into])
            solve(result, *jax.tree.unflatten(given_structure, [array[*task, ...] for array in arrays]))

        tasks = list(np.ndindex(batch))
        if len(tasks) == 1:
            solve_one(tasks[0])
        else:
            list(_threads().map(solve_one, tasks))

    found = buffer_callback(solve_all, result_leaves, vmap_method="expand_dims")(*given_leaves)
    return jax.tree.unflatten(result_structure, found)


@cache
def _threads() -> ThreadPoolExecutor:
    """One thread a core; the kernels do not hold Python's lock."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return ThreadPoolExecutor(cores, thread_name_prefix="sidestep-sweeps")


# ---------------------------------------------------------------------------------------------------- on the host

_OUT_OF_ORDER = 0.05
"""The share of states that may want to go to a farther one, before states are put in order anew."""
_WHOLE = 8
"""How many sweeps go over all states at once, shifting what is farther, before stretches are swept one by one."""
_GROWING = 2.0
"""By how much changes may grow from one sweep over all states to the next; beyond that, the last one is taken back."""
_STRETCH, _SMALLEST_STRETCH = 32, 256
"""How many states are swept together until they are still: some times the root of all states, but no fewer than these."""
_ROUNDS = 30
"""How often a stretch is swept at most before the next one."""
_STILL = 0.25
"""The share of the tolerance that counts as no change, so that what is left alone does not add up beyond it."""
_FEW = 0.01
"""The share of states at work below which stretches are swept one by one."""


def _solve_values(
    kind: int,
    tie: float,
    max_sweeps: int,
    result: Sweeps,
    process: DecisionProcess,
    bound: np.ndarray,
    beta: np.ndarray,
    start: np.ndarray,
    order: np.ndarray,
    tolerance: np.ndarray,
) -> None:
    """Finds values."""
    number = start.dtype.type
    bottom = number(lowest(start.dtype))
    run = sweeping_for(*_sizes(process.successors))
    order, world = _in_order(run, process, start, order, bottom)
    values = np.where(world.fixed, np.broadcast_to(process.final_reward, start.shape)[order], start[order])
    run.first_values(world, values, bottom, number(bound))
    behavior = (kind, number(beta), number(tie))
    sweeps, residual, converged = _sweep_until_still(
        run, behavior, world, values, number(tolerance), bottom, max_sweeps
    )
    result.values[order] = values
    _fill(result, order, sweeps, residual, converged)


def _fill(result: Sweeps, order: np.ndarray, sweeps: int, residual: float, converged: bool) -> None:
    """Fills in all but the values."""
    result.order[:] = order
    result.sweeps[...], result.residual[...], result.converged[...] = sweeps, residual, converged


def _sizes(successors: np.ndarray) -> tuple[int, int, int]:
    """The number of actions, of outcomes, and the most outcomes of an action that leave the state (at least 1)."""
    _, actions, outcomes = successors.shape
    return actions, outcomes, _most_that_leave(successors)


@njit(nogil=True, cache=True, error_model="numpy")
def _most_that_leave(successors):  # pragma: no cover
    """The largest number of an action's outcomes that leave the state; at least 1."""
    most = 1
    for state in range(len(successors)):
        for a in range(successors.shape[1]):
            count = 0
            for k in range(successors.shape[2]):
                count += successors[state, a, k] != state
            most = max(most, count)
    return most


def _in_order(
    run: Sweeping, process: DecisionProcess, start: np.ndarray, order: np.ndarray, bottom: np.floating
) -> tuple[np.ndarray, Numbered]:
    """The order, the one given if it still serves; and the task with its states numbered by it."""
    if order[0] >= 0:
        world = _numbered(run, process, order)
        if run.out_of_order(world, start[order], bottom) <= _OUT_OF_ORDER * len(order):
            return order, world
    order = order_by_distance(
        process.successors, process.probabilities, process.reward, process.terminal, process.discount[()]
    )
    return order, _numbered(run, process, order)


def _numbered(run: Sweeping, process: DecisionProcess, order: np.ndarray) -> Numbered:
    states, actions, _ = process.successors.shape
    width = _most_that_leave(process.successors)
    dtype = process.probabilities.dtype
    reward = np.broadcast_to(process.reward, (len(process.reward), actions))
    world = Numbered(
        successors=np.empty((states, actions, width), np.int32),
        moves=np.empty((states, actions, width), dtype),
        patience=np.empty((states, actions), dtype),
        reward=np.ascontiguousarray(reward[order] if len(reward) > 1 else reward),
        fixed=np.empty(states, bool),
        ending=1 - process.discount[()],
    )
    run.number_states(
        order,
        _positions(order),
        process.successors,
        process.probabilities,
        process.terminal,
        process.discount[()],
        world,
    )
    return world


def _positions(order: np.ndarray) -> np.ndarray:
    """Where each state stands in an order."""
    position = np.empty_like(order)
    position[order] = np.arange(len(order), dtype=order.dtype)
    return position


def _sweep_until_still(
    run: Sweeping,
    behavior: tuple[int, np.floating, np.floating],
    world: Numbered,
    values: np.ndarray,
    tolerance: np.floating,
    bottom: np.floating,
    max_sweeps: int,
) -> tuple[int, float, bool]:
    """Sweeps (see `sweeping`) until one over all states changes none by more than the tolerance.

    Returns how often a state was solved on average, the last residual, and whether it is within the tolerance.
    """
    states = len(values)
    everywhere = np.arange(states, dtype=np.int32)
    still = _STILL * tolerance
    marks = Marks(values.copy(), np.zeros(states, np.int32), np.zeros(states, np.int32))
    size = max(_SMALLEST_STRETCH, int(_STRETCH * states**0.5))
    stretches = np.split(everywhere, range(size, states, size))
    # values above the best action's would be swept upwards by a shift, and come down again only slowly
    whole = 0 if behavior[0] in (HARD_MAX, LOG_SUM_EXP) else _WHOLE
    number, work, residual = 0, 0, np.inf
    while work < max_sweeps * states:
        marks.before[:] = values
        first, at_work, last, residual = number + 1, 0, residual, 0.0
        for stretch in [everywhere] if whole else stretches:
            for again in range(1 if whole else _ROUNDS):
                number += 1
                shifted = 0 if whole else stretch[-1] + 1
                change, worked_at = run.sweep(
                    stretch, *behavior, world, values, marks, number, first, shifted, False, still, bottom
                )
                work += worked_at
                if again == 0:
                    at_work, residual = at_work + worked_at, max(residual, change)
                if not change > tolerance:
                    break
        if not np.isfinite(residual):
            break
        if whole and residual > _GROWING * last:
            values[:] = marks.before
        whole = max(0, whole - 1) if at_work > _FEW * states and residual <= _GROWING * last else 0
        if residual <= tolerance:
            marks.before[:] = values
            number += 1
            residual, worked_at = run.sweep(
                everywhere, *behavior, world, values, marks, number, number, states, True, still, bottom
            )
            work += worked_at
            if residual <= tolerance:
                return -(-work // states), float(residual), True
    return -(-work // states), float(residual), False


_COARSEST = 1e-3
"""The residuals of an adjoint are passed on from this share of their sum down, so that small ones add up first."""
_FINER = 0.1
"""By how much the threshold shrinks from sweep to sweep."""


def _pull_back(
    kind: int,
    tie: float,
    exact: bool,
    max_sweeps: int,
    result: tuple[Gradients, Sweeps],
    process: DecisionProcess,
    beta: np.ndarray,
    values: np.ndarray,
    cotangent: np.ndarray,
    start: np.ndarray,
    order: np.ndarray,
    tolerance: np.ndarray,
) -> None:
    """Finds the adjoint (with the states' own numbers) and the gradients."""
    number = values.dtype.type
    by, found = result
    position = _positions(order)
    run = passing_for(*_sizes(process.successors))
    given = Given(
        process.successors, process.probabilities, process.reward, process.terminal, process.discount[()], values
    )
    shares = _no_shares(given, np.nan_to_num(start[order], nan=0.0), cotangent[order])
    reached = number(-((-lowest(values.dtype)) ** 0.5))
    told = (kind, number(beta), number(tie), exact, given, order, position, reached, shares)
    sweeps, left = _pass_on_until_gone(
        run, told, shares, number(np.abs(cotangent).sum()), number(tolerance), max_sweeps
    )
    scalars = np.zeros(2, values.dtype)
    for gradient in by:
        gradient[...] = 0
    run.pull_back(given, order, shares, found.values, by.probabilities, by.reward, by.final_reward, scalars)
    by.discount[...], by.beta[...] = scalars
    _fill(found, order, sweeps, left, left <= tolerance)


def _no_shares(given: Given, adjoint: np.ndarray, residual: np.ndarray) -> Shares:
    """Nothing filled in; what is not needed takes no memory until it is."""
    states, actions, _ = given.successors.shape
    width = _most_that_leave(given.successors)
    dtype = given.values.dtype
    return Shares(
        known=np.zeros(states, bool),
        weights=np.empty((states, actions), dtype),
        beta=np.empty(states, dtype),
        successors=np.empty((states, actions, width), np.int32),
        shares=np.empty((states, actions, width), dtype),
        leaving=np.empty(states, dtype),
        divisor=np.empty(states, dtype),
        adjoint=adjoint,
        residual=residual,
    )


def _pass_on_until_gone(
    run: Passing, told: tuple, shares: Shares, total: np.floating, tolerance: np.floating, max_sweeps: int
) -> tuple[int, float]:
    """Sweeps until the residuals' sum is no more than the share `tolerance` of `total`; how many, and what is left."""
    if total == 0 or not np.isfinite(total):
        shares.adjoint[:] = total
        return 0, float(total)
    finest = tolerance * total / len(shares.residual)
    if shares.adjoint.any():
        run.pass_on(finest, True, *told)
    threshold, left = _COARSEST * total, np.inf
    for sweeps in range(1, max_sweeps + 1):
        at_work, left_alone = run.pass_on(threshold, False, *told)
        if at_work == 0:
            left = left_alone / total
            if left <= tolerance:
                break
        threshold = max(finest, _FINER * threshold)
    return sweeps, float(left)
