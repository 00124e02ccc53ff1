"""Two sweeps over the same states at once, the second as far behind the first as it takes for neither to notice.

A sweep at a state reads nothing but what belongs to states within its *reach* (see `Numbered`): the state itself and
those that it leads to. Of these it changes the state and farther ones. So two sweeps, one at the position i and the
other at j > i + 2 reach, have nothing in common, and what lies before j is as the one at j leaves it: the one at i
finds what it would have found if the other had ended before.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from sidestep.tabular.solvers.native import at_once, heed_interrupts

_Result = TypeVar("_Result")
_SweepOf = Callable[[np.ndarray], _Result]


def one_behind_the_other(
    leading: _SweepOf, following: _SweepOf, settled: Callable[[int], None], stretches: Sequence[np.ndarray], reach: int
) -> tuple[list[_Result], list[_Result]]:
    """What two sweeps return for each of the stretches, which they go through one by one.

    - `settled`: is told as the first sweep gets on: what comes before a position is now as it leaves it (for the
      second sweep to find; at the end, all is).
    - `stretches`: ascending positions, one stretch after the other.
    """
    ends = [int(stretch[-1]) for stretch in stretches]
    first: list[_Result] = []
    second: list[_Result] = []
    while len(second) < len(stretches):
        heed_interrupts()
        ahead, behind = len(first), len(second)
        works = []
        if ahead < len(stretches):
            front = int(stretches[ahead][0])
            settled(front)
            works.append((first, partial(leading, stretches[ahead])))
            follows = ends[behind] + 2 * reach < front
        else:
            settled(ends[-1] + reach + 1)
            follows = True
        if follows:
            works.append((second, partial(following, stretches[behind])))
        for (results, _), result in zip(works, at_once([work for _, work in works]), strict=True):
            results.append(result)
    return first, second
