"""Planning by policy gradients: the policy of an optimal (Q*) or soft (Q≈) agent that knows the dynamics.

Each step samples rollouts from a batch of starts, and makes one step of Adam with the policy (eq. 12 of the paper) and
several with its critic.

A soft agent has π ∝ exp βQ^π. With the policy's advantages q_λ and the Q estimate Q̂_i of a rollout, the divergence
between the agent's choices and those of π_λ falls along

    −∇_λ = E [ Σ_i ∇_λ ln π_λ(a_i | s_i) γ^i ( Q̂_i − E_i − q_λ(s_i, a_i)/β ) ].

This is a variational policy gradient with a baseline (Williams 1992). It differs from eq. 12 as printed in four points.

1. It is divided by −β, and discounted.
2. The baseline E_i, any function of s_i, is subtracted. The whole of what is subtracted is V_w(s_i) − b_i, a critic's
   value, because the bonuses b_i of rollouts hold q_λ/β.
3. Q̂_i may hold bonuses of later moves (`Backup.bonus`). As printed, eq. 12 counts rewards only, and leads to the
   **Boltzmann average** (eqs. 3–5). The divergence to Ziebart's trajectory distribution also counts the entropies of
   later moves, E[−Σ_{j>i} ln π_λ(a_j | s_j)]; with these the same equation leads to the **log-sum-exp**. For the
   **hard maximum** 1/β is 0, and the ordinary policy gradient is left.
4. At the first state of a rollout all actions are tried (or several draws of the policy), and the sum over them is
   taken exactly, with their probabilities.

The gradient is 0 where q_λ/β are the advantages of Q^π.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Int, PRNGKeyArray, Shaped

from sidestep._arguments import to_floats, to_integers
from sidestep._typing import Tree
from sidestep.continuous.dynamics import PerCandidate, Real, check_finite
from sidestep.continuous.estimators import with_control_variates
from sidestep.continuous.gaps import policy_gaps
from sidestep.continuous.policies import Agent, Critic, FinitePolicy, Policy, SomePolicy, Starts, make_critic
from sidestep.continuous.policy_steps import fit_critic, policy_gradient
from sidestep.continuous.rollouts import Rollout, discounted_returns, q_estimates, returns_to_go, sample_rollouts
from sidestep.continuous.tasks import ContinuousTask, States, check_tasks, has_ended, task_at, task_features
from sidestep.errors import (
    NotConverged,
    check,
    check_count,
    check_function,
    check_instance,
    check_positive,
    to_count,
)
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior


class PlanProgress(NamedTuple):
    """Figures of a policy, estimated from one batch of rollouts.

    Attributes:
        iteration: The step.
        expected_return: The mean of Σ γ^i R_i over the starts.
        gradient: The norm of the policy's gradient, in units of reward.
        entropy: The mean over the starts, in nats.
        policy_gap: The gap between the policy and its own Q estimates (`policy_gaps`). It is near 0 for
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
        policy_moments: The state of the policy's optimizer.
        critic_moments: The state of the critic's optimizer.
    """

    policy: SomePolicy
    critic: Critic
    policy_moments: Tree
    critic_moments: Tree


class Planner(eqx.Module):
    """Settings of rollouts and of the optimizers.

    Attributes:
        horizon: τ, the number of moves of a rollout, 1 or more.
        batch_size: The starts of a step. (The iterations of a fit use `Schedule.batch_size` instead.)
        samples: Rollouts of each candidate action, 2 or more, because `policy_gaps` compares halves of them.
        candidates: Candidate actions of each start where actions are vectors; of a finite set, all are tried.
        learning_rate: That of Adam, for the policy.
        critic_rate: That of Adam, for the critic.
        critic_width: Units in each hidden layer of the critic.
        critic_steps: Minibatches of a batch, each for one step of the critic.

    Raises:
        InputError: For counts below 1, fewer than 2 samples, and rates not above 0.

    Example:
        >>> Planner(horizon=10).samples
        4
    """

    horizon: int = eqx.field(static=True)
    batch_size: int = eqx.field(default=32, static=True)
    samples: int = eqx.field(default=4, static=True)
    candidates: int = eqx.field(default=8, static=True)
    learning_rate: float = eqx.field(default=1e-2, static=True)
    critic_rate: float = eqx.field(default=1e-2, static=True)
    critic_width: int = eqx.field(default=64, static=True)
    critic_steps: int = eqx.field(default=8, static=True)

    def __check_init__(self):
        for name in ("horizon", "batch_size", "samples", "candidates", "critic_width", "critic_steps"):
            check_count(getattr(self, name), 2 if name == "samples" else 1, name)
        for name in ("learning_rate", "critic_rate"):
            check_positive(getattr(self, name), name)

    def initialize(
        self, key: PRNGKeyArray, agent: Agent[SomePolicy], tasks: ContinuousTask, states: States
    ) -> PlannerState[SomePolicy]:
        """Return the initial state, with a critic fitted to the mean return of the first policy.

        Args:
            key: Draws everything random.
            agent: The agent to plan for, with its first policy.
            tasks: The task of each start.
            states: The starts.

        Returns:
            The agent's policy, a critic, and fresh optimizers for both.

        Raises:
            InputError: For no start where a task goes on.
            NotConverged: For rollouts with numbers that are not finite.
        """
        critic_key, *first = _first_moves(self, agent, tasks, states, key)
        acting, *examples = map(np.asarray, first)
        check(acting.any(), f"expected starts where a task has not ended, found none of {len(states)}", field="states")
        moves = [leaf[acting] for leaf in examples]
        if not all(np.isfinite(leaf).all() for leaf in moves):
            reason = "the first rollouts have features or returns that are not, by dynamics or rewards"
            raise NotConverged(f"the policy's figures ceased to be finite at step 0: {reason}")
        critic = make_critic(critic_key, *map(jax.device_put, moves), width=self.critic_width)
        return PlannerState(agent.policy, critic, *_fresh_moments(self, agent.policy, critic))

    def candidate_actions(
        self, key: PRNGKeyArray, policy: Policy, tasks: ContinuousTask, states: States
    ) -> tuple[Shaped[Array, "starts candidates *choice"], PerCandidate]:
        """Return the first choices to try from every start, and their probabilities.

        A sum over the candidates with these probabilities is a mean under the policy.

        Args:
            key: Draws the candidates where actions are vectors.
            policy: π_λ.
            tasks: The task of each start.
            states: The starts.

        Returns:
            Choices of shape (starts, candidates, …) and probabilities of shape (starts, candidates).
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
        self,
        state: PlannerState[SomePolicy],
        behavior: Behavior,
        rollouts: Rollout,
        probabilities: PerCandidate,
        fraction: Real | float = 1.0,
    ) -> tuple[PlannerState[SomePolicy], PlanProgress]:
        """Make one step with the policy and several with its critic.

        Args:
            state: Policy, critic and their optimizers.
            behavior: The agent's backup and β.
            rollouts: With axes (starts, candidates, samples).
            probabilities: Those of the candidates, from `candidate_actions`.
            fraction: Of both learning rates, in (0, 1].

        Returns:
            The next state, and the figures of the policy before the step.
        """
        policy, critic = state.policy, state.critic
        gradient = policy_gradient(policy, critic, rollouts, probabilities)
        step, policy_moments = optax.adam(self.learning_rate).update(gradient, state.policy_moments)
        step = jax.tree.map(lambda leaf: fraction * leaf, step)
        adam = optax.adam(self.critic_rate)
        critic, critic_moments = fit_critic(critic, adam, state.critic_moments, rollouts, self.critic_steps, fraction)
        after = PlannerState(eqx.apply_updates(policy, step), critic, policy_moments, critic_moments)
        expected_return = jnp.sum(probabilities * discounted_returns(rollouts).mean(axis=-1), axis=1).mean()
        tasks = jax.tree.map(lambda leaf: leaf[:, 0, 0], rollouts.task)
        entropy = jax.vmap(policy.entropy)(task_features(tasks, rollouts.states[:, 0, 0, 0])).mean()
        advantages = rollouts.policy_advantages(policy)[..., 0, 0]
        gap = policy_gaps(behavior, advantages, q_estimates(rollouts)[..., 0], probabilities).mean()
        figures = expected_return, optax.tree.norm(gradient), entropy, gap
        return after, PlanProgress(0, *figures)  # pyright: ignore[reportArgumentType]


class PolicyPlan(eqx.Module, Generic[SomePolicy]):
    """The result of planning.

    Attributes:
        planner_state: Policy, critic and their optimizers, for a warm start.
        history: One `PlanProgress` a step.
    """

    planner_state: PlannerState[SomePolicy]
    history: tuple[PlanProgress, ...] = eqx.field(static=True)

    @property
    def policy(self) -> SomePolicy:
        """The policy."""
        return self.planner_state.policy

    def recent_progress(self, steps: int = 50) -> PlanProgress:
        """Return the mean of the last steps' figures, which are noisy one by one.

        Args:
            steps: The number of steps, 1 or more.

        Returns:
            The figures, with the number of the last step.
        """
        last = np.asarray(self.history[-steps:])
        return PlanProgress(int(last[-1, 0]), *last[:, 1:].mean(axis=0).tolist())


def plan_policy(
    agent: Agent[SomePolicy],
    tasks: ContinuousTask,
    states: States,
    task: Int[Array, " starts"],
    planner: Planner,
    *,
    steps: int,
    seed: int = 0,
    warm_start: PlannerState[SomePolicy] | None = None,
    report: Callable[[PlanProgress], None] | None = None,
) -> PolicyPlan[SomePolicy]:
    """Find the policy of an agent that knows its dynamics, by policy gradients.

    Args:
        agent: T_θ, the backup and β, and the initial policy.
        tasks: All tasks, as a batch.
        states: The starts.
        task: The index of each start's task.
        planner: Settings of rollouts and optimizers.
        steps: The number of steps, 1 or more.
        seed: Draws everything random.
        warm_start: The state of an earlier plan, instead of the agent's policy.
        report: Called with the figures after every step.

    Returns:
        The policy, its critic and their optimizers, and the figures of every step.

    Raises:
        InputError: For starts that are not finite or where a task has ended, tasks that do not exist, parameters that
            are not finite, a number of steps below 1, or a mellowmax agent with vectors of actions.
        NotConverged: For figures that cease to be finite.

    Example:
        >>> import sidestep as ss, sidestep.continuous as sc
        >>> task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.9))
        >>> dynamics = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
        >>> starts, planner = jnp.linspace(-1, 1, 9)[:, None], Planner(horizon=3, critic_width=4)
        >>> policy = sc.gaussian_policy(jax.random.key(0), 1, starts)
        >>> agent = sc.Agent(dynamics, policy, ss.Behavior(ss.LogSumExp(), 2.0))
        >>> plan = plan_policy(agent, sc.batch_tasks([task]), starts, jnp.zeros(9, int), planner, steps=2)
        >>> len(plan.history)
        2

    References:
        Eq. 12 of the paper; see the module's docstring.
    """
    check_instance(agent, Agent, "agent")
    check_instance(planner, Planner, "planner")
    check_instance(warm_start, (PlannerState, type(None)), "warm_start")
    if report is not None:
        check_function(report, "report")
    seed = to_count(seed, "seed", 0)
    check_tasks(tasks)
    states, task = check_starts(states, task, tasks)
    check_finite(agent.dynamics.parameters)
    check_count(steps, 1, "steps")
    initial_key, key = jax.random.split(jax.random.key(seed))
    each_task, history = task_at(tasks, task), []
    whole = jnp.asarray(1.0, jnp.float32)  # the type that fits pass, so that both use one compiled program
    state = warm_start or planner.initialize(initial_key, agent, each_task, states)
    for iteration in range(steps):
        step_key = jax.random.fold_in(key, iteration)
        state, progress = plan_step(planner, agent, each_task, states, state, step_key, whole)
        history.append(PlanProgress(iteration, *(float(number) for number in progress[1:])))
        if not np.isfinite(history[-1]).all():
            reason = "dynamics or rewards that return NaN, or too high a rate"
            raise NotConverged(f"the policy's figures ceased to be finite at step {iteration}: {reason}")
        if report:
            report(history[-1])
    return PolicyPlan(state, tuple(history))


@eqx.filter_jit
def _first_moves(
    planner: Planner, agent: Agent[Any], tasks: ContinuousTask, states: States, key: PRNGKeyArray
) -> tuple:
    """Return a key for the critic, whether each move of some first rollouts counts, and what the critic is made of."""
    start_key, rollout_key, choice_key, critic_key = jax.random.split(key, 4)
    batch = jax.random.choice(start_key, len(states), (min(len(states), 8 * planner.batch_size),), replace=False)
    tasks, states = task_at(tasks, batch), states[batch]
    choices, _ = planner.candidate_actions(choice_key, agent.policy, tasks, states)
    rollouts = sample_rollouts(agent, Starts(tasks, states, choices), rollout_key, planner.horizon, planner.samples)
    examples = rollouts.features(), rollouts.fraction_left, returns_to_go(rollouts)[..., :-1]
    return critic_key, rollouts.acting, *examples


@eqx.filter_jit
def _fresh_moments(planner: Planner, policy: Policy, critic: Critic) -> tuple[Tree, ...]:
    """Return the states of both optimizers before their first step."""
    rates = (policy, planner.learning_rate), (critic, planner.critic_rate)
    return tuple(optax.adam(rate).init(eqx.filter(module, eqx.is_inexact_array)) for module, rate in rates)


@eqx.filter_jit
def plan_step(
    planner: Planner,
    agent: Agent[Any],
    tasks: ContinuousTask,
    states: States,
    state: PlannerState[Any],
    key: PRNGKeyArray,
    fraction: Real,
) -> tuple[PlannerState[Any], PlanProgress]:
    """Make one step of a policy and its critic by rollouts from a batch of starts.

    Args:
        planner: Settings of rollouts and optimizers.
        agent: T_θ, the backup and β.
        tasks: The task of each start.
        states: The starts.
        state: The policy, its critic and their optimizers.
        key: Draws everything random.
        fraction: Of the learning rates of policy and critic, in (0, 1].

    Returns:
        The next state, and the figures of the policy before the step.
    """
    start_key, choice_key, rollout_key = jax.random.split(key, 3)
    count, agent = len(states), replace(agent, policy=state.policy)
    batch = jax.random.choice(start_key, count, (planner.batch_size,), replace=count < planner.batch_size)
    tasks, states = task_at(tasks, batch), states[batch]
    choices, probabilities = planner.candidate_actions(choice_key, agent.policy, tasks, states)
    rollouts = sample_rollouts(agent, Starts(tasks, states, choices), rollout_key, planner.horizon, planner.samples)
    rollouts = with_control_variates(agent, rollouts, state.critic)
    return planner.update(state, agent.behavior, rollouts, probabilities, fraction)


def check_starts(
    states: States, task: Int[Array, " starts"], tasks: ContinuousTask
) -> tuple[States, Int[Array, " starts"]]:
    """Return starts and their tasks as arrays.

    There is a start, all are finite, and their tasks exist and have not ended there.

    Args:
        states: The states.
        task: The index of the task of each start.
        tasks: The tasks as a batch.

    Returns:
        The states and the indices.

    Raises:
        InputError: For any of these.
    """
    message = "expected a batch of tasks (batch_tasks), found a single one"
    check(np.ndim(tasks.discount) == 1, message, field="tasks")
    places = states if isinstance(states, jax.Array) else to_jax(to_floats(states, "states"))
    message = f"expected one or more starts, found shape {places.shape}"
    check(places.ndim and len(places), message, field="states")
    last = len(tasks.discount) - 1
    which = to_jax(to_integers(task, "task", (len(places),), least=0, most=last, what="tasks"))
    finite = np.isfinite(places).reshape(len(places), -1).all(axis=1)
    message = f"expected finite numbers, found {places[int(finite.argmin())]}"
    check(finite.all(), message, source="states", row=int(finite.argmin()) + 1)
    ended = np.asarray(has_ended(tasks, which, places))
    message = f"expected starts where a task has not ended, found {places[int(ended.argmax())]}"
    check(not ended.any(), message, source="states", row=int(ended.argmax()) + 1)
    return places, which
