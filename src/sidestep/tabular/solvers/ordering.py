"""Orders of the states by distance from where a task ends, and the task with its states numbered in an order.

The distance of a state is the least expected cost of a path to a terminal state, each move repeated until it succeeds
(Dijkstra, 1959, by SciPy). A move with probability p costs, with discount γ and reward R,

    max(0, −R) / p  +  log((1 − γ + γp) / γp):

the expected cost of its repetitions, and by how much the discount shrinks what comes after them. Any order gives the
same values; a good one gives them in fewer sweeps (prioritized sweeping with a fixed order). With the states numbered
in the order of the sweep, what a sweep reads lies close together in memory.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from sidestep.tabular.solvers.native import HostProcess, NativeFunction, compiled, inlined, map_ranges


def order_by_distance(
    process: HostProcess, finite: Bool[np.ndarray, " states"] | None = None
) -> Int[np.ndarray, " states"]:
    """Return the states, nearest first; those from which no terminal state can be reached come last.

    Without a terminal state they keep their numbers.

    Args:
        process: The task under a model.
        finite: Whether each state has a finite value; actions that may lead to the others are not taken.
    """
    finite = np.ones_like(process.terminal) if finite is None else finite
    if not process.terminal.any():
        return np.arange(len(process.successors), dtype=np.int32)
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    row_starts, sources, costs = _edges_into_states(
        process.successors, process.probabilities, process.reward, float(process.discount), process.available, finite
    )
    edges = csr_array((costs, sources, row_starts), shape=(len(process.successors), len(process.successors)))
    ends = np.flatnonzero(process.terminal)
    distance = dijkstra(edges, indices=ends[0]) if len(ends) == 1 else dijkstra(edges, indices=ends, min_only=True)
    return np.argsort(distance, kind="stable").astype(np.int32)


@inlined()
def is_usable(state, a, successors, probabilities, available, finite):  # pragma: no cover
    """Return whether an action is available, and surely leads to states with finite values."""
    usable = available[state if available.shape[0] > 1 else 0, a if available.shape[1] > 1 else 0]
    for k in range(successors.shape[2]):
        usable &= finite[successors[state, a, k]] or not probabilities[state, a, k] > 0
    return usable


@compiled()
def _edges_into_states(successors, probabilities, reward, discount, available, finite):  # pragma: no cover
    """Return the moves into each state as a sparse matrix: where a row starts, the moves' sources, their costs."""
    states, actions, outcomes = successors.shape
    first, usable = np.zeros(states + 2, np.int32), np.empty((states, actions), np.bool_)
    for state in range(states):
        for a in range(actions):
            usable[state, a] = is_usable(state, a, successors, probabilities, available, finite)
            for k in range(outcomes):
                if usable[state, a] and successors[state, a, k] != state and probabilities[state, a, k] > 0:
                    first[successors[state, a, k] + 2] += 1
    for state in range(states):
        first[state + 2] += first[state + 1]
    sources, costs = np.empty(first[-1], np.int32), np.empty(first[-1], np.float64)
    for state in range(states):
        for a in range(actions):
            price = max(-reward[state if reward.shape[0] > 1 else 0, a if reward.shape[1] > 1 else 0], 0.0)
            for k in range(outcomes):
                after, chance = successors[state, a, k], probabilities[state, a, k]
                if usable[state, a] and after != state and chance > 0:
                    sources[first[after + 1]] = state
                    cost = price / chance + np.log1p((1 - discount) / (discount * chance))
                    # an edge without cost would not be one, nor one that costs infinitely much
                    costs[first[after + 1]] = min(max(cost, 1e-300), 1e300)
                    first[after + 1] += 1
    return first[:-1], sources, costs


class NumberedProcess(NamedTuple):
    """A task under a model with its states numbered in an order, without self-loops.

    Attributes:
        successors: The states that possible outcomes lead to which leave their state; padded with the state itself.
        discounted_probs: γP of these outcomes, 0 for the padding.
        self_loop_factor: 1/(1 − γp), p the probability of staying: the discounted number of times that an action is
            taken which is repeated until it succeeds; 0 where that is for ever.
        reward: R(s, a), with one row if it is the same in all states; −∞ for actions that are never taken.
        choosable: The number of available actions, with one entry if it is the same in all states.
        terminal: Whether there is nothing to solve: a state is terminal, or has no finite value.
        one_minus_discount: 1 − γ.
        bandwidth: The largest difference between the positions of a state and of one of its successors.
    """

    successors: np.ndarray
    discounted_probs: np.ndarray
    self_loop_factor: np.ndarray
    reward: np.ndarray
    choosable: np.ndarray
    terminal: np.ndarray
    one_minus_discount: np.floating
    bandwidth: int


class NumberingKernels(NamedTuple):
    """The native code for one number of actions, of outcomes, and of outcomes that leave a state (`width`)."""

    width: int
    number_states: NativeFunction
    greedy_successors: NativeFunction


def number_process(
    process: HostProcess,
    order: Int[np.ndarray, " states"],
    position: Int[np.ndarray, " states"],
    finite: Bool[np.ndarray, " states"],
) -> tuple[NumberedProcess, NumberingKernels]:
    """Return the process numbered in an order, and the native code for it; `position` is the order's inverse."""
    kernels = numbering_kernels(*process.kernel_sizes())
    states, actions, _ = process.successors.shape
    dtype = process.probabilities.dtype
    successors = np.empty((states, actions, kernels.width), np.int32)
    probs, self_loop_factor = np.empty(successors.shape, dtype), np.empty((states, actions), dtype)
    available = np.broadcast_to(process.available, (len(process.available), actions))
    choosable = available.sum(axis=1, dtype=np.int32)
    choosable = choosable[order] if len(choosable) > 1 else choosable
    reward, terminal = np.broadcast_to(process.reward, (len(process.reward), actions)), np.empty(states, bool)
    if not (available.all() and finite.all()):
        reward = np.where(
            _usable_actions(process.successors, process.probabilities, available, finite), reward, -np.inf
        )
        reward = reward.astype(dtype)
    reward = np.ascontiguousarray(reward[order] if len(reward) > 1 else reward)
    reward.flags.writeable = False  # as where it has one row: numba compiles once for each kind of array
    one_minus_discount = 1 - process.discount
    rest = self_loop_factor, reward, choosable, terminal, one_minus_discount
    numbered = NumberedProcess(successors, probs, *rest, bandwidth=0)
    arrays = (order, position, finite, process, numbered)
    bandwidth = max(map_ranges(lambda begin, end: kernels.number_states(begin, end, *arrays), states))
    return numbered._replace(bandwidth=bandwidth), kernels


@compiled()
def _usable_actions(successors, probabilities, available, finite):  # pragma: no cover
    usable = np.empty(successors.shape[:2], np.bool_)
    for state in range(len(successors)):
        for a in range(successors.shape[1]):
            usable[state, a] = is_usable(state, a, successors, probabilities, available, finite)
    return usable


@cache
def numbering_kernels(actions: int, outcomes: int, width: int) -> NumberingKernels:
    """Return the native code for these numbers; as constants they make it twice as fast."""

    @compiled()
    def number_states(begin, end, order, position, finite, process, numbered):  # pragma: no cover
        """Fill in `numbered` for a range of positions; return their bandwidth."""
        bandwidth = 0
        for i in range(begin, end):
            state = order[i]
            numbered.terminal[i] = process.terminal[state] or not finite[state]
            for a in range(actions):
                exit_weight = numbered.one_minus_discount
                m = 0
                for k in range(outcomes):
                    after = process.successors[state, a, k]
                    move = process.discount * process.probabilities[state, a, k]
                    # an impossible outcome may lead to a state without a finite value
                    if after != state and move > 0:
                        numbered.successors[i, a, m] = position[after]
                        bandwidth = max(bandwidth, abs(position[after] - i))
                        numbered.discounted_probs[i, a, m] = move
                        exit_weight += move
                        m += 1
                for padding in range(m, width):
                    numbered.successors[i, a, padding] = i
                    numbered.discounted_probs[i, a, padding] = 0
                numbered.self_loop_factor[i, a] = 1 / exit_weight if exit_weight > 0 else 0.0
        return bandwidth

    @compiled()
    def greedy_successors(begin, end, numbered, values, greedy_successor):  # pragma: no cover
        """Fill in the best successor of states by known values; return how many are farther than their state."""
        count = 0
        for i in range(begin, end):
            best, leads_to = -np.inf, i
            for a in range(actions):
                for m in range(width):
                    j = numbered.successors[i, a, m]
                    move = numbered.discounted_probs[i, a, m]
                    if move > 0:
                        worth = values[j] + numbered.reward[i if len(numbered.reward) > 1 else 0, a] / move
                        if worth > best:
                            best, leads_to = worth, j
            greedy_successor[i] = leads_to
            count += leads_to > i and not numbered.terminal[i]
        return count

    return NumberingKernels(width, number_states, greedy_successors)
