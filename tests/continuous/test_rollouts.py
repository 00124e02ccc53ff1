"""Rollouts: rewards, the end of tasks, and returns."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.small_worlds import ACTIONS, ENDS, PLACES, WHICH, entropies, exact_values, policy_table, table

WORLD, HORIZON, BETA, SAMPLES = table(), 6, 2.0, 300
AGENT = sc.Agent(WORLD.dynamics, WORLD.policy, ss.Behavior(ss.LogSumExp(), BETA))
PI = np.asarray(policy_table(WORLD.policy))
BONUS = entropies(PI) / BETA
ALL = jnp.append(PLACES, jnp.asarray([4, 0]))  # also where the first task has ended, and the first place once more
OWN = jnp.append(WHICH, jnp.asarray([0, 0]))
OPTIONS = jnp.asarray([0, 1, 2, 1])  # one of them twice


@eqx.filter_jit
def sample_all(key) -> sc.Rollout:
    starts = sc.Starts(sc.task_at(WORLD.tasks, OWN), ALL, jnp.broadcast_to(OPTIONS, (len(ALL), len(OPTIONS))))
    return sc.sample_rollouts(AGENT, starts, key, HORIZON, SAMPLES)


@pytest.fixture(scope="module")
def rolled() -> sc.Rollout:
    """Many rollouts, in plain arrays."""
    return jax.tree.map(np.asarray, sample_all(jax.random.key(0)))


def one_by_one(rolled: sc.Rollout) -> list[SimpleNamespace]:
    """Rollouts in plain arrays."""
    names = "states", "choices", "rewards", "bonuses", "transition_control_variates", "acting"
    parts = (np.asarray(getattr(rolled, name)) for name in names)
    rows = zip(*(part.reshape(-1, part.shape[-1]) for part in parts), strict=True)
    return [SimpleNamespace(**dict(zip(names, each, strict=True))) for each in rows]


def test_sample_rollouts_starts_and_transitions_follow_the_model(rolled):
    shape = len(ALL), len(OPTIONS), SAMPLES
    assert rolled.states.shape == rolled.rewards.shape == (*shape, HORIZON + 1)
    assert rolled.choices.shape == rolled.bonuses.shape == rolled.acting.shape == (*shape, HORIZON)
    assert (rolled.states[..., 0] == np.asarray(ALL)[:, None, None]).all()
    assert (rolled.choices[..., 0] == np.asarray(OPTIONS)[:, None]).all()
    assert (rolled.leaving == rolled.states[..., :-1]).all()
    assert (rolled.following == rolled.states[..., 1:]).all()
    led = np.asarray(WORLD.dynamics.model.graph.successors)[rolled.states[..., :-1], rolled.choices]
    assert (led == rolled.states[..., 1:, None]).any(axis=-1).all()


def test_sample_rollout_rewards_stop_after_one_terminal_reward(rolled):
    tasks = jax.tree.map(np.asarray, WORLD.tasks.task)
    ends, ends_at = set(), np.asarray(ENDS)
    few = jax.tree.map(lambda leaf: leaf[:, :, :40], rolled)
    for index, each in enumerate(one_by_one(few)):
        own = int(OWN[index // (len(OPTIONS) * 40)])
        ended = ends_at[own, each.states]
        end = int(ended.argmax()) if ended.any() else HORIZON + 1
        ends.add(end)
        leaving, acting = each.states[:-1], np.arange(HORIZON) < end
        paid = np.append(np.where(acting, tasks.reward[own, leaving, each.choices], 0), 0)
        paid[end : end + 1] = tasks.terminal_reward[own, 0]
        np.testing.assert_array_equal(each.acting, acting)
        np.testing.assert_array_equal(each.rewards, paid)
        # the mean of −ln π is the entropy
        bonus = -np.log(PI)[own, leaving, each.choices] / BETA
        np.testing.assert_allclose(each.bonuses, np.where(acting, bonus, 0), rtol=1e-12)
    # ends before the first move, with the last move, and none are among them
    assert ends == set(range(HORIZON + 2))


def test_returns_to_go_q_estimates_and_discounted_returns_are_plain_sums(rolled):
    few = jax.tree.map(lambda leaf: leaf[:2, :, :20], rolled)
    discounts = np.broadcast_to(np.array([0.8, 1.0])[:, None, None], few.bonuses.shape[:-1])
    variates = np.random.default_rng(0).normal(size=few.bonuses.shape)
    few = eqx.tree_at(lambda few: (few.transition_control_variates, few.task.discount), few, (variates, discounts))
    sums = [np.asarray(function(few)) for function in (sc.returns_to_go, sc.discounted_returns, sc.q_estimates)]
    sums = [part.reshape(-1, *part.shape[3:]) for part in sums]
    plain = one_by_one(few)
    for index, each in enumerate(plain):
        discount = 0.8 if index < len(plain) / 2 else 1.0
        totals = [each.rewards[HORIZON]]
        for move in reversed(range(HORIZON)):
            gain = each.rewards[move] + each.bonuses[move] - each.transition_control_variates[move]
            totals.insert(0, gain + discount * totals[0])
        earned = sum(discount**move * reward for move, reward in enumerate(each.rewards))
        expected = totals, earned, np.array(totals[:-1]) - each.bonuses
        for part, number in zip(sums, expected, strict=True):
            np.testing.assert_allclose(part[index], number, rtol=1e-12, atol=1e-12)


def test_q_estimates_average_to_exact_action_values(rolled):
    _, q = exact_values(WORLD, WORLD.dynamics.parameters, PI, HORIZON, BONUS)
    estimates = np.asarray(sc.q_estimates(rolled))[: len(PLACES), :ACTIONS, :, 0]
    error = estimates.std(axis=-1) / np.sqrt(SAMPLES)
    assert error.max() < 0.2
    np.testing.assert_array_less(np.abs(estimates.mean(axis=-1) - np.asarray(q)[WHICH, PLACES]), 3 * error)


def test_sample_rollout_without_choice_draws_it_from_the_policy():
    task, state = sc.task_at(WORLD.tasks, 0), jnp.asarray(1)

    def total(key):
        each = sc.sample_rollout(AGENT, task, key, state, HORIZON)
        return sc.returns_to_go(each)[0], each.choices[0]

    drawn = jax.jit(jax.vmap(total))(jax.random.split(jax.random.key(1), 2000))
    totals, choices = map(np.asarray, drawn)
    values, _ = exact_values(WORLD, WORLD.dynamics.parameters, PI, HORIZON, BONUS)
    assert abs(totals.mean() - values[0, 1]) < 3 * totals.std() / np.sqrt(2000) < 0.2
    frequencies = np.bincount(choices, minlength=ACTIONS) / 2000
    np.testing.assert_array_less(np.abs(frequencies - PI[0, 1]), 3 * np.sqrt(PI[0, 1] * (1 - PI[0, 1]) / 2000))


def test_sample_rollouts_same_key_same_rollouts(rolled):
    for part, again in zip(*map(jax.tree.leaves, (rolled, sample_all(jax.random.key(0)))), strict=True):
        np.testing.assert_array_equal(part, again)
    assert (rolled.states != sample_all(jax.random.key(1)).states).any()


def test_sample_rollouts_candidates_share_random_numbers_and_samples_do_not(rolled):
    for part in jax.tree.leaves(rolled):
        np.testing.assert_array_equal(part[:, 1], part[:, 3])
    first = rolled.states[0, 1]
    assert (first != rolled.states[-1, 1]).any()  # from the same place
    assert (first[:1] != first[1:]).any(axis=-1).mean() > 0.5
