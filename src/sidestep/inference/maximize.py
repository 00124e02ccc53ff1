"""The loop of every fit: evaluate the objective, stop or take a step of the optimizer.

Two methods save work on large maps:

- Solves are loose at first. Where the optimizer has converged, or finds no better point, it continues from there with
  exact solves. It ends only with exact solves.
- An optimizer may ask for an approximate loss at a trial point (see `Optimizer.approximates`). It reuses the
  contributions of tasks that have hardly changed, and of tasks that have changed little it solves only the states that
  mattered (see `Objective.evaluate`).
"""

import enum
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from sidestep._typing import Tree
from sidestep.errors import InputError, NotConverged
from sidestep.inference.batching import LARGE_MAP
from sidestep.inference.checkpoints import Saver
from sidestep.inference.objective import Contribution, Objective, Parameters, Problem, SolveSummary, joined
from sidestep.inference.optimizers import Optimizer, Vector
from sidestep.tabular.likelihood import choices_of, log_policies, transition_probabilities
from sidestep.tabular.solvers.base import WarmStart


class Progress(NamedTuple):
    """The state of a fit after an iteration.

    Attributes:
        iteration: 0 before the first step.
        objective: log L(θ) + log p(θ), in nats.
        actions, transitions, prior: Its parts.
        gradient: The largest component of its gradient.

    Example:
        >>> Progress(0, objective=-3.0, actions=-2.0, transitions=-0.5, prior=-0.5, gradient=1.0).objective
        -3.0
    """

    iteration: int
    objective: float
    actions: float
    transitions: float
    prior: float
    gradient: float

    @property
    def total(self) -> None:
        """Return the number of all iterations: it is not known."""
        return None

    @property
    def description(self) -> str:
        """Return the objective and the largest component of its gradient as text."""
        return f"objective {self.objective:.3f}, largest gradient {self.gradient:.2g}"


class Status(enum.Enum):
    """Why an optimization stopped, or whether chains have mixed; the values are the readable form.

    Example:
        >>> Status.MAX_ITERATIONS.advice
        'a larger max_iterations lets it continue'
    """

    CONVERGED = "converged"
    MAX_ITERATIONS = "stopped at max_iterations"
    NO_ASCENT_STEP = "stopped, no step increases the objective"
    PRECISION_LIMIT = "stopped, no step increases the objective in 32-bit numbers"
    NO_VALUES = "stopped, values do not exist or do not converge next to this point"
    MIXED = "mixed"
    NOT_MIXED = "chains have not mixed"

    @property
    def advice(self) -> str:
        """What may help; nothing after success."""
        return _ADVICE.get(self, "")


_ADVICE = {
    Status.NOT_MIXED: "more sweeps let the chains agree",
    Status.MAX_ITERATIONS: "a larger max_iterations lets it continue",
    Status.NO_ASCENT_STEP: (
        "the objective has a kink here (as with HardMax), or the solver's tolerance does not resolve smaller changes"
    ),
    Status.NO_VALUES: (
        "the maximum may lie where a task has no values; a discount below 1, a narrower prior or more sweeps may help"
    ),
    Status.PRECISION_LIMIT: (
        "32-bit numbers cannot resolve smaller changes of the objective; set jax.config.update('jax_enable_x64', True) "
        "before the model is made"
    ),
}


class Maximum(NamedTuple):
    """The end of an optimization.

    Attributes:
        parameters: θ.
        history: The progress before the first and after every iteration.
        status: Why the optimizer stopped.
        message: The status with its measure and advice.
        solves: The solves of each batch's tasks at θ.
    """

    parameters: Parameters
    history: tuple[Progress, ...]
    status: Status
    message: str
    solves: list[SolveSummary]


_REUSE = 2e-5
"""The largest change of all contributions together that an approximate evaluation reuses (a fraction of the objective).
"""
_MOST_LEFT = 1.0
"""The most nats that may be left to gain where a fit has converged, whatever its numbers resolve."""
_ROUNDING = 64
"""The error of the objective by rounding, in units of its last digit."""
_PARTIAL = 0.01
"""The largest change of a contribution, as a fraction of it, for which only the states that mattered are solved."""


def maximize(
    objective: Objective,
    optimizer: Optimizer,
    *,
    tolerances: Sequence[float | None] = (None,),
    saver: Saver | None = None,
    report: Callable[[Progress], None] | None = None,
    resume: bool = False,
) -> Maximum:
    """Maximize an objective from the parameters of its problem.

    Args:
        objective: The objective.
        optimizer: `LBFGS`, `Adam` or `Rprop`.
        tolerances: Those of the solves, one after the other (see `solve_tolerances`); None for the solver's own.
        saver: Keeps a checkpoint up to date.
        report: Called with the progress before the first step and after each step.
        resume: Continue from the saver's checkpoint.

    Returns:
        The parameters, the progress, and why the optimization stopped.

    Raises:
        NotConverged: If values do not converge at the start, or stop converging on the way.
        InputError: If a visited state cannot reach its goal, and as `Saver.load` does.
    """
    saver = saver or Saver(None, "")
    evaluator = _Evaluator(objective, tolerances, optimizer.scales)
    x, state, history = evaluator.start, optimizer.init(evaluator.start), []
    if resume:
        x, state, history = evaluator.load(saver, x, state)
    while True:
        point = evaluator.evaluate(x)
        progress = Progress(
            len(history), *point.terms.tolist(), gradient=float(np.abs(point.gradient).max(initial=0.0))
        )
        if progress.iteration == 0:
            _check_start(objective.problem, progress, evaluator.solves)
        if not np.isfinite(progress).all():
            raise NotConverged(
                f"the values or their gradient stopped converging at iteration {progress.iteration}: a smaller β, "
                "a smaller learning rate or more sweeps may help"
            )
        evaluator.scale = abs(progress.objective)
        history.append(progress)
        if report:
            report(progress)
        status, update = None, None
        if optimizer.terminate(point.gradient, state):
            status = Status.CONVERGED
        elif progress.iteration >= optimizer.max_iterations:
            status = Status.MAX_ITERATIONS
        else:
            evaluator.nearest = _Nearest(x)
            update = optimizer.step(evaluator.loss, x, -progress.objective, point.gradient, state)
        if update is not None:
            x, state = update
            if jax.process_index() == objective.processes[0]:
                dependencies, starts = evaluator.dependencies(x, state)
                saver.save(dependencies, history, starts)
        elif evaluator.tighten():
            history.pop()
        else:
            measure = optimizer.measure.format(optimizer.convergence(point.gradient, state))
            limit = min(evaluator.resolution, _MOST_LEFT)
            if status is None and not evaluator.nearest.usable:
                status = Status.NO_VALUES
            if status is None and optimizer.expected_gain(x, point.gradient, state) <= limit:
                status = Status.CONVERGED
                measure += f", and no more than {limit:.1g} nats are left to gain, the precision of the objective"
                measure += "" if x.dtype == np.float64 else " in 32-bit numbers (see jax_enable_x64)"
            status = status or (Status.NO_ASCENT_STEP if x.dtype == np.float64 else Status.PRECISION_LIMIT)
            message = "; ".join(filter(None, (f"{status.value}: {measure}", status.advice)))
            return Maximum(evaluator.parameters(x), tuple(history), status, message, evaluator.solves_at(x))


def solve_tolerances(problem: Problem, optimizer: Optimizer, large_map: int = LARGE_MAP) -> list[float | None]:
    """Return the tolerances of the solves for `maximize`: loose ones first on large maps in 64-bit numbers.

    Args:
        problem: The problem.
        optimizer: The optimizer, which has the first tolerance.
        large_map: The number of states from which a map is large.
    """
    dtype = jax.eval_shape(problem.model.probabilities).dtype
    if problem.solver.tolerance is not None or dtype != np.float64 or problem.model.graph.states < large_map:
        return [None]
    return [optimizer.solve_tolerance, float(problem.solver.tolerance_for(dtype))]


class _Point(NamedTuple):
    """The objective and its parts, and the gradient of the loss, at x."""

    x: np.ndarray
    terms: np.ndarray
    gradient: np.ndarray


class _Nearest(NamedTuple):
    """The trial point next to x of one step, and whether it has a finite loss; none at first."""

    x: np.ndarray
    distance: float = np.inf
    usable: bool = True

    def after(self, trial: np.ndarray, usable: bool) -> "_Nearest":
        distance = float(np.abs(trial - self.x).max(initial=0.0))
        return _Nearest(self.x, distance, usable) if 0 < distance < self.distance else self


class _Evaluator:
    """Evaluates an objective at vectors, each time from the warm starts of the last time.

    It keeps the last exact point, because line searches ask for it twice.
    """

    def __init__(self, objective: Objective, tolerances: Sequence[float | None], scales: bool):
        self.objective, self.tolerances = objective, list(tolerances)
        problem = objective.problem
        start, self.unravel = _ravel(problem.parameters)
        self.unit = np.ones_like(start)
        if scales:
            # a tight prior would leave the line search no step to start with
            tight = _ravel(problem.prior.scale(problem.model.parameters))[0]
            self.unit[: len(tight)] = tight
        self.start = start / self.unit
        self.warm_starts = objective.cold_starts()
        self.last = _Point(np.full_like(self.start, np.nan), np.zeros(4), np.zeros_like(self.start))
        self.solves: list[SolveSummary] = []
        self.contributions: list[Contribution] = []
        self.scale = 0.0
        self.nearest = _Nearest(self.start)

    @property
    def resolution(self) -> float:
        """Return the smallest change of the objective that its numbers and the tolerance of the solves resolve."""
        problem = self.objective.problem
        dtype = jax.eval_shape(problem.model.probabilities).dtype
        return max(float(problem.solver.tolerance_for(dtype)), _ROUNDING * float(np.finfo(dtype).eps)) * self.scale

    def parameters(self, x: Vector) -> Parameters:
        return jax.device_put(self.unravel(x * self.unit))

    def evaluate(self, x: Vector, approximate: bool = False) -> _Point:
        # without parameters there is no NaN to tell that nothing was evaluated yet
        if x.size and np.array_equal(x, self.last.x):
            return self.last
        approximate = approximate and bool(self.contributions)
        evaluation, self.warm_starts = self.objective.evaluate(
            self.parameters(x),
            self.warm_starts,
            tolerance=self.tolerances[0],
            known=self.contributions,
            reuse_below=_REUSE * self.scale / max(1, len(self.objective.batches)) if approximate else 0.0,
            partial_below=_PARTIAL if approximate and len(self.tolerances) > 1 else 0.0,
        )
        point = _Point(x, np.array(evaluation[:4]), _ravel(evaluation.gradient)[0] * self.unit)
        self.contributions = evaluation.contributions
        if not approximate:
            self.last, self.solves = point, evaluation.solves
        return point

    def loss(self, x: Vector, *, approximate: bool = False) -> tuple[float, Vector]:
        """Return minus the objective and its gradient; infinity where a solve failed, so that no search ends there."""
        point = self.evaluate(x, approximate)
        usable = np.isfinite(point.terms[0]) and np.isfinite(point.gradient).all()
        self.nearest = self.nearest.after(x, bool(usable))
        return -float(point.terms[0]) if usable else np.inf, point.gradient

    def tighten(self) -> bool:
        """Continue with the next tolerance; return whether there is one."""
        if len(self.tolerances) == 1:
            return False
        self.tolerances = self.tolerances[1:]
        self._forget()
        return True

    def solves_at(self, x: Vector) -> list[SolveSummary]:
        """Return the solves at x; after an interruption or elsewhere, evaluate them once more."""
        if not self.solves:
            self._forget()
        self.evaluate(x)
        return self.solves

    def _forget(self) -> None:
        self.last, self.contributions = self.last._replace(x=np.full_like(self.start, np.nan)), []

    def dependencies(self, x: Vector, state: Tree) -> tuple[Tree, list[WarmStart]]:
        """Return what the rest of the optimization depends on.

        Warm starts that never change or are spread over processes are left out.
        """
        keep = self.objective.plan.keeps_warm_starts and len(self.objective.processes) == 1
        return (x, state, self.last, np.asarray(len(self.tolerances))), self.warm_starts if keep else []

    def load(self, saver: Saver, x: Vector, state: Tree) -> tuple[Vector, Tree, list[Progress]]:
        """Return the point, the optimizer's state and the history of a checkpoint."""
        saved, starts = self.dependencies(x, state)
        (x, state, self.last, remaining), rows, starts = saver.load(saved, starts)
        if starts:
            self.warm_starts = self.objective.place(starts)
        self.tolerances = self.tolerances[len(self.tolerances) - int(remaining) :]
        return x, state, [Progress(int(row[0]), *row[1:]) for row in rows]


def _ravel(tree: Tree) -> tuple[Vector, Callable[[Vector], Tree]]:
    """Return the leaves of a tree as one vector, and the inverse: `ravel_pytree` without compiled code."""
    leaves, structure = jax.tree.flatten(jax.tree.map(np.asarray, tree))
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]

    def unravel(x: Vector) -> Tree:
        parts = zip(np.split(x, ends), leaves, strict=True)
        return jax.tree.unflatten(structure, [part.reshape(leaf.shape).astype(leaf.dtype) for part, leaf in parts])

    return np.concatenate([leaf.ravel() for leaf in leaves]), unravel


def _check_start(problem: Problem, progress: Progress, solves: list[SolveSummary]) -> None:
    """Raise unless all moves are possible, values converge, and every visited state can reach its goal."""
    demos = problem.demonstrations
    if progress.transitions == -np.inf:
        move = np.flatnonzero(np.asarray(transition_probabilities(problem.model, demos)) == 0)[0]
        raise InputError(
            f"action {int(demos.actions[move])} in state {int(demos.states[move])} led to state "
            f"{int(demos.next_states[move])}, to which the model gives probability 0 (on a map: a known obstacle)",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
        )
    if not solves:
        return
    _, residual, converged, unreachable = joined(solves)
    if not converged.all():
        raise NotConverged(
            f"values did not converge for task(s) {np.flatnonzero(~converged).tolist()} (residual up to "
            f"{residual.max():.2g}): 64-bit numbers (`jax_enable_x64`), more sweeps, a smaller β or another backup may "
            "help"
        )
    if unreachable.any():
        task, choice = np.argwhere(unreachable)[0]
        state = choices_of(demos, deadline=problem.options.deadline).states[task, choice]
        move = np.flatnonzero((np.asarray(demos.task) == task) & (np.asarray(demos.states) == state))[0]
        raise InputError(
            f"state {int(state)} is visited, but the goal cannot be reached from it",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
        )
    if progress.actions == -np.inf:
        chosen = np.asarray(log_policies(problem.model, demos, problem.behavior, options=problem.options))
        move = np.flatnonzero((chosen == -np.inf) & (np.asarray(demos.weights) > 0))[0]
        raise InputError(
            f"agents choose action {int(demos.actions[move])} in state {int(demos.states[move])} with probability 0: "
            "its value is −∞, as where it may lead to states from which the task never ends; a lapse, a discount below "
            "1 or a horizon makes it possible",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
        )
