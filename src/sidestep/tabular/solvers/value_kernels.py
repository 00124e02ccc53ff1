"""The sweeps of Gauss–Seidel value iteration over states numbered by distance, as native code (numba).

The equations are those of `base`. The classical sweep (Bertsekas, *Dynamic Programming and Optimal Control*, vol. II,
2012) replaces one value after another by its backup. This one differs:

1. States come by their distance from where the task ends, so that a state comes after those that its best actions lead
   to. If no action led farther, one sweep would do.
2. A state's own equation is solved, by a Newton step, with its neighbors' values held (see `base`).
3. Values of farther states are **shifted**. A state's value depends on its farther neighbors too, and these are still
   old. What changed near the goal changes all values that depend on it by about the same amount. So as soon as a state
   is solved, the farther states of which it is the greedy successor move by as much as it has moved since the round
   over all states began; in proportion to the value where values fall with the distance. At the fixed point nothing
   moves, so the equations are the old ones. A state that was worth more than its greedy successor is not moved: two
   that are moved by each other would rise for ever.
4. A state is **skipped** as long as neither it nor a neighbor has changed by more than a threshold since it was last
   solved. The threshold is less than the tolerance, but what is skipped may add up. So a last sweep without skips
   decides when to stop (see `sweep_loop`).
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from sidestep.tabular.solvers.native import BOLTZMANN, HARD_MAX, LOG_SUM_EXP, NativeFunction, compiled, inlined

_SMALLEST_EXPONENT = -80.0
"""Weights below exp of this are lost in rounding."""

_NEWTON_STEPS, _LONG_STEP = 4, 0.1
"""The most Newton steps on a state's value, and the step down (times β) beyond which another follows."""

_FAST = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may do with sums and products; it may not assume that NaN and infinity are impossible."""


class SweepHistory(NamedTuple):
    """What the sweeps have done so far, by position.

    Attributes:
        round_start: The values when the present round over all states began.
        greedy_successor: The successor of the best of the actions that most likely lead nearer; the state itself if
            there is none.
        last_changed: The sweep in which the value last changed by more than the threshold.
        last_solved: The sweep in which the state was last solved, or skipped.
    """

    round_start: np.ndarray
    greedy_successor: np.ndarray
    last_changed: np.ndarray
    last_solved: np.ndarray


class Scratch(NamedTuple):
    """Memory for a state's c(a), l(a) and advantages A(a) (see `base`).

    numba does not count references to arrays in a tuple. Arrays by themselves it counts at every state, with atomic
    instructions that keep cores waiting.
    """

    exit_values: np.ndarray
    exit_weights: np.ndarray
    advantages: np.ndarray


@inlined(fastmath=_FAST)
def backed_up(backup, count, scratch):  # pragma: no cover
    """Return B(A) and the divisor of the Newton step, the larger of Σ w l and Σ π l (see `base`).

    A is −∞ for actions that are never taken; `count` is the number of available ones.
    """
    kind, beta, tie = backup.kind, backup.beta, backup.tie
    best = scratch.advantages[0]
    for a in range(1, len(scratch.advantages)):
        best = max(best, scratch.advantages[a])
    total = 0.0 * best
    below, exits, product = total, total, total
    for a in range(len(scratch.advantages)):
        difference = scratch.advantages[a] - best
        if kind == HARD_MAX:
            weight = 1.0 if difference >= -tie * abs(best) else 0.0
        else:
            exponent = beta * difference
            weight = np.exp(exponent) if exponent > _SMALLEST_EXPONENT else 0.0
        if weight > 0:
            total += weight
            below += weight * difference
            exits += weight * scratch.exit_weights[a]
            product += weight * difference * scratch.exit_weights[a]
    scale = 1 / total
    policy_exit = exits * scale
    if kind == HARD_MAX:
        return best, policy_exit
    if kind == BOLTZMANN:
        below *= scale
        exact_exit = policy_exit + beta * (product * scale - below * policy_exit)
        return best + below, max(exact_exit, policy_exit)
    if kind == LOG_SUM_EXP:
        return best + np.log(total) / beta, policy_exit
    # log mean exp, without adding 1 to what may be far smaller
    excess = 0.0 * best
    for a in range(len(scratch.advantages)):
        excess += np.expm1(beta * (scratch.advantages[a] - best))
    # those that are not available have added −1 each
    excess += len(scratch.advantages) - count
    return best + np.log1p(excess / count) / beta, policy_exit


@inlined()
def _is_up_to_date(i, actions, width, successors, history):  # pragma: no cover
    """Return whether neither the state nor a neighbor has changed since the state was last solved."""
    at = history.last_solved[i]
    unchanged = history.last_changed[i] != at
    for a in range(actions):
        for m in range(width):
            j = successors[i, a, m]
            unchanged &= history.last_changed[j] < at or (history.last_changed[j] == at and j < i)
    return unchanged


@inlined(fastmath=_FAST)
def _shifted_value(j, round_start, moved, size):  # pragma: no cover
    """Return the value of a farther state moved along with one that has `moved` and was of this size."""
    old = round_start[j]
    return old + moved * min(abs(old) / size, 1.0) if size > 0 else old + moved


@inlined(fastmath=_FAST)
def _fill_exit_values(i, actions, width, process, values, history, shift_from, scratch):  # pragma: no cover
    """Fill in c(a); return the repeat-action value, the largest |c(a)|, and the greedy successor."""
    row = i if len(process.reward) > 1 else 0
    start = history.round_start
    moved, size_here = values[i] - start[i], abs(start[i])
    shifts = moved != 0
    nothing = 0.0 * size_here
    repeat_value, best, size, greedy_successor = nothing - np.inf, nothing - np.inf, nothing, i
    for a in range(actions):
        exit_value = process.reward[row, a]
        likeliest, toward = 0.0 * exit_value, i
        for m in range(width):
            j, move = process.successors[i, a, m], process.discounted_probs[i, a, m]
            value = values[j]
            farther = shifts and j > i and j >= shift_from
            if farther and history.greedy_successor[j] >= i and start[j] < start[i]:
                value = _shifted_value(j, start, moved, size_here)
            exit_value += move * value
            if move > likeliest:
                likeliest, toward = move, j
        scratch.exit_values[a] = exit_value
        if exit_value > -np.inf or np.isnan(exit_value):
            size = max(size, abs(exit_value))
            if process.self_loop_factor[i, a] > 0:
                repeated = exit_value * process.self_loop_factor[i, a]
                repeat_value = max(repeat_value, repeated)
                if toward < i and repeated > best:
                    best, greedy_successor = repeated, toward
    return repeat_value, size, greedy_successor


@inlined(fastmath=_FAST)
def _shift_farther(i, actions, width, process, values, history, shift_from):  # pragma: no cover
    """Move the farther states of which state i is the greedy successor along with it."""
    start = history.round_start
    for a in range(actions):
        for m in range(width):
            j = process.successors[i, a, m]
            farther = j > i and j >= shift_from
            if farther and history.greedy_successor[j] == i and start[j] < start[i]:
                values[j] = _shifted_value(j, start, values[i] - start[i], abs(start[i]))


@inlined(fastmath=_FAST)
def _solve_state(i, actions, width, process, backup, guess, repeat_value, scratch):  # pragma: no cover
    """Return the root of the state's own equation; c(a) is in the scratch already."""
    for a in range(actions):
        scratch.exit_weights[a] = process.one_minus_discount
        for m in range(width):
            scratch.exit_weights[a] += process.discounted_probs[i, a, m]
    count = process.choosable[i if len(process.choosable) > 1 else 0]
    return own_root(actions, backup, count, guess, repeat_value, scratch)


@inlined(fastmath=_FAST)
def own_root(actions, backup, count, guess, repeat_value, scratch):  # pragma: no cover
    """Return the root of a state's own equation, by one Newton step from a guess (see `base`).

    For the log-sum-exp, a step from far above the root ends below it, perhaps far below, where actions that never leave
    seemed to matter most; so another step follows.
    """
    above = backup.kind == LOG_SUM_EXP
    value = max(guess, repeat_value) if above else min(guess, repeat_value)
    # a break would make numba count references again (see `Scratch`)
    again = True
    for _ in range(_NEWTON_STEPS):
        if again:
            for a in range(actions):
                scratch.advantages[a] = scratch.exit_values[a] - scratch.exit_weights[a] * value
            gain, divisor = backed_up(backup, count, scratch)
            step = gain / (divisor if divisor > 0 else 1.0)
            value = max(value + step, repeat_value) if above else min(value + step, repeat_value)
            again = above and backup.beta * step < -_LONG_STEP
    return value


@cache
def sweep_kernel(actions: int, width: int) -> NativeFunction:
    """Return the native code of a sweep for these numbers; as constants they make it twice as fast."""

    @compiled(fastmath=_FAST)
    def sweep(
        positions, backup, process, values, into, history, number, round_first, shift_from, solve_all, skip
    ):  # pragma: no cover
        """Solve the own equations of the states at ascending positions.

        Args:
            positions: The states.
            backup: `NativeBackup`.
            process: `NumberedProcess`.
            values: The values by position.
            into: The array of the new values: `values` itself for states to see those solved before them.
            history: `SweepHistory`.
            number: The sweep's number.
            round_first: The number of the first sweep of the present round over all states.
            shift_from: Values from this position on are shifted.
            solve_all: Whether no state is skipped.
            skip: The relative change that counts as none.

        Returns:
            The largest relative change, NaN if any is, and the number of states that were solved.
        """
        dtype = values.dtype
        scratch = Scratch(np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype))
        last_changed, last_solved = history.last_changed, history.last_solved
        smallest = np.finfo(values.dtype).tiny / skip
        largest = 0.0 * process.one_minus_discount
        solved = 0
        for index in range(len(positions)):
            i = positions[index]
            if process.terminal[i]:
                continue
            if not solve_all and _is_up_to_date(i, actions, width, process.successors, history):
                last_solved[i] = number
                continue
            solved += 1
            repeat_value, size, history.greedy_successor[i] = _fill_exit_values(
                i, actions, width, process, values, history, shift_from, scratch
            )
            old = history.round_start[i] if last_solved[i] < round_first else values[i]
            value = _solve_state(i, actions, width, process, backup, values[i], repeat_value, scratch)
            change, scale = abs(value - old), max(abs(value), size, smallest)
            into[i] = value
            last_solved[i] = number
            if not change <= skip * scale:
                last_changed[i] = number
                if shift_from < len(values):
                    _shift_farther(i, actions, width, process, values, history, shift_from)
            if change > largest * scale or np.isnan(change):
                largest = change / scale
        return largest, solved

    return sweep


@cache
def first_values_kernel(actions: int, width: int) -> NativeFunction:
    """Return the native code of first values for these numbers."""

    @compiled()
    def first_values(backup, process, values, bound):  # pragma: no cover
        """Fill in unknown values (−∞), nearest first, by the moves to nearer states.

        An action that leads to none counts as one that costs its price twice, there and back. Where no nearer state is
        known the value is `bound`.
        """
        dtype = values.dtype
        scratch = Scratch(np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype))
        for i in range(len(values)):
            if process.terminal[i] or values[i] > -np.inf:
                continue
            value, is_known = bound, False
            for a in range(actions):
                scratch.exit_values[a] = process.reward[i if len(process.reward) > 1 else 0, a]
                scratch.exit_weights[a] = process.one_minus_discount
                for m in range(width):
                    j = process.successors[i, a, m]
                    if j < i and process.discounted_probs[i, a, m] > 0 and values[j] > -np.inf:
                        scratch.exit_values[a] += process.discounted_probs[i, a, m] * values[j]
                        scratch.exit_weights[a] += process.discounted_probs[i, a, m]
                if scratch.exit_weights[a] > process.one_minus_discount and scratch.exit_values[a] > -np.inf:
                    repeat_value = scratch.exit_values[a] / scratch.exit_weights[a]
                    value = max(value, repeat_value) if is_known else repeat_value
                    is_known = True
            if is_known:
                for a in range(actions):
                    scratch.advantages[a] = scratch.exit_values[a] - scratch.exit_weights[a] * value
                    if not scratch.exit_weights[a] > process.one_minus_discount:
                        scratch.advantages[a] += min(scratch.exit_values[a], 0.0)
                count = process.choosable[i if len(process.choosable) > 1 else 0]
                gain, divisor = backed_up(backup, count, scratch)
                value += gain / (divisor if divisor > 0 else 1.0)
            values[i] = value

    return first_values
