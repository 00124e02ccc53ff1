"""Values by Gauss–Seidel value iteration on the host: where a solve starts, in which order, and over which states.

A start's values are trusted for some sweeps. If they have not converged by then, the solve starts anew without values
and with a new order. An order is kept as long as few states have a greedy successor that is farther than they are.
States outside the region are swept once and then only shifted, as long as the start's values serve; without values,
and if the region is empty, all states are solved.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.tabular.solvers.base import SolveResult, WarmStart
from sidestep.tabular.solvers.bounds import MoveCosts
from sidestep.tabular.solvers.native import NativeEquation, SolveInfo, inverse_permutation, map_ranges, write_info
from sidestep.tabular.solvers.ordering import NumberedProcess, number_process, order_by_distance
from sidestep.tabular.solvers.reachability import finite_states_on_host
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


def solve_values(
    max_sweeps: int,
    into: SolveResult,
    equation: NativeEquation,
    bound: np.floating,
    costs: MoveCosts,
    start: WarmStart,
    region: Bool[np.ndarray, " states"],
) -> None:
    """Solve for the values and write them into the arrays of a result.

    Args:
        max_sweeps: When to stop (see `GaussSeidel`).
        into: The result.
        equation: What is to be solved, and how well.
        bound: A lower bound of the values.
        costs: What bounds the number of moves.
        start: Values and an order.
        region: The states that have to be solved.
    """
    values, order, process = np.asarray(start.values), np.asarray(start.order), equation.process
    numbers = (process.probabilities, process.reward, process.terminal_reward, process.discount)
    if any(np.isnan(np.min(part)) for part in (*numbers, equation.backup.beta, equation.tolerance)):
        into.values[:] = np.nan
        write_info(into, order, SolveInfo(0, np.nan, np.inf, False))
        return

    if inverse_permutation(order) is None:
        order = order_by_distance(process)
        start = start._replace(order=order)
    finite = finite_states_on_host(process, order)
    region = region if region.any() else np.ones_like(region)

    def solve_from(start: WarmStart, region: np.ndarray, max_sweeps: int, max_rounds: int) -> SolveInfo:
        """Solve from values and an order, or a new one if that does not serve; write the values and the order."""
        begun = _begin(start, equation, finite, bound)
        if begun is None or begun.out_of_order > _OUT_OF_ORDER * len(order):
            begun = _begin(start._replace(order=order_by_distance(process, finite)), equation, finite, bound)
            assert begun is not None
        positions = np.arange(len(order), dtype=np.int32)
        if not region.all():
            positions = positions[region[begun.order]]
        rules = equation.backup, costs, equation.tolerance, max_sweeps, max_rounds
        info = SweepLoop(begun.process, begun.values, begun.greedy_successor, positions, *rules).run()
        into.values[begun.order] = begun.values
        into.order[:] = begun.order
        return info

    info = SolveInfo(0, np.inf, np.inf, False)
    if (values > -np.inf).any():
        digits = -np.log10(max(equation.tolerance, np.finfo(values.dtype).eps))
        trusted = min(int(np.ceil(_TRUST * max(1.0, digits))), max_sweeps)
        info = solve_from(start, region, trusted, _TRUSTED_ROUNDS * trusted)
    if not info.converged and info.sweeps < max_sweeps:
        # where the start's values did not serve, its order is no better
        known_order = np.full_like(order, -1) if info.sweeps else order
        cold, left = start._replace(values=np.full_like(values, -np.inf), order=known_order), max_sweeps - info.sweeps
        again = solve_from(cold, np.ones_like(region), left, left)
        info = again._replace(sweeps=info.sweeps + again.sweeps)
    write_info(into, into.order, info)


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
    start: WarmStart, equation: NativeEquation, finite: Bool[np.ndarray, " states"], bound: np.floating
) -> _Begun | None:
    """Return the task numbered in the start's order.

    None if this is not a permutation of all states, or leaves a state without a first value that has a finite one.
    """
    known, order = np.asarray(start.values), np.asarray(start.order)
    position = inverse_permutation(order)
    if position is None:
        return None
    process, kernels = number_process(equation.process, order, position, finite)
    values, ends = known[order], np.flatnonzero(equation.process.terminal[order])
    values[~finite[order]] = -np.inf
    values[ends] = np.broadcast_to(equation.process.terminal_reward, known.shape)[order[ends]]
    greedy = np.empty_like(order)
    counts = map_ranges(lambda begin, end: kernels.greedy_successors(begin, end, process, values, greedy), len(order))
    first_values_kernel(*process.discounted_probs.shape[1:])(equation.backup, process, values, bound)
    if (np.isneginf(values) & finite[order]).any():
        return None
    return _Begun(order, process, values, greedy, sum(counts))
