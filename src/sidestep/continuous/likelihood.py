"""Estimates of the objective and its gradient from a batch of demonstrated moves.

The objective is the discrete one (eq. 6 of the paper), and so is its gradient, but for expectations:

    ∇ log L = Σ_moves [ β ( ∇Q(s, a) − Σ_a′ π(a′|s) ∇Q(s, a′) ) + ∇ ln T_θ(s, a, s′) ],

with ∇Q by rollouts of the agent's policy under the current model (eq. 11). The same rollouts give a step of that policy
and of its critic (eq. 12). Over vectors of actions the sum over a′ is a mean over choices that the policy draws, with
importance weights exp(βQ)/π_λ: it is then that of the agent under the current model, even if the policy lags behind.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from sidestep._typing import Tree
from sidestep.continuous.dynamics import Dynamics, check_finite
from sidestep.continuous.estimators import Estimator, check_estimator, value_gradient
from sidestep.continuous.planner import Planner, PlannerState, PlanProgress, check_planner, check_starts
from sidestep.continuous.policies import FinitePolicy, PerCandidate, Policy
from sidestep.continuous.rollouts import q_estimates
from sidestep.continuous.tasks import ContinuousTask, check_tasks, task_at, task_features
from sidestep.errors import InputError, check, check_count, check_positive
from sidestep.inference.priors import Prior
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Term

_Moves = Int[Array, " batch"]


class FitProgress(NamedTuple):
    """Figures of a fit, estimated from one batch of moves; the prior is exact.

    Attributes:
        iteration: the step of the model.
        objective: `actions` + `transitions` + `prior`, in nats.
        actions: the log-likelihood of all actions, in nats.
        transitions: the log-likelihood of all transitions, in nats.
        prior: the log-density of the parameters.
        gradient: the norm of the objective's gradient.
        expected_return: of the policy, as `PlanProgress` has it; 0 without the actions' term, as the next two.
        entropy: of the policy.
        policy_gap: of the policy.
    """

    iteration: int
    objective: float
    actions: float
    transitions: float
    prior: float
    gradient: float
    expected_return: float
    entropy: float
    policy_gap: float


class Schedule(eqx.Module):
    """The length and the steps of a fit.

    Attributes:
        iterations: steps of the model, 2 or more.
        policy_warmup: steps of the policy alone, before the model's first.
        batch_size: demonstrated moves of a step.
        learning_rate: of Adam, in units of θ; it falls to a twentieth along a cosine.
        policy_steps: steps of the policy for each of the model's, one of them with the model's own rollouts.
        drift_tolerance: the largest drift of a converged fit.
        policy_gap_tolerance: the largest policy gap of a converged fit, on either side of 0.

    Example:
        >>> Schedule(iterations=100).learning_rate
        0.05
    """

    iterations: int = eqx.field(default=400, static=True)
    policy_warmup: int = eqx.field(default=200, static=True)
    batch_size: int = eqx.field(default=32, static=True)
    learning_rate: float = eqx.field(default=0.05, static=True)
    policy_steps: int = eqx.field(default=1, static=True)
    drift_tolerance: float = eqx.field(default=0.5, static=True)
    policy_gap_tolerance: float = eqx.field(default=0.1, static=True)

    def rate(self) -> optax.Schedule:
        """Return the learning rate as a function of the iteration."""
        return optax.cosine_decay_schedule(self.learning_rate, self.iterations, alpha=0.05)

    def adam(self) -> optax.GradientTransformation:
        """Return the model's optimizer; with β₂ = 0.99 it forgets the rare large gradients of rollouts quickly."""
        return optax.adam(self.rate(), b2=0.99)


class FitProblem(eqx.Module):
    """Data and settings of a fit.

    Attributes:
        actions: the action of every move, where `demonstrations.actions` holds choices.
    """

    dynamics: Dynamics
    demonstrations: Demonstrations
    behavior: Behavior
    prior: Prior
    planner: Planner
    actions: Shaped[Array, "moves *action"]
    schedule: Schedule
    terms: tuple[Term, ...] = eqx.field(static=True)
    estimator: Estimator = eqx.field(static=True)


def improve_policy(
    problem: FitProblem, parameters: Tree, planner_state: PlannerState, key: PRNGKeyArray
) -> PlannerState:
    """Make a step of the policy and its critic by rollouts from a batch of moves; the model stays the same."""
    batch_key, rollout_key = jax.random.split(key)
    return _action_terms(problem, parameters, planner_state, _draw_moves(problem, batch_key), rollout_key)[0]


def objective_gradient(
    problem: FitProblem, parameters: Tree, planner_state: PlannerState, key: PRNGKeyArray
) -> tuple[PlannerState, Tree, FitProgress]:
    """Estimate the gradient of minus the objective from one batch of moves.

    Returns:
        The next state of the planner, the gradient, and the figures of the fit.

    References:
        Eq. 6 of the paper, with ∇Q by eq. 11.
    """
    batch_key, rollout_key = jax.random.split(key)
    moves = _draw_moves(problem, batch_key)
    slope, transitions, prior = _rollout_free_terms(problem, parameters, moves)
    actions = zero = jnp.zeros_like(prior)
    figures = zero, zero, zero
    if "actions" in problem.terms:
        terms = _action_terms(problem, parameters, planner_state, moves, rollout_key)
        planner_state, action_slope, actions, plan = terms
        slope = jax.tree.map(jnp.add, slope, action_slope)
        figures = plan.expected_return, plan.entropy, plan.policy_gap
    values = transitions + prior + actions, actions, transitions, prior
    return planner_state, slope, FitProgress(0, *values, optax.tree.norm(slope), *figures)  # pyright: ignore[reportArgumentType]


def _draw_moves(problem: FitProblem, key: PRNGKeyArray) -> _Moves:
    count = len(problem.demonstrations)
    return jax.random.choice(key, count, (min(problem.schedule.batch_size, count),), replace=False)


def _rollout_free_terms(problem: FitProblem, parameters: Tree, moves: _Moves) -> tuple[Tree, Array, Array]:
    """Return the gradient of minus the transitions' term (if it counts) and the prior, and the two values."""
    demos = problem.demonstrations

    def loss(parameters: Tree) -> tuple[Array, tuple[Array, Array]]:
        dynamics, prior = problem.dynamics.with_parameters(parameters), problem.prior.log_density(parameters)
        transitions = jnp.zeros_like(prior)
        if "transitions" in problem.terms:
            arguments = demos.states[moves], problem.actions[moves], demos.next_states[moves]
            transitions = len(demos) / len(moves) * jax.vmap(dynamics.log_prob)(*arguments).sum()
        return -(transitions + prior), (transitions, prior)

    slope, (transitions, prior) = jax.grad(loss, has_aux=True)(parameters)
    return slope, transitions, prior


def _action_terms(
    problem: FitProblem, parameters: Tree, planner_state: PlannerState, moves: _Moves, key: PRNGKeyArray
) -> tuple[PlannerState, Tree, Array, PlanProgress]:
    """Estimate the actions' term by rollouts from the states of a batch of moves.

    Returns:
        The next state of the planner, the gradient of minus the actions' log-likelihood, this log-likelihood, and the
        figures of the policy.
    """
    demos, planner, behavior, policy = problem.demonstrations, problem.planner, problem.behavior, planner_state.policy
    choice_key, rollout_key = jax.random.split(key)
    scale = len(demos) / len(moves)
    tasks, states, observed = task_at(demos.tasks, demos.task[moves]), demos.states[moves], demos.actions[moves]
    drawn, probabilities = planner.candidate_actions(choice_key, policy, tasks, states)
    likelihood = _ActionLikelihood(behavior, policy, tasks, states, observed, drawn)
    candidates, probabilities = likelihood.candidates(probabilities)
    agent = problem.dynamics.with_parameters(parameters), policy, tasks, behavior
    size = {"horizon": planner.horizon, "samples": planner.samples}
    method = {"critic": planner_state.critic, "estimator": problem.estimator}
    gradient, rollouts = value_gradient(*agent, rollout_key, states, candidates, likelihood.weights, **size, **method)
    improved, progress = planner.update(planner_state, behavior, rollouts, probabilities)
    q = q_estimates(rollouts)[..., 0].mean(axis=-1)
    slope = jax.tree.map(lambda leaf: -scale * leaf, gradient)
    return improved, slope, scale * likelihood.log_probs(q).sum(), progress


class _ActionLikelihood(NamedTuple):
    """The likelihood of the choices of some demonstrated moves, by Q estimates.

    `observed` are the choices of the demonstrations, `drawn` those of the policy (over a finite set, all actions).
    """

    behavior: Behavior
    policy: Policy
    tasks: ContinuousTask
    states: Array
    observed: Array
    drawn: Array

    def candidates(self, probabilities: Array) -> tuple[Array, Array]:
        """Return all actions of a finite set, or the observed choices followed by those that the policy draws."""
        if isinstance(self.policy, FinitePolicy):
            return self.drawn, probabilities
        candidates = jnp.concatenate([self.observed[:, None], self.drawn], axis=1)
        return candidates, jnp.concatenate([jnp.zeros_like(probabilities[:, :1]), probabilities], axis=1)

    def weights(self, q: PerCandidate) -> PerCandidate:
        """Return β (1 for the observed choice − π), the weights of ∇Q in ∇ log π of the observed choices."""
        beta = self.behavior.beta
        if isinstance(self.policy, FinitePolicy):
            observed = jax.nn.one_hot(self.observed, q.shape[1], dtype=q.dtype)
            return beta * (observed - jnp.exp(self.behavior.log_policy(q)))
        probabilities = jax.nn.softmax(self._log_importance(q), axis=1)
        return beta * jnp.concatenate([jnp.ones_like(probabilities[:, :1]), -probabilities], axis=1)

    def log_probs(self, q: PerCandidate) -> Float[Array, " starts"]:
        """Return ln π of the observed choices."""
        if isinstance(self.policy, FinitePolicy):
            return jnp.take_along_axis(self.behavior.log_policy(q), self.observed[:, None], axis=1)[:, 0]
        weights = self._log_importance(q)
        return self.behavior.beta * q[:, 0] - jax.nn.logsumexp(weights, axis=1) + jnp.log(weights.shape[1])

    def _log_importance(self, q: PerCandidate) -> Float[Array, "starts drawn"]:
        """Return the logarithms βQ − ln π_λ of the importance weights of the drawn choices."""
        features = task_features(self.tasks, self.states)
        log_probs = jax.vmap(jax.vmap(self.policy.log_prob, (None, 0)))(features, self.drawn)
        return self.behavior.beta * q[:, 1:] - log_probs


def check_problem(problem: FitProblem, policy: Policy) -> None:
    """Refuse data or settings that do not go together."""
    demos = problem.demonstrations
    message = f"expected one or both of {ALL_TERMS}, found {problem.terms}"
    check(problem.terms and set(problem.terms) <= set(ALL_TERMS), message, field="terms")
    check_schedule(problem.schedule)
    check_planner(problem.planner)
    check(jax.tree.leaves(problem.dynamics.parameters), "expected parameters to learn, found none", field="dynamics")
    check_finite(problem.dynamics.parameters)
    check_tasks(demos.tasks)
    check_starts(demos.states, demos.task, demos.tasks)
    check_estimator(problem.estimator, problem.dynamics, demos.tasks)
    message = "over vectors of actions the policy is known for the log-sum-exp only: expected that, or a finite set"
    known = isinstance(policy, FinitePolicy) or isinstance(problem.behavior.backup, LogSumExp)
    check(known, message, field="behavior")
    check_finite(demos.next_states, field="next_states")
    _check_shapes(problem)
    densities = np.asarray(jax.vmap(problem.dynamics.log_prob)(demos.states, problem.actions, demos.next_states))
    wrong = np.isnan(densities) | ((densities == -np.inf) & ("transitions" in problem.terms))
    move = int(wrong.argmax())
    message = f"expected a density above 0 for every transition, found the logarithm {densities[move]}"
    check(not wrong.any(), message, source=f"trajectory {int(demos.trajectory[move]) + 1}", field="log_prob")


def _check_shapes(problem: FitProblem) -> None:
    """Refuse states or actions of shapes that the dynamics cannot take."""
    state, action = problem.demonstrations.states[0], problem.actions[0]
    expected = f"expected states and actions that the dynamics can take, found shapes {state.shape} and {action.shape}"
    try:
        following = jax.eval_shape(problem.dynamics.sample, jax.random.key(0), state, action).shape
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(expected, field="demonstrations") from error
    check(following == state.shape, f"{expected}, which lead to {following}", field="demonstrations")


def check_schedule(schedule: Schedule) -> None:
    """Refuse settings that are too small, and rates or tolerances not above 0."""
    # the drift is a difference between two iterations or more
    for name, least in {"iterations": 2, "policy_warmup": 0, "batch_size": 1, "policy_steps": 1}.items():
        check_count(getattr(schedule, name), least, name)
    for name in ("learning_rate", "drift_tolerance", "policy_gap_tolerance"):
        check_positive(getattr(schedule, name), name)
