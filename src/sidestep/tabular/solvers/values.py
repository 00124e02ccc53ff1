"""Values by Gauss–Seidel value iteration on the host: where a solve starts, in which order, and over which states.

A start's values are trusted for some sweeps. If they have not converged by then, the solve starts anew without values
and with a new order. An order is kept as long as few states have a greedy successor that is farther than they are.
States outside the region are swept once and then only shifted, as long as the start's values serve; without values,
and if the region is empty, all states are solved.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.tabular.solvers import native
from sidestep.tabular.solvers.base import SolveResult, WarmStart, neg_inf
from sidestep.tabular.solvers.ordering import NumberedProcess, number_process, order_by_distance
from sidestep.tabular.solvers.sweep_loop import SweepLoop
from sidestep.tabular.solvers.value_kernels import first_values_kernel

_OUT_OF_ORDER = 0.05
"""The fraction of states with a farther greedy successor beyond which a new order is made."""
_TRUST = 1.2
"""The number of sweeps for each digit of the tolerance that a start's values are trusted for.

After a bad start changes run along a front that the old order cannot follow, a block a round.
"""
_TRUSTED_ROUNDS = 4
"""The number of rounds for each of these sweeps; most rounds solve few states, and are cheap."""


class _Problem(NamedTuple):
    """What is to be solved, and how well; `bound` is a lower bound of the values."""

    process: native.HostProcess
    backup: native.NativeBackup
    bound: np.floating
    tolerance: np.floating

    def has_nan(self) -> bool:
        process = self.process
        numbers = (process.probabilities, process.reward, process.terminal_reward, process.discount)
        return any(np.isnan(np.min(part)) for part in (*numbers, self.backup.beta, self.tolerance))


def solve_values(
    kind: int,
    tie: float,
    max_sweeps: int,
    into: SolveResult,
    process: list[np.ndarray],
    bound: Float[np.ndarray, ""],
    beta: Float[np.ndarray, ""],
    start: WarmStart,
    region: Bool[np.ndarray, " states"],
    tolerance: Float[np.ndarray, ""],
) -> None:
    """Solve for the values and write them into the arrays of a result.

    Args:
        kind, tie, beta: The backup (see `NativeBackup`).
        max_sweeps: When to stop (see `GaussSeidel`).
        into: The result.
        process: The arrays of `HostProcess`.
        bound: A lower bound of the values.
        start: Values and an order.
        region: The states that have to be solved.
        tolerance: The relative change at which to stop.
    """
    values, _, order = start
    number = values.dtype.type
    backup = native.NativeBackup(kind, number(beta), number(tie))
    problem = _Problem(native.HostProcess.from_arrays(process), backup, number(bound), number(tolerance))
    if problem.has_nan():
        into.values[:] = np.nan
        native.write_info(into, order, native.SolveInfo(0, np.nan, False))
        return
    unknown = number(neg_inf(values.dtype))
    info = native.SolveInfo(0, np.inf, False)
    region = region if region.any() else np.ones_like(region)
    if (values > unknown).any():
        digits = -np.log10(max(problem.tolerance, np.finfo(values.dtype).eps))
        trusted = min(int(np.ceil(_TRUST * max(1.0, digits))), max_sweeps)
        info = _solve_from(values, order, region, problem, trusted, _TRUSTED_ROUNDS * trusted, into)
    if not info.converged and info.sweeps < max_sweeps:
        # where the start's values did not serve, its order is no better
        cold, known_order = np.full_like(values, unknown), np.full_like(order, -1) if info.sweeps else order
        left = max_sweeps - info.sweeps
        again = _solve_from(cold, known_order, np.ones_like(region), problem, left, left, into)
        info = again._replace(sweeps=info.sweeps + again.sweeps)
    native.write_info(into, into.order, info)


def _solve_from(
    start: Float[np.ndarray, " states"],
    order: Int[np.ndarray, " states"],
    region: Bool[np.ndarray, " states"],
    problem: _Problem,
    max_sweeps: int,
    max_rounds: int,
    result: SolveResult,
) -> native.SolveInfo:
    """Solve from values and an order, or a new one if that does not serve; write the values and the order."""
    position = native.inverse_permutation(order)
    begun = None if position is None else _begin(start, order, position, problem)
    if begun is None or begun.out_of_order > _OUT_OF_ORDER * len(order):
        best = order_by_distance(problem.process)
        position = native.inverse_permutation(best)
        assert position is not None
        begun = _begin(start, best, position, problem)
    positions = np.arange(len(order), dtype=np.int32)
    if not region.all():
        positions = positions[region[begun.order]]
    loop = SweepLoop(
        begun.process,
        begun.values,
        begun.greedy_successor,
        positions,
        problem.backup,
        problem.tolerance,
        max_sweeps,
        max_rounds,
    )
    info = loop.run()
    result.values[begun.order] = begun.values
    result.order[:] = begun.order
    return info


class _Begun(NamedTuple):
    """A task numbered in an order, with first values for all states.

    Attributes:
        greedy_successor: By the values of the start; the state itself where these are unknown.
        out_of_order: The number of states with a farther greedy successor.
    """

    order: Int[np.ndarray, " states"]
    process: NumberedProcess
    values: Float[np.ndarray, " states"]
    greedy_successor: Int[np.ndarray, " states"]
    out_of_order: int


def _begin(
    start: Float[np.ndarray, " states"],
    order: Int[np.ndarray, " states"],
    position: Int[np.ndarray, " states"],
    problem: _Problem,
) -> _Begun:
    unknown = start.dtype.type(neg_inf(start.dtype))
    process, kernels = number_process(problem.process, order, position)
    values, ends = start[order], np.flatnonzero(process.terminal)
    values[ends] = np.broadcast_to(problem.process.terminal_reward, start.shape)[order[ends]]
    greedy = np.empty_like(order)
    counts = native.map_ranges(
        lambda begin, end: kernels.greedy_successors(begin, end, process, values, unknown, greedy), len(order)
    )
    first_values_kernel(*process.discounted_probs.shape[1:])(problem.backup, process, values, unknown, problem.bound)
    return _Begun(order, process, values, greedy, sum(counts))
