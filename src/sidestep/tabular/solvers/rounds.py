"""Rounds of sweeps until values are still: which states are swept when, and when to stop. On the host.

`sweeping` holds a single sweep. A round goes once over all states that are to be solved; where these are not all, a
round over every state comes first, so that the others have moved with them by and large.

1. For the Boltzmann average and the log-sum-exp, up to 8 rounds sweep all of them at once, with everything farther
   shifted. If changes grow from one round to the next, all is taken back to the first values, and this ends. Rounds go
   in pairs, the second as far behind the first as it takes for neither to notice: on another core, if there is one.
   What becomes of a pair is decided at its end.
2. Then rounds go stretch by stretch, some 32 √states of them each: a stretch is swept until it is still, at most 30
   times, before the next one. Its states stay in the processor's cache, and those behind it have settled when it
   begins. For these two backups the states beyond the stretch are shifted, in the first 16 rounds (those of step 1
   among them).
3. When no stretch begins with a change beyond the tolerance, a sweep over all of them, without exception or shift and
   from the values as they are, decides whether the values have converged.

The other backups are not shifted: on a real map (mellowmax, the depot) it saved nothing.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sidestep.tabular.solvers.base import neg_inf
from sidestep.tabular.solvers.given import Outcome
from sidestep.tabular.solvers.native import heed_interrupts, shared_out
from sidestep.tabular.solvers.numbering import Numbered
from sidestep.tabular.solvers.pairs import one_behind_the_other
from sidestep.tabular.solvers.value_kernels import BOLTZMANN, LOG_SUM_EXP, Marks, Valuing, sweep_for

_SHIFTED = (BOLTZMANN, LOG_SUM_EXP)
"""The backups whose sweeps shift farther values."""
_PAIRS = 4
"""How many pairs of rounds sweep all states at once, at most."""
_GROWING = 2.0
"""By how much changes may grow from one of these rounds to the next."""
_FEW = 0.01
"""The share of states still at work below which rounds go stretch by stretch."""
_STRETCH, _SMALLEST_STRETCH = 32, 256
"""How many states a stretch has: this many times the root of their number, but no fewer than that."""
_SHIFTING = 16
"""In how many rounds values are shifted, at most; two states that move each other may never come to rest."""
_AGAIN = 30
"""How often a stretch is swept in a round, at most."""
_STILL = 0.25
"""The share of the tolerance that counts as no change, so that what is left alone does not add up beyond it."""


class _Sweep(NamedTuple):
    """A sweep: its number, that of the first one of its round, and the marks that it reads and makes."""

    number: int
    first: int
    marks: Marks


class Rounds:
    """Values on their way to the fixed point, states by position; and how much has been done so far.

    - `values`: are changed where they are.
    - `which`: the positions of the states that are to be solved, ascending.
    - `max_sweeps`, `max_rounds`: when to give up: so often a state was solved on average, or after so many rounds.
    - `number`: of the last sweep over any states; `first`: of the first one of the present round.
    - `rounds`: how many have been begun; `solved`: how many states have been solved, in all sweeps together.
    """

    def __init__(
        self,
        world: Numbered,
        values: Float[np.ndarray, " states"],
        favourite: Int[np.ndarray, " states"],
        which: Int[np.ndarray, " solved"],
        valuing: Valuing,
        tolerance: np.floating,
        max_sweeps: int,
        max_rounds: int,
    ):
        self.which = which
        self.world, self.values, self.valuing, self.tolerance = world, values, valuing, tolerance
        self.max_sweeps, self.max_rounds = max_sweeps, max_rounds
        never = np.zeros((2, len(values)), np.int32)
        self.marks = Marks(values.copy(), favourite, *never)
        size = max(_SMALLEST_STRETCH, int(_STRETCH * len(which) ** 0.5))
        self.stretches = np.split(which, range(size, len(which), size))
        self.number = self.first = self.rounds = self.solved = 0

    def until_still(self) -> Outcome:
        """Sweeps until a sweep over `which` changes none by more than the tolerance, or too much has been done."""
        if len(self.which) < len(self.values):
            self._begin_round()
            everyone = np.arange(len(self.values), dtype=np.int32)
            self._sweep(everyone, shifted=0 if self.valuing.kind in _SHIFTED else len(everyone))
        residual = self._all_at_once() if self.valuing.kind in _SHIFTED else np.inf
        converged = False
        while not (converged or self._given_up() or np.isnan(residual)):
            residual = self._stretch_by_stretch() if residual > self.tolerance else residual
            if residual <= self.tolerance and not self._given_up():
                residual = self._once_more()
                converged = bool(residual <= self.tolerance)
        return Outcome(-(-self.solved // len(self.values)), float(residual), converged)

    def _all_at_once(self) -> float:
        """Step 1; the largest change in the last round, infinite if all was taken back."""
        first_values, last = self.values.copy(), np.inf
        for _ in range(_PAIRS):
            if self._given_up():
                break
            (first, _), (residual, at_work) = self._two_rounds()
            if not (first <= _GROWING * last and residual <= _GROWING * first):
                self.values[:] = first_values
                return np.inf
            last = residual
            if residual <= self.tolerance or at_work <= _FEW * len(self.which):
                break
        return last

    def _two_rounds(self) -> list[tuple[float, int]]:
        """A pair of rounds of step 1; the largest change in each, and how many states were solved."""
        self._begin_round()
        leading = self._next_sweep()
        # the second begins with the values that the first leaves, as soon as they are there
        self.marks, filled = self.marks._replace(before=np.full_like(self.values, np.nan)), 0
        self._count_round()
        following = self._next_sweep()

        def settled(end: int) -> None:
            nonlocal filled
            following.marks.before[filled:end] = self.values[filled:end]
            filled = end

        lead, follow = (partial(self._solve, self.values, sweep, shifted=0) for sweep in (leading, following))
        results = one_behind_the_other(lead, follow, settled, self.stretches, self.world.reach)
        found = [(float(np.max([change for change, _ in own])), sum(solved for _, solved in own)) for own in results]
        self.solved += sum(solved for _, solved in found)
        return found

    def _stretch_by_stretch(self) -> float:
        """A round of step 2; the largest change in the first sweeps over the stretches."""
        self._begin_round()
        residuals = [self._sweep_stretch(stretch) for stretch in self.stretches]
        return float(np.max(residuals))

    def _sweep_stretch(self, stretch: np.ndarray) -> float:
        """Sweeps a stretch until it is still; the largest change in the first sweep."""
        residual = np.inf
        for again in range(_AGAIN):
            if self._given_up():
                break
            change, _ = self._sweep(stretch, self._beyond(stretch))
            residual = change if again == 0 else residual
            if not change > self.tolerance:
                break
        return residual

    def _beyond(self, stretch: np.ndarray) -> int:
        """The first position that is shifted when a stretch is swept; past the last where a shift may do harm."""
        shifted = self.valuing.kind in _SHIFTED and self.rounds <= _SHIFTING
        return int(stretch[-1]) + 1 if shifted else len(self.values)

    def _begin_round(self) -> None:
        self.marks.before[:] = self.values
        self._count_round()

    def _count_round(self) -> None:
        self.first = self.number + 1
        self.rounds += 1

    def _next_sweep(self) -> _Sweep:
        self.number += 1
        return _Sweep(self.number, self.first, self.marks)

    def _once_more(self) -> float:
        """Step 3, from the values as they are, so that all cores can share in it; the largest change."""
        self._begin_round()
        sweep = self._next_sweep()
        self.solved += len(self.which)
        into = self.values.copy()

        def solve(begin: int, end: int) -> float:
            return self._solve(into, sweep, self.which[begin:end], shifted=len(into), everyone=True)[0]

        residual = float(np.max(shared_out(solve, len(self.which))))
        self.values[:] = into
        # none saw what became of the others, whichever came first
        marks, moved = self.marks, self.marks.changed == self.number
        self.number += 1
        marks.changed[moved] = marks.solved[moved] = self.number
        return residual

    def _sweep(self, which: np.ndarray, shifted: int) -> tuple[float, int]:
        """One sweep; the largest change, and how many states were solved."""
        heed_interrupts()
        change, solved = self._solve(self.values, self._next_sweep(), which, shifted)
        self.solved += solved
        return change, solved

    def _solve(
        self, into: np.ndarray, sweep: _Sweep, which: np.ndarray, shifted: int, everyone: bool = False
    ) -> tuple[float, int]:
        """Solves states in a sweep, everyone in the very first; the largest change, and how many were solved."""
        return sweep_for(*self.world.moves.shape[1:])(
            which,
            self.valuing,
            self.world,
            self.values,
            into,
            sweep.marks,
            sweep.number,
            sweep.first,
            shifted,
            everyone or sweep.number == 1,
            _STILL * self.tolerance,
            self.values.dtype.type(neg_inf(self.values.dtype)),
        )

    def _given_up(self) -> bool:
        # rounds count too: a few states that never settle should not keep all others waiting
        return self.solved >= self.max_sweeps * len(self.values) or self.rounds >= self.max_rounds
