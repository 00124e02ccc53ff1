"""Fits in continuous worlds: the dynamics that make demonstrations most probable, when values need roll-outs.

The gradient of the objective (`likelihood`) takes the people's policy, and that policy is itself found by gradients
(`planner`). Both take one step at a time: one batch of roll-outs, from some of the demonstrated states, gives a step of
the policy, of its critic and of the model. The policy is so always a little behind the model; by how much, `lag` says.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from sidestep.continuous.demonstrations import check_choices
from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.estimators import Estimator
from sidestep.continuous.likelihood import FitProgress, Problem, check_problem, descend, rehearse
from sidestep.continuous.planner import Planner, Planning, SomePolicy
from sidestep.continuous.planning import plan
from sidestep.continuous.policies import Policy
from sidestep.continuous.tasks import task_at
from sidestep.errors import NotConverged, check_count, check_positive
from sidestep.inference.checkpoints import Saver, fingerprint
from sidestep.inference.priors import Normal, Prior
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Term

Family = TypeVar("Family", bound=Dynamics)


class ContinuousFit(eqx.Module, Generic[Family, SomePolicy]):
    """Learned dynamics and how they were found.

    - `dynamics`: the family at the mean of θ over the last quarter of the iterations.
    - `planning`: the people's policy, and what planning goes on from.
    - `history`: a `FitProgress` an iteration.
    - `drift`: how far the mean of θ over the last eighth is from that over the eighth before, at most, a parameter:
      as a share of how far that would be, had every step gone the whole learning rate one way.
    - `lag`: the policy's, on average over the last quarter.
    - `converged`: whether drift and lag are below the tolerances that were asked for; `message` says what they are.
    """

    dynamics: Family
    planning: Planning[SomePolicy]
    history: tuple[FitProgress, ...] = eqx.field(static=True)
    drift: float = eqx.field(static=True)
    lag: float = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)


class Schedule(eqx.Module):
    """How long a fit climbs, and in which steps.

    - `iterations`: steps of the model. `rehearsals`: steps of the policy alone, before the model's first.
    - `moves`: how many demonstrated moves a step looks at.
    - `learning_rate`: of Adam, in units of θ; it falls to a twentieth along a cosine.
    - `policy_steps`: steps of the policy for each of the model's, one of them with the model's own roll-outs.
    - `drift`, `lag`: below which (either side of 0) a fit counts as converged, as in `ContinuousFit`.
    """

    iterations: int = eqx.field(default=400, static=True)
    rehearsals: int = eqx.field(default=200, static=True)
    moves: int = eqx.field(default=32, static=True)
    learning_rate: float = eqx.field(default=0.05, static=True)
    policy_steps: int = eqx.field(default=1, static=True)
    drift: float = eqx.field(default=0.5, static=True)
    lag: float = eqx.field(default=0.1, static=True)

    def rate(self) -> optax.Schedule:
        """The learning rate at each iteration."""
        return optax.cosine_decay_schedule(self.learning_rate, self.iterations, alpha=0.05)

    def adam(self) -> optax.GradientTransformation:
        """The model's optimiser; it forgets rare large gradients, which roll-outs give, within a hundred steps."""
        return optax.adam(self.rate(), b2=0.99)


class _Fitting(eqx.Module):
    """What a fit carries from iteration to iteration; arrays only, so that a checkpoint can hold it.

    `sums` are of θ: over the last quarter of the iterations but its second half, and over that half.
    """

    parameters: PyTree[Float[Array, "..."]]
    moments: PyTree
    planning: PyTree
    sums: Float[Array, "2 parameters"]


def fit(
    dynamics: Family,
    demonstrations: Demonstrations,
    behavior: Behavior,
    policy: SomePolicy,
    planner: Planner,
    *,
    prior: Prior | None = None,
    terms: tuple[Term, ...] = ALL_TERMS,
    estimator: Estimator = "score",
    schedule: Schedule | None = None,
    seed: int = 0,
    report: Callable[[FitProgress, Family], None] | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> ContinuousFit[Family, SomePolicy]:
    """The dynamics of the family of `dynamics` that maximise the posterior of `demonstrations`, starting there.

    - `demonstrations`: from `gather`. `policy`: where the people's policy begins.
    - `planner`: how roll-outs are made and the policy is improved; its `samples` count here too.
    - `prior`: over all parameters, `Normal()` by default. `terms`: "actions", "transitions" or both.
    - `estimator`: "score" (eq. 11), or "pathwise" for reparameterised dynamics and smooth rewards.
    - `report`: called with a `FitProgress` and the dynamics as they are then, after every iteration.
    - `checkpoint`: a file that is kept up to date; with `resume` the fit goes on from there and ends exactly as if it
      had not been interrupted.

    Raises `InputError` for data or settings that cannot be used, `NotConverged` if numbers cease to be finite.
    """
    schedule = schedule or Schedule()
    check_choices(demonstrations, policy)
    taken = jax.vmap(policy.action)(demonstrations.actions)
    problem = Problem(
        dynamics, demonstrations, behavior, prior or Normal(), planner, taken, schedule.moves, terms, estimator
    )
    check_schedule(schedule)
    check_problem(problem, policy)
    rehearsing, key = jax.random.split(jax.random.key(seed))
    saver = Saver(
        checkpoint, fingerprint(_identity((problem, schedule, policy, seed))) if checkpoint is not None else ""
    )
    beginning, rehearsing = jax.random.split(rehearsing)
    carried, fixed = eqx.partition(_begun(problem, schedule, policy, beginning), eqx.is_array)
    history: list[FitProgress] = []
    if resume:
        carried, records, _ = saver.load(carried)
        history = [FitProgress(int(record[0]), *record[1:]) for record in records]
    if not history:
        carried = eqx.filter(_rehearsed(problem, schedule, eqx.combine(carried, fixed), rehearsing), eqx.is_array)
    for iteration in range(len(history), schedule.iterations):
        carried, numbers = _step(
            problem, schedule, carried, fixed, jax.random.fold_in(key, iteration), jnp.asarray(iteration)
        )
        history.append(FitProgress(iteration, *(float(number) for number in numbers[1:])))
        _check_numbers(history[-1])
        saver.save(carried, history)
        if report:
            report(history[-1], dynamics.with_parameters(eqx.combine(carried, fixed).parameters))
    return _ended(problem, schedule, eqx.combine(carried, fixed), history)


def _identity(problem: PyTree) -> tuple[list, str]:
    """All of a problem, as numbers and text: functions by their names, for their addresses change between processes."""
    numbers, rest = eqx.partition(problem, eqx.is_array_like)
    text = f"{jax.tree.structure(problem)} {jax.tree.leaves(rest)}"
    return jax.tree.leaves(numbers), re.sub(r" at 0x[0-9a-f]+", "", text)


def _begun(problem: Problem, schedule: Schedule, policy: Policy, key: PRNGKeyArray) -> _Fitting:
    """A fit before anything has been found."""
    demos, parameters = problem.demonstrations, problem.dynamics.parameters
    own = task_at(demos.tasks, demos.task)
    planning = problem.planner.begin(key, problem.dynamics, policy, own, problem.behavior, demos.states)
    flat = ravel_pytree(parameters)[0]
    return _Fitting(parameters, schedule.adam().init(parameters), planning, jnp.zeros((2, len(flat)), flat.dtype))


def _rehearsed(problem: Problem, schedule: Schedule, begun: _Fitting, key: PRNGKeyArray) -> _Fitting:
    """A fit once the policy has been found for the first model, as well as so many steps can."""
    if not schedule.rehearsals or "actions" not in problem.terms:
        return begun
    demos = problem.demonstrations
    found = plan(
        problem.dynamics,
        demos.tasks,
        problem.behavior,
        begun.planning.policy,
        demos.states,
        demos.task,
        problem.planner,
        steps=schedule.rehearsals,
        seed=int(jax.random.randint(key, (), 0, 2**31 - 1)),
        warm=begun.planning,
    )
    return eqx.tree_at(lambda fitting: fitting.planning, begun, found.planning)


@eqx.filter_jit
def _step(
    problem: Problem, schedule: Schedule, carried: PyTree, fixed: PyTree, key: PRNGKeyArray, iteration: Int[Array, ""]
) -> tuple[PyTree, FitProgress]:
    """One step of the policy, its critic and the model."""
    fitting: _Fitting = eqx.combine(carried, fixed)
    looking, *rehearsing = jax.random.split(key, schedule.policy_steps)
    planning = fitting.planning
    if "actions" in problem.terms:
        for again in rehearsing:
            planning = rehearse(problem, fitting.parameters, planning, again)
    planning, slope, numbers = descend(problem, fitting.parameters, planning, looking)
    step, moments = schedule.adam().update(slope, fitting.moments)
    parameters = optax.apply_updates(fitting.parameters, step)
    late = jnp.stack([iteration >= first for first in _windows(schedule)[:2]])
    late = late & jnp.stack([iteration < end for end in _windows(schedule)[1:]])
    sums = fitting.sums + late[:, None] * ravel_pytree(parameters)[0]
    after = _Fitting(parameters, moments, planning, sums)
    return eqx.filter(after, eqx.is_array), numbers


def _windows(schedule: Schedule) -> tuple[int, int, int]:
    """Where the last two eighths of the iterations begin, and where they end."""
    eighth = max(1, schedule.iterations // 8)
    return max(0, schedule.iterations - 2 * eighth), schedule.iterations - eighth, schedule.iterations


def _ended(problem: Problem, schedule: Schedule, fitting: _Fitting, history: list[FitProgress]) -> ContinuousFit:
    begin, middle, end = _windows(schedule)
    flat, to_parameters = ravel_pytree(problem.dynamics.parameters)
    former, latter = fitting.sums / jnp.asarray([[middle - begin], [end - middle]], flat.dtype)
    gone = jnp.cumsum(schedule.rate()(jnp.arange(end)))
    drift = float(jnp.abs(latter - former).max() / (gone[middle:end].mean() - gone[begin:middle].mean()))
    lag = float(np.mean([progress.lag for progress in history[begin:]]))
    return ContinuousFit(
        dynamics=problem.dynamics.with_parameters(to_parameters((former + latter) / 2)),
        planning=fitting.planning,
        history=tuple(history),
        drift=drift,
        lag=lag,
        converged=drift <= schedule.drift and abs(lag) <= schedule.lag,
        message=f"over the last quarter parameters drifted by up to {drift:.2g} of what their steps allow (asked: "
        f"{schedule.drift:g}), and the policy lagged {lag:.2g} behind the model (asked: {schedule.lag:g})",
    )


def check_schedule(schedule: Schedule) -> None:
    """Raises `InputError` for settings that are too small, or a rate that is not above 0."""
    # the drift is from one half of the last quarter to the other
    for name, least in {"iterations": 2, "rehearsals": 0, "moves": 1, "policy_steps": 1}.items():
        check_count(getattr(schedule, name), least, name)
    for name in ("learning_rate", "drift", "lag"):
        check_positive(getattr(schedule, name), name)


def _check_numbers(progress: FitProgress) -> None:
    if not np.isfinite(progress).all():
        raise NotConverged(
            f"the figures ceased to be finite at iteration {progress.iteration}: dynamics or rewards that return NaN, "
            "or too high a learning rate"
        )
