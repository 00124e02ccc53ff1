"""The bound of values' errors by a potential (see `bounds`), on the host: its passes over the states as native code."""

from functools import cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sidestep.tabular.solvers.bounds import MOST_STEPS, ROUNDINGS, STEP_LENGTH, MoveCosts
from sidestep.tabular.solvers.native import NativeBackup, NativeFunction, compiled, map_ranges
from sidestep.tabular.solvers.ordering import NumberedProcess
from sidestep.tabular.solvers.value_kernels import backed_up


class BoundScratch(NamedTuple):
    """Memory for what a state's actions have; a tuple, as `Scratch` is.

    Attributes:
        own: A(a).
        exit_weights: d(a), the falls of the potential; `backed_up` returns their average, too.
        rounding: The most that rounding moves A(a).
        advantages: A(a) at V ± t u.
    """

    own: np.ndarray
    exit_weights: np.ndarray
    rounding: np.ndarray
    advantages: np.ndarray


def bound_by_potential(
    process: NumberedProcess,
    backup: NativeBackup,
    costs: MoveCosts,
    values: Float[np.ndarray, " states"],
    positions: Int[np.ndarray, " solved"],
) -> float:
    """Return the bound of the error of some states, the others taken as they are; ∞ where none is found.

    Args:
        process: What is solved.
        backup: Of the agents.
        costs: What bounds the number of moves.
        values: V by position.
        positions: The states.
    """
    least, ending = float(costs.least), float(costs.ending)
    above = np.where(values > -np.inf, np.maximum(ending - values, 0), 0).astype(values.dtype)
    potential = np.log1p(above / values.dtype.type(least)) if least > 0 else np.ones_like(values)
    excess, factor = excess_kernel(*process.discounted_probs.shape[1:]), 0.0
    numbers = backup, process, values, potential

    def in_range(factor: np.floating, begin: int, end: int) -> float:
        return excess(positions[begin:end], *numbers, factor)

    largest, limit = potential[positions[~process.terminal[positions]]].max(initial=0), np.finfo(values.dtype).max
    for _ in range(1 + MOST_STEPS):
        left = float(np.max(map_ranges(partial(in_range, values.dtype.type(factor)), len(positions))))
        if left <= 0:
            return factor * float(largest)
        factor = min(factor + STEP_LENGTH * left, float(limit))
    return np.inf


@cache
def excess_kernel(actions: int, width: int) -> NativeFunction:
    """Return the native code of a pass for these numbers."""

    @compiled()
    def excess(positions, backup, process, values, potential, factor):  # pragma: no cover
        """Return by how much the factor of the potential is too small, to first order: at most 0 if it suffices.

        NaN if that is anywhere.
        """
        dtype = values.dtype
        memory = np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype), np.empty(actions, dtype)
        scratch = BoundScratch(*memory)
        unit = (ROUNDINGS + width) * np.finfo(dtype).eps
        largest = 0.0 * factor
        for index in range(len(positions)):
            i = positions[index]
            if process.terminal[i]:
                continue
            count = process.choosable[i if len(process.choosable) > 1 else 0]
            for a in range(actions):
                reward = process.reward[i if len(process.reward) > 1 else 0, a]
                scratch.own[a] = reward - process.one_minus_discount * values[i]
                scratch.exit_weights[a] = process.one_minus_discount * potential[i]
                scratch.rounding[a] = 0.0
                if reward > -np.inf:
                    terms = abs(reward) + process.one_minus_discount * abs(values[i])
                    for m in range(width):
                        j, move = process.successors[i, a, m], process.discounted_probs[i, a, m]
                        scratch.own[a] += move * (values[j] - values[i])
                        scratch.exit_weights[a] += move * (potential[i] - potential[j])
                        terms += move * abs(values[j] - values[i])
                    scratch.rounding[a] = unit * terms
            for a in range(actions):
                scratch.advantages[a] = scratch.own[a] + scratch.rounding[a] - factor * scratch.exit_weights[a]
            above, slope = backed_up(backup, count, scratch)
            for a in range(actions):
                scratch.advantages[a] = scratch.own[a] - scratch.rounding[a] + factor * scratch.exit_weights[a]
            below, _ = backed_up(backup, count, scratch)
            left = max(above, -below) / (slope if slope > 0 else 1.0)
            if left > largest or np.isnan(left):
                largest = left
        return largest

    return excess
