"""Fits: maximize the posterior of a transition model after demonstrations (eqs. 1 and 6 of the paper).

    log L(θ) + log p(θ)

With exact gradients any optimizer may be used. The fixed-policy gradient of the Boltzmann average (eq. 9, the paper's)
is not the gradient of any function, so a line search is impossible: use `Adam` with it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import InputError
from sidestep.inference.batching import LARGE_MAP, MEMORY, plan_batches
from sidestep.inference.checkpoints import Checkpoint, Saver, fingerprint
from sidestep.inference.maximize import Progress, Status, maximize, solve_tolerances
from sidestep.inference.objective import Objective, Problem, SolveSummary
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer
from sidestep.inference.priors import Normal, Prior
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Term
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions, check_proper

Model = TypeVar("Model", bound=TransitionModel)


class Fit(eqx.Module, Generic[Model]):
    """A learned transition model.

    Attributes:
        model: the transition model at the maximum.
        behavior: the behavior model, with its learned parameters.
        history: the progress before the first and after every iteration.
        sweeps: the number of sweeps of each task's solve under the learned model.
        residual: the residual of each task's solve.
        task_converged: whether each task's solve converged.
        status: why the optimizer stopped.
        converged: whether the optimizer and all tasks converged.
        message: the status with its measure and advice.
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


def fit(
    model: Model,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    *,
    prior: Prior | None = None,
    tempering: float = 1.0,
    terms: tuple[Term, ...] = ALL_TERMS,
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
        model: the transition model where the fit starts.
        demonstrations: trajectories of agents that know the true dynamics.
        behavior: the behavior of the agents; `behavior_model(...)` where its parameters are to be learned too.
        prior: the prior of the model's parameters, by default `Normal()`, the paper's.
        tempering: κ in (0, 1], a factor of the actions' log-likelihood; below 1 where steps are not independent.
        terms: the parts of the likelihood that count: "actions", "transitions" or both.
        options: as for `solve`. On large maps solves are only as exact as the optimizer needs until it has converged,
            and exact from then on, unless the solver has a tolerance.
        optimizer: by default `LBFGS()`; `Adam()` for the fixed-policy gradient, `Rprop()` for large maps.
        memory: about how many bytes the arrays may take on a device; tasks are solved in batches that fit.
        mesh: the devices over which tasks are spread (see `tasks_mesh`). With devices of several processes, each
            process calls `fit` with the same arguments and gets the same model.
        large_map: the number of states from which a map is large: its first solves are loose, its batches small.
        report: called with a `Progress` before the first and after every iteration, in every process.
        checkpoint: a file that is kept up to date while the fit runs.
        resume: continue from the checkpoint. The fit ends exactly as if it had not been interrupted; with other
            devices, cores or `memory` than before, or with several processes, up to the tolerances. (The first process
            writes the file, all must see it.)

    Returns:
        The learned model, and how the optimization ended.

    Raises:
        InputError: for arguments that exclude each other, visited states from which a goal cannot be reached, or a
            checkpoint of another fit.
        ImproperTask: for tasks without values.
        NotConverged: if values do not converge at the start, or stop converging on the way.
    """
    optimizer, options = optimizer or LBFGS(), options or SolveOptions()
    behavior = behavior_model(behavior) if isinstance(behavior, Behavior) else behavior
    _check_settings(terms, tempering, options, behavior.behavior, optimizer)
    _check_sizes(model, demonstrations)
    tasks = demonstrations.tasks
    check_proper(behavior.tasks_of(tasks), behavior.behavior_of(), model.graph.actions, options.horizon)
    solver = options.solver_for(behavior.behavior.backup, model.graph.states)
    options = SolveOptions(options.gradient, options.horizon, solver)
    problem = Problem(model, behavior, demonstrations, prior or Normal(), terms, options, tempering)
    plan = plan_batches(
        model,
        solver,
        len(tasks.terminal),
        memory=memory,
        devices=1 if mesh is None else mesh.size,
        reuse=optimizer.approximates,
        large_map=large_map,
    )
    result = maximize(
        Objective(problem, plan, mesh),
        optimizer,
        tolerances=solve_tolerances(problem, optimizer, large_map),
        saver=Saver(checkpoint, fingerprint((problem, optimizer.key)) if checkpoint is not None else ""),
        report=report,
        resume=resume,
    )
    solves = _of_all_tasks(result.solves, len(tasks.terminal))
    return Fit(
        model=model.with_parameters(result.parameters.model),
        behavior=behavior.with_parameters(result.parameters.behavior),
        history=tuple(result.history),
        sweeps=solves.sweeps,
        residual=solves.residual,
        task_converged=solves.converged,
        status=result.status,
        converged=result.status is Status.CONVERGED and bool(np.asarray(solves.converged).all()),
        message=result.message,
    )


def _of_all_tasks(batches: list[SolveSummary], tasks: int) -> SolveSummary:
    """Join the solves of batches, without those of padding; tasks without a solve count as converged."""
    if not batches:
        unsolved = np.zeros(tasks, int), np.zeros(tasks), np.ones(tasks, dtype=bool), np.zeros((tasks, 0), dtype=bool)
        return SolveSummary(*map(jax.device_put, unsolved))
    return SolveSummary(
        *(
            jax.device_put(np.concatenate([np.asarray(leaf) for leaf in leaves])[:tasks])
            for leaves in zip(*batches, strict=True)
        )
    )


def _check_settings(
    terms: tuple[Term, ...], tempering: float, options: SolveOptions, behavior: Behavior, optimizer: Optimizer
) -> None:
    if not terms or not set(terms) <= set(ALL_TERMS):
        raise InputError(f"expected one or both of {ALL_TERMS}, found {terms}", field="terms")
    if not 0 < tempering <= 1:
        raise InputError(f"expected a number above 0 and at most 1, found {tempering}", field="tempering")
    searches = not isinstance(optimizer, Adam)
    if options.gradient == "fixed_policy" and searches and isinstance(behavior.backup, BoltzmannAverage):
        raise InputError(
            "the fixed-policy gradient of the Boltzmann average is not the gradient of any function, so a line search "
            "is impossible: expected Adam() as the optimizer, or SolveOptions('exact')",
            field="gradient",
        )


def _check_sizes(model: TransitionModel, demonstrations: Demonstrations) -> None:
    states, actions = demonstrations.tasks.terminal.shape[-1], int(np.asarray(demonstrations.actions).max())
    if states != model.graph.states or actions >= model.graph.actions:
        raise InputError(
            f"expected demonstrations in the model's {model.graph.states} states with its {model.graph.actions} actions"
            f", found {states} states and actions up to {actions}",
            field="demonstrations",
        )
