"""A sweep: the own equations of states solved one after another by ascending distance, as machine code (numba).

The equations are those of `process`; what is different here is in which order they are used, and how often. `outwards`
says which states are swept when.

**Order.** States are numbered by their distance from where the task ends, so that a state's own equation is solved
after those of the states that it wants to go to. Where nobody ever turned back, one sweep would do.

**Shift.** People do turn back, a little: a state's value depends on its farther neighbours too, whose values are still
old. All values far out change by about the same amount, because what changed near the goal is passed outwards. So
farther neighbours that have not been solved yet are first moved by as much as the state's favourite nearer neighbour
has moved since the round over all states began; by the same share of the value where values fall with the distance. At
the fixed point nothing moves, and the equations are the old ones.

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
    - `changed`: the sweep in which the value last changed by more than `still`.
    - `solved`: the sweep in which the state was last solved, or found to need no solving.
    """

    before: np.ndarray
    changed: np.ndarray
    solved: np.ndarray


@inlined(fastmath=_FAST)
def backed_up(valuing, advantage, leaving):  # pragma: no cover
    """B(A), and what the own equation is divided by: the larger of Σ w l and Σ π l (see `process`)."""
    kind, beta, tie = valuing.kind, valuing.beta, valuing.tie
    best = advantage[0]
    for a in range(1, len(advantage)):
        best = max(best, advantage[a])
    total = 0.0 * best
    below, left, both = total, total, total
    for a in range(len(advantage)):
        behind = advantage[a] - best
        if kind == HARD_MAX:
            odds = 1.0 if behind >= -tie * abs(best) else 0.0
        else:
            exponent = beta * behind
            odds = np.exp(exponent) if exponent > _SMALLEST_EXPONENT else 0.0
        total += odds
        below += odds * behind
        left += odds * leaving[a]
        both += odds * behind * leaving[a]
    policy_left = left / total
    if kind == HARD_MAX:
        return best, policy_left
    if kind == BOLTZMANN:
        below /= total
        own_left = policy_left + beta * (both / total - below * policy_left)
        return best + below, max(own_left, policy_left)
    if kind == LOG_SUM_EXP:
        return best + np.log(total) / beta, policy_left
    # log mean exp, without adding 1 to what may be far smaller
    gained = 0.0 * best
    for a in range(len(advantage)):
        gained += np.expm1(beta * (advantage[a] - best))
    return best + np.log1p(gained / len(advantage)) / beta, policy_left


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
def _look_around(i, actions, width, world, values, solved, first, shifted, bottom, worths, beyond):  # pragma: no cover
    """Fills in what actions are worth, and their chance of leading to where values are to be shifted.

    Returns where the best of the actions leads whose likeliest outcome has been solved in this round.
    """
    row = i if len(world.reward) > 1 else 0
    best, leads_to = bottom, i
    for a in range(actions):
        worth = world.reward[row, a]
        farther, likeliest, toward = 0.0 * worth, 0.0 * worth, i
        for m in range(width):
            j, move = world.successors[i, a, m], world.moves[i, a, m]
            worth += move * values[j]
            if j >= shifted and j > i and solved[j] < first:
                farther += move
            if move > likeliest:
                likeliest, toward = move, j
        worths[a], beyond[a] = worth, farther
        if solved[toward] >= first and worth * world.patience[i, a] > best:
            best, leads_to = worth * world.patience[i, a], toward
    return leads_to


@inlined(fastmath=_FAST)
def _shift(i, leads_to, values, marks, first, reached):  # pragma: no cover
    """By how much the values beyond a state are to be moved, from how the neighbour `leads_to` has moved."""
    new, before = values[leads_to], marks.before[leads_to]
    moved = 0.0 * new
    if marks.solved[leads_to] >= first and new > reached and before > reached:
        moved = new - before
        if abs(values[i]) < abs(new):
            moved *= abs(values[i]) / abs(new)
    return moved


@inlined(fastmath=_FAST)
def _solved(
    i, actions, width, world, valuing, guess, escape, reached, bottom, worths, leaving, advantage
):  # pragma: no cover
    """The value by the state's own equation: one Newton step from a guess (see `process`)."""
    above = valuing.kind == LOG_SUM_EXP
    value = escape
    if guess > reached:
        value = max(guess, escape) if above else min(guess, escape)
    for a in range(actions):
        leaving[a] = world.ending
        for m in range(width):
            leaving[a] += world.moves[i, a, m]
        advantage[a] = worths[a] - leaving[a] * value
    gain, divisor = backed_up(valuing, advantage, leaving)
    value += gain / (divisor if divisor > 0 else 1.0)
    return max(value, escape) if above else max(min(value, escape), bottom)


@cache
def sweep_for(actions: int, width: int) -> Any:
    """The machine code of a sweep for that many actions and outcomes; as constants they make it twice as fast."""

    @compiled(fastmath=_FAST)
    def sweep(
        which, valuing, world, values, marks, number, first, shifted, everyone, still, bottom
    ):  # pragma: no cover
        """Solves the own equations of the states at the positions `which` (ascending), in sweep `number`.

        Those with nothing to do are left out, unless `everyone` takes part. Values from the position `shifted` on are
        shifted; `first` is the first sweep of the present round over all states. Returns the largest relative change,
        NaN if any is, and how many states were solved.
        """
        worths, beyond = np.empty(actions, values.dtype), np.empty(actions, values.dtype)
        leaving, advantage = np.empty(actions, values.dtype), np.empty(actions, values.dtype)
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
            leads_to = _look_around(i, actions, width, world, values, solved, first, shifted, bottom, worths, beyond)
            shift = _shift(i, leads_to, values, marks, first, reached)
            escape, size = bottom, 0.0 * bottom
            for a in range(actions):
                worths[a] += shift * beyond[a]
                size = max(size, abs(worths[a]))
                if world.patience[i, a] > 0:
                    escape = max(escape, worths[a] * world.patience[i, a])
            old, value = values[i], bottom
            if escape > reached:
                guess = old
                if old > reached and solved[i] < first:
                    guess += shift
                value = _solved(
                    i, actions, width, world, valuing, guess, escape, reached, bottom, worths, leaving, advantage
                )
            change = 0.0 * bottom
            if old > reached or value > reached:
                change = abs(value - old) / max(abs(value), size, smallest)
            values[i] = value
            solved[i] = number
            if not change <= still:
                changed[i] = number
            if change > largest or np.isnan(change):
                largest = change
        return largest, at_work

    return sweep
