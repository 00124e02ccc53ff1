"""Roll-outs: what happens when a policy acts in a world, τ moves far, and what it was worth.

Move i = 0…τ−1 takes action a_i in state s_i, pays R(s_i, a_i) and leads to s_{i+1}; a terminal state pays its final
reward once and nothing happens after. The worth of what is *to come* from state s_i is

    W_i = R_i + b_i − z_i + γ W_{i+1},        W_τ = R_τ (a final reward, if s_τ is the first terminal state),

where b_i is what the people's backup adds to the mean of its actions' values (`Backup.bonus`: the entropy over β for
the log-sum-exp, nothing for the Boltzmann average and the hard maximum), less q_λ(s_i, a_i)/β, what the policy's own
advantages expect of this choice beyond the mean. The latter averages to nothing, whatever the policy, and takes off
most of the noise of drawing choices where the policy is near π ∝ exp βQ^π. (For the log-sum-exp, b_i is so
−ln π(a_i | s_i)/β.) The *surprise* z_i = γ (V_w(s_{i+1}) − E V_w(s_{i+1})), by a critic V_w and the dynamics, does the
same for the noise of what an action leads to; it averages to nothing too, however wrong the critic. What a roll-out
says of Q^π(s_i, a_i), of people who look τ moves ahead, is then

    Q̂_i = R_i − z_i + γ W_{i+1},        and E[W_0] = V^π(s_0).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped

from sidestep.continuous.dynamics import Dynamics, State
from sidestep.continuous.policies import Choice, FinitePolicy, Policy
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import check_count
from sidestep.tabular.backups import Behavior, HardMax


class RollOut(eqx.Module):
    """One roll-out, or (with leading axes) many.

    - `states`: s_0…s_τ; after the end they go on as if it had not come, and count for nothing.
    - `choices`: those of the policy; `choices[0]` may have been given.
    - `rewards`: R_0…R_τ, 0 after the end.
    - `bonuses`: b_0…b_{τ−1}, 0 after the end.
    - `surprises`: z_0…z_{τ−1}, 0 until a critic says what was to be expected (`estimators.surprised`).
    - `acting`: whether an action was taken in s_i.
    """

    states: Shaped[Array, "..."]
    choices: Shaped[Array, "..."]
    rewards: Float[Array, "*batch payments"]
    bonuses: Float[Array, "*batch moves"]
    surprises: Float[Array, "*batch moves"]
    acting: Bool[Array, "*batch moves"]

    @property
    def leaving(self) -> Shaped[Array, "..."]:
        """s_0…s_{τ−1}, the states that moves leave."""
        return jax.lax.slice_in_dim(self.states, 0, self.acting.shape[-1], axis=self.acting.ndim - 1)

    @property
    def following(self) -> Shaped[Array, "..."]:
        """s_1…s_τ, the states that moves lead to."""
        return jax.lax.slice_in_dim(self.states, 1, None, axis=self.acting.ndim - 1)


def temperature(behavior: Behavior) -> Float[Array, ""]:
    """1/β, or 0 for people who act optimally (`HardMax`)."""
    return jnp.zeros_like(behavior.beta) if isinstance(behavior.backup, HardMax) else 1 / behavior.beta


def roll_out(
    dynamics: Dynamics,
    policy: Policy,
    task: ContinuousTask,
    behavior: Behavior,
    key: PRNGKeyArray,
    state: State,
    horizon: int,
    choice: Choice | None = None,
) -> RollOut:
    """What happens from `state` within `horizon` moves; the first choice is the policy's, unless it is given.

    Differentiable along the path by θ, by λ, or both, where dynamics and policy are reparameterised. Raises
    `InputError` for a horizon below 1.
    """
    check_count(horizon, 1, "horizon")

    def move(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, tuple]:
        state, choice, over = carry
        moving, choosing = jax.random.split(key)
        terminal = task.terminal(state)
        acting = ~(over | terminal)
        action = policy.action(choice)
        pays = jnp.where(acting, task.reward(state, action), jnp.where(over, 0.0, task.terminal_reward(state)))
        seen = task.features(state)
        entropy = policy.entropy(seen)
        beyond_mean = temperature(behavior) * (policy.log_prob(seen, choice) + entropy)
        bonus = jnp.where(acting, behavior.backup.bonus(entropy, actions, behavior.beta) - beyond_mean, 0.0)
        following = dynamics.sample(moving, state, action)
        next_choice = policy.sample(choosing, task.features(following))
        return (following, next_choice, over | terminal), (state, choice, pays, bonus, acting)

    actions = len(policy.actions) if isinstance(policy, FinitePolicy) else None
    first, key = jax.random.split(key)
    choice = policy.sample(first, task.features(state)) if choice is None else choice
    last, passed = jax.lax.scan(move, (state, choice, jnp.zeros((), bool)), jax.random.split(key, horizon))
    states, choices, rewards, bonuses, acting = passed
    end, _, over = last
    pays = jnp.where(task.terminal(end) & ~over, task.terminal_reward(end), 0.0).astype(rewards.dtype)
    bonuses = bonuses.astype(rewards.dtype)
    return RollOut(
        jnp.concatenate([states, end[None]]),
        choices,
        jnp.append(rewards, pays),
        bonuses,
        jnp.zeros_like(bonuses),
        acting,
    )


def roll_outs(
    dynamics: Dynamics,
    policy: Policy,
    tasks: ContinuousTask,
    behavior: Behavior,
    key: PRNGKeyArray,
    states: Shaped[Array, "places *state"],
    horizon: int,
    choices: Shaped[Array, "places options *choice"],
    samples: int,
) -> RollOut:
    """Many roll-outs: `samples` from every place with every one of its first choices.

    - `tasks`: the task of each place (a leading axis of places).
    - The result has leading axes (places, options, samples). The options of a place share their random numbers, so that
      differences between them are less noisy than they are.

    Raises `InputError` for a horizon or samples below 1.
    """
    check_count(samples, 1, "samples")
    keys = jax.random.split(key, (len(states), samples))

    def one(task: ContinuousTask, state: State, choice: Choice, key: PRNGKeyArray) -> RollOut:
        return roll_out(dynamics, policy, task, behavior, key, state, horizon, choice)

    over_samples = jax.vmap(one, (None, None, None, 0))
    over_options = jax.vmap(over_samples, (None, None, 0, None))
    return jax.vmap(over_options)(tasks, states, choices, keys)


def to_come(rolled: RollOut, discount: Float[Array, "*#batch"]) -> Float[Array, "*batch payments"]:
    """W_0…W_τ; `discount` broadcasts against the leading axes of the roll-outs."""

    def earlier(after: Array, now: Array) -> tuple[Array, Array]:
        worth = now + discount * after
        return worth, worth

    gains = rolled.rewards[..., :-1] + rolled.bonuses - rolled.surprises
    last = rolled.rewards[..., -1]
    _, worths = jax.lax.scan(earlier, last, jnp.moveaxis(gains, -1, 0), reverse=True)
    return jnp.concatenate([jnp.moveaxis(worths, 0, -1), last[..., None]], axis=-1)


def said(rolled: RollOut, discount: Float[Array, "*#batch"]) -> Float[Array, "*batch moves"]:
    """Q̂_i = R_i − z_i + γ W_{i+1}, what roll-outs say of Q^π(s_i, a_i), for every move."""
    after = to_come(rolled, discount)[..., 1:]
    return rolled.rewards[..., :-1] - rolled.surprises + discount[..., None] * after


def returns(rolled: RollOut, discount: Float[Array, "*#batch"]) -> Float[Array, "*batch"]:
    """Σ γ^i R_i, without bonuses."""
    powers = discount[..., None] ** jnp.arange(rolled.rewards.shape[-1])
    return jnp.sum(powers * rolled.rewards, axis=-1)


def spread_over(tasks: ContinuousTask, rolled: RollOut) -> ContinuousTask:
    """The tasks of roll-outs with the same leading axes as these, from tasks with an axis of places."""
    leading = rolled.acting.shape[:-1]

    def over(leaf: Array) -> Array:
        inner = leaf.reshape(leaf.shape[0], *(1,) * (len(leading) - 1), *leaf.shape[1:])
        return jnp.broadcast_to(inner, (*leading, *leaf.shape[1:]))

    return jax.tree.map(over, tasks)
