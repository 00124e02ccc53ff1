"""Fits in continuous worlds: the dynamics that make demonstrations most probable, when values need roll-outs.

The objective is that of the tabular half (eq. 6), and so is its gradient, but for expectations:

    ∇ log L = Σ_moves [ β ( ∇Q(s, a) − Σ_a′ π(a′|s) ∇Q(s, a′) ) + ∇ ln T_θ(s, a, s′) ],

with ∇Q by roll-outs of the people's policy under the current model (eq. 11), and that policy itself found by gradients
(eq. 12). Both take one step at a time: one batch of roll-outs, from some of the demonstrated states, gives a step of
the policy, of its critic and of the model. The policy is so always a little behind the model; by how much, `lag` says.

Over vectors of actions the sum over a′ is the mean over choices that the policy draws.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree, Shaped

from sidestep.continuous.demonstrations import check_choices
from sidestep.continuous.dynamics import Dynamics, check_finite
from sidestep.continuous.estimators import Estimator, check_estimator, value_gradient
from sidestep.continuous.planning import Planner, Planning, PlanProgress, check_places, check_planner, plan
from sidestep.continuous.policies import FinitePolicy, Policy
from sidestep.continuous.rollouts import said, spread_over
from sidestep.continuous.tasks import ContinuousTask, check_tasks, task_at
from sidestep.demonstrations import Demonstrations
from sidestep.errors import InputError, NotConverged
from sidestep.inference.checkpoints import Saver, fingerprint
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.likelihood import ALL_TERMS, Term

Family = TypeVar("Family", bound=Dynamics)
SomePolicy = TypeVar("SomePolicy", bound=Policy)


class FitProgress(NamedTuple):
    """Where a fit stands: estimates from a batch of moves, but for the prior.

    - `objective`: the sum of its parts `actions`, `transitions` (both scaled up to all moves) and `prior`, in nats.
    - `gradient`: the norm of the objective's gradient.
    - `expected_return`, `entropy`, `lag`: of the policy, see `PlanProgress`; 0 without the actions' term, which alone
      needs one.
    """

    iteration: int
    objective: float
    actions: float
    transitions: float
    prior: float
    gradient: float
    expected_return: float
    entropy: float
    lag: float


class ContinuousFit(eqx.Module, Generic[Family, SomePolicy]):
    """Learned dynamics and how they were found.

    - `dynamics`: the family at the mean of θ over the last quarter of the iterations.
    - `planning`: the people's policy, and what planning goes on from.
    - `history`: a `FitProgress` an iteration.
    - `drift`: how far the mean of θ over the last eighth is from that over the eighth before, at most, a parameter.
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
    - `drift`, `lag`: below which a fit counts as converged, in units of θ and as in `PlanProgress`.
    """

    iterations: int = eqx.field(default=400, static=True)
    rehearsals: int = eqx.field(default=200, static=True)
    moves: int = eqx.field(default=32, static=True)
    learning_rate: float = eqx.field(default=0.05, static=True)
    policy_steps: int = eqx.field(default=1, static=True)
    drift: float = eqx.field(default=0.3, static=True)
    lag: float = eqx.field(default=0.1, static=True)

    def adam(self) -> optax.GradientTransformation:
        """The model's optimiser; it forgets rare large gradients, which roll-outs give, within a hundred steps."""
        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, self.iterations, alpha=0.05), b2=0.99)


class _Fitting(eqx.Module):
    """What a fit carries from iteration to iteration; arrays only, so that a checkpoint can hold it.

    `sums` are of θ: over the last quarter of the iterations but its second half, and over that half.
    """

    parameters: PyTree[Float[Array, "..."]]
    moments: PyTree
    planning: PyTree
    sums: Float[Array, "2 parameters"]


class _Given(eqx.Module):
    """All that stays as it is."""

    dynamics: Dynamics
    demonstrations: Demonstrations
    behavior: Behavior
    prior: Normal
    planner: Planner
    schedule: Schedule
    taken: Shaped[Array, "moves *action"]
    terms: tuple[Term, ...] = eqx.field(static=True)
    estimator: Estimator = eqx.field(static=True)


def fit(
    dynamics: Family,
    demonstrations: Demonstrations,
    behavior: Behavior,
    policy: SomePolicy,
    planner: Planner,
    *,
    prior: Normal | None = None,
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
    - `prior`: over all parameters, the paper's N(−2, 4) by default. `terms`: "actions", "transitions" or both.
    - `estimator`: "score" (eq. 11), or "pathwise" for reparameterised dynamics and smooth rewards.
    - `report`: called with a `FitProgress` and the dynamics as they are then, after every iteration.
    - `checkpoint`: a file that is kept up to date; with `resume` the fit goes on from there and ends exactly as if it
      had not been interrupted.

    Raises `InputError` for data or settings that cannot be used, `NotConverged` if numbers cease to be finite.
    """
    schedule = schedule or Schedule()
    check_choices(demonstrations, policy)
    taken = jax.vmap(policy.action)(demonstrations.actions)
    given = _Given(dynamics, demonstrations, behavior, prior or Normal(), planner, schedule, taken, terms, estimator)
    _check(given, policy)
    rehearsing, key = jax.random.split(jax.random.key(seed))
    saver = Saver(checkpoint, fingerprint(_identity((given, policy, seed))) if checkpoint is not None else "")
    begun = _rehearsed(given, policy, rehearsing)
    carried, fixed = eqx.partition(begun, eqx.is_array)
    history: list[FitProgress] = []
    if resume:
        carried, records, _ = saver.load(carried)
        history = [FitProgress(int(record[0]), *record[1:]) for record in records]
    for iteration in range(len(history), schedule.iterations):
        carried, numbers = _step(given, carried, fixed, jax.random.fold_in(key, iteration), jnp.asarray(iteration))
        history.append(FitProgress(iteration, *(float(number) for number in numbers[1:])))
        _check_numbers(history[-1])
        saver.save(carried, history)
        if report:
            report(history[-1], dynamics.with_parameters(eqx.combine(carried, fixed).parameters))
    return _ended(given, eqx.combine(carried, fixed), history)


def _identity(problem: PyTree) -> tuple[list, str]:
    """All of a problem, as numbers and text: functions by their names, for their addresses change between processes."""
    numbers, rest = eqx.partition(problem, eqx.is_array_like)
    text = f"{jax.tree.structure(problem)} {jax.tree.leaves(rest)}"
    return jax.tree.leaves(numbers), re.sub(r" at 0x[0-9a-f]+", "", text)


def _rehearsed(given: _Given, policy: Policy, key: PRNGKeyArray) -> _Fitting:
    """A fit at its start: the policy has been found for the first model, as well as so many steps can."""
    demos, planner = given.demonstrations, given.planner
    own = task_at(demos.tasks, demos.task)
    planning = planner.begin(key, given.dynamics, policy, own, given.behavior, demos.states)
    if given.schedule.rehearsals and "actions" in given.terms:
        planning = plan(
            given.dynamics,
            demos.tasks,
            given.behavior,
            policy,
            demos.states,
            demos.task,
            planner,
            steps=given.schedule.rehearsals,
            seed=int(jax.random.randint(key, (), 0, 2**31 - 1)),
            warm=planning,
        ).planning
    parameters = given.dynamics.parameters
    flat = ravel_pytree(parameters)[0]
    return _Fitting(parameters, given.schedule.adam().init(parameters), planning, jnp.zeros((2, len(flat)), flat.dtype))


@eqx.filter_jit
def _step(
    given: _Given, carried: PyTree, fixed: PyTree, key: PRNGKeyArray, iteration: Int[Array, ""]
) -> tuple[PyTree, FitProgress]:
    """One step of the policy, its critic and the model."""
    fitting: _Fitting = eqx.combine(carried, fixed)
    looking, *rehearsing = jax.random.split(key, 1 + given.schedule.policy_steps)
    slope, numbers = _rest(given, fitting.parameters, looking)
    planning = fitting.planning
    if "actions" in given.terms:
        for again in rehearsing[1:]:
            planning, _, _ = _actions(given, fitting.parameters, planning, again, learning=False)
        planning, of_actions, progress = _actions(given, fitting.parameters, planning, looking, learning=True)
        slope = jax.tree.map(jnp.add, slope, of_actions)
        numbers = _together(numbers, progress)
    step, moments = given.schedule.adam().update(slope, fitting.moments)
    parameters = optax.apply_updates(fitting.parameters, step)
    late = jnp.stack([iteration >= first for first in _windows(given.schedule)[:2]])
    late = late & jnp.stack([iteration < end for end in _windows(given.schedule)[1:]])
    sums = fitting.sums + late[:, None] * ravel_pytree(parameters)[0]
    after = _Fitting(parameters, moments, planning, sums)
    return eqx.filter(after, eqx.is_array), numbers._replace(gradient=optax.tree.norm(slope))


def _windows(schedule: Schedule) -> tuple[int, int, int]:
    """Where the last two eighths of the iterations begin, and where they end."""
    eighth = max(1, schedule.iterations // 8)
    return max(0, schedule.iterations - 2 * eighth), schedule.iterations - eighth, schedule.iterations


def _drawn(given: _Given, key: PRNGKeyArray) -> tuple[Int[Array, " some"], float]:
    """Some of the moves, and by how much sums over them have to be scaled up."""
    count, all_moves = min(given.schedule.moves, len(given.demonstrations)), len(given.demonstrations)
    return jax.random.choice(key, all_moves, (count,), replace=False), all_moves / count


def _rest(given: _Given, parameters: PyTree, key: PRNGKeyArray) -> tuple[PyTree, FitProgress]:
    """The slope of minus what needs no roll-outs, the transitions' term (if it counts) and the prior, and the two."""
    demos = given.demonstrations
    moves, scale = _drawn(given, key)

    def parts(parameters: PyTree) -> tuple[Array, tuple[Array, Array]]:
        dynamics, prior = given.dynamics.with_parameters(parameters), given.prior.log_density(parameters)
        passed = jnp.zeros_like(prior)
        if "transitions" in given.terms:
            densities = jax.vmap(dynamics.log_prob)(demos.states[moves], given.taken[moves], demos.next_states[moves])
            passed = scale * densities.sum()
        return -(passed + prior), (passed, prior)

    slope, (passed, prior) = jax.grad(parts, has_aux=True)(parameters)
    none = jnp.zeros_like(prior)
    return slope, FitProgress(0, passed + prior, none, passed, prior, none, none, none, none)  # pyright: ignore[reportArgumentType]


def _together(rest: FitProgress, progress: tuple[Array, PlanProgress]) -> FitProgress:
    """The figures of all terms, those of the actions added."""
    actions, plan = progress
    return rest._replace(
        objective=rest.objective + actions,  # pyright: ignore[reportArgumentType]
        actions=actions,  # pyright: ignore[reportArgumentType]
        expected_return=plan.expected_return,
        entropy=plan.entropy,
        lag=plan.lag,
    )


def _actions(
    given: _Given, parameters: PyTree, planning: Planning, key: PRNGKeyArray, learning: bool
) -> tuple[Planning, PyTree, tuple[Array, PlanProgress]]:
    """What roll-outs from some demonstrated moves say.

    That is the improved planning, the slope of minus the actions' log-likelihood (nothing, unless it is to be learned
    from), the log-likelihood itself, and how good the policy is.
    """
    demos, planner, behavior = given.demonstrations, given.planner, given.behavior
    choosing, drawing, rolling = jax.random.split(key, 3)
    moves, scale = _drawn(given, choosing)
    tasks, states, chosen = task_at(demos.tasks, demos.task[moves]), demos.states[moves], demos.actions[moves]
    people = _People(behavior, planning.policy, tasks, states, chosen)
    tried, shares = people.options(*planner.tried(drawing, planning.policy, tasks, states))
    gradient, rolled = value_gradient(
        given.dynamics.with_parameters(parameters),
        planning.policy,
        tasks,
        behavior,
        rolling,
        states,
        tried,
        people.weights if learning else jnp.zeros_like,
        horizon=planner.horizon,
        samples=planner.samples,
        critic=planning.critic,
        estimator=given.estimator,
    )
    improved, progress = planner.improve(planning, tasks, behavior, rolled, shares)
    q = said(rolled, spread_over(tasks, rolled).discount)[..., 0].mean(axis=-1)
    slope = jax.tree.map(lambda leaf: -scale * leaf, gradient)
    return improved, slope, (scale * people.log_probs(q).sum(), progress)


class _People(NamedTuple):
    """Some demonstrated moves, and how probable their choices are by what roll-outs say."""

    behavior: Behavior
    policy: Policy
    tasks: ContinuousTask
    states: Array
    chosen: Array

    def options(self, choices: Array, shares: Array) -> tuple[Array, Array]:
        """What is to be tried: all actions of a finite set, or what people did and what the policy draws."""
        if isinstance(self.policy, FinitePolicy):
            return choices, shares
        return (
            jnp.concatenate([self.chosen[:, None], choices], axis=1),
            jnp.concatenate([jnp.zeros_like(shares[:, :1]), shares], axis=1),
        )

    def weights(self, q: Float[Array, "places options"]) -> Float[Array, "places options"]:
        """β (1 for what was done − π): what ∇Q of each option counts for ∇ log π of what was done."""
        beta = self.behavior.beta
        if isinstance(self.policy, FinitePolicy):
            done = jax.nn.one_hot(self.chosen, q.shape[1], dtype=q.dtype)
            return beta * (done - jnp.exp(self.behavior.log_policy(q)))
        drawn = q.shape[1] - 1
        return beta * jnp.broadcast_to(jnp.append(1.0, jnp.full(drawn, -1 / drawn)), q.shape)

    def log_probs(self, q: Float[Array, "places options"]) -> Float[Array, " places"]:
        """log π of what was done: by the values of all actions, or by the policy where these cannot be listed."""
        if isinstance(self.policy, FinitePolicy):
            return jnp.take_along_axis(self.behavior.log_policy(q), self.chosen[:, None], axis=1)[:, 0]
        seen = jax.vmap(lambda task, state: task.features(state))(self.tasks, self.states)
        return jax.vmap(self.policy.log_prob)(seen, self.chosen)


def _ended(given: _Given, fitting: _Fitting, history: list[FitProgress]) -> ContinuousFit:
    begin, middle, end = _windows(given.schedule)
    flat, to_parameters = ravel_pytree(given.dynamics.parameters)
    former, latter = fitting.sums / jnp.asarray([[middle - begin], [end - middle]], flat.dtype)
    drift = float(jnp.abs(latter - former).max())
    lag = float(np.mean([progress.lag for progress in history[begin:]]))
    schedule = given.schedule
    return ContinuousFit(
        dynamics=given.dynamics.with_parameters(to_parameters((former + latter) / 2)),
        planning=fitting.planning,
        history=tuple(history),
        drift=drift,
        lag=lag,
        converged=drift <= schedule.drift and lag <= schedule.lag,
        message=f"over the last quarter the parameters drifted by up to {drift:.2g} (allowed: {schedule.drift:g}) and "
        f"the policy lagged {lag:.2g} behind the model (allowed: {schedule.lag:g})",
    )


def _check(given: _Given, policy: Policy) -> None:
    """Raises `InputError` for data or settings that do not go together."""
    demos = given.demonstrations
    if not given.terms or not set(given.terms) <= set(ALL_TERMS):
        raise InputError(f"expected one or both of {ALL_TERMS}, found {given.terms}", field="terms")
    for name in ("iterations", "moves", "policy_steps"):
        least = 2 if name == "iterations" else 1  # the drift is from one half of the last quarter to the other
        if getattr(given.schedule, name) < least:
            raise InputError(f"expected at least {least}, found {getattr(given.schedule, name)}", field=name)
    if not given.schedule.learning_rate > 0:
        raise InputError(f"expected a number above 0, found {given.schedule.learning_rate}", field="learning_rate")
    check_planner(given.planner)
    if not jax.tree.leaves(given.dynamics.parameters):
        raise InputError("expected parameters to learn, found none", field="dynamics")
    check_finite(given.dynamics.parameters)
    check_tasks(demos.tasks)
    check_places(demos.states, demos.task, demos.tasks)
    check_estimator(given.estimator, given.dynamics, demos.tasks)
    if not isinstance(policy, FinitePolicy) and not isinstance(given.behavior.backup, LogSumExp):
        raise InputError(
            "over vectors of actions people's policy is known for the log-sum-exp only: expected that, or a finite set",
            field="behavior",
        )
    densities = np.asarray(jax.vmap(given.dynamics.log_prob)(demos.states, given.taken, demos.next_states))
    wrong = np.isnan(densities) | ((densities == -np.inf) & ("transitions" in given.terms))
    if wrong.any():
        move = int(wrong.argmax())
        raise InputError(
            f"expected a density above 0 for what happened, found the logarithm {densities[move]}",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
            field="log_prob",
        )


def _check_numbers(progress: FitProgress) -> None:
    if not np.isfinite(progress).all():
        raise NotConverged(
            f"the figures ceased to be finite at iteration {progress.iteration}: dynamics or rewards that return NaN, "
            "or too high a learning rate"
        )
