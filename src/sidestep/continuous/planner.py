"""Planning by policy gradients: the policy of an optimal (Q*) or soft (Q≈, eq. 12) agent that knows the dynamics.

`policy_gradient` has the mathematics. Each step samples rollouts from a batch of starts, and makes one step of Adam
with the policy (eq. 12) and several with its critic.
"""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Int, PRNGKeyArray, Shaped

from sidestep._typing import Tree
from sidestep.continuous.critic import Critic, make_critic
from sidestep.continuous.dynamics import Dynamics, check_finite
from sidestep.continuous.estimators import features_at_moves, policy_advantages, with_control_variates
from sidestep.continuous.policies import FinitePolicy, PerCandidate, Policy
from sidestep.continuous.policy_gradient import fit_critic, policy_gap, policy_gradient
from sidestep.continuous.rollouts import Rollout, discounted_returns, q_estimates, returns_to_go, sample_rollouts
from sidestep.continuous.tasks import ContinuousTask, check_tasks, has_ended, task_at, task_features
from sidestep.errors import NotConverged, check, check_count, check_positive
from sidestep.tabular.backups import Behavior

SomePolicy = TypeVar("SomePolicy", bound=Policy)
_sample = eqx.filter_jit(sample_rollouts)


class PlanProgress(NamedTuple):
    """Figures of a policy, estimated from one batch of rollouts.

    Attributes:
        iteration: the step.
        expected_return: the mean of Σ γ^i R_i over the starts.
        gradient: the norm of the policy's gradient, in units of reward.
        entropy: the mean over the starts, in nats.
        policy_gap: the gap between the policy and its own Q estimates (`policy_gradient.policy_gap`). It is near 0 for
            a converged policy; noise is subtracted, so it can be below 0.
    """

    iteration: int
    expected_return: float
    gradient: float
    entropy: float
    policy_gap: float


class PlannerState(eqx.Module, Generic[SomePolicy]):
    """The state that planning carries from step to step, and to a changed model as a warm start.

    Attributes:
        policy: π_λ.
        critic: V_w.
        policy_moments: the state of the policy's optimizer.
        critic_moments: the state of the critic's optimizer.
    """

    policy: SomePolicy
    critic: Critic
    policy_moments: Tree
    critic_moments: Tree


class PlanProblem(eqx.Module):
    """An agent to plan for.

    Attributes:
        dynamics: T_θ.
        tasks: the task of each start.
        behavior: the agent's backup and β.
        states: the starts.
    """

    dynamics: Dynamics
    tasks: ContinuousTask
    behavior: Behavior
    states: Shaped[Array, "starts *state"]


class Planner(eqx.Module):
    """Settings of rollouts and of the optimizers.

    Attributes:
        horizon: τ, the number of moves of a rollout, 1 or more.
        batch_size: the starts of a step. (The iterations of a fit use `Schedule.batch_size` instead.)
        samples: rollouts of each candidate action, 2 or more, because `policy_gap` compares halves of them.
        candidates: candidate actions of each start where actions are vectors; of a finite set, all are tried.
        learning_rate: of Adam, for the policy.
        critic_rate: of Adam, for the critic.
        critic_width: units in each hidden layer of the critic.
        critic_steps: minibatches of a batch, each for one step of the critic.

    Example:
        >>> Planner(horizon=10).samples
        4
    """

    horizon: int = eqx.field(static=True)
    batch_size: int = eqx.field(default=32, static=True)
    samples: int = eqx.field(default=4, static=True)
    candidates: int = eqx.field(default=8, static=True)
    learning_rate: float = eqx.field(default=3e-3, static=True)
    critic_rate: float = eqx.field(default=1e-2, static=True)
    critic_width: int = eqx.field(default=64, static=True)
    critic_steps: int = eqx.field(default=8, static=True)

    def initialize(self, key: PRNGKeyArray, problem: PlanProblem, policy: SomePolicy) -> PlannerState[SomePolicy]:
        """Return the initial state, with a critic fitted to the mean return of the first policy.

        Args:
            key: draws everything random.
            problem: the agent to plan for.
            policy: the initial policy.

        Raises:
            InputError: settings that `check_planner` refuses, or no start where a task goes on.
        """
        check_planner(self)
        start_key, rollout_key, choice_key, critic_key = jax.random.split(key, 4)
        count = len(problem.states)
        batch = jax.random.choice(start_key, count, (min(count, 8 * self.batch_size),), replace=False)
        tasks, states = task_at(problem.tasks, batch), problem.states[batch]
        choices, _ = self.candidate_actions(choice_key, policy, tasks, states)
        agent = problem.dynamics, policy, tasks, problem.behavior
        rollouts = _sample(*agent, rollout_key, states, self.horizon, choices, self.samples)
        acting = np.asarray(rollouts.acting)
        check(acting.any(), "expected starts where a task has not ended", field="states")
        examples = features_at_moves(rollouts), rollouts.fraction_left, returns_to_go(rollouts)[..., :-1]
        critic = make_critic(critic_key, *(leaf[acting] for leaf in examples), width=self.critic_width)
        optimizers = (policy, optax.adam(self.learning_rate)), (critic, optax.adam(self.critic_rate))
        moments = (adam.init(eqx.filter(module, eqx.is_inexact_array)) for module, adam in optimizers)
        return PlannerState(policy, critic, *moments)

    def candidate_actions(
        self, key: PRNGKeyArray, policy: Policy, tasks: ContinuousTask, states: Shaped[Array, "starts *state"]
    ) -> tuple[Shaped[Array, "starts candidates *choice"], PerCandidate]:
        """Return the first choices to try from every start, and their probabilities.

        A sum over the candidates with these probabilities is a mean under the policy.
        """
        features = task_features(tasks, states)
        if isinstance(policy, FinitePolicy):
            every = jnp.arange(len(policy.actions))
            choices = jnp.broadcast_to(every, (len(states), len(every)))
            return choices, jnp.exp(jax.vmap(policy.log_probs)(features))
        keys = jax.random.split(key, (len(states), self.candidates))
        choices = jax.vmap(jax.vmap(policy.sample, (0, None)))(keys, features)
        return choices, jnp.full(choices.shape[:2], 1 / self.candidates, features.dtype)

    def update(
        self, state: PlannerState[SomePolicy], behavior: Behavior, rollouts: Rollout, probabilities: PerCandidate
    ) -> tuple[PlannerState[SomePolicy], PlanProgress]:
        """Make one step with the policy and several with its critic.

        Args:
            state: policy, critic and their optimizers.
            behavior: the agent's backup and β.
            rollouts: with axes (starts, candidates, samples).
            probabilities: of the candidates, from `candidate_actions`.

        Returns:
            The next state, and the figures of the policy before the step.
        """
        policy, critic = state.policy, state.critic
        gradient = policy_gradient(policy, critic, rollouts, probabilities)
        step, policy_moments = optax.adam(self.learning_rate).update(gradient, state.policy_moments)
        adam = optax.adam(self.critic_rate)
        critic, critic_moments = fit_critic(critic, adam, state.critic_moments, rollouts, self.critic_steps)
        after = PlannerState(eqx.apply_updates(policy, step), critic, policy_moments, critic_moments)
        mean_returns = discounted_returns(rollouts).mean(axis=-1)
        expected_return = jnp.sum(probabilities * mean_returns, axis=1).mean()
        tasks = jax.tree.map(lambda leaf: leaf[:, 0, 0], rollouts.task)
        entropy = jax.vmap(policy.entropy)(task_features(tasks, rollouts.states[:, 0, 0, 0])).mean()
        advantages = policy_advantages(policy, rollouts)[..., 0, 0]
        gap = policy_gap(behavior, advantages, q_estimates(rollouts)[..., 0], probabilities)
        figures = expected_return, optax.tree.norm(gradient), entropy, gap
        return after, PlanProgress(0, *figures)  # pyright: ignore[reportArgumentType]


class PolicyPlan(eqx.Module, Generic[SomePolicy]):
    """The result of planning.

    Attributes:
        planner_state: policy, critic and their optimizers, for a warm start.
        history: one `PlanProgress` a step.
    """

    planner_state: PlannerState[SomePolicy]
    history: tuple[PlanProgress, ...] = eqx.field(static=True)

    @property
    def policy(self) -> SomePolicy:
        """The policy."""
        return self.planner_state.policy

    def recent_progress(self, steps: int = 50) -> PlanProgress:
        """Return the mean of the last steps' figures, which are noisy one by one."""
        last = np.asarray(self.history[-steps:])
        return PlanProgress(int(last[-1, 0]), *last[:, 1:].mean(axis=0).tolist())


def plan_policy(
    dynamics: Dynamics,
    tasks: ContinuousTask,
    behavior: Behavior,
    policy: SomePolicy,
    states: Shaped[Array, "starts *state"],
    task: Int[Array, " starts"],
    planner: Planner,
    *,
    steps: int,
    seed: int = 0,
    warm_start: PlannerState[SomePolicy] | None = None,
    report: Callable[[PlanProgress], None] | None = None,
) -> PolicyPlan[SomePolicy]:
    """Find the policy of an agent that knows `dynamics`, by policy gradients.

    Args:
        dynamics: T_θ.
        tasks: all tasks, as a batch.
        behavior: the agent's backup and β.
        policy: the initial policy.
        states: the starts.
        task: the index of each start's task.
        planner: settings of rollouts and optimizers.
        steps: the number of steps, 1 or more.
        seed: draws everything random.
        warm_start: the state of an earlier plan, instead of `policy`.
        report: called with the figures after every step.

    Raises:
        InputError: starts that are not finite or where a task has ended, tasks that do not exist, parameters that are
            not finite, settings out of range, or a mellowmax agent with vectors of actions.
        NotConverged: figures that cease to be finite.

    Example:
        >>> import sidestep as ss
        >>> import sidestep.continuous as sc
        >>> task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.9))
        >>> dynamics = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
        >>> starts, behavior = jnp.linspace(-1, 1, 9)[:, None], Behavior(ss.LogSumExp(), 2.0)
        >>> policy, planner = sc.gaussian_policy(jax.random.key(0), 1, starts), Planner(horizon=3, critic_width=4)
        >>> len(plan_policy(
        ...     dynamics, sc.batch_tasks([task]), behavior, policy, starts, jnp.zeros(9, int), planner, steps=2
        ... ).history)
        2

    References:
        Eq. 12 of the paper; see `policy_gradient`.
    """
    check_planner(planner)
    check_tasks(tasks)
    check_starts(states, task, tasks)
    check_finite(dynamics.parameters)
    check_count(steps, 1, "steps")
    initial_key, key = jax.random.split(jax.random.key(seed))
    problem = PlanProblem(dynamics, task_at(tasks, task), behavior, states)
    state = warm_start or planner.initialize(initial_key, problem, policy)
    history = []
    for iteration in range(steps):
        step_key = jax.random.fold_in(key, iteration)
        state, progress = _plan_step(planner, problem, state, step_key)
        history.append(PlanProgress(iteration, *(float(number) for number in progress[1:])))
        if not np.isfinite(history[-1]).all():
            reason = "dynamics or rewards that return NaN, or too high a rate"
            raise NotConverged(f"the policy's figures ceased to be finite at step {iteration}: {reason}")
        if report:
            report(history[-1])
    return PolicyPlan(state, tuple(history))


@eqx.filter_jit
def _plan_step(
    planner: Planner, problem: PlanProblem, state: PlannerState[SomePolicy], key: PRNGKeyArray
) -> tuple[PlannerState[SomePolicy], PlanProgress]:
    start_key, choice_key, rollout_key = jax.random.split(key, 3)
    count, policy = len(problem.states), state.policy
    batch = jax.random.choice(start_key, count, (planner.batch_size,), replace=count < planner.batch_size)
    tasks, states = task_at(problem.tasks, batch), problem.states[batch]
    choices, probabilities = planner.candidate_actions(choice_key, policy, tasks, states)
    agent = problem.dynamics, policy, tasks, problem.behavior
    rollouts = sample_rollouts(*agent, rollout_key, states, planner.horizon, choices, planner.samples)
    rollouts = with_control_variates(problem.dynamics, policy, rollouts, state.critic)
    return planner.update(state, problem.behavior, rollouts, probabilities)


def check_planner(planner: Planner) -> None:
    """Refuse settings below 1, fewer than 2 samples (halves are compared), and rates not above 0."""
    for name in ("horizon", "batch_size", "samples", "candidates", "critic_width", "critic_steps"):
        check_count(getattr(planner, name), 2 if name == "samples" else 1, name)
    for name in ("learning_rate", "critic_rate"):
        check_positive(getattr(planner, name), name)


def check_starts(states: Shaped[Array, "starts *state"], task: Int[Array, " starts"], tasks: ContinuousTask) -> None:
    """Refuse no starts, starts that are not finite, and tasks that do not exist or have ended there."""
    count = len(tasks.discount)
    message = f"expected starts and a task for each, found {len(states)} and {len(task)}"
    check(0 < len(states) == len(task), message, field="states")
    finite = np.isfinite(states).reshape(len(states), -1).all(axis=1)
    check(finite.all(), "expected finite numbers", source="states", row=int(finite.argmin()) + 1)
    check(((task >= 0) & (task < count)).all(), f"expected tasks in 0…{count - 1}", field="task")
    ended, message = has_ended(tasks, task, states), "expected starts where a task has not ended"
    check(not ended.any(), message, source="states", row=int(ended.argmax()) + 1)
