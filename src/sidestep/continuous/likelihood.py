"""What a batch of demonstrated moves says of dynamics: estimates of the objective and its gradient.

The objective is that of the tabular half (eq. 6), and so is its gradient, but for expectations:

    ∇ log L = Σ_moves [ β ( ∇Q(s, a) − Σ_a′ π(a′|s) ∇Q(s, a′) ) + ∇ ln T_θ(s, a, s′) ],

with ∇Q by roll-outs of the people's policy under the current model (eq. 11). The same roll-outs give a step of that
policy and of its critic (eq. 12). Over vectors of actions the sum over a′ is a mean over choices that the policy draws,
weighed by exp(βQ)/π_λ: so it is that of the people under the current model, even where the policy is a little behind.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree, Shaped

from sidestep.continuous.dynamics import Dynamics, check_finite
from sidestep.continuous.estimators import Estimator, check_estimator, value_gradient
from sidestep.continuous.planner import Planner, Planning, PlanProgress, check_planner
from sidestep.continuous.planning import check_places
from sidestep.continuous.policies import FinitePolicy, Policy
from sidestep.continuous.rollouts import said, spread_over
from sidestep.continuous.tasks import ContinuousTask, check_tasks, task_at
from sidestep.errors import InputError
from sidestep.inference.priors import Prior
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Term


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


class Problem(eqx.Module):
    """All that stays as it is during a fit.

    - `taken`: the action of every move. `moves`: how many of the moves make a batch.
    - The rest is what `fit` was given.
    """

    dynamics: Dynamics
    demonstrations: Demonstrations
    behavior: Behavior
    prior: Prior
    planner: Planner
    taken: Shaped[Array, "moves *action"]
    moves: int = eqx.field(static=True)
    terms: tuple[Term, ...] = eqx.field(static=True)
    estimator: Estimator = eqx.field(static=True)


class _Batch(NamedTuple):
    """Some of the moves, and by how much sums over them have to be scaled up."""

    moves: Int[Array, " some"]
    scale: float


def rehearse(problem: Problem, parameters: PyTree, planning: Planning, key: PRNGKeyArray) -> Planning:
    """Planning after a step by roll-outs from a batch of moves; nothing is learned of the dynamics."""
    choosing, rolling = jax.random.split(key)
    return _actions(problem, parameters, planning, _drawn(problem, choosing), rolling)[0]


def descend(
    problem: Problem, parameters: PyTree, planning: Planning, key: PRNGKeyArray
) -> tuple[Planning, PyTree, FitProgress]:
    """By one batch of moves: improved planning, the slope of minus the objective, and where the fit stands."""
    choosing, rolling = jax.random.split(key)
    batch = _drawn(problem, choosing)
    slope, numbers = _rest(problem, parameters, batch)
    if "actions" in problem.terms:
        planning, of_actions, progress = _actions(problem, parameters, planning, batch, rolling)
        slope = jax.tree.map(jnp.add, slope, of_actions)
        numbers = _together(numbers, progress)
    return planning, slope, numbers._replace(gradient=optax.tree.norm(slope))


def _drawn(problem: Problem, key: PRNGKeyArray) -> _Batch:
    count, all_moves = min(problem.moves, len(problem.demonstrations)), len(problem.demonstrations)
    return _Batch(jax.random.choice(key, all_moves, (count,), replace=False), all_moves / count)


def _rest(problem: Problem, parameters: PyTree, batch: _Batch) -> tuple[PyTree, FitProgress]:
    """The slope of minus what needs no roll-outs, the transitions' term (if it counts) and the prior, and the two."""
    demos = problem.demonstrations
    moves, scale = batch

    def parts(parameters: PyTree) -> tuple[Array, tuple[Array, Array]]:
        dynamics, prior = problem.dynamics.with_parameters(parameters), problem.prior.log_density(parameters)
        passed = jnp.zeros_like(prior)
        if "transitions" in problem.terms:
            densities = jax.vmap(dynamics.log_prob)(demos.states[moves], problem.taken[moves], demos.next_states[moves])
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
    problem: Problem, parameters: PyTree, planning: Planning, batch: _Batch, key: PRNGKeyArray
) -> tuple[Planning, PyTree, tuple[Array, PlanProgress]]:
    """What roll-outs from some demonstrated moves say.

    That is the improved planning, the slope of minus the actions' log-likelihood, the log-likelihood itself, and how
    good the policy is.
    """
    demos, planner, behavior = problem.demonstrations, problem.planner, problem.behavior
    drawing, rolling = jax.random.split(key)
    moves, scale = batch
    tasks, states, chosen = task_at(demos.tasks, demos.task[moves]), demos.states[moves], demos.actions[moves]
    drawn, shares = planner.tried(drawing, planning.policy, tasks, states)
    people = _People(behavior, planning.policy, tasks, states, chosen, drawn)
    tried, shares = people.options(shares)
    gradient, rolled = value_gradient(
        problem.dynamics.with_parameters(parameters),
        planning.policy,
        tasks,
        behavior,
        rolling,
        states,
        tried,
        people.weights,
        horizon=planner.horizon,
        samples=planner.samples,
        critic=planning.critic,
        estimator=problem.estimator,
    )
    improved, progress = planner.improve(planning, tasks, behavior, rolled, shares)
    q = said(rolled, spread_over(tasks, rolled).discount)[..., 0].mean(axis=-1)
    slope = jax.tree.map(lambda leaf: -scale * leaf, gradient)
    return improved, slope, (scale * people.log_probs(q).sum(), progress)


class _People(NamedTuple):
    """Some demonstrated moves, and how probable their choices are by what roll-outs say.

    - `chosen`: what was done. `drawn`: what the policy would do; over a finite set, all actions.
    """

    behavior: Behavior
    policy: Policy
    tasks: ContinuousTask
    states: Array
    chosen: Array
    drawn: Array

    def options(self, shares: Array) -> tuple[Array, Array]:
        """What is to be tried: all actions of a finite set, or what people did and what the policy draws."""
        if isinstance(self.policy, FinitePolicy):
            return self.drawn, shares
        return (
            jnp.concatenate([self.chosen[:, None], self.drawn], axis=1),
            jnp.concatenate([jnp.zeros_like(shares[:, :1]), shares], axis=1),
        )

    def weights(self, q: Float[Array, "places options"]) -> Float[Array, "places options"]:
        """β (1 for what was done − π): what ∇Q of each option counts for ∇ log π of what was done."""
        beta = self.behavior.beta
        if isinstance(self.policy, FinitePolicy):
            done = jax.nn.one_hot(self.chosen, q.shape[1], dtype=q.dtype)
            return beta * (done - jnp.exp(self.behavior.log_policy(q)))
        shares = jax.nn.softmax(self._soft(q), axis=1)
        return beta * jnp.concatenate([jnp.ones_like(shares[:, :1]), -shares], axis=1)

    def log_probs(self, q: Float[Array, "places options"]) -> Float[Array, " places"]:
        """log π of what was done."""
        if isinstance(self.policy, FinitePolicy):
            return jnp.take_along_axis(self.behavior.log_policy(q), self.chosen[:, None], axis=1)[:, 0]
        drawn = self._soft(q)
        return self.behavior.beta * q[:, 0] - jax.nn.logsumexp(drawn, axis=1) + jnp.log(drawn.shape[1])

    def _soft(self, q: Float[Array, "places options"]) -> Float[Array, "places drawn"]:
        """βQ − ln π_λ of what the policy draws; means by π ∝ exp βQ are means of draws with the exponential of this."""
        seen = jax.vmap(lambda task, state: task.features(state))(self.tasks, self.states)
        log_probs = jax.vmap(jax.vmap(self.policy.log_prob, (None, 0)))(seen, self.drawn)
        return self.behavior.beta * q[:, 1:] - log_probs


def check_problem(problem: Problem, policy: Policy) -> None:
    """Raises `InputError` for data or settings that do not go together."""
    demos = problem.demonstrations
    if not problem.terms or not set(problem.terms) <= set(ALL_TERMS):
        raise InputError(f"expected one or both of {ALL_TERMS}, found {problem.terms}", field="terms")
    check_planner(problem.planner)
    if not jax.tree.leaves(problem.dynamics.parameters):
        raise InputError("expected parameters to learn, found none", field="dynamics")
    check_finite(problem.dynamics.parameters)
    check_tasks(demos.tasks)
    check_places(demos.states, demos.task, demos.tasks)
    check_estimator(problem.estimator, problem.dynamics, demos.tasks)
    if not isinstance(policy, FinitePolicy) and not isinstance(problem.behavior.backup, LogSumExp):
        raise InputError(
            "over vectors of actions people's policy is known for the log-sum-exp only: expected that, or a finite set",
            field="behavior",
        )
    if not np.isfinite(demos.next_states).all():
        raise InputError("expected finite numbers", field="next_states")
    _check_shapes(problem)
    densities = np.asarray(jax.vmap(problem.dynamics.log_prob)(demos.states, problem.taken, demos.next_states))
    wrong = np.isnan(densities) | ((densities == -np.inf) & ("transitions" in problem.terms))
    if wrong.any():
        move = int(wrong.argmax())
        raise InputError(
            f"expected a density above 0 for what happened, found the logarithm {densities[move]}",
            source=f"trajectory {int(demos.trajectory[move]) + 1}",
            field="log_prob",
        )


def _check_shapes(problem: Problem) -> None:
    """Raises `InputError` for states or actions that the dynamics cannot take."""
    states, taken = problem.demonstrations.states, problem.taken
    expected = f"expected states and actions that the dynamics can take, found shapes {states.shape[1:]} and "
    try:
        led = jax.eval_shape(problem.dynamics.sample, jax.random.key(0), states[0], taken[0]).shape
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"{expected}{taken.shape[1:]}", field="demonstrations") from error
    if led != states.shape[1:]:
        raise InputError(f"{expected}{taken.shape[1:]}, which lead to {led}", field="demonstrations")
