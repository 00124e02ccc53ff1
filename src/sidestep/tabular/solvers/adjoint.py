"""The adjoint, from the farthest state back to where a task ends, and the gradient by it. On the host.

`passing` holds a single sweep. Residuals are passed on from a thousandth of their sum down, the threshold falling
tenfold from sweep to sweep, until all that is left is less than the tolerance's share of the sum. If states that were
left out when the values were solved turn out to matter, there is no gradient (see `process`).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.tabular.solvers.adjoint_kernels import HostCotangents, Passing, Setting, Shares, passing_for
from sidestep.tabular.solvers.base import neg_inf
from sidestep.tabular.solvers.given import Found, Given, Outcome, given_from, positions, sizes, write
from sidestep.tabular.solvers.native import heed_interrupts, shared_out
from sidestep.tabular.solvers.value_kernels import Valuing

_COARSEST = 1e-3
"""The first threshold, as a share of the sum of what is to be passed on; so that small residuals add up first."""
_FINER = 0.1
"""By how much the threshold shrinks from sweep to sweep."""
_MOST_SWEEPS = 100
"""How many sweeps are tried where states were left out; whoever walks in circles there never gets rid of residuals."""


def vjp(
    kind: int,
    tie: float,
    exact: bool,
    max_sweeps: int,
    into: tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]],
    process: tuple[np.ndarray, ...],
    beta: Float[np.ndarray, ""],
    values: Float[np.ndarray, " states"],
    cotangent: Float[np.ndarray, " states"],
    start: Float[np.ndarray, " states"],
    order: Int[np.ndarray, " states"],
    region: Bool[np.ndarray, " states"],
    tolerance: Float[np.ndarray, ""],
) -> None:
    """Writes the gradient `into` the arrays of `HostCotangents`, and the adjoint into those of `Found`.

    `kind` and `tie` as in `Valuing`, `process` as in `given_from`; `values` are the solution, `cotangent` is the
    gradient by them, `start` an adjoint to start from, `region` is as for `Solver.vjp`.
    """
    number = values.dtype.type
    by, found = HostCotangents(*into[0]), Found(*into[1])
    position = positions(order)
    total = np.abs(cotangent).sum()
    if position is None or total == 0 or not np.isfinite(total):
        # nothing to solve, or nothing that it could be solved for
        _fill(0.0 if total == 0 else np.nan, found.values, *by)
        write(found, order, Outcome(0, 0.0 if total == 0 else np.nan, bool(total == 0)))
        return
    given, valuing = given_from(process), Valuing(kind, number(beta), number(tie))
    reached = number(-((-neg_inf(values.dtype)) ** 0.5))
    setting = Setting(valuing, exact, values, reached, order, position)
    known = np.where(np.isfinite(start), start, number(0))
    actions, outcomes, width = sizes(given)
    shares = _no_shares(given, width, known[order], cotangent[order])
    run, whole = passing_for(actions, outcomes, width), region.all()
    sweeps = max_sweeps if whole else min(max_sweeps, _MOST_SWEEPS)
    outcome = _pass_on_until_gone(run, given, setting, shares, number(total), number(tolerance), sweeps)
    if outcome.converged and not whole:
        cost = _cost_of_leaving_out(run, given, setting, shares, region)
        outcome = outcome._replace(residual=cost, converged=bool(cost <= tolerance))
    if not outcome.converged:
        _fill(np.nan, found.values, *by)
        write(found, order, outcome)
        return
    by_values = shares.adjoint, shares.row, shares.weights, shares.beta
    del shares  # the gradient takes the memory that it held
    _fill(0.0, *by[1:])

    def assemble(begin: int, end: int) -> HostCotangents:
        shared = [np.zeros_like(part) if len(np.atleast_1d(part)) == 1 else part for part in by[1:]]
        own = HostCotangents(by.probabilities, *shared)
        run.vjp(begin, end, given, setting, *by_values, found.values, own)
        return own

    for own in shared_out(assemble, len(order)):
        for part, added in zip(by[1:], own[1:], strict=True):
            if added is not part:
                np.add(part, added, out=part)
    write(found, order, outcome)


def _fill(number: float, *arrays: np.ndarray) -> None:
    for array in arrays:
        array[...] = number


def _no_shares(given: Given, width: int, adjoint: np.ndarray, residual: np.ndarray) -> Shares:
    """Nothing filled in; what is not needed takes no memory until it is."""
    states, actions, _ = given.successors.shape
    dtype = adjoint.dtype
    return Shares(
        row=np.full(states, -1, np.int32),
        adjoint=adjoint,
        residual=residual,
        weights=np.empty((states, actions), dtype),
        beta=np.empty(states, dtype),
        successors=np.empty((states, actions, width), np.int32),
        shares=np.empty((states, actions, width), dtype),
        leaving=np.empty(states, dtype),
        divisor=np.empty(states, dtype),
    )


def _cost_of_leaving_out(
    run: Passing, given: Given, setting: Setting, shares: Shares, region: Bool[np.ndarray, " states"]
) -> float:
    """What states outside the region cost that were left as they were, as a share of Σ |λ V|."""
    reached = setting.values > setting.reached
    size = np.abs(shares.adjoint * np.where(reached, setting.values, 0)[setting.order]).sum()
    cost = run.left_out(given, setting, shares.adjoint, region)
    return float(cost / size) if size > 0 else float(np.inf if cost > 0 else cost)


def _pass_on_until_gone(
    run: Passing,
    given: Given,
    setting: Setting,
    shares: Shares,
    total: np.floating,
    tolerance: np.floating,
    max_sweeps: int,
) -> Outcome:
    """Sweeps until the residuals' sum is no more than the share `tolerance` of `total`."""
    states = len(shares.residual)
    finest = tolerance * total / states
    threshold = max(finest, _COARSEST * total)
    passed_on, left = 0, np.inf
    filled = _take_over(run, given, setting, shares, finest) if shares.adjoint.any() else 0
    for _ in range(max_sweeps):
        heed_interrupts()
        at_work, left_alone, filled = run.pass_on(threshold, False, filled, given, setting, shares)
        passed_on += at_work
        if at_work == 0:
            left = float(left_alone / total)
        if left <= tolerance or np.isnan(left_alone):
            break
        threshold = max(finest, _FINER * threshold)
    return Outcome(-(-passed_on // states), left, bool(left <= tolerance))


def _take_over(run: Passing, given: Given, setting: Setting, shares: Shares, finest: np.floating) -> int:
    """Passes on what a first λ amounts to, its rows filled in on all cores; returns how many these are."""
    needed = np.flatnonzero(np.abs(shares.adjoint) > finest)
    shared_out(lambda begin, end: run.fill_in(begin, end, needed, given, setting, shares), len(needed))
    _, _, filled = run.pass_on(finest, True, len(needed), given, setting, shares)
    return filled
