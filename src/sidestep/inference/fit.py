"""Fits: the transition model that makes demonstrations most probable.

The objective is the posterior up to a constant (eqs. 1 and 6),

    log L(θ) + log prior(θ),

which `fit` climbs from the model's own parameters. With `gradient="exact"` that is done by L-BFGS or by first-order
ascent. The fixed-policy gradient of the Boltzmann average (eq. 9, the paper's) is not the gradient of any function,
so a line search has nothing to search along: use first-order ascent with it.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from sidestep.demonstrations import Demonstrations
from sidestep.errors import InputError, NotConverged
from sidestep.inference.checkpoints import fingerprint, load_checkpoint, save_checkpoint
from sidestep.inference.optimisers import LBFGS, Optimiser
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage, Gradient
from sidestep.tabular.likelihood import ALL_TERMS, LogLikelihood, Term, log_likelihood, transition_probabilities
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import Solution, check_proper, solve
from sidestep.tabular.solvers.process import Solver, reachable
from sidestep.tasks import Task

Model = TypeVar("Model", bound=TransitionModel)


class Progress(NamedTuple):
    """Where a fit stands after an iteration: the objective, its parts, and its largest gradient component."""

    iteration: int
    objective: float
    actions: float
    transitions: float
    prior: float
    gradient: float


class Fit(eqx.Module, Generic[Model]):
    """A learned model and how it was found.

    - `model`: the transition model at the θ that was found.
    - `history`: `Progress` before the first and after every iteration.
    - `sweeps`, `residual`, `task_converged`: the solve of every task under the learned model.
    - `converged`: whether the optimiser and every task converged; `message` says why it stopped.
    """

    model: Model
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


class _Problem(eqx.Module):
    """All that the objective depends on, besides θ."""

    model: TransitionModel
    demonstrations: Demonstrations
    behavior: Behavior
    prior: Normal
    terms: tuple[Term, ...] = eqx.field(static=True)
    horizon: int | None = eqx.field(static=True)
    gradient: Gradient = eqx.field(static=True)
    solver: Solver | None

    def likelihood(self, parameters: PyTree) -> LogLikelihood:
        return log_likelihood(
            self.model.with_parameters(parameters),
            self.demonstrations,
            self.behavior,
            terms=self.terms,
            horizon=self.horizon,
            gradient=self.gradient,
            solver=self.solver,
        )

    def solution(self, parameters: PyTree) -> Solution:
        model = self.model.with_parameters(parameters)
        return _solution(model, self.demonstrations.tasks, self.behavior, self.horizon, self.solver)


@eqx.filter_jit
def _solution(
    model: TransitionModel, tasks: Task, behavior: Behavior, horizon: int | None, solver: Solver | None
) -> Solution:
    """`solve`, compiled apart from the objective: fits of other terms or gradients need not compile it again."""
    return solve(model, tasks, behavior, horizon=horizon, solver=solver)


def fit(
    model: Model,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    prior: Normal | None = None,
    terms: tuple[Term, ...] = ALL_TERMS,
    gradient: Gradient = "exact",
    horizon: int | None = None,
    optimiser: Optimiser | None = None,
    solver: Solver | None = None,
    report: Callable[[Progress], None] | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> Fit[Model]:
    """The model of `model`'s family that maximises the posterior of `demonstrations`, starting at `model`.

    - `prior`: over the parameters; by default the paper's N(−2, 4).
    - `terms`: which parts of the likelihood count, "actions", "transitions" or both.
    - `gradient`, `horizon`, `solver`: as for `solve`.
    - `optimiser`: `LBFGS()` by default, or `Ascent()`.
    - `report`: called with a `Progress` before the first and after every iteration.
    - `checkpoint`: a file that is kept up to date while the fit runs; with `resume`, the fit goes on from there and
      ends
      exactly as if it had not been interrupted.

    Raises `InputError` for arguments that do not go together, visited states from which a goal cannot be reached, or a
    checkpoint of another fit; `ImproperTask` for tasks without values; `NotConverged` if values do not converge at the
    start or stop converging on the way.
    """
    optimiser = optimiser or LBFGS()
    _check_settings(terms, gradient, behavior, optimiser)
    check_proper(demonstrations.tasks, behavior, model.graph.actions, horizon)
    problem = _Problem(model, demonstrations, behavior, prior or Normal(), terms, horizon, gradient, solver)
    _check_moves(problem)
    if "actions" in terms:
        _check_start(problem)
    parameters, history, message = _climb(problem, optimiser, report, _Saver.of(checkpoint, problem, optimiser), resume)
    solution = problem.solution(parameters)
    settled = history[-1].gradient <= optimiser.tolerance
    return Fit(
        model=model.with_parameters(parameters),
        history=tuple(history),
        sweeps=solution.sweeps,
        residual=solution.residual,
        task_converged=solution.converged,
        converged=settled and ("actions" not in terms or bool(solution.converged.all())),
        message=message,
    )


def _climb(
    problem: _Problem,
    optimiser: Optimiser,
    report: Callable[[Progress], None] | None,
    saver: "_Saver",
    resume: bool,
) -> tuple[PyTree, list[Progress], str]:
    start, to_parameters = ravel_pytree(problem.model.parameters)
    seen: dict[bytes, tuple[float, np.ndarray, tuple[float, ...]]] = {}

    def look(x: np.ndarray) -> tuple[float, np.ndarray, tuple[float, ...]]:
        """The loss, its slope and the objective's parts; the last point is remembered, for line searches ask twice."""
        if x.tobytes() not in seen:
            slope, parts = _evaluate(problem, to_parameters(jnp.asarray(x)))
            parts = tuple(float(part) for part in parts)
            seen.clear()
            # values that do not converge make the objective NaN: worse than any other, so that no search ends there
            loss = -parts[0] if np.isfinite(parts[0]) else np.inf
            seen[x.tobytes()] = (loss, np.asarray(ravel_pytree(slope)[0]), parts)
        return seen[x.tobytes()]

    x, history = np.asarray(start), []
    state = optimiser.init(x)
    if resume:
        (x, state), history = saver.load((x, state))
    while True:
        value, slope, parts = look(x)
        objective, actions, transitions, prior = parts
        progress = Progress(len(history), objective, actions, transitions, prior, float(np.abs(slope).max()))
        if not np.isfinite(progress).all():
            raise NotConverged(
                f"the values or their gradient stopped converging at iteration {progress.iteration}: a smaller β, "
                "a lower learning rate or more sweeps may help"
            )
        history.append(progress)
        if report:
            report(progress)
        message = _reason_to_stop(progress, optimiser)
        after = None if message else optimiser.step(lambda x: look(x)[:2], x, value, slope, state)
        if after is None:
            unsaid = f"stopped: no step gains anything; the largest gradient is {progress.gradient:.2g}"
            return to_parameters(jnp.asarray(x)), history, message or unsaid
        x, state = after
        saver.save((x, state), history)


@eqx.filter_jit
def _evaluate(problem: _Problem, parameters: PyTree) -> tuple[PyTree, tuple[Float[Array, ""], ...]]:
    """The slope of the loss (minus the objective) at θ; and the objective and its parts."""

    def loss(parameters: PyTree) -> tuple[Float[Array, ""], tuple[Float[Array, ""], ...]]:
        likelihood = problem.likelihood(parameters)
        prior = problem.prior.log_density(parameters)
        objective = likelihood.total + prior
        return -objective, (objective, likelihood.actions, likelihood.transitions, prior)

    return jax.grad(loss, has_aux=True)(parameters)


def _reason_to_stop(now: Progress, optimiser: Optimiser) -> str:
    if now.gradient <= optimiser.tolerance:
        return f"converged: the largest gradient is {now.gradient:.2g}"
    if now.iteration >= optimiser.iterations:
        return f"stopped after {now.iteration} iterations; the largest gradient is {now.gradient:.2g}"
    return ""


def _check_settings(terms: tuple[Term, ...], gradient: Gradient, behavior: Behavior, optimiser: Optimiser) -> None:
    if not terms or not set(terms) <= set(ALL_TERMS):
        raise InputError(f"expected one or both of {ALL_TERMS}, found {terms}", field="terms")
    if gradient not in ("exact", "fixed_policy"):
        raise InputError(f"expected 'exact' or 'fixed_policy', found {gradient!r}", field="gradient")
    if gradient == "fixed_policy" and isinstance(optimiser, LBFGS) and isinstance(behavior.backup, BoltzmannAverage):
        raise InputError(
            "the fixed-policy gradient of the Boltzmann average is not the gradient of any function, so L-BFGS has "
            "nothing to search along: expected Ascent() as the optimiser, or gradient='exact'",
            field="gradient",
        )


def _check_moves(problem: _Problem) -> None:
    """Every move must be one that the model has, and, if transitions count, one that it thinks possible."""
    model, demos = problem.model, problem.demonstrations
    if demos.tasks.terminal.shape[-1] != model.graph.states or int(demos.actions.max()) >= model.graph.actions:
        raise InputError(
            f"expected demonstrations in the model's {model.graph.states} states with its {model.graph.actions} actions"
            f", found {demos.tasks.terminal.shape[-1]} states and actions up to {int(demos.actions.max())}",
            field="demonstrations",
        )
    if "transitions" not in problem.terms:
        return
    impossible = np.flatnonzero(np.asarray(transition_probabilities(model, demos)) == 0)
    if len(impossible):
        move = impossible[0]
        raise InputError(
            f"action {int(demos.actions[move])} in state {int(demos.states[move])} led to state "
            f"{int(demos.next_states[move])}, which the model (what the map knows, say) holds to be impossible",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
        )


def _check_start(problem: _Problem) -> None:
    """Values must exist at the start, and every walker must be able to arrive."""
    solution = problem.solution(problem.model.parameters)
    if not bool(solution.converged.all()):
        tasks = np.flatnonzero(~np.asarray(solution.converged)).tolist()
        raise NotConverged(
            f"values did not converge for task(s) {tasks} (residual up to {float(solution.residual.max()):.2g}): "
            "a smaller β, more sweeps or another backup may help"
        )
    demos = problem.demonstrations
    stuck = np.flatnonzero(~np.asarray(reachable(solution.values[demos.task, demos.states])))
    if len(stuck):
        raise InputError(
            f"state {int(demos.states[stuck[0]])} is visited, but the goal cannot be reached from it",
            source=f"trajectory {int(demos.trajectory[stuck[0]]) + 1}",
        )


class _Saver:
    """Keeps a checkpoint file up to date, at most every few seconds; without a path it keeps nothing."""

    interval = 5.0

    def __init__(self, path: Path | None, key: str):
        self.path, self.key, self.last = path, key, 0.0

    @classmethod
    def of(cls, path: str | Path | None, problem: _Problem, optimiser: Optimiser) -> "_Saver":
        return cls(Path(path), fingerprint((problem, optimiser.key))) if path is not None else cls(None, "")

    def load(self, like: PyTree) -> tuple[PyTree, list[Progress]]:
        if self.path is None:
            raise InputError("expected a checkpoint to resume from", field="resume")
        if not self.path.exists():
            return like, []
        carried, records = load_checkpoint(self.path, self.key, like)
        return carried, [Progress(int(record[0]), *record[1:]) for record in records]

    def save(self, carried: PyTree, history: list[Progress]) -> None:
        if self.path is not None and time.monotonic() - self.last > self.interval:
            save_checkpoint(self.path, self.key, carried, history)
            self.last = time.monotonic()
