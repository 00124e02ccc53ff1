"""Fits: maximize the posterior of a transition model after demonstrations (eqs. 1 and 6 of the paper).

    log L(θ) + log p(θ)

With exact gradients any optimizer may be used. The fixed-policy gradient of the Boltzmann average (eq. 9, the paper's)
is not the gradient of any function, so a line search is impossible: use `Adam` with it.

The loop of every fit is `maximize`: evaluate the objective, stop or take a step of the optimizer. Two devices save work
on large maps:

- Solves are loose at first. Where the optimizer has converged, or finds no better point, it continues from there with
  exact solves. It ends only with exact solves.
- An optimizer may ask for an approximate loss at a trial point (see `Optimizer.approximates`). It reuses the
  contributions of tasks that have hardly changed, and of tasks that have changed little it solves only the states that
  mattered (see `Objective.evaluate`).
"""

import enum
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from sidestep._typing import Tree
from sidestep.errors import InputError, NotConverged, check
from sidestep.inference.batching import LARGE_MAP, MEMORY, plan_batches
from sidestep.inference.checkpoints import Checkpoint, Saver, fingerprint
from sidestep.inference.objective import Contribution, Objective, Parameters, Problem, SolveSummary, joined
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer, Vector
from sidestep.inference.priors import Normal, Prior
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Terms, choices_of, transition_probabilities
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions, check_proper
from sidestep.tabular.solvers.base import WarmStart

Model = TypeVar("Model", bound=TransitionModel)


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


class Status(enum.Enum):
    """Why an optimization stopped; the values are the readable form.

    Example:
        >>> Status.MAX_ITERATIONS.advice
        'a larger max_iterations of the optimizer lets it continue'
    """

    CONVERGED = "converged"
    MAX_ITERATIONS = "stopped at max_iterations"
    NO_ASCENT_STEP = "stopped, no step increases the objective"
    PRECISION_LIMIT = "stopped, no step increases the objective in 32-bit numbers"

    @property
    def advice(self) -> str:
        """What may help; nothing after convergence."""
        return _ADVICE.get(self, "")


_ADVICE = {
    Status.MAX_ITERATIONS: "a larger max_iterations of the optimizer lets it continue",
    Status.NO_ASCENT_STEP: (
        "the objective has a kink here (as with HardMax), or the solver's tolerance does not resolve smaller changes"
    ),
    Status.PRECISION_LIMIT: (
        "32-bit numbers cannot resolve smaller changes of the objective; set jax.config.update('jax_enable_x64', True) "
        "before the model is made"
    ),
}


class Fit(eqx.Module, Generic[Model]):
    """A learned transition model.

    Attributes:
        model: The transition model at the maximum.
        behavior: The behavior model, with its learned parameters.
        history: The progress before the first and after every iteration.
        sweeps: The number of sweeps of each task's solve under the learned model.
        residual: The residual of each task's solve.
        task_converged: Whether each task's solve converged.
        status: Why the optimizer stopped.
        converged: Whether the optimizer and all tasks converged.
        message: The status with its measure and advice.

    Example:
        >>> from sidestep.tabular.demonstrations import Trajectory, gather
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> shown = gather([Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [reach(grid, 2)])
        >>> result = fit(ObstacleGrid(grid, 0.0), shown, Behavior(BoltzmannAverage()), terms=("transitions",))
        >>> result.status
        <Status.CONVERGED: 'converged'>
    """

    model: Model
    behavior: BehaviorModel
    history: tuple[Progress, ...] = eqx.field(static=True)
    sweeps: Int[Array, " tasks"]
    residual: Float[Array, " tasks"]
    task_converged: Bool[Array, " tasks"]
    status: Status = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)

    @property
    def final(self) -> Progress:
        """Return the objective and its parts at the learned model."""
        return self.history[-1]

    def summary(self) -> dict[str, Any]:
        """Return the fit's numbers: the objective and its parts in nats, and how the optimizer and the tasks ended.

        Returns:
            Plain numbers and texts.
        """
        final, solves = self.final, (self.sweeps, self.residual, self.task_converged)
        of_tasks = zip(*(np.asarray(each).tolist() for each in solves), strict=True)
        return {
            "objective": final.objective,
            "log_likelihood_actions": final.actions,
            "log_likelihood_transitions": final.transitions,
            "log_prior": final.prior,
            "largest_gradient": final.gradient,
            "iterations": final.iteration,
            "converged": self.converged,
            "message": self.message,
            "tasks": [dict(zip(("sweeps", "residual", "converged"), each, strict=True)) for each in of_tasks],
        }


def fit(
    model: Model,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    *,
    prior: Prior | None = None,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
    options: SolveOptions | None = None,
    optimizer: Optimizer | None = None,
    memory: float = MEMORY,
    mesh: Mesh | None = None,
    large_map: int = LARGE_MAP,
    report: Callable[[Progress], None] | None = None,
    checkpoint: str | Path | Checkpoint | None = None,
    resume: bool = False,
) -> Fit[Model]:
    """Maximize the posterior of demonstrations over the family of a transition model.

    Args:
        model: The transition model where the fit starts.
        demonstrations: Trajectories of agents that know the true dynamics.
        behavior: The behavior of the agents; `behavior_model(...)` where its parameters are to be learned too.
        prior: The prior of the model's parameters, by default `Normal()`, the paper's.
        tempering: κ in (0, 1], a factor of the actions' log-likelihood; below 1 where steps are not independent.
        terms: The parts of the likelihood that count: "actions", "transitions" or both.
        options: As for `solve`. On large maps solves are only as exact as the optimizer needs until it has converged,
            and exact from then on, unless the solver has a tolerance.
        optimizer: By default `LBFGS()`; `Adam()` for the fixed-policy gradient, `Rprop()` for large maps.
        memory: About how many bytes the arrays may take on a device; tasks are solved in batches that fit.
        mesh: The devices over which tasks are spread (see `tasks_mesh`). With devices of several processes, each
            process calls `fit` with the same arguments and gets the same model.
        large_map: The number of states from which a map is large: its first solves are loose, its batches small.
        report: Called with a `Progress` before the first and after every iteration, in every process.
        checkpoint: A file that is kept up to date while the fit runs.
        resume: Continue from the checkpoint. The fit ends exactly as if it had not been interrupted; with other
            devices, cores or `memory` than before, or with several processes, up to the tolerances. (The first process
            writes the file, all must see it.)

    Returns:
        The learned model, and how the optimization ended.

    Raises:
        InputError: For arguments that exclude each other, visited states from which a goal cannot be reached, or a
            checkpoint of another fit.
        ImproperTask: For tasks without values.
        NotConverged: If values do not converge at the start, or stop converging on the way.

    Example:
        >>> from sidestep.tabular.demonstrations import Trajectory, gather
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> shown = gather([Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [reach(grid, 2)])
        >>> result = fit(ObstacleGrid(grid, 0.0), shown, Behavior(BoltzmannAverage()), terms=("transitions",))
        >>> bool((result.model.blocked < 0.5)[0, 1])  # a cell that was entered
        True

    References:
        Equations 1 and 6 of the behavior-aware modeling paper.
    """
    optimizer, options = optimizer or LBFGS(), options or SolveOptions()
    behavior = behavior_model(behavior) if isinstance(behavior, Behavior) else behavior
    solver = options.solver_for(behavior.behavior.backup, model.graph.states)
    options = SolveOptions(options.gradient, options.horizon, solver)
    problem = Problem(model, behavior, demonstrations, prior or Normal(), terms, options, tempering)
    _check_problem(problem, optimizer)
    count, devices, reuse = len(demonstrations.tasks.terminal), 1 if mesh is None else mesh.size, optimizer.approximates
    plan = plan_batches(model, solver, count, memory=memory, devices=devices, reuse=reuse, large_map=large_map)
    objective, tolerances = Objective(problem, plan, mesh), solve_tolerances(problem, optimizer, large_map)
    saver = Saver(checkpoint, fingerprint((problem, optimizer.key)) if checkpoint is not None else "")
    return maximize(objective, optimizer, tolerances=tolerances, saver=saver, report=report, resume=resume)


_REUSE = 2e-5
"""The largest change of all contributions together that an approximate evaluation reuses (a fraction of the objective).
"""
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
) -> Fit[Any]:
    """Maximize an objective from the parameters of its problem.

    Args:
        objective: The objective.
        optimizer: `LBFGS`, `Adam` or `Rprop`.
        tolerances: Those of the solves, one after the other (see `solve_tolerances`); None for the solver's own.
        saver: Keeps a checkpoint up to date.
        report: Called with the progress before the first step and after each step.
        resume: Continue from the saver's checkpoint.

    Returns:
        The fit.

    Raises:
        NotConverged: If values do not converge at the start, or stop converging on the way.
        InputError: If a visited state cannot reach its goal, and as `Saver.load` does.
    """
    saver = saver or Saver(None, "")
    evaluator = _Evaluator(objective, tolerances)
    x, state, history = evaluator.start, optimizer.init(evaluator.start), []
    if resume:
        x, state, history = evaluator.load(saver, x, state)
    while True:
        point = evaluator.evaluate(x)
        progress = Progress(len(history), *point.terms.tolist(), gradient=float(np.abs(point.gradient).max()))
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
            update = optimizer.step(evaluator.loss, x, -progress.objective, point.gradient, state)
        if update is not None:
            x, state = update
            if jax.process_index() == objective.processes[0]:
                dependencies, starts = evaluator.dependencies(x, state)
                saver.save(dependencies, history, starts)
        elif evaluator.tighten():
            history.pop()
        else:
            status = status or (Status.NO_ASCENT_STEP if x.dtype == np.float64 else Status.PRECISION_LIMIT)
            measure = optimizer.measure.format(optimizer.convergence(point.gradient, state))
            message = "; ".join(filter(None, (f"{status.value}: {measure}", status.advice)))
            problem, parameters = objective.problem, evaluator.parameters(x)
            tasks = len(problem.demonstrations.tasks.terminal)
            model = problem.model.with_parameters(parameters.model)
            behavior = problem.behavior.with_parameters(parameters.behavior)
            sweeps, residual, task_converged = _of_all_tasks(evaluator.solves_at(x), tasks)
            solves = sweeps, residual, task_converged
            converged = status is Status.CONVERGED and bool(np.asarray(task_converged).all())
            return Fit(model, behavior, tuple(history), *solves, status, converged, message)


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


class _Evaluator:
    """Evaluates an objective at vectors, each time from the warm starts of the last time.

    It keeps the last exact point, because line searches ask for it twice.
    """

    def __init__(self, objective: Objective, tolerances: Sequence[float | None]):
        self.objective, self.tolerances = objective, list(tolerances)
        self.start, self.unravel = _ravel(objective.problem.parameters)
        self.warm_starts = objective.cold_starts()
        self.last = _Point(np.full_like(self.start, np.nan), np.zeros(4), np.zeros_like(self.start))
        self.solves: list[SolveSummary] = []
        self.contributions: list[Contribution] = []
        self.scale = 0.0

    def parameters(self, x: Vector) -> Parameters:
        return jax.tree.map(jax.device_put, self.unravel(x))

    def evaluate(self, x: Vector, approximate: bool = False) -> _Point:
        if np.array_equal(x, self.last.x):
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
        point = _Point(x, np.array(evaluation[:4]), _ravel(evaluation.gradient)[0])
        self.contributions = evaluation.contributions
        if not approximate:
            self.last, self.solves = point, evaluation.solves
        return point

    def loss(self, x: Vector, *, approximate: bool = False) -> tuple[float, Vector]:
        """Return minus the objective and its gradient; infinity where a solve failed, so that no search ends there."""
        point = self.evaluate(x, approximate)
        usable = np.isfinite(point.terms[0]) and np.isfinite(point.gradient).all()
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
            f"{residual.max():.2g}): a smaller β, more sweeps or another backup may help"
        )
    if unreachable.any():
        task, choice = np.argwhere(unreachable)[0]
        state = choices_of(demos).states[task, choice]
        move = np.flatnonzero((np.asarray(demos.task) == task) & (np.asarray(demos.states) == state))[0]
        raise InputError(
            f"state {int(state)} is visited, but the goal cannot be reached from it",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
        )


def _of_all_tasks(batches: list[SolveSummary], tasks: int) -> list[Array]:
    """Return the sweeps, residuals and convergence of all tasks; tasks without a solve count as converged."""
    unsolved = np.zeros(tasks, int), np.zeros(tasks), np.ones(tasks, dtype=bool)
    return [jax.device_put(leaf[:tasks]) for leaf in (joined(batches)[:3] if batches else unsolved)]


def _check_problem(problem: Problem, optimizer: Optimizer) -> None:
    terms, tempering, options, behavior = problem.terms, float(problem.tempering), problem.options, problem.behavior
    graph, demos = problem.model.graph, problem.demonstrations
    known = terms and set(terms) <= set(ALL_TERMS)
    check(known, f"expected one or both of {ALL_TERMS}, found {terms}", field="terms")
    check(0 < tempering <= 1, f"expected a number above 0 and at most 1, found {tempering}", field="tempering")
    has_objective = options.gradient == "exact" or not isinstance(behavior.behavior.backup, BoltzmannAverage)
    check(
        has_objective or isinstance(optimizer, Adam),
        "the fixed-policy gradient of the Boltzmann average is not the gradient of any function, so a line search is "
        "impossible: expected Adam() as the optimizer, or SolveOptions('exact')",
        field="gradient",
    )
    states, actions = demos.tasks.terminal.shape[-1], int(np.asarray(demos.actions).max())
    check(
        states == graph.states and actions < graph.actions,
        f"expected demonstrations in the model's {graph.states} states with its {graph.actions} actions, found "
        f"{states} states and actions up to {actions}",
        field="demonstrations",
    )
    check_proper(behavior.tasks_of(demos.tasks), behavior.behavior_of(), graph.actions, options.horizon)
