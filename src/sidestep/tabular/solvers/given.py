"""What JAX and the host tell each other, as the NumPy arrays that the host sees."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.tabular.solvers.compiled import compiled
from sidestep.tabular.solvers.native import shared_out


class Given(NamedTuple):
    """A task under a model; fields as in `DecisionProcess`."""

    successors: Int[np.ndarray, "states actions outcomes"]
    probabilities: Float[np.ndarray, "states actions outcomes"]
    reward: Float[np.ndarray, "#states #actions"]
    terminal_reward: Float[np.ndarray, "#states"]
    terminal: Bool[np.ndarray, " states"]
    discount: np.floating


class Found(NamedTuple):
    """Where a solver writes what it found; fields as in `SolveResult`."""

    values: Float[np.ndarray, " states"]
    order: Int[np.ndarray, " states"]
    sweeps: Int[np.ndarray, ""]
    residual: Float[np.ndarray, ""]
    converged: Bool[np.ndarray, ""]


class Outcome(NamedTuple):
    """How a solve went.

    - `sweeps`: how often a state was solved on average, rounded up.
    - `residual`, `converged`: as in `SolveResult`.
    """

    sweeps: int
    residual: float
    converged: bool


def given_from(process: tuple[np.ndarray, ...]) -> Given:
    """The fields of a `DecisionProcess` by name, the discount as a number."""
    *arrays, discount = process
    return Given(*arrays, discount=discount.dtype.type(discount))


def write(found: Found, order: Int[np.ndarray, " states"], outcome: Outcome) -> None:
    """Writes down all but the values."""
    found.order[:] = order
    found.sweeps[...], found.residual[...], found.converged[...] = outcome


def look_up(
    into: Float[np.ndarray, "some actions outcomes"],
    probabilities: Float[np.ndarray, "states actions outcomes"],
    states: Int[np.ndarray, " some"],
) -> None:
    """Writes the probabilities of some states `into` an array; of the last one for what is no state."""
    np.take(probabilities, states, axis=0, out=into, mode="clip")


def sizes(given: Given) -> tuple[int, int, int]:
    """The number of actions, of outcomes, and the most outcomes of an action that leave the state (at least 1)."""
    states, actions, outcomes = given.successors.shape
    most = shared_out(lambda begin, end: _most_that_leave(given.successors[begin:end]), states)
    return actions, outcomes, max(most)


def positions(order: Int[np.ndarray, " states"]) -> Int[np.ndarray, " states"] | None:
    """Where each state stands in an order; None if it is not one of all states."""
    if order.min() < 0 or order.max() >= len(order):
        return None
    position = np.full(len(order), -1, np.int32)
    position[order] = np.arange(len(order), dtype=np.int32)
    return None if position.min() < 0 else position


@compiled()
def _most_that_leave(successors):  # pragma: no cover
    most = 1
    for state in range(len(successors)):
        for a in range(successors.shape[1]):
            count = 0
            for k in range(successors.shape[2]):
                count += successors[state, a, k] != state
            most = max(most, count)
    return most
