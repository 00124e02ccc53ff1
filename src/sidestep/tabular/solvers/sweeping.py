"""Sweeps in the order of distance from the goal, one state after another, as machine code (numba).

The equations are those of `process`; what is different here is in which order they are used, and how often.

**Order.** States are numbered by their distance from where the task ends, so that a state's own equation is solved after
those of the states that it wants to go to. Where nobody ever turned back, one sweep would do.

**Shift.** People do turn back, a little: a state's value depends on its farther neighbours too, whose values are still
old. All values far out change by about the same amount from one sweep to the next, because what changed near the goal
is passed outwards. So where a state wants to go to a nearer neighbour, the farther ones are first moved by as much as that one has just
moved, or by the same share where values fall with the distance. At the fixed point nothing moves and the equations are the old ones.

**Work that is not done.** A state is left alone as long as neither it nor any of its neighbours has changed by more
than the tolerance since it was last solved. That alone does not decide when to stop (see `ordered`).
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit

HARD_MAX, BOLTZMANN, LOG_SUM_EXP, MELLOWMAX = range(4)
"""The backups that have machine code, by number."""

_SMALLEST_EXPONENT = -80.0
"""Odds of less than exp of this are lost in rounding."""


class Numbered(NamedTuple):
    """A task under a model with its states numbered by their distance; self-loops left out.

    - `successors`: where the outcomes that leave a state lead; padded with the state itself.
    - `moves`: γP of these outcomes, 0 for the padding.
    - `patience`: 1/(1 − γp), p the probability of staying: for how long an action is tried; 0 where that is for ever.
    - `reward`: R(s, a), with one row if it is the same in all states.
    - `fixed`: the terminal states.
    - `ending`: 1 − γ.
    """

    successors: np.ndarray
    moves: np.ndarray
    patience: np.ndarray
    reward: np.ndarray
    fixed: np.ndarray
    ending: float


class Marks(NamedTuple):
    """What the sweeps have done so far.

    - `before`: the values when the states were last begun with, nearest first.
    - `changed`: the sweep in which it last changed by more than the tolerance; `solved`: in which it was last solved.
    """

    before: np.ndarray
    changed: np.ndarray
    solved: np.ndarray


class Sweeping(NamedTuple):
    """The machine code for one number of actions, of outcomes, and of outcomes that leave a state."""

    number_states: Any
    first_values: Any
    out_of_order: Any
    sweep: Any


@njit(nogil=True, error_model="numpy", inline="always", fastmath={"contract", "reassoc", "nsz", "arcp"})
def _backed_up(kind, beta, tie, advantage, leaving):  # pragma: no cover
    """B(A), and what the own equation is divided by: the larger of Σ w l and Σ π l (see `process`)."""
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
    gained = 0.0 * best
    for a in range(len(advantage)):
        gained += np.expm1(beta * (advantage[a] - best))
    return best + np.log1p(gained / len(advantage)) / beta, policy_left


@cache
def sweeping_for(actions: int, outcomes: int, width: int) -> Sweeping:
    """The machine code for that many; as constants they make it twice as fast."""

    @njit(nogil=True, cache=True, error_model="numpy")
    def number_states(order, position, successors, probabilities, terminal, discount, world):  # pragma: no cover
        """Fills in `world` with the states taken in `order`."""
        for i in range(len(order)):
            state = order[i]
            world.fixed[i] = terminal[state]
            for a in range(actions):
                leaving = world.ending
                m = 0
                for k in range(outcomes):
                    after = successors[state, a, k]
                    if after != state:
                        move = discount * probabilities[state, a, k]
                        world.successors[i, a, m] = position[after]
                        world.moves[i, a, m] = move
                        leaving += move
                        m += 1
                for padding in range(m, width):
                    world.successors[i, a, padding] = i
                    world.moves[i, a, padding] = 0
                world.patience[i, a] = 1 / leaving if leaving > 0 else 0.0

    @njit(nogil=True, cache=True, error_model="numpy")
    def first_values(world, values, bottom, bound):  # pragma: no cover
        """Fills in values that are not known (`bottom`): of the best action tried until it leads nearer, by order."""
        for i in range(len(values)):
            if world.fixed[i] or values[i] > bottom:
                continue
            best = bound
            for a in range(actions):
                worth = world.reward[i if len(world.reward) > 1 else 0, a]
                leaving = world.ending
                for m in range(width):
                    j = world.successors[i, a, m]
                    if j < i and values[j] > bottom:
                        worth += world.moves[i, a, m] * values[j]
                        leaving += world.moves[i, a, m]
                if leaving > world.ending:
                    best = max(best, worth / leaving)
            values[i] = best

    @njit(nogil=True, cache=True, error_model="numpy")
    def out_of_order(world, values, bottom):  # pragma: no cover
        """How many states want to go to a farther one, by values that are known."""
        count = 0
        for i in range(len(values)):
            best, leads_to = bottom, i
            for a in range(actions):
                for m in range(width):
                    j = world.successors[i, a, m]
                    move = world.moves[i, a, m]
                    worth = values[j] + world.reward[i if len(world.reward) > 1 else 0, a] / move
                    if move > 0 and worth > best:
                        best, leads_to = worth, j
            count += leads_to > i and not world.fixed[i]
        return count

    @njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
    def sweep(which, kind, beta, tie, world, values, marks, number, first, shifted, all_of_them, still, bottom):
        """Solves the own equations of the states `which`, by ascending position.

        Of those, it leaves out (unless `all_of_them`) the states with nothing to do: neither they nor their neighbours
        have changed by more than `still` since. `first` is the first of the sweeps since all states were last begun with, `shifted` the first position that is shifted.
        Returns the largest relative change, and how many states it worked at.
        """
        worths, beyond = np.empty(actions, values.dtype), np.empty(actions, values.dtype)
        leaving, advantage = np.empty(actions, values.dtype), np.empty(actions, values.dtype)
        successors, moves = world.successors, world.moves
        before, changed, solved = marks.before, marks.changed, marks.solved
        # below this lie values at discount 1 of states that cannot reach a terminal state
        reached = -np.sqrt(-bottom)
        above = kind == LOG_SUM_EXP
        smallest = np.finfo(values.dtype).tiny / still
        largest = 0.0 * beta
        at_work = 0
        for index in range(len(which)):
            i = which[index]
            if world.fixed[i]:
                continue
            if not all_of_them:
                idle = changed[i] != solved[i]
                for a in range(actions):
                    for m in range(width):
                        j = successors[i, a, m]
                        idle &= changed[j] < solved[i] or (changed[j] == solved[i] and j < i)
                if idle:
                    solved[i] = number
                    continue
            at_work += 1
            row = i if len(world.reward) > 1 else 0
            old = values[i]
            best, leads_to = bottom, i
            for a in range(actions):
                worth = world.reward[row, a]
                farther, likeliest, toward = 0.0 * beta, 0.0 * beta, i
                for m in range(width):
                    j, move = successors[i, a, m], moves[i, a, m]
                    worth += move * values[j]
                    if j >= shifted and j > i and solved[j] < first:
                        farther += move
                    if move > likeliest:
                        likeliest, toward = move, j
                worths[a], beyond[a] = worth, farther
                if worth * world.patience[i, a] > best:
                    best, leads_to = worth * world.patience[i, a], toward
            shift = 0.0 * beta
            if solved[leads_to] >= first and values[leads_to] > reached and before[leads_to] > reached:
                shift = values[leads_to] - before[leads_to]
                if abs(old) < abs(values[leads_to]):
                    shift *= abs(old) / abs(values[leads_to])
            escape = bottom
            size = 0.0 * beta
            for a in range(actions):
                worths[a] += shift * beyond[a]
                size = max(size, abs(worths[a]))
                if world.patience[i, a] > 0:
                    escape = max(escape, worths[a] * world.patience[i, a])
            value = bottom
            if escape > reached:
                value = escape
                if old > reached:
                    first_guess = old + shift if solved[i] < first else old
                    value = max(first_guess, escape) if above else min(first_guess, escape)
                for a in range(actions):
                    leaving[a] = world.ending
                    for m in range(width):
                        leaving[a] += moves[i, a, m]
                    advantage[a] = worths[a] - leaving[a] * value
                gain, divisor = _backed_up(kind, beta, tie, advantage, leaving)
                value += gain / (divisor if divisor > 0 else 1.0)
                value = max(value, escape) if above else max(min(value, escape), bottom)
            change = 0.0 * beta
            if old > reached or value > reached:
                change = abs(value - old) / max(abs(value), size, smallest)
            values[i] = value
            solved[i] = number
            if not change <= still:
                changed[i] = number
            if not change <= largest:
                largest = change
        return largest, at_work

    return Sweeping(number_states, first_values, out_of_order, sweep)
