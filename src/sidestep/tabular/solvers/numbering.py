"""A task with its states numbered in an order, as the sweeps read it, as machine code (numba).

With the states in the order in which they are swept, those that a sweep needs lie close together in memory.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from sidestep.tabular.solvers.compiled import compiled
from sidestep.tabular.solvers.given import Given
from sidestep.tabular.solvers.native import shared_out


class Numbered(NamedTuple):
    """A task under a model with its states numbered in an order; self-loops left out.

    - `successors`: where the outcomes that leave a state lead; padded with the state itself.
    - `moves`: γP of these outcomes, 0 for the padding.
    - `patience`: 1/(1 − γp), p the probability of staying: for how long an action is tried; 0 where that is for ever.
    - `reward`: R(s, a), with one row if it is the same in all states.
    - `fixed`: the terminal states.
    - `ending`: 1 − γ.
    - `reach`: the largest difference between the positions of a state and of one that it leads to.
    """

    successors: np.ndarray
    moves: np.ndarray
    patience: np.ndarray
    reward: np.ndarray
    fixed: np.ndarray
    ending: np.floating
    reach: int


class Numbering(NamedTuple):
    """The machine code for one number of actions, of outcomes, and of outcomes that leave a state: `width`."""

    width: int
    number_states: Any
    favourites: Any


def numbered(
    run: Numbering, given: Given, order: Int[np.ndarray, " states"], position: Int[np.ndarray, " states"]
) -> Numbered:
    """The task with its states numbered in an order; `position` is where each state stands in it."""
    states, actions, _ = given.successors.shape
    dtype = given.probabilities.dtype
    reward = np.broadcast_to(given.reward, (len(given.reward), actions))
    world = Numbered(
        successors=np.empty((states, actions, run.width), np.int32),
        moves=np.empty((states, actions, run.width), dtype),
        patience=np.empty((states, actions), dtype),
        reward=np.ascontiguousarray(reward[order] if len(reward) > 1 else reward),
        fixed=np.empty(states, bool),
        ending=1 - given.discount,
        reach=0,
    )
    arrays = (order, position, given.successors, given.probabilities, given.terminal, given.discount, world)
    return world._replace(reach=max(shared_out(lambda begin, end: run.number_states(begin, end, *arrays), states)))


@cache
def numbering_for(actions: int, outcomes: int, width: int) -> Numbering:
    """The machine code for that many; as constants they make it twice as fast."""

    @compiled()
    def number_states(
        begin, end, order, position, successors, probabilities, terminal, discount, world
    ):  # pragma: no cover
        """Fills in `world` with the states taken in `order`, from one position up to another; returns their reach."""
        reach = 0
        for i in range(begin, end):
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
                        reach = max(reach, abs(position[after] - i))
                        world.moves[i, a, m] = move
                        leaving += move
                        m += 1
                for padding in range(m, width):
                    world.successors[i, a, padding] = i
                    world.moves[i, a, padding] = 0
                world.patience[i, a] = 1 / leaving if leaving > 0 else 0.0
        return reach

    @compiled()
    def favourites(begin, end, world, values, bottom, favourite):  # pragma: no cover
        """Fills in where states want to go, by values that are known; returns how many want to go to a farther one."""
        count = 0
        for i in range(begin, end):
            best, leads_to = bottom, i
            for a in range(actions):
                for m in range(width):
                    j = world.successors[i, a, m]
                    move = world.moves[i, a, m]
                    worth = values[j] + world.reward[i if len(world.reward) > 1 else 0, a] / move
                    if move > 0 and worth > best:
                        best, leads_to = worth, j
            favourite[i] = leads_to
            count += leads_to > i and not world.fixed[i]
        return count

    return Numbering(width, number_states, favourites)
