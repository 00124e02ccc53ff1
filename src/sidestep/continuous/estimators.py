"""Estimates of ∇_θ Q^π by rollouts (eq. 11 of the paper), for a policy that is held fixed.

With the Q estimate Q̂_i = R_i − z_i + γ W_{i+1} (see `rollouts`), the **score** estimate is the likelihood-ratio
estimator (Williams 1992),

    ∇_θ Q^π(s_0, a_0) = E [ Σ_i ∇_θ ln T_θ(s_i, a_i, s_{i+1}) γ^i (Q̂_i + z_i − E_i) ].

It differs from eq. 11 as printed in four points.

1. Terms of mean 0 are left out: rewards that were paid before a transition do not depend on it.
2. The *baseline* E_i is subtracted. It may be any function of s_i and a_i, because ∇_θ ln T_θ has mean 0 given these;
   here it is the critic's estimate of Q^π, V_w(s_i) − b_i.
3. z_i is added back, because the credit of a transition is the effect of its own draw.
4. The part of this effect that the critic knows has its mean in place of its draw: with the credit that the critic
   expects of s_{i+1}, u = R_i + γ V_w(s_{i+1}) − E_i, the number ∇ ln T_θ u − ∇E[u], which has mean 0, is subtracted
   (`score_control_variate`). With an exact critic hardly any noise of this draw is left. Gu et al. (2017) have the same
   control variate for draws of actions.

The **pathwise** estimate (Kingma and Welling 2014) is the derivative of Q̂_0 along the path, with the random numbers
held fixed. It requires reparameterized dynamics and smooth rewards; its variance is then far lower on stable systems.
Draws from a finite set of actions are not smooth; they add a score,
Σ_{i≥1} ∇_θ ln π(a_i | s_i(θ)) γ^i (Q̂_i − V_w(s_i) + b_i).

Both are implemented as *surrogates*: numbers with the estimate as their derivative by θ.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._typing import FloatTree
from sidestep.continuous.control_variates import ValueFunction
from sidestep.continuous.dynamics import Dynamics, PerCandidate, PerSample
from sidestep.continuous.policies import Agent, Critic, Starts
from sidestep.continuous.rollouts import Rollout, q_estimates, sample_rollouts
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import InputError, check_choice, check_function, check_instance

Estimator = Literal["score", "pathwise"]

WeightFunction = Callable[[PerCandidate], PerCandidate]
"""The weights of ∇Q of all candidates, as a function of the estimates of Q."""


def with_control_variates(agent: Agent[Any], rollouts: Rollout, critic: Critic) -> Rollout:
    """Return the rollouts with the z_i of a critic; no gradients pass through them.

    Args:
        agent: The agent of the rollouts.
        rollouts: One or, with leading axes, many.
        critic: V_w.

    Returns:
        The same rollouts with other `transition_control_variates`.
    """

    def variate(task: ContinuousTask, state: Array, choice: Array, following: Array, seed: Array, left: Array) -> Array:
        action, value = agent.policy.action(choice), _value_after(task, critic, left, one_move)
        return task.discount * agent.dynamics.transition_control_variate(
            value, state, action, following, jax.random.key(seed)
        )

    one_move, moves = 1 / rollouts.acting.shape[-1], (rollouts.choices, rollouts.following, rollouts.seeds)
    variates = rollouts.at_every_move(variate, *moves, rollouts.fraction_left)
    variates = jax.lax.stop_gradient(jnp.where(rollouts.acting, variates, 0.0)).astype(rollouts.rewards.dtype)
    return eqx.tree_at(lambda rollouts: rollouts.transition_control_variates, rollouts, variates)


def _value_after(task: ContinuousTask, critic: Critic, left: Array, one_move: float) -> ValueFunction:
    """Return the value of a next state by a critic, when the fraction `left` of the horizon is left before the move."""

    after = left - one_move

    def going_on(state: Array) -> Array:
        return jnp.where(after > 0.5 * one_move, critic(task.features(state), after), 0.0)

    def at_end(state: Array) -> Array:
        return jnp.asarray(task.terminal_reward(state), jnp.result_type(left))  # whole numbers have no gradient

    return ValueFunction(going_on, task.terminal if task.can_end else None, at_end)


def score_surrogate(agent: Agent[Any], rollouts: Rollout, critic: Critic | None = None) -> Float[Array, "*batch"]:
    """Return numbers with the score estimate of eq. 11 as their derivative by θ, one a rollout.

    Args:
        agent: The agent of the rollouts; gradients pass through its dynamics T_θ.
        rollouts: One or, with leading axes, many.
        critic: V_w of the baseline; 0 by default.

    Returns:
        A number for each rollout, in units of reward; only its derivative has a meaning.

    Example:
        >>> import sidestep as ss, sidestep.continuous as sc
        >>> task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.9))
        >>> dynamics = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
        >>> policy = sc.gaussian_policy(jax.random.key(0), 1, jnp.ones((1, 1)))
        >>> agent = sc.Agent(dynamics, policy, ss.Behavior(ss.HardMax()))
        >>> def surrogate(key):
        ...     return score_surrogate(agent, sc.sample_rollout(agent, task, key, jnp.zeros(1), horizon=2))
        >>> jax.eval_shape(surrogate, jax.random.key(1)).shape
        ()

    References:
        Eq. 11 of the paper, with the differences that the module's docstring lists.
    """
    check_instance(agent, Agent, "agent")
    check_instance(rollouts, Rollout, "rollouts")
    check_instance(critic, (Critic, type(None)), "critic")
    term, arrays = _score_terms(agent, rollouts, critic)
    terms = rollouts.at_every_move(lambda *move: term(agent.dynamics, *move), *arrays)
    return jnp.sum(terms, axis=-1)


def _score_terms(agent: Agent[Any], rollouts: Rollout, critic: Critic | None) -> tuple[Callable, tuple[Array, ...]]:
    """Return a function of the dynamics and of what a move has, and the arrays of what moves have.

    The sum of the function over the moves of a rollout has the score estimate as its derivative by θ.
    """
    moves = rollouts.acting.shape[-1]
    baselines, one_move = rollouts.action_baselines(critic), 1 / moves
    powers = jnp.broadcast_to(rollouts.discount_powers(moves), baselines.shape)
    credit = powers * (q_estimates(rollouts) + rollouts.transition_control_variates - baselines)
    known = rollouts.rewards[..., :-1] - baselines

    def term(
        dynamics: Dynamics,
        task: ContinuousTask,
        state: Array,
        choice: Array,
        following: Array,
        seed: Array,
        left: Array,
        power: Array,
        credit: Array,
        known: Array,
    ) -> Array:
        move = state, agent.policy.action(choice), following
        total = dynamics.log_prob(*move) * credit
        if critic is None:
            return total
        value = _value_after(task, critic, left, one_move)
        effect = value.times(task.discount, plus=known)
        return total - power * dynamics.score_control_variate(effect, *move, jax.random.key(seed))

    fixed = jax.lax.stop_gradient((rollouts.fraction_left, powers, credit, known))
    return term, (rollouts.choices, rollouts.following, rollouts.seeds, *fixed)


def pathwise_surrogate(agent: Agent[Any], rollouts: Rollout, critic: Critic | None = None) -> Float[Array, "*batch"]:
    """Return numbers with the pathwise estimate as their derivative by θ, for rollouts that are functions of θ.

    Args:
        agent: The agent of the rollouts.
        rollouts: One or, with leading axes, many.
        critic: V_w of the baseline; 0 by default.

    Returns:
        A number for each rollout, in units of reward.
    """
    q = q_estimates(rollouts)
    if agent.policy.reparameterized:
        return q[..., 0]
    credit = jax.lax.stop_gradient(rollouts.discount_powers(q.shape[-1]) * (q - rollouts.action_baselines(critic)))
    scores = jnp.where(rollouts.acting, rollouts.policy_log_probs(agent.policy) * credit, 0.0)
    return q[..., 0] + scores[..., 1:].sum(axis=-1)


def value_gradient(
    agent: Agent[Any],
    starts: Starts,
    key: PRNGKeyArray,
    weight_function: WeightFunction,
    *,
    horizon: int,
    samples: int,
    critic: Critic | None = None,
    estimator: Estimator = "score",
) -> tuple[FloatTree, Rollout]:
    """Estimate Σ_starts Σ_candidates weight · ∇_θ Q^π(s, c) by rollouts (eq. 11).

    With two samples or more, each half of them is weighted by the Q estimates of the other half: the noise of weights
    and gradients is then independent. With four or more, the weights have the jackknife's correction of the bias that
    noise in Q̂ brings into them (`jackknife`).

    Args:
        agent: T_θ, π and the backup.
        starts: The tasks, the states, and the candidates of each.
        key: Draws everything random.
        weight_function: The weights, as a function of the means of Q̂_0 over samples.
        horizon: τ, the number of moves, 1 or more.
        samples: Rollouts of each candidate, 1 or more.
        critic: V_w of baseline and control variates; none by default.
        estimator: "score" or "pathwise"; both are unbiased where they apply.

    Returns:
        The gradient, shaped as the parameters, and the rollouts, with axes (starts, candidates, samples).

    Raises:
        InputError: For a horizon or samples below 1, or an estimator that does not apply (`check_estimator`).

    Example:
        >>> import sidestep as ss, sidestep.continuous as sc
        >>> task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.9))
        >>> dynamics = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.1))
        >>> policy = sc.gaussian_policy(jax.random.key(0), 1, jnp.ones((1, 1)))
        >>> starts = sc.Starts(sc.batch_tasks([task]), jnp.zeros((1, 1)), jnp.ones((1, 2, 1)))
        >>> agent = sc.Agent(dynamics, policy, ss.Behavior(ss.HardMax()))
        >>> def gradient(key):
        ...     return value_gradient(agent, starts, key, jnp.ones_like, horizon=2, samples=2)[0]
        >>> {name: part.shape for name, part in jax.eval_shape(gradient, jax.random.key(1)).items()}
        {'action': (1, 1), 'state': (1, 1)}

    References:
        Eq. 11 of the paper.
    """
    check_instance(agent, Agent, "agent")
    check_instance(starts, Starts, "starts")
    check_function(weight_function, "weight_function")
    check_instance(critic, (Critic, type(None)), "critic")
    check_estimator(estimator, agent.dynamics, starts.tasks)

    def total(parameters: FloatTree) -> tuple[Array, Rollout]:
        size = {"horizon": horizon, "samples": samples}
        surrogates, rollouts = sample_surrogates(agent, parameters, starts, key, critic, estimator, **size)
        weights = jax.lax.stop_gradient(_cross_weights(q_estimates(rollouts)[..., 0], weight_function))
        return jnp.sum(weights * surrogates) / samples, rollouts

    return jax.grad(total, has_aux=True)(agent.dynamics.parameters)


def sample_surrogates(
    agent: Agent[Any],
    parameters: FloatTree,
    starts: Starts,
    key: PRNGKeyArray,
    critic: Critic | None,
    estimator: Estimator,
    *,
    horizon: int,
    samples: int,
) -> tuple[PerSample, Rollout]:
    """Sample rollouts, and return numbers with the estimates of ∇_θ Q^π as their derivatives by θ.

    Args:
        agent: T_θ, π and the backup.
        parameters: θ, equal to that of the agent; derivatives by it are the estimates.
        starts: The tasks, the states, and the candidates of each.
        key: Draws everything random.
        critic: V_w of baseline and control variates; None for none.
        estimator: "score" or "pathwise".
        horizon: τ, the number of moves, 1 or more.
        samples: Rollouts of each candidate, 1 or more.

    Returns:
        A number for each rollout, and the rollouts, with axes (starts, candidates, samples); no derivatives pass
        through the rollouts.
    """
    pathwise = estimator == "pathwise"
    moved = replace(agent, dynamics=agent.dynamics.with_parameters(parameters))
    rollouts = sample_rollouts(moved if pathwise else agent, starts, key, horizon, samples)
    if critic is not None:
        rollouts = with_control_variates(agent, rollouts, critic)
    surrogates = (pathwise_surrogate if pathwise else score_surrogate)(moved, rollouts, critic)
    return surrogates, jax.lax.stop_gradient(rollouts)


def half_gradients(
    agent: Agent[Any],
    starts: Starts,
    key: PRNGKeyArray,
    critic: Critic,
    estimator: Estimator,
    *,
    horizon: int,
    half: int,
) -> tuple[Float[Array, "2 starts candidates parameters"], Rollout]:
    """Return the estimates of ∇_θ Q^π of every candidate by each of two halves of the rollouts.

    Args:
        agent: T_θ, π and the backup.
        starts: The tasks, the states, and the candidates of each.
        key: Draws everything random.
        critic: V_w of baseline and control variates.
        estimator: "score" or "pathwise".
        horizon: τ, the number of moves, 1 or more.
        half: Rollouts of each candidate in each half, 1 or more.

    Returns:
        The gradients with the entries of `ravel_pytree` of the parameters, and all rollouts.
    """
    flat, to_parameters = ravel_pytree(agent.dynamics.parameters)
    size, shape = {"horizon": horizon, "samples": 2 * half}, starts.choices.shape[:2]
    if estimator == "pathwise":

        def of_candidate(task: ContinuousTask, state: Array, choice: Array, key: PRNGKeyArray) -> tuple[Array, Rollout]:
            start = Starts(jax.tree.map(lambda leaf: leaf[None], task), state[None], choice[None, None])

            def means(flat: Array) -> tuple[Array, Rollout]:
                sampled = sample_surrogates(agent, to_parameters(flat), start, key, critic, estimator, **size)
                return sampled[0].reshape(2, half).mean(axis=1), jax.tree.map(lambda leaf: leaf[0, 0], sampled[1])

            return jax.jacrev(means, has_aux=True)(flat)

        # the candidates of one start share their random numbers
        of_start = jax.vmap(of_candidate, (None, None, 0, None))
        keys = jax.random.split(key, len(starts.states))
        slopes, rollouts = jax.vmap(of_start)(starts.tasks, starts.states, starts.choices, keys)
        return jnp.moveaxis(slopes, 2, 0), rollouts
    rollouts = with_control_variates(agent, sample_rollouts(agent, starts, key, **size), critic)
    term, arrays = _score_terms(agent, rollouts, critic)

    def of_move(flat: Array, *move: Any) -> Array:
        return term(agent.dynamics.with_parameters(to_parameters(flat)), *move)

    each = jnp.arange(2 * shape[0] * shape[1]).reshape(*shape, 2, 1)
    groups = jnp.broadcast_to(jnp.repeat(each, half, axis=2), rollouts.acting.shape)
    sums = rollouts.gradient_sums(of_move, flat, groups, each.size, *arrays)
    return jnp.moveaxis(sums.reshape(*shape, 2, -1), 2, 0) / half, rollouts


def check_estimator(estimator: Estimator, dynamics: Dynamics, tasks: ContinuousTask) -> None:
    """Refuse an estimator that does not exist, or is biased for these dynamics or tasks.

    Args:
        estimator: Its name.
        dynamics: The dynamics T_θ.
        tasks: The tasks as a batch.

    Raises:
        InputError: For another name, or an estimator that is biased here.
    """
    check_choice(estimator, ("score", "pathwise"), "estimator")
    if estimator == "pathwise" and not (dynamics.reparameterized and tasks.smooth):
        what = "these dynamics jump" if not dynamics.reparameterized else "the returns of these tasks jump"
        message = f"{what}, and gradients along the path do not see that: expected 'score', found {estimator!r}"
        raise InputError(message, field="estimator")


def _cross_weights(q: PerSample, weight_function: WeightFunction) -> PerSample:
    """Return the weight of every rollout, by the Q estimates of the other half of the samples."""
    samples = q.shape[-1]
    if samples < 2:
        return jackknife(weight_function, q)[..., None]
    half = samples // 2
    first, second = (jackknife(weight_function, part)[..., None] for part in (q[..., :half], q[..., half:]))
    return jnp.where(jnp.arange(samples) < half, second, first)


def jackknife(function: WeightFunction, q: PerSample) -> PerCandidate:
    """Return a function of the mean of Q over samples, less the first order of its bias by the noise of that mean.

    With f of the mean of all n samples and f₋ᵢ of the mean without the i-th, it is n f − (n − 1) Σ f₋ᵢ / n. The bias
    that is left falls as 1/n² instead of 1/n. One sample leaves f as it is.

    Args:
        function: Of the mean of Q̂_0.
        q: Q̂_0 of every sample, in units of reward.

    Returns:
        The function's value, with its bias reduced.

    References:
        Quenouille, "Notes on bias in estimation" (1956).
    """
    samples, mean = q.shape[-1], q.mean(axis=-1)
    if samples < 2:
        return function(mean)
    without = (samples * mean[..., None] - q) / (samples - 1)
    parts = jax.vmap(function)(jnp.moveaxis(without, -1, 0))
    return samples * function(mean) - (samples - 1) * parts.mean(axis=0)
