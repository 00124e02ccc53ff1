"""The climb of a fit: from point to point up the objective, with solves as exact as the optimiser needs.

On large maps the solves of the first points are loose. Where the optimiser has converged, or finds no step that gains
anything, the same point is looked at again with exact solves and the climb goes on from there; it ends only on exact
ones. A rough look, which tells whether a step is worth a proper one, takes over batches of tasks that have hardly
changed; in those that have changed little, loose solves are of the states only that mattered.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from sidestep.errors import InputError, NotConverged
from sidestep.inference.batching import LARGE
from sidestep.inference.checkpoints import Saver
from sidestep.inference.objective import Objective, Part, Problem, Solved
from sidestep.inference.optimizers import Optimizer
from sidestep.tabular.likelihood import choices_of
from sidestep.tabular.solvers.base import WarmStart


class Progress(NamedTuple):
    """Where a fit stands after an iteration: the objective, its parts, and its largest gradient component."""

    iteration: int
    objective: float
    actions: float
    transitions: float
    prior: float
    gradient: float


class Summit(NamedTuple):
    """Where a climb ended: θ, the way there, how the last solves went, whether the optimiser had settled, and why."""

    parameters: PyTree
    history: list[Progress]
    solved: list[Solved]
    settled: bool
    message: str


class _Point(NamedTuple):
    """What is known of the objective at one θ; arrays and numbers only, so that a checkpoint can hold it."""

    x: np.ndarray
    parts: np.ndarray
    slope: np.ndarray


class Climb:
    """The way of an optimiser up an objective.

    The last point is remembered, for line searches ask twice; its solves are where the next ones start. What batches of
    tasks added is remembered too, for rough looks (see `objective`).
    """

    def __init__(self, objective: Objective, optimizer: Optimizer, saver: Saver):
        self.objective, self.optimizer, self.saver = objective, optimizer, saver
        start, self.to_parameters = ravel_pytree(objective.problem.parameters)
        self.start = np.asarray(start)
        self.starts = objective.cold_starts()
        self.last = _Point(np.full_like(self.start, np.nan), np.zeros(4), np.zeros_like(self.start))
        self.solved: list[Solved] = []
        self.known: list[Part] = []
        self.negligible = 0.0
        self.tolerances = _tolerances(objective.problem, optimizer)

    def run(self, report: Callable[[Progress], None] | None, resume: bool) -> Summit:
        """Climbs until converged or stopped; raises `NotConverged` where values stop converging on the way."""
        x, state, history = self.start, self.optimizer.init(self.start), []
        if resume:
            x, state, history = self._resumed(x, state)
        while True:
            point = self._look(x)
            objective, actions, transitions, prior = point.parts.tolist()
            steepest = float(np.abs(point.slope).max())
            progress = Progress(len(history), objective, actions, transitions, prior, steepest)
            self._check(progress)
            self.negligible = _NEGLIGIBLE * abs(objective) / max(1, len(self.objective.batches))
            history.append(progress)
            if report:
                report(progress)
            settled = self.optimizer.settled(point.slope, state)
            message = _reason_to_stop(progress, settled, self.optimizer)
            after = None if message else self.optimizer.step(self._loss, x, -progress.objective, point.slope, state)
            if after is not None:
                x, state = after
                self._save(x, state, history)
            elif len(self.tolerances) > 1:
                history.pop()
                self._be_more_exact()
            else:
                unsaid = f"stopped: no step gains anything; the largest gradient is {progress.gradient:.2g}"
                parameters = self.to_parameters(jnp.asarray(x))
                return Summit(parameters, history, self._solved_at(x), bool(settled), message or unsaid)

    def _look(self, x: np.ndarray, rough: bool = False) -> _Point:
        """The objective at x; a rough look saves work where little seems to have changed since the last one."""
        if np.array_equal(x, self.last.x):
            return self.last
        rough = rough and bool(self.known)
        found, self.starts = self.objective.evaluate(
            self.to_parameters(jnp.asarray(x)),
            self.starts,
            self.tolerances[0],
            self.known,
            self.negligible if rough else 0.0,
            _LITTLE if rough and len(self.tolerances) > 1 else 0.0,
        )
        parts = np.array([found.objective, found.actions, found.transitions, found.prior])
        point, self.known = _Point(x, parts, np.asarray(ravel_pytree(found.slope)[0])), found.parts
        if not rough:
            self.last, self.solved = point, found.solved
        return point

    def _loss(self, x: np.ndarray, rough: bool = False) -> tuple[float, np.ndarray]:
        """Minus the objective, and its slope."""
        point = self._look(x, rough)
        # a solve that failed makes them NaN: worse than any other point, so that no search ends there
        usable = np.isfinite(point.parts[0]) and np.isfinite(point.slope).all()
        return -float(point.parts[0]) if usable else np.inf, point.slope

    def _be_more_exact(self) -> None:
        self.tolerances = self.tolerances[1:]
        self._forget()

    def _forget(self) -> None:
        """Makes the next look at any point a new one."""
        self.last, self.known = self.last._replace(x=np.full_like(self.start, np.nan)), []

    def _solved_at(self, x: np.ndarray) -> list[Solved]:
        """How the solves at x went; looked at once more if the last look was elsewhere or before an interruption."""
        if not self.solved:
            self._forget()
        self._look(x)
        return self.solved

    def _save(self, x: np.ndarray, state: PyTree, history: list[Progress]) -> None:
        if jax.process_index() == self.objective.processes[0]:
            self.saver.save(self._carried(x, state), history, self._kept())

    def _resumed(self, x: np.ndarray, state: PyTree) -> tuple[np.ndarray, PyTree, list[Progress]]:
        carried, records, kept = self.saver.load(self._carried(x, state), self._kept())
        x, state, self.last, left = carried
        if kept:
            self.starts = self.objective.placed(kept)
        self.tolerances = self.tolerances[len(self.tolerances) - int(left) :]
        return x, state, [Progress(int(record[0]), *record[1:]) for record in records]

    def _carried(self, x: np.ndarray, state: PyTree) -> PyTree:
        """All that the rest of the climb depends on, as arrays, but for where solves start."""
        return x, state, self.last, np.asarray(len(self.tolerances))

    def _kept(self) -> list[WarmStart]:
        """Where solves start, for a checkpoint: nothing where that is never changed, or is spread over processes."""
        return self.starts if self.objective.planned.keeps_starts and len(self.objective.processes) == 1 else []

    def _check(self, progress: Progress) -> None:
        """Raises if what was found at a point cannot be used."""
        if progress.iteration == 0:
            _check_start(self.objective.problem, self.solved)
        if not np.isfinite(progress).all():
            raise NotConverged(
                f"the values or their gradient stopped converging at iteration {progress.iteration}: a smaller β, "
                "a lower learning rate or more sweeps may help"
            )


_NEGLIGIBLE = 2e-5
"""What may be left out of a rough look, all batches of tasks together, as a share of the objective."""
_LITTLE = 0.01
"""Up to which change of what a batch adds, as a share of it, loose rough looks leave out states that did not matter."""


def _tolerances(problem: Problem, optimizer: Optimizer) -> list[float | None]:
    """The tolerances of the solves, one after the other; None for the solver's own."""
    dtype = jax.eval_shape(problem.model.probabilities).dtype
    if problem.solver.tolerance is not None or dtype != np.float64 or problem.model.graph.states < LARGE:
        return [None]
    return [optimizer.exactness, float(problem.solver.tolerance_for(dtype))]


def _reason_to_stop(now: Progress, settled: str, optimizer: Optimizer) -> str:
    if settled:
        return f"converged: {settled}"
    if now.iteration >= optimizer.iterations:
        return f"stopped after {now.iteration} iterations; the largest gradient is {now.gradient:.2g}"
    return ""


def _check_start(problem: Problem, solved: list[Solved]) -> None:
    """Values must exist at the start, and every walker must be able to arrive."""
    if not solved:
        return
    converged, residual, stuck = (
        np.concatenate([np.asarray(getattr(part, name)) for part in solved])
        for name in ("converged", "residual", "stuck")
    )
    if not converged.all():
        raise NotConverged(
            f"values did not converge for task(s) {np.flatnonzero(~converged).tolist()} (residual up to "
            f"{residual.max():.2g}): a smaller β, more sweeps or another backup may help"
        )
    if not stuck.any():
        return
    demos = problem.demonstrations
    task, choice = np.argwhere(stuck)[0]
    state = choices_of(demos).states[task, choice]
    move = np.flatnonzero((np.asarray(demos.task) == task) & (np.asarray(demos.states) == state))[0]
    raise InputError(
        f"state {int(state)} is visited, but the goal cannot be reached from it",
        source=f"trajectory {int(demos.trajectory[move]) + 1}",
    )
