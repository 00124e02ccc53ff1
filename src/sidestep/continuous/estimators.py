"""Estimates of ∇_θ Q^π by rollouts (eq. 11 of the paper), for a policy that is held fixed.

With the Q estimate Q̂_i = R_i − z_i + γ W_{i+1} (see `rollouts`), the **score** estimate is the likelihood-ratio
estimator (Williams 1992),

    ∇_θ Q^π(s_0, a_0) = E [ Σ_i ∇_θ ln T_θ(s_i, a_i, s_{i+1}) γ^i (Q̂_i + z_i − E_i) ].

It differs from eq. 11 as printed in three points.

1. Terms of mean 0 are left out: rewards that were paid before a transition do not depend on it.
2. The *baseline* E_i is subtracted. It may be any function of s_i and a_i, because ∇_θ ln T_θ has mean 0 given these;
   here it is the critic's estimate of Q^π, V_w(s_i) − b_i.
3. z_i is added back, because the credit of a transition is the effect of its own draw.

The **pathwise** estimate (Kingma and Welling 2014) is the derivative of Q̂_0 along the path, with the random numbers
held fixed. It requires reparameterized dynamics and smooth rewards; its variance is then far lower on stable systems.
Draws from a finite set of actions are not smooth; they add a score,
Σ_{i≥1} ∇_θ ln π(a_i | s_i(θ)) γ^i (Q̂_i − V_w(s_i) + b_i).

Both are implemented as *surrogates*: numbers with the estimate as their derivative by θ.
"""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from sidestep._typing import FloatTree
from sidestep.continuous.critic import Critic
from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.policies import PerCandidate, PerSample, Policy
from sidestep.continuous.rollouts import Rollout, discount_powers, q_estimates, sample_rollouts
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import InputError, check
from sidestep.tabular.backups import Behavior

Estimator = Literal["score", "pathwise"]

WeightFunction = Callable[[PerCandidate], PerCandidate]
"""The weights of ∇Q of all candidates, as a function of the estimates of Q."""


def at_every_move(function: Callable, rollouts: Rollout, *more: Array) -> Array:
    """Return function(task, state, …) at every move; `more` has all axes of the moves."""
    mapped = jax.vmap(function, (None, *(0,) * (1 + len(more))))
    for _ in rollouts.acting.shape[:-1]:
        mapped = jax.vmap(mapped)
    return mapped(rollouts.task, rollouts.leaving, *more)


def features_at_moves(rollouts: Rollout) -> Float[Array, "*batch moves features"]:
    """Return the features of every state that a move leaves."""
    return at_every_move(lambda task, state: task.features(state), rollouts)


def policy_log_probs(policy: Policy, rollouts: Rollout) -> Float[Array, "*batch moves"]:
    """Return ln π_λ(a_i | s_i) of every move."""
    moves = rollouts, rollouts.choices
    return at_every_move(lambda task, state, choice: policy.log_prob(task.features(state), choice), *moves)


def policy_advantages(policy: Policy, rollouts: Rollout) -> Float[Array, "*batch moves"]:
    """Return q_λ(s_i, a_i) = ln π_λ(a_i | s_i) + H(π_λ(· | s_i)) of every move."""

    def advantage(task: ContinuousTask, state: Array, choice: Array) -> Array:
        features = task.features(state)
        return policy.log_prob(features, choice) + policy.entropy(features)

    return at_every_move(advantage, rollouts, rollouts.choices)


def critic_values(critic: Critic, rollouts: Rollout) -> Float[Array, "*batch moves"]:
    """Return V_w of every state that a move leaves."""
    moves = rollouts, rollouts.fraction_left
    return at_every_move(lambda task, state, left: critic(task.features(state), left), *moves)


def action_baselines(critic: Critic | None, rollouts: Rollout) -> Float[Array, "*batch moves"]:
    """Return E_i = V_w(s_i) − b_i of every move; V_w is 0 without a critic."""
    if critic is None:
        return -rollouts.bonuses
    return critic_values(critic, rollouts) - rollouts.bonuses


def with_control_variates(dynamics: Dynamics, policy: Policy, rollouts: Rollout, critic: Critic) -> Rollout:
    """Return the rollouts with the z_i of a critic; no gradients pass through them."""
    one_move = 1 / rollouts.acting.shape[-1]

    def variate(task: ContinuousTask, state: Array, choice: Array, following: Array, left: Array) -> Array:
        def value(state: Array) -> Array:
            going_on = jnp.where(left > 0.5 * one_move, critic(task.features(state), left), 0.0)
            return jnp.where(task.terminal(state), task.terminal_reward(state), going_on)

        return task.discount * dynamics.transition_control_variate(value, state, policy.action(choice), following)

    left_after = rollouts.fraction_left - one_move
    variates = at_every_move(variate, rollouts, rollouts.choices, rollouts.following, left_after)
    variates = jax.lax.stop_gradient(jnp.where(rollouts.acting, variates, 0.0)).astype(rollouts.rewards.dtype)
    return eqx.tree_at(lambda rollouts: rollouts.transition_control_variates, rollouts, variates)


def score_surrogate(
    dynamics: Dynamics, policy: Policy, rollouts: Rollout, critic: Critic | None = None
) -> Float[Array, "*batch"]:
    """Return numbers with the score estimate of eq. 11 as their derivative by θ, one a rollout.

    Args:
        dynamics: T_θ, with gradients.
        policy: π.
        rollouts: one or, with leading axes, many.
        critic: V_w of the baseline; 0 by default.

    References:
        Eq. 11 of the paper, with the differences that the module's docstring lists.
    """
    baselines = action_baselines(critic, rollouts)
    beyond = q_estimates(rollouts) + rollouts.transition_control_variates - baselines
    credit = discount_powers(rollouts, rollouts.acting.shape[-1]) * jnp.where(rollouts.acting, beyond, 0.0)

    def log_prob(_: ContinuousTask, state: Array, choice: Array, following: Array) -> Array:
        return dynamics.log_prob(state, policy.action(choice), following)

    log_probs = at_every_move(log_prob, rollouts, rollouts.choices, rollouts.following)
    return jnp.sum(log_probs * jax.lax.stop_gradient(credit), axis=-1)


def pathwise_surrogate(policy: Policy, rollouts: Rollout, critic: Critic | None = None) -> Float[Array, "*batch"]:
    """Return numbers with the pathwise estimate as their derivative by θ, for rollouts that are functions of θ."""
    q = q_estimates(rollouts)
    if policy.reparameterized:
        return q[..., 0]
    baselines = action_baselines(critic, rollouts)
    credit = jax.lax.stop_gradient(discount_powers(rollouts, rollouts.acting.shape[-1]) * (q - baselines))
    scores = jnp.where(rollouts.acting, policy_log_probs(policy, rollouts) * credit, 0.0)
    return q[..., 0] + scores[..., 1:].sum(axis=-1)


def value_gradient(
    dynamics: Dynamics,
    policy: Policy,
    tasks: ContinuousTask,
    behavior: Behavior,
    key: PRNGKeyArray,
    states: Shaped[Array, "starts *state"],
    choices: Shaped[Array, "starts candidates *choice"],
    weight_function: WeightFunction,
    *,
    horizon: int,
    samples: int,
    critic: Critic | None = None,
    estimator: Estimator = "score",
) -> tuple[FloatTree, Rollout]:
    """Estimate Σ_starts Σ_candidates weight · ∇_θ Q^π(s, c) by rollouts (eq. 11).

    With two samples or more, each half of them is weighted by the Q estimates of the other half: the noise of weights
    and gradients is then independent.

    Args:
        dynamics: T_θ.
        policy: π.
        tasks: the task of each start.
        behavior: the agent's backup and β.
        key: draws everything random.
        states: the starts.
        choices: the candidates of each start.
        weight_function: the weights, as a function of the means of Q̂_0 over samples.
        horizon: τ, the number of moves, 1 or more.
        samples: rollouts of each candidate, 1 or more.
        critic: V_w of baseline and control variates; none by default.
        estimator: "score" or "pathwise"; both are unbiased where they apply.

    Returns:
        The gradient, shaped as the parameters, and the rollouts, with axes (starts, candidates, samples).

    Raises:
        InputError: a horizon or samples below 1, or an estimator that does not apply (`check_estimator`).

    References:
        Eq. 11 of the paper.
    """
    check_estimator(estimator, dynamics, tasks)

    def total(parameters: FloatTree) -> tuple[Array, Rollout]:
        moved = dynamics.with_parameters(parameters)
        sampled = moved if estimator == "pathwise" else dynamics
        rollouts = sample_rollouts(sampled, policy, tasks, behavior, key, states, horizon, choices, samples)
        if critic is not None:
            rollouts = with_control_variates(dynamics, policy, rollouts, critic)
        if estimator == "pathwise":
            surrogates = pathwise_surrogate(policy, rollouts, critic)
        else:
            surrogates = score_surrogate(moved, policy, rollouts, critic)
        rollouts = jax.lax.stop_gradient(rollouts)
        weights = jax.lax.stop_gradient(_cross_weights(q_estimates(rollouts)[..., 0], weight_function))
        return jnp.sum(weights * surrogates) / samples, rollouts

    return jax.grad(total, has_aux=True)(dynamics.parameters)


def check_estimator(estimator: Estimator, dynamics: Dynamics, tasks: ContinuousTask) -> None:
    """Refuse an estimator that does not exist, or is biased for these dynamics or tasks."""
    check(estimator in ("score", "pathwise"), f"expected 'score' or 'pathwise', found {estimator!r}", field="estimator")
    if estimator == "pathwise" and not (dynamics.reparameterized and tasks.smooth):
        what = "these dynamics jump" if not dynamics.reparameterized else "the returns of these tasks jump"
        raise InputError(f"{what}, and gradients along the path do not see that: expected 'score'", field="estimator")


def _cross_weights(q: PerSample, weight_function: WeightFunction) -> PerSample:
    """Return the weight of every rollout, by the Q estimates of the other half of the samples."""
    samples = q.shape[-1]
    if samples < 2:
        return jnp.broadcast_to(weight_function(q.mean(axis=-1))[..., None], q.shape)
    half = samples // 2
    first, second = (weight_function(part.mean(axis=-1))[..., None] for part in (q[..., :half], q[..., half:]))
    return jnp.where(jnp.arange(samples) < half, second, first)
