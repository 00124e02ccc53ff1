"""The loop of sweeps in Gauss–Seidel value iteration: which states are solved when, and when to stop.

`value_kernels` holds a single sweep. A *round* goes once over all states that are to be solved. Where these are not
all, a sweep over every state comes first, so that the others roughly follow.

1. For the Boltzmann average and the log-sum-exp, up to 8 rounds sweep all states with everything farther shifted. If
   changes grow from one round to the next, the first values are restored, and this ends. Rounds go in pairs, pipelined:
   the second follows on another core, if there is one, as far behind the first as neither notices (see `pipeline`).
2. Then a round goes block by block, each of some 32 √states: a block is swept until no value changes, at most 30 times,
   before the next one. Its states stay in the processor's cache, and the nearer blocks have converged when it begins.
   For these two backups the states beyond the block are shifted, in the first 16 rounds (those of step 1 included).
3. When no block begins with a change beyond the tolerance, a sweep over all states, without skips or shifts and as in
   Jacobi iteration, decides whether the values have converged. Where the bound of the error (`bounds`) is too large,
   the rounds go on to a smaller tolerance.

The other backups are not shifted: on a real map (mellowmax, the depot) it saved nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from sidestep.tabular.solvers import native
from sidestep.tabular.solvers.bound_kernels import bound_by_potential
from sidestep.tabular.solvers.bounds import MoveCosts
from sidestep.tabular.solvers.ordering import NumberedProcess
from sidestep.tabular.solvers.value_kernels import SweepHistory, sweep_kernel

_Result = TypeVar("_Result")

_SHIFTED_BACKUPS = (native.BOLTZMANN, native.LOG_SUM_EXP)
_MOST_PAIRS = 4
"""The most pairs of rounds in step 1."""
_GROWTH = 2.0
"""The factor by which changes may grow from one of these rounds to the next."""
_FEW = 0.01
"""The fraction of states solved in a round below which step 2 follows."""
_BLOCK_FACTOR, _SMALLEST_BLOCK = 32, 256
"""The size of a block: this many times the root of the number of states, but no less than that."""
_SHIFTED_ROUNDS = 16
"""The most rounds with shifts: two states that move each other may never converge."""
_MOST_REPETITIONS = 30
"""The most sweeps over a block in a round."""
_FINER = 0.1
"""The factor between one tolerance and the next where the error is too large."""
_SKIP = 0.25
"""The part of the tolerance that counts as no change, so that what is skipped does not add up beyond it."""


class _Sweep(NamedTuple):
    """A sweep: the history that it reads and writes, its number, and that of the first one of its round."""

    history: SweepHistory
    number: int
    round_first: int


@dataclass
class SweepLoop:
    """Values on their way to the fixed point, by position, and what has been done so far.

    Attributes:
        process: What is solved, under which `backup`.
        values: The values, changed in place.
        greedy_successor: Of each state, by the first values; changed in place.
        positions: The states that are to be solved, ascending.
        costs: What bounds the number of moves.
        tolerance, max_sweeps, max_rounds: When to stop.
        history: What the sweeps leave for later ones.
        blocks: `positions` in blocks.
        number: That of the last sweep over any states.
        round_first: The number of the first sweep of the present round.
        rounds: The number of rounds begun.
        solved: The number of states solved, in all sweeps together.
    """

    process: NumberedProcess
    values: Float[np.ndarray, " states"]
    greedy_successor: Int[np.ndarray, " states"]
    positions: Int[np.ndarray, " solved"]
    backup: native.NativeBackup
    costs: MoveCosts
    tolerance: np.floating
    max_sweeps: int
    max_rounds: int

    def __post_init__(self) -> None:
        marks = np.zeros((2, len(self.values)), np.int32)
        self.history: SweepHistory = SweepHistory(self.values.copy(), self.greedy_successor, *marks)
        size = max(_SMALLEST_BLOCK, int(_BLOCK_FACTOR * len(self.positions) ** 0.5))
        self.blocks: list[np.ndarray] = np.split(self.positions, range(size, len(self.positions), size))
        self.number = self.round_first = self.rounds = self.solved = 0

    def run(self) -> native.SolveInfo:
        """Sweep until no value of `positions` changes by more than the tolerance, or a limit is reached."""
        if len(self.positions) < len(self.values):
            self._begin_round()
            shift_from = 0 if self.backup.kind in _SHIFTED_BACKUPS else len(self.values)
            self.sweep(np.arange(len(self.values), dtype=np.int32), shift_from)
        residual = self._shifted_rounds() if self.backup.kind in _SHIFTED_BACKUPS else np.inf
        eps = np.finfo(self.values.dtype).eps
        largest_error, error, converged = np.sqrt(float(max(self.tolerance, eps))), np.inf, False
        while not (converged or self._limit_reached() or np.isnan(residual)):
            residual = self._round_by_blocks() if residual > self.tolerance else residual
            if residual <= self.tolerance and not self._limit_reached():
                residual, change = self.jacobi_sweep()
                error, size = self._error(change)
                if np.isfinite(error) and error > largest_error * size:
                    solved = self.process, self.backup, self.costs, self.values, self.positions
                    error = min(error, bound_by_potential(*solved))
                is_near = not np.isfinite(error) or error <= largest_error * size
                converged = bool(residual <= self.tolerance and is_near)
                if not is_near:
                    self.tolerance = self.tolerance * self.values.dtype.type(_FINER)
                    if self.tolerance < eps:
                        break
        return native.SolveInfo(-(-self.solved // len(self.values)), float(residual), float(error), converged)

    def sweep(self, positions: Int[np.ndarray, " solved"], shift_from: int) -> float:
        """Sweep over some states, those from a position on shifted; return the largest change."""
        native.check_interrupt()
        change, solved = self._solve(self.values, self._next_sweep(), positions, shift_from)
        self.solved += solved
        return change

    def jacobi_sweep(self) -> tuple[float, float]:
        """Solve all states from the values as they are (step 3), on all cores.

        Return the largest change relative to the values, and in their unit.
        """
        self._begin_round()
        sweep = self._next_sweep()
        self.solved += len(self.positions)
        into = self.values.copy()

        def solve(begin: int, end: int) -> float:
            return self._solve(into, sweep, self.positions[begin:end], shift_from=len(into), solve_all=True)[0]

        residual = float(np.max(native.map_ranges(solve, len(self.positions))))
        known = self.positions[into[self.positions] > -np.inf]
        change = float(np.abs(into[known] - self.values[known]).max(initial=0.0))
        self.values[:] = into
        # no state saw the new values of the others, whichever came first
        history, changed = self.history, self.history.last_changed == self.number
        self.number += 1
        history.last_changed[changed] = history.last_solved[changed] = self.number
        return residual, change

    def _error(self, change: float) -> tuple[float, float]:
        """Return the bound of the error after such a change (`bounds.error_bound`), and the largest value."""
        known, limits = self.values[self.values > -np.inf], np.finfo(self.values.dtype)
        lowest, size = float(known.min(initial=np.inf)), float(np.abs(known).max(initial=0.0))
        by_cost = float(self.costs.least) / max(float(self.costs.ending) - lowest, float(limits.tiny))
        rate = max(by_cost, float(self.process.one_minus_discount), 0.0)
        if rate == 0:
            return np.inf, size
        # no more than the results' type holds
        return min((change + float(limits.eps) * size) / rate, float(limits.max)), size

    def _shifted_rounds(self) -> float:
        """Step 1; return the largest change in the last round, infinite if the first values were restored."""
        first_values, last = self.values.copy(), np.inf
        for _ in range(_MOST_PAIRS):
            if self._limit_reached():
                break
            (first, _), (residual, solved) = self._two_rounds()
            if not (first <= _GROWTH * last and residual <= _GROWTH * first):
                self.values[:] = first_values
                return np.inf
            last = residual
            if residual <= self.tolerance or solved <= _FEW * len(self.positions):
                break
        return last

    def _two_rounds(self) -> list[tuple[float, int]]:
        """Run a pair of rounds of step 1; return the largest change in each, and the number of states solved."""
        self._begin_round()
        leading = self._next_sweep()
        # the second begins with the values that the first leaves, as soon as they are there
        self.history, filled = self.history._replace(round_start=np.full_like(self.values, np.nan)), 0
        self._count_round()
        following = self._next_sweep()

        def on_progress(end: int) -> None:
            nonlocal filled
            following.history.round_start[filled:end] = self.values[filled:end]
            filled = end

        lead, follow = (partial(self._solve, self.values, sweep, shift_from=0) for sweep in (leading, following))
        results = [
            (float(np.max([change for change, _ in blocks])), sum(solved for _, solved in blocks))
            for blocks in pipeline(lead, follow, on_progress, self.blocks, self.process.bandwidth)
        ]
        self.solved += sum(solved for _, solved in results)
        return results

    def _round_by_blocks(self) -> float:
        """Run a round of step 2; return the largest change in the first sweeps over the blocks."""
        self._begin_round()
        return float(np.max([self._sweep_block(block) for block in self.blocks]))

    def _sweep_block(self, block: np.ndarray) -> float:
        """Sweep a block until no value changes; return the largest change in the first sweep."""
        shifts = self.backup.kind in _SHIFTED_BACKUPS and self.rounds <= _SHIFTED_ROUNDS
        residual = np.inf
        for repetition in range(_MOST_REPETITIONS):
            if self._limit_reached():
                break
            change = self.sweep(block, int(block[-1]) + 1 if shifts else len(self.values))
            residual = change if repetition == 0 else residual
            if not change > self.tolerance:
                break
        return residual

    def _begin_round(self) -> None:
        self.history.round_start[:] = self.values
        self._count_round()

    def _count_round(self) -> None:
        self.round_first = self.number + 1
        self.rounds += 1

    def _next_sweep(self) -> _Sweep:
        self.number += 1
        return _Sweep(self.history, self.number, self.round_first)

    def _solve(
        self, into: np.ndarray, sweep: _Sweep, positions: np.ndarray, shift_from: int, solve_all: bool = False
    ) -> tuple[float, int]:
        """Solve states in a sweep, without skips in the very first; return the largest change and their number."""
        kernel = sweep_kernel(*self.process.discounted_probs.shape[1:])
        rules = shift_from, solve_all or sweep.number == 1, _SKIP * self.tolerance
        return kernel(positions, self.backup, self.process, self.values, into, *sweep, *rules)

    def _limit_reached(self) -> bool:
        # rounds count too: a few states that never converge should not keep all others waiting
        return self.solved >= self.max_sweeps * len(self.values) or self.rounds >= self.max_rounds


def pipeline(
    leading: Callable[[np.ndarray], _Result],
    following: Callable[[np.ndarray], _Result],
    on_progress: Callable[[int], None],
    blocks: Sequence[np.ndarray],
    bandwidth: int,
) -> tuple[list[_Result], list[_Result]]:
    """Return the results of two sweeps for each block, the second run behind the first, as if after it.

    A sweep at a state reads only what belongs to states within the bandwidth (see `NumberedProcess`). Of these it
    changes the state and farther ones. So two sweeps, at the positions i and j > i + 2 bandwidth, have nothing in
    common, and what lies before j is as the first sweep leaves it: the second does what it would do after the first.

    Args:
        leading: The first sweep, called with one block after another.
        following: The second sweep, likewise.
        on_progress: Called as the first sweep advances: what lies before this position is now as it leaves it.
        blocks: Ascending positions, one block after the other.
        bandwidth: Of the process.
    """
    ends = [int(block[-1]) for block in blocks]
    first: list[_Result] = []
    second: list[_Result] = []
    while len(second) < len(blocks):
        native.check_interrupt()
        ahead, behind = len(first), len(second)
        works = [(first, partial(leading, blocks[ahead]))] if ahead < len(blocks) else []
        front = int(blocks[ahead][0]) if works else ends[-1] + 2 * bandwidth + 1
        on_progress(min(front, ends[-1] + bandwidth + 1))
        if ends[behind] + 2 * bandwidth < front:
            works.append((second, partial(following, blocks[behind])))
        for (results, _), result in zip(works, native.run_parallel([work for _, work in works]), strict=True):
            results.append(result)
    return first, second
