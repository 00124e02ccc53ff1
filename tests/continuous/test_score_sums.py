"""Scores by rollouts (eqs. 11 and 12) beside plain sums over the moves of the same rollouts, in a table."""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers import small_worlds
from helpers.small_worlds import ACTIONS, STATES, TASKS
from sidestep.continuous.estimators import half_gradients, score_surrogate
from sidestep.continuous.policies import ScaledNetwork
from sidestep.continuous.policy_steps import fit_critic, minibatches, policy_gradient
from sidestep.continuous.rollouts import Rollout

WORLD, BETA, HORIZON, HALF = small_worlds.table(), 2.0, 3, 2
AGENT = sc.Agent(WORLD.dynamics, WORLD.policy, ss.Behavior(ss.LogSumExp(), BETA))
WHICH, PLACES = jnp.asarray([0, 1]), jnp.asarray([1, 3])
STARTS = sc.Starts(sc.task_at(WORLD.tasks, WHICH), PLACES, jnp.broadcast_to(jnp.arange(ACTIONS), (2, ACTIONS)))
VALUES, CENTER, SPREAD, LEFT = np.random.default_rng(0).normal(size=(TASKS, STATES)), 0.5, 2.0, 0.4
PI = np.asarray(small_worlds.policy_table(WORLD.policy))
CHANCES = np.asarray(WORLD.dynamics.model.probabilities())
SUCCESSORS = np.asarray(WORLD.dynamics.model.graph.successors)
TASK = jax.tree.map(np.asarray, WORLD.tasks.task)


def critic() -> sc.Critic:
    """CENTER + SPREAD (VALUES[task, state] + LEFT · fraction left)."""
    count = TASKS * STATES + 1
    layer = eqx.nn.Linear(count, 1, use_bias=False, key=jax.random.key(0))
    layer = eqx.tree_at(lambda layer: layer.weight, layer, jnp.append(jnp.asarray(VALUES), LEFT)[None])
    return sc.Critic(ScaledNetwork(layer, jnp.zeros(count), jnp.ones(count)), jnp.asarray(CENTER), jnp.asarray(SPREAD))


def weight_of(module: Any) -> jax.Array:
    """The weight of the only layer of a policy or critic."""
    return module.network.network.weight


def value(task, state, left):
    return CENTER + SPREAD * (VALUES[task, state] + LEFT * left)


@cache
def halves() -> tuple[np.ndarray, Rollout]:
    """The scores of both halves, and the rollouts in plain arrays, with control variates."""

    @eqx.filter_jit
    def draw(key):
        return half_gradients(AGENT, STARTS, key, critic(), "score", horizon=HORIZON, half=HALF)

    return jax.tree.map(np.asarray, draw(jax.random.key(1)))


@cache
def q_estimates():
    return np.asarray(sc.q_estimates(halves()[1]))


def score_of_move(index, move, with_critic):
    """γ^i (∇ ln T (Q̂ + z − E) − ∇ ln T u + ∇ E[u]), with u = R + γ V(s′) − E."""
    rolled, own = halves()[1], int(WHICH[index[0]])
    at = (*index, move)
    discount = TASK.discount[own]
    state, choice, after = rolled.states[at], rolled.choices[at], rolled.states[(*index, move + 1)]
    left = 1 - move / HORIZON
    baseline = with_critic * value(own, state, left) - rolled.bonuses[at]
    chances = CHANCES[state, choice]
    taken = SUCCESSORS[state, choice] == after
    credit = q_estimates()[at] + rolled.transition_control_variates[at] - baseline
    total = credit * (taken - chances)
    if with_critic:
        following = SUCCESSORS[state, choice]
        later = value(own, following, left - 1 / HORIZON) if move < HORIZON - 1 else np.zeros(3)
        worth = np.where(TASK.terminal[own, following], TASK.terminal_reward[own, following], later)
        known = rolled.rewards[at] + discount * worth - baseline
        total = total - known[taken][0] * (taken - chances) + chances * (known - chances @ known)
    return discount**move * total


def score_of_rollout(index, with_critic=True):
    rolled, total = halves()[1], np.zeros_like(CHANCES)
    for move in range(HORIZON):
        if rolled.acting[(*index, move)]:
            total[rolled.states[(*index, move)], rolled.choices[(*index, move)]] += score_of_move(
                index, move, with_critic
            )
    return total.ravel()


def test_half_gradients_are_the_mean_scores_of_each_half():
    slopes, rolled = halves()
    assert not rolled.acting.all()
    for start, candidate, half in np.ndindex(2, ACTIONS, 2):
        own = [score_of_rollout((start, candidate, half * HALF + sample)) for sample in range(HALF)]
        np.testing.assert_allclose(slopes[half, start, candidate], np.mean(own, axis=0), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("with_critic", [True, False], ids=["critic", "no critic"])
def test_score_surrogate_has_the_scores_as_its_derivative(with_critic):
    rolled = jax.tree.map(lambda leaf: jnp.asarray(leaf[:, :, :1]), halves()[1])
    weights = np.random.default_rng(2).normal(size=(2, ACTIONS, 1))

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(dynamics):
        agent = sc.Agent(dynamics, AGENT.policy, AGENT.behavior)
        return jnp.sum(weights * score_surrogate(agent, rolled, critic() if with_critic else None))

    expected = sum(
        weights[start, candidate, 0] * score_of_rollout((start, candidate, 0), with_critic)
        for start, candidate in np.ndindex(2, ACTIONS)
    )
    np.testing.assert_allclose(np.ravel(slope(WORLD.dynamics).parameters), expected, rtol=1e-9, atol=1e-12)


def test_value_gradient_weighs_each_half_by_the_other():
    """The weights are linear in Q̂, and the jackknife leaves these as they are."""
    key = jax.random.key(1)

    @eqx.filter_jit
    def estimate(key):
        settings = {"horizon": HORIZON, "samples": 2 * HALF, "critic": critic()}
        return sc.value_gradient(AGENT, STARTS, key, lambda q: 0.5 + 2 * q, **settings)

    found, rolled = jax.tree.map(np.asarray, estimate(key))
    np.testing.assert_array_equal(rolled.states, halves()[1].states)
    q, expected = q_estimates()[..., 0], np.zeros(CHANCES.size)
    for start, candidate, sample in np.ndindex(2, ACTIONS, 2 * HALF):
        other = q[start, candidate, HALF:] if sample < HALF else q[start, candidate, :HALF]
        expected += (0.5 + 2 * other.mean()) * score_of_rollout((start, candidate, sample)) / (2 * HALF)
    np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-9, atol=1e-12)


# Steps of policy and critic


def critic_values(rolled):
    lefts = 1 - np.arange(HORIZON) / HORIZON
    own = np.asarray(WHICH)[:, None, None, None]
    return value(own, rolled.states[..., :-1], lefts)


PROBABILITIES = PI[WHICH, PLACES]


def test_policy_gradient_is_a_sum_of_scores_of_choices():
    rolled = halves()[1]
    beyond = q_estimates() - critic_values(rolled) + rolled.bonuses
    expected = np.zeros((TASKS, STATES, ACTIONS))
    for index in np.ndindex(*rolled.acting.shape):
        if rolled.acting[index]:
            own, move, state = int(WHICH[index[0]]), index[-1], rolled.states[index]
            taken = np.arange(ACTIONS) == rolled.choices[index]
            counts = ACTIONS * PROBABILITIES[index[:2]] if move == 0 else 1.0
            credit = counts * TASK.discount[own] ** move * beyond[index]
            expected[own, state] -= credit * (taken - PI[own, state]) / (2 * ACTIONS * 2 * HALF)
    found = eqx.filter_jit(policy_gradient)(AGENT.policy, critic(), halves()[1], jnp.asarray(PROBABILITIES))
    np.testing.assert_allclose(weight_of(found).T, expected.reshape(-1, ACTIONS), rtol=1e-9, atol=1e-12)


def test_fit_critic_steps_along_the_slope_of_each_minibatch():
    rolled, rate, steps = halves()[1], 0.3, 4
    found, _ = eqx.filter_jit(fit_critic)(
        critic(), optax.sgd(rate), optax.sgd(rate).init(eqx.filter(critic(), eqx.is_inexact_array)),
        jax.tree.map(jnp.asarray, rolled), steps, 0.5,
    )  # fmt: skip
    lefts = np.broadcast_to(1 - np.arange(HORIZON) / HORIZON, rolled.acting.shape)
    places = np.asarray(WHICH)[:, None, None, None] * STATES + rolled.states[..., :-1]
    inputs = np.concatenate([np.eye(TASKS * STATES)[places], lefts[..., None]], axis=-1)
    parts = inputs, np.asarray(sc.returns_to_go(rolled))[..., :-1], rolled.acting
    batches = [np.asarray(minibatches(jnp.asarray(part[:, :, :, 1:]), steps)) for part in parts]
    weight = np.append(VALUES, LEFT)
    for x, returns, acting in zip(*batches, strict=True):
        errors = np.where(acting, CENTER + SPREAD * x @ weight - returns, 0.0)
        weight = weight - 0.5 * rate * 2 * (errors @ x) / SPREAD / max(acting.sum(), 1)
    np.testing.assert_allclose(weight_of(found)[0], weight, rtol=1e-9)
    assert (float(found.center), float(found.spread)) == (CENTER, SPREAD)


def test_update_first_step_has_the_rate_of_its_fraction():
    """The first step of Adam is as long as its rate in each direction with a slope."""
    planner = sc.Planner(horizon=HORIZON, learning_rate=0.02, critic_rate=0.04, critic_steps=1)
    moments = [optax.adam(1.0).init(eqx.filter(part, eqx.is_inexact_array)) for part in (AGENT.policy, critic())]
    state = sc.PlannerState(AGENT.policy, critic(), *moments)
    rolled, pi = jax.tree.map(jnp.asarray, halves()[1]), jnp.asarray(PROBABILITIES)
    after, figures = eqx.filter_jit(planner.update)(state, AGENT.behavior, rolled, pi, jnp.asarray(0.25))
    slope = weight_of(policy_gradient(AGENT.policy, critic(), rolled, pi))
    change = weight_of(after.policy) - weight_of(AGENT.policy)
    np.testing.assert_allclose(change, -0.25 * 0.02 * np.sign(slope) * (np.abs(slope) > 1e-9), atol=1e-6)
    of_critic = np.abs(weight_of(after.critic) - weight_of(critic()))
    assert of_critic.max() == pytest.approx(0.25 * 0.04, abs=1e-6)
    assert figures.gradient == pytest.approx(np.sqrt(np.sum(np.square(slope))))
    earned = np.sum(np.asarray(rolled.rewards) * TASK.discount[WHICH][:, None, None, None] ** np.arange(4), axis=-1)
    assert figures.expected_return == pytest.approx(np.sum(PROBABILITIES * earned.mean(axis=-1), axis=1).mean())
    assert figures.entropy == pytest.approx(-np.sum(PROBABILITIES * np.log(PROBABILITIES), axis=1).mean())
