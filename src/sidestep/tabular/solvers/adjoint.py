"""The adjoint of Gauss–Seidel value iteration on the host, and the gradient by it.

`adjoint_kernels` holds a single sweep. Residuals are pushed from a thousandth of their sum down, the threshold falling
tenfold from sweep to sweep, until the sum of all that remain is within the tolerance. If states that were left out when
the values were solved turn out to matter, there is no gradient (see `base`).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sidestep.tabular.solvers import adjoint_kernels, native
from sidestep.tabular.solvers.base import Cotangents, SolveResult, WarmStart

_COARSEST = 1e-3
"""The first threshold, as a part of the residuals' sum; so that small residuals add up first."""
_FINER = 0.1
"""The factor between the thresholds of one sweep and the next."""


def vjp_of_process(
    exact: bool,
    max_sweeps: int,
    max_region_sweeps: int,
    into: tuple[Cotangents, SolveResult],
    equation: native.NativeEquation,
    start: WarmStart,
    cotangent: Float[np.ndarray, " states"],
    region: Bool[np.ndarray, " states"],
) -> None:
    """Write the gradient and the adjoint into the arrays of records.

    Args:
        exact: Whether the gradient is the backup's own, or that of the policy held fixed.
        max_sweeps: When to stop (see `GaussSeidel`).
        max_region_sweeps: Likewise, where states were left out.
        into: The gradient, and the adjoint as a result.
        equation: The equation; its tolerance is the part of the cotangent's sum that may remain.
        start: The solution with its order, and an adjoint to start from.
        cotangent: The gradient of a scalar by the values.
        region: The states that were solved.
    """
    values, first, order = (np.asarray(part) for part in start)
    (by, result), process = into, equation.process
    number = values.dtype.type
    position = native.inverse_permutation(order)
    total = np.abs(cotangent).sum()
    if position is None or total == 0 or not np.isfinite(total):
        # nothing to solve, or nothing that it could be solved for
        residual = 0.0 if total == 0 else np.nan
        _fill(residual, result.values, *by)
        native.write_info(result, order, native.SolveInfo(0, residual, 0.0, bool(total == 0)))
        return
    problem = adjoint_kernels.AdjointProblem(equation.backup, exact, values, order, position)
    known = np.where(np.isfinite(first), first, number(0))
    actions, outcomes, width = process.kernel_sizes()
    work = _empty_state(process, width, known[order], cotangent[order])
    kernels, is_whole = adjoint_kernels.kernels_for(actions, outcomes, width), region.all()
    solve = _AdjointSolve(kernels, process, problem, work)
    sweeps = max_sweeps if is_whole else min(max_sweeps, max_region_sweeps)
    info = solve.push_all(total, equation.tolerance, sweeps)
    if info.converged and not is_whole:
        cost = solve.omission_cost(region)
        info = info._replace(residual=cost, converged=bool(cost <= equation.tolerance))
    if not info.converged:
        _fill(np.nan, result.values, *by)
        native.write_info(result, order, info)
        return
    solution = work.adjoint, work.row, work.weights, work.beta
    del solve, work  # the gradient takes the memory that they held
    _fill(0.0, *by[1:])

    def pull_back_range(begin: int, end: int) -> Cotangents:
        sums: list[Any] = [np.zeros_like(part) if len(np.atleast_1d(part)) == 1 else part for part in by[1:]]
        own = Cotangents(by.probabilities, *sums)
        kernels.vjp_of_process(begin, end, process, problem, *solution, result.values, own)
        return own

    for own in native.map_ranges(pull_back_range, len(order)):
        for part, added in zip(by[1:], own[1:], strict=True):
            if added is not part:
                part[...] += added
    native.write_info(result, order, info)


def _fill(number: float, *arrays: Any) -> None:
    for array in arrays:
        array[...] = number


def _empty_state(
    process: native.HostProcess, width: int, adjoint: np.ndarray, residual: np.ndarray
) -> adjoint_kernels.AdjointState:
    """Return a state without rows; rows that are not needed take no memory."""
    states, actions, _ = process.successors.shape
    dtype = adjoint.dtype
    row, successors = np.full(states, -1, np.int32), np.empty((states, actions, width), np.int32)
    weights, jacobian = np.empty((states, actions), dtype), np.empty(successors.shape, dtype)
    beta, exit_weight, divisor = (np.empty(states, dtype) for _ in range(3))
    by_row = weights, beta, successors, jacobian, exit_weight, divisor
    return adjoint_kernels.AdjointState(row, adjoint, residual, *by_row)


class _AdjointSolve(NamedTuple):
    """A solve of the adjoint equation: what is solved, λ so far, and the native code for it."""

    kernels: adjoint_kernels.AdjointKernels
    process: native.HostProcess
    problem: adjoint_kernels.AdjointProblem
    work: adjoint_kernels.AdjointState

    def push_all(self, total: np.floating, tolerance: np.floating, max_sweeps: int) -> native.SolveInfo:
        """Push until the residuals' sum is no more than the part `tolerance` of `total`."""
        kernels, *arrays = self
        adjoint, states = self.work.adjoint, len(self.work.residual)
        finest = tolerance * total / states
        threshold = max(finest, _COARSEST * total)
        pushed, left, filled = 0, np.inf, 0
        if adjoint.any():
            # what a first λ amounts to, its rows filled in on all cores
            needed = np.flatnonzero(np.abs(adjoint) > finest)
            native.map_ranges(lambda begin, end: kernels.fill_rows(begin, end, needed, *arrays), len(needed))
            _, _, filled = kernels.push(finest, True, len(needed), *arrays)
        for _ in range(max_sweeps):
            native.check_interrupt()
            pushes, remaining, filled = kernels.push(threshold, False, filled, *arrays)
            pushed += pushes
            if pushes == 0:
                left = float(remaining / total)
            if left <= tolerance or np.isnan(remaining):
                break
            threshold = max(finest, _FINER * threshold)
        return native.SolveInfo(-(-pushed // states), left, 0.0, bool(left <= tolerance))

    def omission_cost(self, region: Bool[np.ndarray, " states"]) -> float:
        """Return the cost of the states outside the region that were not solved, as a part of Σ |λ V|."""
        kernels, process, problem, work = self
        finite = np.where(problem.values > -np.inf, problem.values, 0)
        size = np.abs(work.adjoint * finite[problem.order]).sum()
        cost = kernels.omission_cost(process, problem, work.adjoint, region)
        return float(cost / size) if size > 0 else float(np.inf if cost > 0 else cost)
