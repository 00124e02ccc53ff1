"""Rollouts: τ moves of a policy in a world, and the returns that follow.

Move i = 0…τ−1 takes action a_i in state s_i, pays R(s_i, a_i) and leads to s_{i+1}; a terminal state pays its terminal
reward once, and nothing happens after it. The *return-to-go* from state s_i is

    W_i = R_i + b_i − z_i + γ W_{i+1},        W_τ = R_τ (a terminal reward, if s_τ is the first terminal state).

It differs from the textbook's sum of discounted rewards in two terms.

1. The *bonus* b_i = B_i − q_λ(s_i, a_i)/β. B_i is the difference between the agent's backup and the mean of its
   actions' values (`Backup.bonus`: the entropy over β for the log-sum-exp, 0 for the Boltzmann average and the hard
   maximum). q_λ/β is the advantage that the policy itself expects of the choice. Its mean is 0 for every policy, and
   near π ∝ exp βQ^π it removes most of the variance of drawing choices. (For the log-sum-exp, b_i is therefore
   −ln π(a_i | s_i)/β.)
2. The *transition control variate* z_i = γ (V_w(s_{i+1}) − E V_w(s_{i+1})), by a critic V_w and the dynamics, removes
   variance of the draw of next states. Its mean is 0 for every critic.

The *Q estimate* of Q^π(s_i, a_i), for an agent that looks τ moves ahead, is then

    Q̂_i = R_i − z_i + γ W_{i+1},        and E[W_0] = V^π(s_0).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped, UInt32

from sidestep._arguments import to_key
from sidestep.continuous.dynamics import State
from sidestep.continuous.moves import map_moves, sum_gradients
from sidestep.continuous.policies import Agent, Choice, Critic, FinitePolicy, Policy, Starts
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import check_count, check_instance


class Rollout(eqx.Module):
    """One rollout or, with leading axes, many.

    Attributes:
        task: The task of every rollout.
        states: The states s_0…s_τ; those after the end are sampled too, and count for nothing.
        choices: The choices c_0…c_{τ−1} of the policy; the caller may fix the first.
        rewards: R_0…R_τ, 0 after the end.
        bonuses: The bonuses b_0…b_{τ−1}, 0 after the end.
        transition_control_variates: The control variates z_0…z_{τ−1}, 0 until they are set.
        acting: Whether an action was taken in s_i.
        seeds: The seed of each move for what its control variates draw.
    """

    task: ContinuousTask
    states: Shaped[Array, "..."]
    choices: Shaped[Array, "..."]
    rewards: Float[Array, "*batch payments"]
    bonuses: Float[Array, "*batch moves"]
    transition_control_variates: Float[Array, "*batch moves"]
    acting: Bool[Array, "*batch moves"]
    seeds: UInt32[Array, "*batch moves"]

    @property
    def leaving(self) -> Shaped[Array, "..."]:
        """The states s_0…s_{τ−1} that moves leave."""
        return jax.lax.slice_in_dim(self.states, 0, self.acting.shape[-1], axis=self.acting.ndim - 1)

    @property
    def following(self) -> Shaped[Array, "..."]:
        """The states s_1…s_τ that moves lead to."""
        return jax.lax.slice_in_dim(self.states, 1, None, axis=self.acting.ndim - 1)

    @property
    def fraction_left(self) -> Float[Array, "*batch moves"]:
        """The fraction 1 − i/τ of the horizon that is left at every move."""
        moves = self.acting.shape[-1]
        return jnp.broadcast_to(1 - jnp.arange(moves) / moves, self.acting.shape).astype(self.rewards.dtype)

    def at_every_move(self, function: Callable, *more: Array) -> Array:
        """Return function(task, state, …) at every move with an action, and 0 at the others.

        Args:
            function: Of the task, of the state that the move leaves, and of an entry of each of `more`.
            more: Arrays with all axes of the moves.
        """
        return map_moves(function, self.task, self.acting, (self.leaving, *more))

    def gradient_sums(
        self, function: Callable, parameters: Float[Array, " parameters"], groups: Array, count: int, *more: Array
    ) -> Float[Array, "groups parameters"]:
        """Return the gradients by θ of function(θ, task, state, …) at every move, added up in groups of moves.

        Args:
            function: Of θ, of the task, of the state that the move leaves, and of an entry of each of `more`.
            parameters: θ as one vector.
            groups: The group of each move, from 0.
            count: The number of groups.
            more: Arrays with all axes of the moves.
        """
        return sum_gradients(function, parameters, self.task, self.acting, (self.leaving, *more), groups, count)

    def features(self) -> Float[Array, "*batch moves features"]:
        """Return the features of every state that a move leaves."""
        return self.at_every_move(lambda task, state: task.features(state))

    def policy_log_probs(self, policy: Policy) -> Float[Array, "*batch moves"]:
        """Return ln π_λ(a_i | s_i) of every move.

        Args:
            policy: π_λ.
        """
        return self.at_every_move(lambda task, s, choice: policy.log_prob(task.features(s), choice), self.choices)

    def policy_advantages(self, policy: Policy) -> Float[Array, "*batch moves"]:
        """Return q_λ(s_i, a_i) = ln π_λ(a_i | s_i) + H(π_λ(· | s_i)) of every move.

        Args:
            policy: π_λ.
        """
        entropies = self.at_every_move(lambda task, state: policy.entropy(task.features(state)))
        return self.policy_log_probs(policy) + entropies

    def action_baselines(self, critic: Critic | None) -> Float[Array, "*batch moves"]:
        """Return E_i = V_w(s_i) − b_i of every move; V_w is 0 without a critic.

        Args:
            critic: V_w, or None for 0.
        """
        if critic is None:
            return -self.bonuses
        values = self.at_every_move(lambda task, s, left: critic(task.features(s), left), self.fraction_left)
        return values - self.bonuses

    def discount_powers(self, count: int) -> Float[Array, "*batch count"]:
        """Return γ^0…γ^{count−1} of every rollout.

        Args:
            count: The number of powers, 1 or more.
        """
        return self.task.discount[..., None] ** jnp.arange(count)


def sample_rollout(
    agent: Agent[Any], task: ContinuousTask, key: PRNGKeyArray, state: State, horizon: int, choice: Choice | None = None
) -> Rollout:
    """Sample one rollout from a state.

    It is differentiable along the path by θ, by λ, or both, where dynamics and policy are reparameterized.

    Args:
        agent: T_θ, π_λ and the backup.
        task: Rewards and ends.
        key: Draws everything random.
        state: The first state s_0.
        horizon: τ, the number of moves, 1 or more.
        choice: The first choice; drawn from the policy by default.

    Returns:
        The rollout, with `horizon` moves.

    Raises:
        InputError: For a horizon below 1.

    Example:
        >>> import sidestep as ss, sidestep.continuous as sc
        >>> task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.9))
        >>> dynamics = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
        >>> policy = sc.gaussian_policy(jax.random.key(0), 1, jnp.ones((1, 1)))
        >>> agent = sc.Agent(dynamics, policy, ss.Behavior(ss.HardMax()))
        >>> sample_rollout(agent, task, jax.random.key(1), jnp.zeros(1), horizon=5).states.shape
        (6, 1)
    """
    check_count(horizon, 1, "horizon")
    check_instance(agent, Agent, "agent")
    check_instance(task, ContinuousTask, "task")
    key = to_key(key)
    policy, behavior = agent.policy, agent.behavior
    actions = len(policy.actions) if isinstance(policy, FinitePolicy) else None

    def move(carry: tuple, step: tuple[Array, PRNGKeyArray]) -> tuple[tuple, tuple]:
        (state, over), (index, key) = carry, step
        transition_key, choice_key, variate_key = jax.random.split(key, 3)
        terminal, features = task.terminal(state), task.features(state)
        acting = ~(over | terminal)
        # the policy is evaluated once for the draw, its probability and the entropy
        chosen = policy.sample(choice_key, features)
        chosen = chosen if choice is None else jnp.where(index == 0, choice, chosen)
        action, entropy = policy.action(chosen), policy.entropy(features)
        reward = jnp.where(acting, task.reward(state, action), jnp.where(over, 0.0, task.terminal_reward(state)))
        expected = agent.temperature * (policy.log_prob(features, chosen) + entropy)
        bonus = jnp.where(acting, behavior.backup.bonus(entropy, actions, behavior.beta) - expected, 0.0)
        following = agent.dynamics.sample(transition_key, state, action)
        return (following, over | terminal), (
            state,
            chosen,
            reward,
            bonus,
            acting,
            jax.random.bits(variate_key, dtype=jnp.uint32),
        )

    steps = jnp.arange(horizon), jax.random.split(key, horizon)
    (end, over), moves = jax.lax.scan(move, (state, jnp.zeros((), bool)), steps)
    states, choices, rewards, bonuses, acting, seeds = moves
    final = jnp.where(task.terminal(end) & ~over, task.terminal_reward(end), 0.0).astype(rewards.dtype)
    states, rewards = jnp.concatenate([states, end[None]]), jnp.append(rewards, final)
    bonuses = bonuses.astype(rewards.dtype)
    return Rollout(task, states, choices, rewards, bonuses, jnp.zeros_like(bonuses), acting, seeds)


def sample_rollouts(agent: Agent[Any], starts: Starts, key: PRNGKeyArray, horizon: int, samples: int) -> Rollout:
    """Sample several rollouts from every start with each of its first choices.

    The candidates of one start share their random numbers (common random numbers), which reduces the variance of
    differences between them.

    Args:
        agent: T_θ, π_λ and the backup.
        starts: The tasks, states and first choices.
        key: Draws everything random.
        horizon: τ, the number of moves, 1 or more.
        samples: Rollouts of each first choice, 1 or more.

    Returns:
        Rollouts with leading axes (starts, candidates, samples).

    Raises:
        InputError: For a horizon or samples below 1.

    Example:
        >>> import sidestep as ss, sidestep.continuous as sc
        >>> task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.9))
        >>> dynamics = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
        >>> policy = sc.gaussian_policy(jax.random.key(0), 1, jnp.ones((1, 1)))
        >>> starts = sc.Starts(sc.batch_tasks([task, task]), jnp.zeros((2, 1)), jnp.ones((2, 3, 1)))
        >>> agent = sc.Agent(dynamics, policy, ss.Behavior(ss.HardMax()))
        >>> sample_rollouts(agent, starts, jax.random.key(1), horizon=5, samples=4).states.shape
        (2, 3, 4, 6, 1)
    """
    check_count(samples, 1, "samples")
    check_instance(starts, Starts, "starts")
    key = to_key(key)
    keys = jax.random.split(key, (len(starts.states), samples))

    def sample(task: ContinuousTask, state: State, choice: Choice, key: PRNGKeyArray) -> Rollout:
        return sample_rollout(agent, task, key, state, horizon, choice)

    over_candidates = jax.vmap(jax.vmap(sample, (None, None, None, 0)), (None, None, 0, None))
    return jax.vmap(over_candidates)(starts.tasks, starts.states, starts.choices, keys)


def returns_to_go(rollouts: Rollout) -> Float[Array, "*batch payments"]:
    """Return W_0…W_τ.

    Args:
        rollouts: One rollout or, with leading axes, many.

    Returns:
        W_i in units of reward, one more than moves.
    """

    check_instance(rollouts, Rollout, "rollouts")

    def add(after: Array, gain: Array) -> tuple[Array, Array]:
        total = gain + rollouts.task.discount * after
        return total, total

    gains = rollouts.rewards[..., :-1] + rollouts.bonuses - rollouts.transition_control_variates
    last = rollouts.rewards[..., -1]
    _, totals = jax.lax.scan(add, last, jnp.moveaxis(gains, -1, 0), reverse=True)
    return jnp.concatenate([jnp.moveaxis(totals, 0, -1), last[..., None]], axis=-1)


def q_estimates(rollouts: Rollout) -> Float[Array, "*batch moves"]:
    """Return Q̂_i = R_i − z_i + γ W_{i+1} for every move.

    Args:
        rollouts: One rollout or, with leading axes, many.

    Returns:
        Q̂_i in units of reward, one a move.
    """
    after = returns_to_go(rollouts)[..., 1:]
    return rollouts.rewards[..., :-1] - rollouts.transition_control_variates + rollouts.task.discount[..., None] * after


def discounted_returns(rollouts: Rollout) -> Float[Array, "*batch"]:
    """Return Σ γ^i R_i, without bonuses.

    Args:
        rollouts: One rollout or, with leading axes, many.

    Returns:
        A return for each rollout, in units of reward.
    """
    check_instance(rollouts, Rollout, "rollouts")
    return jnp.sum(rollouts.discount_powers(rollouts.rewards.shape[-1]) * rollouts.rewards, axis=-1)
