"""Orders: the states by their distance from where a task ends.

The distance of a state is the least expected cost of getting from there to a terminal state by moves that are each
tried until they succeed. A move with probability p costs, with discount γ and reward R,

    max(0, −R) / p  +  log((1 − γ + γp) / γp),

what the tries cost, and by how much the discount shrinks what comes after them. Any order gives the same values; a good
one gives them sooner.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sidestep.tabular.solvers.compiled import compiled


def order_by_distance(
    successors: Int[np.ndarray, "states actions outcomes"],
    probabilities: Float[np.ndarray, "states actions outcomes"],
    reward: Float[np.ndarray, "#states #actions"],
    terminal: Bool[np.ndarray, " states"],
    discount: float,
) -> Int[np.ndarray, " states"]:
    """The states, nearest first; those from which no terminal state can be reached come last.

    Where nothing is terminal the states keep their numbers. One shortest-path search.
    """
    if not terminal.any():
        return np.arange(len(successors), dtype=np.int32)
    first, begins, costs = _moves_backwards(successors, probabilities, reward, discount)
    moves = csr_array((costs, begins, first), shape=(len(successors), len(successors)))
    ends = np.flatnonzero(terminal)
    distance = dijkstra(moves, indices=ends[0]) if len(ends) == 1 else dijkstra(moves, indices=ends, min_only=True)
    return _ascending(distance)


def _ascending(distances: Float[np.ndarray, " states"]) -> Int[np.ndarray, " states"]:
    """The states by their distance; those that are as far as others in the order of their numbers.

    The bits of numbers that are not negative ascend with them, and NumPy sorts 16 bits many times as fast as 64.
    """
    bits = np.ascontiguousarray(distances, np.float64).view(np.uint64)
    neg_inf, *others = ((bits >> np.uint64(shift)).astype(np.uint16) for shift in range(0, 64, 16))
    order = np.argsort(neg_inf, kind="stable").astype(np.int32)
    for digits in others:
        order = order[np.argsort(digits[order], kind="stable")]
    return order


@compiled()
def _moves_backwards(successors, probabilities, reward, discount):  # pragma: no cover
    """The moves into each state, as rows of a sparse matrix: where a row starts, where moves begin, their costs."""
    states, actions, outcomes = successors.shape
    first = np.zeros(states + 2, np.int32)
    for state in range(states):
        for a in range(actions):
            for k in range(outcomes):
                if successors[state, a, k] != state and probabilities[state, a, k] > 0:
                    first[successors[state, a, k] + 2] += 1
    for state in range(states):
        first[state + 2] += first[state + 1]
    begins, costs = np.empty(first[-1], np.int32), np.empty(first[-1], np.float64)
    for state in range(states):
        for a in range(actions):
            price = max(-reward[state if reward.shape[0] > 1 else 0, a if reward.shape[1] > 1 else 0], 0.0)
            for k in range(outcomes):
                after, chance = successors[state, a, k], probabilities[state, a, k]
                if after != state and chance > 0:
                    begins[first[after + 1]] = state
                    cost = price / chance + np.log1p((1 - discount) / (discount * chance))
                    # an edge without cost would not be one
                    costs[first[after + 1]] = max(cost, 1e-300)
                    first[after + 1] += 1
    return first[:-1], begins, costs
