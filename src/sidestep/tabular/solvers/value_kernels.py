"""A sweep: the own equations of states solved one after another by ascending distance, as machine code (numba).

The equations are those of `process`; what is different here is in which order they are used, and how often. `outwards`
says which states are swept when.

**Order.** States are numbered by their distance from where the task ends, so that a state's own equation is solved
after those of the states that it wants to go to. Where nobody ever turned back, one sweep would do.

**Shift.** People do turn back, a little: a state's value depends on its farther neighbours too, whose values are still
old. What changed near the goal is passed outwards, and changes all values that hang on it by about the same amount. So
as soon as a state is solved, the farther states whose favourite it is (where their best action leads) are moved by as
much as it has moved since the round over all states began; by the same share of the value where values fall with the
distance. At the fixed point nothing moves, and the equations are the old ones. A state that was worth more than the one
it would be moved with does not hang on it, whatever the order says: two that were moved by one another would lift
each other for ever.

**Work that is not done.** A state is left alone as long as neither it nor any of its neighbours has changed by more
than `still` since it was last solved. That is less than the tolerance, but it may add up; so it alone does not decide
when to stop.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from sidestep.tabular.solvers.compiled import compiled, inlined

HARD_MAX, BOLTZMANN, LOG_SUM_EXP, MELLOWMAX = range(4)
"""The backups that have machine code, by number."""

_SMALLEST_EXPONENT = -80.0
"""Odds of less than exp of this are lost in rounding."""

_NEWTON_STEPS, _FAR = 4, 0.1
"""How often a state's value is improved at most, and how large a step down (times β) asks for another."""

_FAST = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may do with sums and products; not to take NaN or infinity for impossible."""


class Valuing(NamedTuple):
    """A backup as the machine code knows it: its number, β, and the share of the best within which actions tie."""

    kind: int
    beta: np.floating
    tie: np.floating


class Marks(NamedTuple):
    """What the sweeps have done so far, by position.

    - `before`: the values when the present round over all states began.
    - `favourite`: where the best of the actions leads whose likeliest outcome is nearer; the state itself if none is.
    - `changed`: the sweep in which the value last changed by more than `still`.
    - `solved`: the sweep in which the state was last solved, or found to need no solving.
    """

    before: np.ndarray
    favourite: np.ndarray
    changed: np.ndarray
    solved: np.ndarray


class Scratch(NamedTuple):
    """Room for what a state's actions are worth, for the chances that they leave it, and for their advantages.

    numba does not count references to arrays that come in a tuple, and looks after those that come alone at every
    state, with instructions that cores cannot share.
    """

    worths: np.ndarray
    leaving: np.ndarray
    advantage: np.ndarray


@inlined(fastmath=_FAST)
def backed_up(valuing, scratch):  # pragma: no cover
    """B(A), and what the own equation is divided by: the larger of Σ w l and Σ π l (see `process`)."""
    kind, beta, tie = valuing.kind, valuing.beta, valuing.tie
    best = scratch.advantage[0]
    for a in range(1, len(scratch.advantage)):
        best = max(best, scratch.advantage[a])
    total = 0.0 * best
    below, left, both = total, total, total
    for a in range(len(scratch.advantage)):
        behind = scratch.advantage[a] - best
        if kind == HARD_MAX:
            odds = 1.0 if behind >= -tie * abs(best) else 0.0
        else:
            exponent = beta * behind
            odds = np.exp(exponent) if exponent > _SMALLEST_EXPONENT else 0.0
        total += odds
        below += odds * behind
        left += odds * scratch.leaving[a]
        both += odds * behind * scratch.leaving[a]
    share = 1 / total
    policy_left = left * share
    if kind == HARD_MAX:
        return best, policy_left
    if kind == BOLTZMANN:
        below *= share
        own_left = policy_left + beta * (both * share - below * policy_left)
        return best + below, max(own_left, policy_left)
    if kind == LOG_SUM_EXP:
        return best + np.log(total) / beta, policy_left
    # log mean exp, without adding 1 to what may be far smaller
    gained = 0.0 * best
    for a in range(len(scratch.advantage)):
        gained += np.expm1(beta * (scratch.advantage[a] - best))
    return best + np.log1p(gained / len(scratch.advantage)) / beta, policy_left


@inlined()
def _nothing_to_do(i, actions, width, successors, marks):  # pragma: no cover
    """Whether neither the state nor a neighbour has changed since the state was last solved."""
    at = marks.solved[i]
    nothing = marks.changed[i] != at
    for a in range(actions):
        for m in range(width):
            j = successors[i, a, m]
            nothing &= marks.changed[j] < at or (marks.changed[j] == at and j < i)
    return nothing


@inlined(fastmath=_FAST)
def _shifted(j, before, moved, size):  # pragma: no cover
    """The value of a farther state if it has moved by as much as one whose value was of this size."""
    old = before[j]
    return old + moved * min(abs(old) / size, 1.0) if size > 0 else old + moved


@inlined(fastmath=_FAST)
def _look_around(i, actions, width, world, values, marks, shifted, bottom, reached, scratch):  # pragma: no cover
    """Fills in what actions are worth; returns the escape, the largest worth's size, and the state's favourite."""
    row = i if len(world.reward) > 1 else 0
    before = marks.before
    moved, size_here = values[i] - before[i], abs(before[i])
    moves_along = values[i] > reached and before[i] > reached and moved != 0
    escape, best, size, favourite = bottom, bottom, 0.0 * bottom, i
    for a in range(actions):
        worth = world.reward[row, a]
        likeliest, toward = 0.0 * worth, i
        for m in range(width):
            j, move = world.successors[i, a, m], world.moves[i, a, m]
            value = values[j]
            if moves_along and j > i and j >= shifted and marks.favourite[j] >= i and reached < before[j] < before[i]:
                value = _shifted(j, before, moved, size_here)
            worth += move * value
            if move > likeliest:
                likeliest, toward = move, j
        scratch.worths[a] = worth
        size = max(size, abs(worth))
        tried = worth * world.patience[i, a] if world.patience[i, a] > 0 else bottom
        escape = max(escape, tried)
        nearer = tried if toward < i else bottom
        favourite = toward if nearer > best else favourite
        best = max(best, nearer)
    return escape, size, favourite


@inlined(fastmath=_FAST)
def _shift(i, actions, width, world, values, marks, shifted, reached):  # pragma: no cover
    """Moves the farther states whose favourite state i is by as much as it has moved in this round."""
    before = marks.before
    if values[i] > reached and before[i] > reached:
        for a in range(actions):
            for m in range(width):
                j = world.successors[i, a, m]
                if j > i and j >= shifted and marks.favourite[j] == i and reached < before[j] < before[i]:
                    values[j] = _shifted(j, before, values[i] - before[i], abs(before[i]))


@inlined(fastmath=_FAST)
def _solved(i, actions, width, world, valuing, guess, escape, reached, bottom, scratch):  # pragma: no cover
    """The value by the state's own equation: one Newton step from a guess (see `process`).

    A guess far above the root of the log-sum-exp ends below it, perhaps far below, where actions that never leave
    seemed to matter most; so from there it takes another step.
    """
    above = valuing.kind == LOG_SUM_EXP
    value = escape
    if guess > reached:
        value = max(guess, escape) if above else min(guess, escape)
    for a in range(actions):
        scratch.leaving[a] = world.ending
        for m in range(width):
            scratch.leaving[a] += world.moves[i, a, m]
    # without a break, out of which numba would count references again (see `Scratch`)
    again = True
    for _ in range(_NEWTON_STEPS):
        if again:
            for a in range(actions):
                scratch.advantage[a] = scratch.worths[a] - scratch.leaving[a] * value
            gain, divisor = backed_up(valuing, scratch)
            step = gain / (divisor if divisor > 0 else 1.0)
            value = max(value + step, escape) if above else max(min(value + step, escape), bottom)
            again = above and valuing.beta * step < -_FAR
    return value


@cache
def sweep_for(actions: int, width: int) -> Any:
    """The machine code of a sweep for that many actions and outcomes; as constants they make it twice as fast."""

    @compiled(fastmath=_FAST)
    def sweep(
        which, valuing, world, values, into, marks, number, first, shifted, everyone, still, bottom
    ):  # pragma: no cover
        """Solves the own equations of the states at the positions `which` (ascending), in sweep `number`.

        The new values go `into` an array: that of the values themselves if states are to see those solved before them.
        States with nothing to do are left out, unless `everyone` takes part. Values from the position `shifted` on are
        shifted; `first` is the first sweep of the present round over all states. Returns the largest relative change,
        NaN if any is, and how many states were solved.
        """
        scratch = Scratch(
            np.empty(actions, values.dtype), np.empty(actions, values.dtype), np.empty(actions, values.dtype)
        )
        changed, solved = marks.changed, marks.solved
        # below this lie values at discount 1 of states that cannot reach a terminal state
        reached = -np.sqrt(-bottom)
        smallest = np.finfo(values.dtype).tiny / still
        largest = 0.0 * bottom
        at_work = 0
        for index in range(len(which)):
            i = which[index]
            if world.fixed[i]:
                continue
            if not everyone and _nothing_to_do(i, actions, width, world.successors, marks):
                solved[i] = number
                continue
            at_work += 1
            escape, size, marks.favourite[i] = _look_around(
                i, actions, width, world, values, marks, shifted, bottom, reached, scratch
            )
            old, value = marks.before[i] if solved[i] < first else values[i], bottom
            if escape > reached:
                value = _solved(i, actions, width, world, valuing, values[i], escape, reached, bottom, scratch)
            change, scale = abs(value - old), max(abs(value), size, smallest)
            if not (old > reached or value > reached):
                change = 0.0 * bottom
            into[i] = value
            solved[i] = number
            if not change <= still * scale:
                changed[i] = number
                if shifted < len(values):
                    _shift(i, actions, width, world, values, marks, shifted, reached)
            if change > largest * scale or np.isnan(change):
                largest = change / scale
        return largest, at_work

    return sweep


@cache
def first_values_for(actions: int, width: int) -> Any:
    """The machine code of values to begin with, for that many actions and outcomes."""

    @compiled()
    def first_values(valuing, world, values, bottom, bound):  # pragma: no cover
        """Fills in values that are not known (`bottom`), by order: what the moves to nearer states make of a state.

        An action that does not lead to any counts as one that costs its price twice, there and back. Where nothing
        nearer is known the value is `bound`.
        """
        scratch = Scratch(
            np.empty(actions, values.dtype), np.empty(actions, values.dtype), np.empty(actions, values.dtype)
        )
        for i in range(len(values)):
            if world.fixed[i] or values[i] > bottom:
                continue
            value, reached = bound, False
            for a in range(actions):
                scratch.worths[a] = world.reward[i if len(world.reward) > 1 else 0, a]
                scratch.leaving[a] = world.ending
                for m in range(width):
                    j = world.successors[i, a, m]
                    if j < i and values[j] > bottom:
                        scratch.worths[a] += world.moves[i, a, m] * values[j]
                        scratch.leaving[a] += world.moves[i, a, m]
                if scratch.leaving[a] > world.ending:
                    escape = scratch.worths[a] / scratch.leaving[a]
                    value = max(value, escape) if reached else escape
                    reached = True
            if reached:
                for a in range(actions):
                    scratch.advantage[a] = scratch.worths[a] - scratch.leaving[a] * value
                    if not scratch.leaving[a] > world.ending:
                        scratch.advantage[a] += min(scratch.worths[a], 0.0)
                gain, divisor = backed_up(valuing, scratch)
                value += gain / (divisor if divisor > 0 else 1.0)
            values[i] = value

    return first_values
