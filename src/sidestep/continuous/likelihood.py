"""Estimates of the objective and its gradient from a batch of demonstrated moves.

The objective is the discrete one (eq. 6 of the paper), and so is its gradient, but for expectations:

    ∇ log L = Σ_moves [ β ( ∇Q(s, a) − Σ_a′ π(a′|s) ∇Q(s, a′) ) + ∇ ln T_θ(s, a, s′) ],

with ∇Q by rollouts of the agent's policy under the current model (eq. 11). The same rollouts give a step of that policy
and of its critic (eq. 12). Over vectors of actions the sum over a′ is a mean over choices that the policy draws, with
importance weights exp(βQ)/π_λ: it is then that of the agent under the current model, even if the policy lags behind.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._typing import Tree
from sidestep.continuous.dynamics import Dynamics, PerCandidate, check_finite
from sidestep.continuous.estimators import Estimator, check_estimator, value_gradient
from sidestep.continuous.planner import Planner, PlannerState, PlanProgress, check_starts, plan_step
from sidestep.continuous.policies import Agent, FinitePolicy, GaussianPolicy, Policy, Starts
from sidestep.continuous.rollouts import q_estimates
from sidestep.continuous.tasks import check_tasks, task_at, task_features
from sidestep.errors import InputError, check, check_count, check_instance, check_positive, input_errors
from sidestep.inference.priors import Prior
from sidestep.tabular.backups import LogSumExp
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import Term, check_terms

_Moves = Int[Array, " batch"]


class FitProgress(NamedTuple):
    """Figures of a fit, estimated from one batch of moves; the prior is exact.

    Attributes:
        iteration: The step of the model.
        objective: `actions` + `transitions` + `prior`, in nats.
        actions: The log-likelihood of all actions, in nats.
        transitions: The log-likelihood of all transitions, in nats.
        prior: The log-density of the parameters.
        gradient: The norm of the objective's gradient.
        expected_return: That of the policy, as `PlanProgress` has it; 0 without the actions' term, as the next two.
        entropy: That of the policy.
        policy_gap: That of the policy.
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
        iterations: Steps of the model, 2 or more.
        policy_warmup: Steps of the policy alone, before the model's first.
        batch_size: Demonstrated moves of a step.
        learning_rate: That of Adam, in units of θ; it falls to a twentieth along a cosine.
        policy_steps: Steps of the policy for each of the model's, one of them with the model's own rollouts.
        distance_tolerance: The largest distance of a converged fit from the maximum, in posterior standard deviations,
            as `Verification` has it; the noise of this distance may be half of it.
        policy_gap_tolerance: The largest policy gap of a converged fit, on either side of 0.
        verification_samples: The most rollouts of each candidate of each move that verify the end of a fit, 8 or more;
            as few are taken as make the noise small enough.

    Raises:
        InputError: For counts that are too small, and rates or tolerances not above 0.

    Example:
        >>> Schedule(iterations=100).learning_rate
        0.05
    """

    iterations: int = eqx.field(default=300, static=True)
    policy_warmup: int = eqx.field(default=150, static=True)
    batch_size: int = eqx.field(default=32, static=True)
    learning_rate: float = eqx.field(default=0.05, static=True)
    policy_steps: int = eqx.field(default=1, static=True)
    distance_tolerance: float = eqx.field(default=0.5, static=True)
    policy_gap_tolerance: float = eqx.field(default=0.1, static=True)
    verification_samples: int = eqx.field(default=1024, static=True)

    def __check_init__(self):
        least = {"iterations": 2, "policy_warmup": 0, "batch_size": 1, "policy_steps": 1, "verification_samples": 8}
        for name, count in least.items():
            check_count(getattr(self, name), count, name)
        for name in ("learning_rate", "distance_tolerance", "policy_gap_tolerance"):
            check_positive(getattr(self, name), name)

    @property
    def noise_tolerance(self) -> float:
        """The largest noise of the distance of a converged fit."""
        return self.distance_tolerance / 2

    @property
    def step_noise(self) -> float:
        """The largest noise of each of the Newton steps before; the mean of eight has that of a converged fit."""
        return math.sqrt(8) * self.noise_tolerance

    def rate(self) -> optax.Schedule:
        """Return the learning rate as a function of the iteration."""
        return optax.cosine_decay_schedule(self.learning_rate, self.iterations, alpha=0.05)

    def fraction(self, iteration: Int[Array, ""]) -> Float[Array, ""]:
        """Return the rate of an iteration as a fraction of the first one's; the policy's and the critic's fall with it.

        Args:
            iteration: Its number, from 0.
        """
        return jnp.asarray(self.rate()(iteration)) / self.learning_rate

    def adam(self) -> optax.GradientTransformation:
        """Return the model's optimizer; with β₂ = 0.99 it forgets the rare large gradients of rollouts quickly."""
        return optax.adam(self.rate(), b2=0.99)


class FitProblem(eqx.Module):
    """Data and settings of a fit; the agent has the initial dynamics and policy."""

    agent: Agent[Any]
    demonstrations: Demonstrations
    prior: Prior
    planner: Planner
    schedule: Schedule
    terms: tuple[Term, ...] = eqx.field(static=True)
    estimator: Estimator = eqx.field(static=True)

    def __check_init__(self) -> None:
        agent, demos = self.agent, self.demonstrations
        check_instance(demos, Demonstrations, "demonstrations")
        for name, kind in {"prior": Prior, "planner": Planner, "schedule": Schedule}.items():
            check_instance(getattr(self, name), kind, name)
        check_terms(self.terms)
        check_tasks(demos.tasks)
        _check_choices(demos, agent.policy)
        check(jax.tree.leaves(agent.dynamics.parameters), "expected parameters to learn, found none", field="dynamics")
        check_finite(agent.dynamics.parameters)
        check_starts(demos.states, demos.task, demos.tasks)
        check_estimator(self.estimator, agent.dynamics, demos.tasks)
        check(
            agent.behavior.lapse is None,
            "expected an agent without lapses, which count for nothing here",
            field="lapse",
        )
        message = "over vectors of actions the policy is known for the log-sum-exp only: expected that, or a finite set"
        known = isinstance(agent.policy, FinitePolicy) or isinstance(agent.behavior.backup, LogSumExp)
        check(known, message, field="behavior")
        check_finite(demos.next_states, field="next_states")
        _check_shapes(agent.dynamics, *jax.eval_shape(lambda: (demos.states[0], agent.policy.action(demos.actions[0]))))
        densities = np.asarray(_log_densities(agent.dynamics, agent.policy, demos, np.arange(len(demos))))
        wrong = np.isnan(densities) | ((densities == -np.inf) & ("transitions" in self.terms))
        move, which = int(wrong.argmax()), np.asarray(demos.trajectory)
        message = f"expected a density above 0 for every transition, found the logarithm {densities[move]}"
        check(not wrong.any(), message, source=f"trajectory {which[move] + 1}", field="log_prob")

    def improve_policy(
        self, parameters: Tree, state: PlannerState[Any], key: PRNGKeyArray, fraction: Float[Array, ""]
    ) -> PlannerState[Any]:
        """Make a step of the policy and its critic by rollouts from a batch of moves; the model stays the same.

        Args:
            parameters: θ.
            state: The policy, its critic and their optimizers.
            key: Draws everything random.
            fraction: Of the learning rates of policy and critic.

        Returns:
            The next state of policy and critic.
        """
        demos, agent = self.demonstrations, self.agent
        agent = replace(agent, dynamics=agent.dynamics.with_parameters(parameters))
        planner = replace(self.planner, batch_size=min(self.schedule.batch_size, len(demos)))
        return plan_step(planner, agent, task_at(demos.tasks, demos.task), demos.states, state, key, fraction)[0]

    def objective_gradient(
        self, parameters: Tree, state: PlannerState[Any], key: PRNGKeyArray, fraction: Float[Array, ""]
    ) -> tuple[PlannerState[Any], Tree, FitProgress]:
        """Estimate the gradient of minus the objective from one batch of moves.

        Args:
            parameters: θ.
            state: The policy, its critic and their optimizers.
            key: Draws everything random.
            fraction: Of the learning rates of policy and critic.

        Returns:
            The next state of the planner, the gradient, and the figures of the fit.

        References:
            Eq. 6 of the paper, with ∇Q by eq. 11.
        """
        batch_key, rollout_key = jax.random.split(key)
        moves = self._draw_moves(batch_key)
        slope, (transitions, prior) = jax.grad(self.rollout_free_loss, has_aux=True)(parameters, moves)
        actions = zero = jnp.zeros_like(prior)
        figures = zero, zero, zero
        if "actions" in self.terms:
            state, action_slope, actions, plan = self._action_terms(parameters, state, moves, rollout_key, fraction)
            slope = jax.tree.map(jnp.add, slope, action_slope)
            figures = plan.expected_return, plan.entropy, plan.policy_gap
        values = transitions + prior + actions, actions, transitions, prior
        return state, slope, FitProgress(0, *values, optax.tree.norm(slope), *figures)  # pyright: ignore[reportArgumentType]

    def _draw_moves(self, key: PRNGKeyArray) -> _Moves:
        count = len(self.demonstrations)
        return jax.random.choice(key, count, (min(self.schedule.batch_size, count),), replace=False)

    def rollout_free_loss(self, parameters: Tree, moves: _Moves) -> tuple[Array, tuple[Array, Array]]:
        """Return minus the transitions' term (if it counts) and the prior, and the two values.

        Args:
            parameters: θ.
            moves: The indices of the moves, which stand for all.
        """
        demos, agent = self.demonstrations, self.agent
        dynamics, prior = agent.dynamics.with_parameters(parameters), self.prior.log_density(parameters)
        transitions = jnp.zeros_like(prior)
        if "transitions" in self.terms:
            each = _log_densities(dynamics, agent.policy, demos, moves)
            transitions = len(demos) / len(moves) * self._counted(each, moves)
        return -(transitions + prior), (transitions, prior)

    def _counted(self, each: Float[Array, " batch"], moves: _Moves) -> Array:
        """Return the sum of a number of each of some moves, by their weights."""
        return jnp.sum(self.demonstrations.weights[moves].astype(each.dtype) * each)

    def _action_terms(
        self, parameters: Tree, state: PlannerState[Any], moves: _Moves, key: PRNGKeyArray, fraction: Array
    ) -> tuple[PlannerState[Any], Tree, Array, PlanProgress]:
        """Estimate the actions' term by rollouts from the states of a batch of moves.

        Returns:
            The next state of the planner, the gradient of minus the actions' log-likelihood, this log-likelihood, and
            the figures of the policy.
        """
        demos, planner = self.demonstrations, self.planner
        agent = replace(self.agent, dynamics=self.agent.dynamics.with_parameters(parameters), policy=state.policy)
        choice_key, rollout_key = jax.random.split(key)
        tasks, states, observed = task_at(demos.tasks, demos.task[moves]), demos.states[moves], demos.actions[moves]
        drawn, probabilities = planner.candidate_actions(choice_key, agent.policy, tasks, states)
        likelihood = ActionLikelihood(agent, Starts(tasks, states, drawn), observed)
        starts, probabilities = likelihood.candidates(probabilities)
        size = {"horizon": planner.horizon, "samples": planner.samples}
        method = {"critic": state.critic, "estimator": self.estimator}
        counts = demos.weights[moves]

        def weights(q: PerCandidate) -> PerCandidate:
            return counts.astype(q.dtype)[:, None] * likelihood.weights(q)

        gradient, rollouts = value_gradient(agent, starts, rollout_key, weights, **size, **method)
        improved, progress = planner.update(state, agent.behavior, rollouts, probabilities, fraction)
        q, scale = q_estimates(rollouts)[..., 0].mean(axis=-1), len(demos) / len(moves)
        slope = jax.tree.map(lambda leaf: -scale * leaf, gradient)
        return improved, slope, scale * self._counted(likelihood.log_probs(q), moves), progress


@eqx.filter_jit
def _log_densities(dynamics: Dynamics, policy: Policy, demos: Demonstrations, moves: Array | np.ndarray) -> Array:
    """Return the logarithm of the density of the transition of each of some moves."""
    actions = jax.vmap(policy.action)(demos.actions[moves])
    return jax.vmap(dynamics.log_prob)(demos.states[moves], actions, demos.next_states[moves])


class ActionLikelihood(NamedTuple):
    """The likelihood of the choices of some demonstrated moves, by Q estimates.

    `drawn` has the choices of the policy (over a finite set, all actions), `observed` those of the demonstrations.
    """

    agent: Agent[Any]
    drawn: Starts
    observed: Array

    def candidates(self, probabilities: Array) -> tuple[Starts, Array]:
        """Return all actions of a finite set, or the observed choices followed by those that the policy draws.

        Args:
            probabilities: Those of the drawn choices under the policy.

        Returns:
            The choices, and the probabilities with 0 for the observed choices that were not drawn.
        """
        if isinstance(self.agent.policy, FinitePolicy):
            return self.drawn, probabilities
        choices = jnp.concatenate([self.observed[:, None], self.drawn.choices], axis=1)
        none = jnp.zeros_like(probabilities[:, :1])
        return replace(self.drawn, choices=choices), jnp.concatenate([none, probabilities], axis=1)

    def probabilities(self, q: PerCandidate) -> PerCandidate:
        """Return π of every candidate, which add up to 1 for each start; 0 for observed choices that were not drawn.

        Args:
            q: Q of every candidate, in units of reward.
        """
        if isinstance(self.agent.policy, FinitePolicy):
            return jnp.exp(self.agent.behavior.log_policy(q))
        drawn = jax.nn.softmax(self._log_importance(q), axis=1)
        return jnp.concatenate([jnp.zeros_like(drawn[:, :1]), drawn], axis=1)

    def weights(self, q: PerCandidate) -> PerCandidate:
        """Return β (1 for the observed choice − π), the weights of ∇Q in ∇ log π of the observed choices.

        Args:
            q: Q of every candidate, in units of reward.
        """
        finite = isinstance(self.agent.policy, FinitePolicy)
        which = self.observed if finite else jnp.zeros(len(q), int)
        observed = jax.nn.one_hot(which, q.shape[1], dtype=q.dtype)
        return self.agent.behavior.beta * (observed - self.probabilities(q))

    def log_probs(self, q: PerCandidate) -> Float[Array, " starts"]:
        """Return ln π of the observed choices.

        Args:
            q: Q of every candidate, in units of reward.
        """
        behavior = self.agent.behavior
        if isinstance(self.agent.policy, FinitePolicy):
            return jnp.take_along_axis(behavior.log_policy(q), self.observed[:, None], axis=1)[:, 0]
        weights = self._log_importance(q)
        return behavior.beta * q[:, 0] - jax.nn.logsumexp(weights, axis=1) + jnp.log(weights.shape[1])

    def _log_importance(self, q: PerCandidate) -> Float[Array, "starts drawn"]:
        """Return the logarithms βQ − ln π_λ of the importance weights of the drawn choices."""
        features = task_features(self.drawn.tasks, self.drawn.states)
        log_probs = jax.vmap(jax.vmap(self.agent.policy.log_prob, (None, 0)))(features, self.drawn.choices)
        return self.agent.behavior.beta * q[:, 1:] - log_probs


def _check_choices(demos: Demonstrations, policy: Policy) -> None:
    """Refuse actions that do not belong to the policy's."""
    choices = np.asarray(demos.actions)
    if isinstance(policy, FinitePolicy):
        last = len(policy.actions) - 1
        is_index = choices.ndim == 1 and np.issubdtype(choices.dtype, np.integer)
        wrong = (choices < 0) | (choices > last) if is_index else np.ones(len(choices), bool)
        for move in np.flatnonzero(wrong)[:1]:
            message = f"expected the index of an action, 0…{last}, found {choices[move]}"
            raise InputError(message, source=f"trajectory {int(demos.trajectory[move]) + 1}", field="actions")
        return
    check(np.issubdtype(choices.dtype, np.floating), "expected vectors, as the policy's actions are", field="actions")
    if isinstance(policy, GaussianPolicy):
        message = f"expected vectors of {len(policy.log_spread)}, found shape {choices.shape[1:]}"
        check(choices.shape[1:] == policy.log_spread.shape, message, field="actions")


def _check_shapes(dynamics: Dynamics, state: jax.ShapeDtypeStruct, action: jax.ShapeDtypeStruct) -> None:
    """Refuse states or actions of shapes that the dynamics cannot take."""
    expected = f"expected states and actions that the dynamics can take, found shapes {state.shape} and {action.shape}"
    with input_errors(expected, TypeError, ValueError, IndexError, source=None, field="demonstrations"):
        following = jax.eval_shape(dynamics.sample, jax.random.key(0), state, action).shape
    check(following == state.shape, f"{expected}, which lead to {following}", field="demonstrations")
