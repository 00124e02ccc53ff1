"""Fits: the transition model that makes demonstrations most probable.

The objective is the posterior up to a constant (eqs. 1 and 6),

    log L(θ) + log prior(θ),

which `fit` climbs from the model's own parameters. With `gradient="exact"` that is done by L-BFGS, by first-order
ascent, or by steps that stay off cliffs. The fixed-policy gradient of the Boltzmann average (eq. 9, the paper's) is not
the gradient of any function, so there is nothing to search along: use first-order ascent with it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import InputError
from sidestep.inference.checkpoints import Saver, fingerprint
from sidestep.inference.maximize import Climb, Progress
from sidestep.inference.objective import MEMORY, Objective, Problem, Solved
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer
from sidestep.inference.priors import Normal, Prior
from sidestep.tabular.backups import Behavior, BoltzmannAverage, Gradient
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Term, arrivals_of, transition_probabilities
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions, check_proper

Model = TypeVar("Model", bound=TransitionModel)


class Fit(eqx.Module, Generic[Model]):
    """A learned model and how it was found.

    - `model`: the transition model at the θ that was found.
    - `people`: what was given of them, and what was found where it was to be learned.
    - `history`: `Progress` before the first and after every iteration.
    - `sweeps`, `residual`, `task_converged`: the solve of every task under the learned model.
    - `converged`: whether the optimiser and every task converged; `message` says why it stopped.
    """

    model: Model
    people: BehaviorModel
    history: tuple[Progress, ...] = eqx.field(static=True)
    sweeps: Int[Array, " tasks"]
    residual: Float[Array, " tasks"]
    task_converged: Bool[Array, " tasks"]
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)

    @property
    def final(self) -> Progress:
        """The objective and its parts at the learned model."""
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
    report: Callable[[Progress], None] | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> Fit[Model]:
    """The model of `model`'s family that maximises the posterior of `demonstrations`, starting at `model`.

    - `behavior`: how people behave; `behavior_model(...)` where that is to be learned too.
    - `prior`: over the model's parameters; by default `Normal()`, the paper's.
    - `tempering`: κ in (0, 1], how much the actions' log-likelihood counts; below 1 where steps depend on each other.
    - `terms`: which parts of the likelihood count, "actions", "transitions" or both.
    - `options`: as for `solve`. On large maps, solves are only as exact as the optimiser needs
      until it has converged, and exact from then on; a solver with a tolerance of its own keeps to that.
    - `optimizer`: `LBFGS()` by default, or `Adam()`, or `Rprop()` (for large maps with people who avoid walls).
    - `memory`: about how many bytes the arrays may take on a device; tasks are solved in batches that fit.
    - `mesh`: devices to spread the tasks over (see `tasks_mesh`); the objective and its gradient are the same. With
      devices of several processes, each process calls `fit` with the same arguments and gets the same model.
    - `report`: called with a `Progress` before the first and after every iteration, in every process.
    - `checkpoint`: a file that is kept up to date while the fit runs; with `resume`, the fit goes on from there and
      ends exactly as if it had not been interrupted. With other devices, cores or `memory` than before, or with several
      processes (the first one writes, all must see the file), it ends there up to the tolerances.

    Raises `InputError` for arguments that do not go together, visited states from which a goal cannot be reached, or a
    checkpoint of another fit; `ImproperTask` for tasks without values; `NotConverged` if values do not converge at the
    start or stop converging on the way.
    """
    optimizer = optimizer or LBFGS()
    someone = behavior_model(behavior) if isinstance(behavior, Behavior) else behavior
    options = options or SolveOptions()
    _check_settings(terms, options.gradient, someone.behavior, optimizer)
    if not 0 < tempering <= 1:
        raise InputError(f"expected a share above 0 and at most 1, found {tempering}", field="tempering")
    check_proper(someone.tasks_of(demonstrations.tasks), someone.behavior_of(), model.graph.actions, options.horizon)
    solver = options.solver_for(someone.behavior.backup, model.graph.states)
    options = SolveOptions(options.gradient, options.horizon, solver)
    problem = Problem(model, someone, demonstrations, prior or Normal(), terms, options, tempering)
    _check_moves(problem)
    saver = Saver(checkpoint, fingerprint((problem, optimizer.key)) if checkpoint is not None else "")
    climb = Climb(Objective(problem, memory, mesh, optimizer.looks_roughly), optimizer, saver)
    found = climb.run(report, resume)
    solved = _of_all_tasks(found.solved, len(demonstrations.tasks.terminal))
    return Fit(
        model=model.with_parameters(found.parameters.model),
        people=someone.with_parameters(found.parameters.people),
        history=tuple(found.history),
        sweeps=solved.sweeps,
        residual=solved.residual,
        task_converged=solved.converged,
        converged=found.settled and bool(solved.converged.all()),
        message=found.message,
    )


def _of_all_tasks(parts: list[Solved], tasks: int) -> Solved:
    """How the solves of all tasks went, from those of batches; nothing to solve counts as converged."""
    if not parts:
        none = jnp.zeros((tasks, 0), dtype=bool)
        return Solved(jnp.zeros(tasks, int), jnp.zeros(tasks), jnp.ones(tasks, dtype=bool), none)
    return Solved(
        *(
            jnp.asarray(np.concatenate([np.asarray(leaf) for leaf in leaves])[:tasks])
            for leaves in zip(*parts, strict=True)
        )
    )


def _check_settings(terms: tuple[Term, ...], gradient: Gradient, behavior: Behavior, optimizer: Optimizer) -> None:
    if not terms or not set(terms) <= set(ALL_TERMS):
        raise InputError(f"expected one or both of {ALL_TERMS}, found {terms}", field="terms")
    searches = not isinstance(optimizer, Adam)
    if gradient == "fixed_policy" and searches and isinstance(behavior.backup, BoltzmannAverage):
        raise InputError(
            "the fixed-policy gradient of the Boltzmann average is not the gradient of any function, so there is "
            "nothing for a search to go along: expected Ascent() as the optimiser, or SolveOptions('exact')",
            field="gradient",
        )


def _check_moves(problem: Problem) -> None:
    """Every move must be one that the model has, and, if transitions count, one that it thinks possible."""
    model, demos = problem.model, problem.demonstrations
    if (
        demos.tasks.terminal.shape[-1] != model.graph.states
        or int(np.asarray(demos.actions).max()) >= model.graph.actions
    ):
        raise InputError(
            f"expected demonstrations in the model's {model.graph.states} states with its {model.graph.actions} actions"
            f", found {demos.tasks.terminal.shape[-1]} states and actions up to {int(np.asarray(demos.actions).max())}",
            field="demonstrations",
        )
    if "transitions" not in problem.terms:
        return
    if (np.asarray(transition_probabilities(model, arrivals_of(demos))) == 0).any():
        move = np.flatnonzero(np.asarray(transition_probabilities(model, demos)) == 0)[0]
        raise InputError(
            f"action {int(demos.actions[move])} in state {int(demos.states[move])} led to state "
            f"{int(demos.next_states[move])}, which the model (what the map knows, say) holds to be impossible",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
        )
