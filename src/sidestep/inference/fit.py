"""Fits: maximize the posterior of a transition model after demonstrations (eqs. 1 and 6 of the paper).

    log L(θ) + log p(θ)

With exact gradients any optimizer may be used. The fixed-policy gradient of the Boltzmann average (eq. 9, the paper's)
is not the gradient of any function, so a line search is impossible: use `Adam` with it.
"""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from sidestep._repr import short_repr
from sidestep.errors import check, check_function, check_instance, to_count, to_number
from sidestep.inference.arguments import check_evidence
from sidestep.inference.batching import LARGE_MAP, MEMORY, plan_batches
from sidestep.inference.checkpoints import Checkpoint, Saver, fingerprint
from sidestep.inference.maximize import Progress, Status, maximize, solve_tolerances
from sidestep.inference.objective import Objective, Parameters, Problem, SolveSummary, joined
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer
from sidestep.inference.priors import Normal, Prior
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import BehaviorModel, as_behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Terms, check_deadline
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.tasks import Task
from sidestep.tabular.wandering import suspects, warn_of_wandering

if TYPE_CHECKING:
    from sidestep.inference.information import Information

Model = TypeVar("Model", bound=TransitionModel)


class Estimate(NamedTuple):
    """A learned number.

    Attributes:
        estimate: The number at the maximum.
        standard_error: Its standard error; None where it is unknown.

    Example:
        >>> Estimate(5.2, 0.4).standard_error
        0.4
    """

    estimate: float
    standard_error: float | None


@short_repr("model", "behavior", "problem", "description", "converged")
class Fit(eqx.Module, Generic[Model]):
    """A learned transition model.

    Attributes:
        model: The transition model at the maximum.
        behavior: The behavior model, with its learned parameters.
        problem: What was maximized: demonstrations, prior, options; with the model and behavior where the fit started.
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
    problem: Problem
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

    @property
    def description(self) -> str:
        """Return the objective and how the optimization ended as text."""
        return f"objective {self.final.objective:.4f} after {self.final.iteration} iterations; {self.message}"

    @cached_property
    def learned_behavior(self) -> dict[str, Estimate]:
        """Return `beta` (of a typical person), `lapse` and `discount`, those of them that were learned.

        There is no standard error where the problem is not small (`laplace` takes longer there), and where the
        posterior has no normal approximation.
        """
        if not jax.tree.leaves(self.behavior.parameters):
            return {}
        from sidestep.inference.laplace import behavior_estimates

        return behavior_estimates(self)

    def information(self) -> "Information":
        """Return the observed information at the maximum, as `laplace` needs it.

        Raises:
            InputError: For values that did not converge.
        """
        from sidestep.inference.tabular_information import TabularInformation

        converged = bool(np.asarray(self.task_converged).all())
        check(converged, f"expected values that converged: {self.message}", source="laplace", field="fit")
        parameters = Parameters(self.model.parameters, self.behavior.parameters)
        return TabularInformation(self.problem, parameters, self.message)

    def summary(self) -> dict[str, Any]:
        """Return the fit's numbers: the objective and its parts in nats, and how the optimizer and the tasks ended.

        Where β, lapse or discount were learned, `learned_behavior` has them with their standard errors.

        Returns:
            Plain numbers and texts.
        """
        final, solves = self.final, (self.sweeps, self.residual, self.task_converged)
        learned = {name: number._asdict() for name, number in self.learned_behavior.items()}
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
            **({"learned_behavior": learned} if learned else {}),
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
        report: Called with a `Progress` before the first and after every iteration, in every process. An error that it
            raises ends the fit and is passed on unchanged.
        checkpoint: A file that is kept up to date while the fit runs.
        resume: Continue from the checkpoint. The fit ends exactly as if it had not been interrupted; with other
            devices, cores or `memory` than before, or with several processes, up to the tolerances. (The first process
            writes the file, all must see it.)

    Returns:
        The learned model, and how the optimization ended. `laplace` gives what was learned standard errors, by second
        derivatives of the posterior. Where agents that behave as was learned avoid their goals, because entropy is
        worth more to them, a `SidestepWarning` says so as `solve` does, once.

    Raises:
        InputError: For arguments of other types or out of range, or that exclude each other, demonstrations in another
            world, visited states from which a goal cannot be reached, or a checkpoint of another fit.
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
    check_evidence(model, demonstrations, behavior, tempering, terms)
    optimizer, prior = LBFGS() if optimizer is None else optimizer, Normal() if prior is None else prior
    options = SolveOptions() if options is None else options
    _check_settings(optimizer, options, prior, memory, mesh, large_map, report)
    behavior = as_behavior_model(behavior)
    solver = options.solver_for(behavior.behavior.backup, model.graph.states)
    options = SolveOptions(options.gradient, options.horizon, solver, deadline=options.deadline)
    problem = Problem(model, behavior, demonstrations, prior, tuple(terms), options, tempering)
    _check_problem(problem, optimizer)
    count, devices, reuse = len(demonstrations.tasks.terminal), 1 if mesh is None else mesh.size, optimizer.approximates
    plan = plan_batches(model, solver, count, memory=memory, devices=devices, reuse=reuse, large_map=large_map)
    objective, tolerances = Objective(problem, plan, mesh), solve_tolerances(problem, optimizer, large_map)
    saver = Saver(checkpoint, fingerprint((problem, optimizer.key)) if checkpoint is not None else "")
    best = maximize(objective, optimizer, tolerances=tolerances, saver=saver, report=report, resume=resume)
    learned = model.with_parameters(best.parameters.model), behavior.with_parameters(best.parameters.behavior)
    sweeps, residual, task_converged = _of_all_tasks(best.solves, count)
    if "actions" in problem.terms and options.horizon is None:
        solved = _solve_suspects(*learned, demonstrations.tasks, options)
        warn_of_wandering(learned[0], demonstrations.tasks, learned[1], *solved)
    converged = best.status is Status.CONVERGED and bool(np.asarray(task_converged).all())
    status = best.status, converged, best.message
    return Fit(*learned, problem, best.history, sweeps, residual, task_converged, *status)


def _of_all_tasks(batches: list[SolveSummary], tasks: int) -> list[Array]:
    """Return the sweeps, residuals and convergence of all tasks; tasks without a solve count as converged."""
    unsolved = np.zeros(tasks, int), np.zeros(tasks), np.ones(tasks, dtype=bool)
    return [jax.device_put(leaf[:tasks]) for leaf in (joined(batches)[:3] if batches else unsolved)]


def _solve_suspects(
    model: TransitionModel, behavior: BehaviorModel, tasks: Task, options: SolveOptions
) -> tuple[Float[np.ndarray, "tasks states"], Bool[np.ndarray, " tasks"]]:
    """Return the values of tasks in which agents may wander, and whether they converged; none of other tasks."""
    values, converged = np.full(tasks.terminal.shape, np.nan), np.zeros(len(tasks.terminal), bool)
    some = np.array(suspects(model, tasks, behavior), int)
    if len(some):
        own, person = jax.tree.map(lambda leaf: to_jax(np.asarray(leaf)[some]), tasks), behavior.person
        if person is not None:
            behavior = eqx.tree_at(lambda each: each.person, behavior, to_jax(np.asarray(person)[some]))
        values[some], converged[some] = (np.asarray(part) for part in _values(model, own, behavior, options))
    return values, converged


@eqx.filter_jit
def _values(
    model: TransitionModel, tasks: Task, behavior: BehaviorModel, options: SolveOptions
) -> tuple[Float[Array, "tasks states"], Bool[Array, " tasks"]]:
    solution = solve(model, tasks, behavior, options=options, visited=jnp.zeros((len(tasks.terminal), 1), jnp.int32))
    return solution.values, solution.converged


def _check_settings(
    optimizer: Optimizer,
    options: SolveOptions,
    prior: Prior,
    memory: float,
    mesh: Mesh | None,
    large_map: int,
    report: Callable[[Progress], None] | None,
) -> None:
    check_instance(optimizer, Optimizer, "optimizer")
    check_instance(options, SolveOptions, "options")
    check_instance(prior, Prior, "prior")
    to_number(memory, "memory", above=0)
    check_instance(mesh, (Mesh, type(None)), "mesh")
    to_count(large_map, "large_map", 0)
    if report is not None:
        check_function(report, "report")


def _check_problem(problem: Problem, optimizer: Optimizer) -> None:
    options, behavior = problem.options, problem.behavior
    graph, demos = problem.model.graph, problem.demonstrations
    problem.prior.check_parameters(problem.model.parameters)
    has_objective = options.gradient == "exact" or not isinstance(behavior.behavior.backup, BoltzmannAverage)
    message = "the fixed-policy gradient of the Boltzmann average belongs to no objective: expected Adam(), or 'exact'"
    message += f", found {type(optimizer).__name__}"
    check(has_objective or isinstance(optimizer, Adam), message, field="gradient")
    check_deadline(demos, options)
    check_proper(demos.tasks, behavior, graph, options.horizon)
