"""The weights of ∇Q beside the likelihood's own derivative, and control variates beside dense sums."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import sidestep as ss
import sidestep.continuous as sc
from helpers import small_worlds
from helpers.small_worlds import ACTIONS, PLACES, SPREAD, STATES, TASKS, WHICH
from sidestep.continuous.estimators import with_control_variates
from sidestep.continuous.likelihood import ActionLikelihood
from sidestep.continuous.policies import ScaledNetwork

BETA = 2.5
TABLE, LINEAR = small_worlds.table(), small_worlds.linear()
SOFT = ss.Behavior(ss.LogSumExp(), BETA)


def finite_likelihood() -> ActionLikelihood:
    """Of one observed action of every task and state of the table."""
    choices = jnp.broadcast_to(jnp.arange(ACTIONS), (len(PLACES), ACTIONS))
    agent = sc.Agent(TABLE.dynamics, TABLE.policy, SOFT)
    starts = sc.Starts(sc.task_at(TABLE.tasks, WHICH), PLACES, choices)
    return ActionLikelihood(agent, starts, jnp.arange(len(PLACES)) % ACTIONS)


def drawn_likelihood() -> ActionLikelihood:
    """Of one observed vector in each of two states, beside three that the policy draws."""
    drawn = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 1)))
    agent = sc.Agent(LINEAR.dynamics, LINEAR.policy, SOFT)
    starts = sc.Starts(LINEAR.tasks, jnp.asarray([[1.0, 0.5], [-0.5, -1.0]]), drawn)
    return ActionLikelihood(agent, starts, jnp.asarray([[0.3], [-0.2]]))


def test_log_probs_over_finite_actions_are_those_of_a_softmax():
    likelihood, q = finite_likelihood(), np.random.default_rng(1).normal(size=(len(PLACES), ACTIONS))
    odds = np.exp(BETA * q)
    expected = np.log(odds / odds.sum(axis=1, keepdims=True))[np.arange(len(q)), np.asarray(likelihood.observed)]
    np.testing.assert_allclose(likelihood.log_probs(jnp.asarray(q)), expected, rtol=1e-12)


def test_log_probs_over_vectors_are_those_of_importance_sampling():
    """The density is exp βQ over its integral, the mean of exp βQ/π_λ of the choices that the policy drew."""
    likelihood, q = drawn_likelihood(), np.random.default_rng(1).normal(size=(2, 4))
    policy: Any = LINEAR.policy
    means = np.asarray(jax.vmap(policy.network)(likelihood.drawn.states - LINEAR.tasks.goal))
    drawn = np.asarray(likelihood.drawn.choices)[..., 0]
    integral = np.mean(np.exp(BETA * q[:, 1:]) / norm.pdf(drawn, means, SPREAD), axis=1)
    np.testing.assert_allclose(likelihood.log_probs(jnp.asarray(q)), BETA * q[:, 0] - np.log(integral), rtol=1e-10)


@pytest.mark.parametrize("likelihood", [finite_likelihood(), drawn_likelihood()], ids=["finite", "vectors"])
def test_weights_are_the_gradient_of_log_probs_by_q(likelihood):
    count = ACTIONS if likelihood.observed.ndim == 1 else 1 + likelihood.drawn.choices.shape[1]
    q = jnp.asarray(np.random.default_rng(2).normal(size=(len(likelihood.observed), count)))
    slope = jax.grad(lambda q: likelihood.log_probs(q).sum())(q)
    np.testing.assert_allclose(likelihood.weights(q), slope, rtol=1e-10, atol=1e-12)


def some_critic(values) -> sc.Critic:
    """A critic with a value of each task and state of the table."""
    layer = eqx.nn.Linear(TASKS * STATES + 1, 1, use_bias=False, key=jax.random.key(0))
    layer = eqx.tree_at(lambda layer: layer.weight, layer, jnp.append(values, 0)[None])
    size = TASKS * STATES + 1
    return sc.Critic(ScaledNetwork(layer, jnp.zeros(size), jnp.ones(size)), jnp.zeros(()), jnp.ones(()))


def test_with_control_variates_in_the_table_equal_dense_sums():
    """After the last move the critic has no say: nothing follows but the reward of a terminal state."""
    values, horizon = np.random.default_rng(3).normal(size=(TASKS, STATES)), 2
    agent = sc.Agent(TABLE.dynamics, TABLE.policy, SOFT)
    actions = jnp.broadcast_to(jnp.arange(ACTIONS), (len(PLACES), ACTIONS))
    starts = sc.Starts(sc.task_at(TABLE.tasks, WHICH), PLACES, actions)

    @eqx.filter_jit
    def draw(critic):
        rolled = sc.sample_rollouts(agent, starts, jax.random.key(0), horizon=horizon, samples=2)
        return with_control_variates(agent, rolled, critic)

    rolled = draw(some_critic(values))
    variates = np.asarray(rolled.transition_control_variates)

    transitions = np.zeros((STATES, ACTIONS, STATES))
    successors, chances = np.asarray(TABLE.dynamics.model.graph.successors), TABLE.dynamics.model.probabilities()
    for (s, a, k), chance in np.ndenumerate(chances):
        transitions[s, a, successors[s, a, k]] += chance
    tasks = jax.tree.map(np.asarray, TABLE.tasks.task)
    states, choices, acting = (np.asarray(part) for part in (rolled.states, rolled.choices, rolled.acting))
    seen = set()
    for index in np.ndindex(*acting.shape):
        own, move = int(WHICH[index[0]]), index[-1]
        later = np.zeros(STATES) if move == horizon - 1 else values[own]
        worth = np.where(tasks.terminal[own], tasks.terminal_reward[own], later)
        here, after = states[index], states[(*index[:-1], move + 1)]
        noise = float(tasks.discount[own]) * (worth[after] - transitions[here, choices[index]] @ worth)
        assert variates[index] == pytest.approx(noise if acting[index] else 0, abs=1e-12)
        seen.add((move == horizon - 1, bool(acting[index])))
    assert (True, True) in seen
