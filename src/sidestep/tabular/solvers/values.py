"""Values, from where a task ends outwards, on the host: what to start from, in which order, and which states.

An earlier solve's values are taken on trust for some sweeps; if they have not converged by then, the solve starts from
no values and in a new order. An order is kept as long as few states want to go to a farther one. States outside the
region are swept once and then only moved along, as long as an earlier solve's values serve; from no values, and if the
region is empty, all are solved.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.tabular.solvers.base import neg_inf
from sidestep.tabular.solvers.given import Found, Given, Outcome, given_from, positions, sizes, write
from sidestep.tabular.solvers.native import shared_out
from sidestep.tabular.solvers.numbering import Numbered, numbered, numbering_for
from sidestep.tabular.solvers.ordering import order_by_distance
from sidestep.tabular.solvers.rounds import Rounds
from sidestep.tabular.solvers.value_kernels import Valuing, first_values_for

_OUT_OF_ORDER = 0.05
"""The share of states that may want to go to a farther one, before states are put in order anew."""
_TRUST = 1.2
"""How many sweeps a solve that starts from an earlier one's values may take for each digit of the tolerance.

A start that leads astray makes changes run along a front that the old order cannot follow, a stretch a round.
"""
_TRUSTED_ROUNDS = 4
"""How many rounds it may take for each of these sweeps; most rounds solve few states, and are cheap."""


class _Asked(NamedTuple):
    """What is to be solved, and how well; `bound` is no more than any value."""

    given: Given
    valuing: Valuing
    bound: np.floating
    tolerance: np.floating


def find_values(
    kind: int,
    tie: float,
    max_sweeps: int,
    into: tuple[np.ndarray, ...],
    process: tuple[np.ndarray, ...],
    bound: Float[np.ndarray, ""],
    beta: Float[np.ndarray, ""],
    start: Float[np.ndarray, " states"],
    order: Int[np.ndarray, " states"],
    region: Bool[np.ndarray, " states"],
    tolerance: Float[np.ndarray, ""],
) -> None:
    """Writes values and how they were found `into` the arrays of `Found`.

    `kind` and `tie` as in `Valuing`, `process` as in `given_from`, `bound` as in `_Asked`, `start` and `order` as in
    `WarmStart`, `region` as for `Solver.values`.
    """
    number = start.dtype.type
    valuing = Valuing(kind, number(beta), number(tie))
    asked = _Asked(given_from(process), valuing, number(bound), number(tolerance))
    found = Found(*into)
    if _anything_missing(asked):
        found.values[:] = np.nan
        write(found, order, Outcome(0, np.nan, False))
        return
    nothing = number(neg_inf(start.dtype))
    outcome = Outcome(0, np.inf, False)
    region = region if region.any() else np.ones_like(region)
    if (start > nothing).any():
        digits = -np.log10(max(asked.tolerance, np.finfo(start.dtype).eps))
        trusted = int(np.ceil(_TRUST * max(1.0, digits)))
        trusted = min(trusted, max_sweeps)
        outcome = _start_from(start, order, region, asked, trusted, _TRUSTED_ROUNDS * trusted, found)
    if not outcome.converged and outcome.sweeps < max_sweeps:
        # where values led astray, their order is no better
        cold, known_order = np.full_like(start, nothing), np.full_like(order, -1) if outcome.sweeps else order
        left = max_sweeps - outcome.sweeps
        again = _start_from(cold, known_order, np.ones_like(region), asked, left, left, found)
        outcome = again._replace(sweeps=outcome.sweeps + again.sweeps)
    write(found, found.order, outcome)


def _anything_missing(asked: _Asked) -> bool:
    """Whether anything is not a number."""
    given = asked.given
    parts = (
        given.probabilities,
        given.reward,
        given.terminal_reward,
        given.discount,
        asked.valuing.beta,
        asked.tolerance,
    )
    return any(np.isnan(np.min(part)) for part in parts)


def _start_from(
    start: Float[np.ndarray, " states"],
    order: Int[np.ndarray, " states"],
    region: Bool[np.ndarray, " states"],
    asked: _Asked,
    max_sweeps: int,
    max_rounds: int,
    found: Found,
) -> Outcome:
    """Solves from values and an order that may serve; writes down the values and the order that did."""
    position = positions(order)
    begun = _begin(start, order, position, asked) if position is not None else None
    if begun is None or begun.astray > _OUT_OF_ORDER * len(order):
        given = asked.given
        best = order_by_distance(
            given.successors, given.probabilities, given.reward, given.terminal, float(given.discount)
        )
        position = positions(best)
        assert position is not None
        begun = _begin(start, best, position, asked)
    everyone = np.arange(len(order), dtype=np.int32)
    which = everyone if region.all() else everyone[region[begun.order]]
    rounds = Rounds(
        begun.world, begun.values, begun.favourite, which, asked.valuing, asked.tolerance, max_sweeps, max_rounds
    )
    outcome = rounds.until_still()
    found.values[begun.order] = begun.values
    found.order[:] = begun.order
    return outcome


class _Begun(NamedTuple):
    """A task with its states numbered by an order, and first values for all of them.

    `favourite` is where each state wants to go by the values that it started from, the state itself where these are not
    known; `astray` says how many want to go to a farther one.
    """

    order: Int[np.ndarray, " states"]
    world: Numbered
    values: Float[np.ndarray, " states"]
    favourite: Int[np.ndarray, " states"]
    astray: int


def _begin(
    start: Float[np.ndarray, " states"],
    order: Int[np.ndarray, " states"],
    position: Int[np.ndarray, " states"],
    asked: _Asked,
) -> _Begun:
    given, bottom = asked.given, start.dtype.type(neg_inf(start.dtype))
    run = numbering_for(*sizes(given))
    world = numbered(run, given, order, position)
    values, fixed = start[order], np.flatnonzero(world.fixed)
    values[fixed] = np.broadcast_to(given.terminal_reward, start.shape)[order[fixed]]
    favourite = np.empty_like(order)
    astray = sum(
        shared_out(lambda begin, end: run.favourites(begin, end, world, values, bottom, favourite), len(order))
    )
    first_values_for(*world.moves.shape[1:])(asked.valuing, world, values, bottom, asked.bound)
    return _Begun(order, world, values, favourite, astray)
