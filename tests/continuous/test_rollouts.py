"""Roll-outs: what is paid where and when, how tasks end, and what was to come."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_worlds import ACTIONS, ENDS, PLACES, WHICH, entropies, exact_values, policy_table, table
from sidestep.continuous.rollouts import RollOut, returns, roll_out, roll_outs, said, to_come
from sidestep.continuous.tasks import task_at
from sidestep.tabular.backups import Behavior, LogSumExp

pytestmark = pytest.mark.usefixtures("unoptimised")

WORLD, HORIZON, BETA, SAMPLES = table(), 6, 2.0, 300
PEOPLE = Behavior(LogSumExp(), BETA)
PI = np.asarray(policy_table(WORLD.policy))
BONUS = entropies(PI) / BETA
ALL = jnp.append(PLACES, jnp.asarray([4, 0]))  # also where the first task has ended, and the first place once more
OWN = jnp.append(WHICH, jnp.asarray([0, 0]))
OPTIONS = jnp.asarray([0, 1, 2, 1])  # one of them twice


@eqx.filter_jit
def rolled_out(key) -> RollOut:
    choices = jnp.broadcast_to(OPTIONS, (len(ALL), len(OPTIONS)))
    tasks = task_at(WORLD.tasks, OWN)
    return roll_outs(WORLD.dynamics, WORLD.policy, tasks, PEOPLE, key, ALL, HORIZON, choices, SAMPLES)


@pytest.fixture(scope="module")
def rolled() -> RollOut:
    """Many roll-outs, in plain arrays."""
    return jax.tree.map(np.asarray, rolled_out(jax.random.key(0)))


class Plain(NamedTuple):
    """A roll-out in plain arrays."""

    states: np.ndarray
    choices: np.ndarray
    rewards: np.ndarray
    bonuses: np.ndarray
    surprises: np.ndarray
    acting: np.ndarray


def one_by_one(rolled: RollOut) -> list[Plain]:
    parts = (np.asarray(getattr(rolled, name)) for name in Plain._fields)
    return [Plain(*each) for each in zip(*(part.reshape(-1, part.shape[-1]) for part in parts), strict=True)]


def test_roll_outs_begin_as_they_were_told_and_go_where_the_world_leads(rolled):
    shape = len(ALL), len(OPTIONS), SAMPLES
    assert rolled.states.shape == rolled.rewards.shape == (*shape, HORIZON + 1)
    assert rolled.choices.shape == rolled.bonuses.shape == rolled.acting.shape == (*shape, HORIZON)
    assert (rolled.states[..., 0] == np.asarray(ALL)[:, None, None]).all()
    assert (rolled.choices[..., 0] == np.asarray(OPTIONS)[:, None]).all()
    assert (rolled.leaving == rolled.states[..., :-1]).all()
    assert (rolled.following == rolled.states[..., 1:]).all()
    led = np.asarray(WORLD.dynamics.model.graph.successors)[rolled.states[..., :-1], rolled.choices]
    assert (led == rolled.states[..., 1:, None]).any(axis=-1).all()


def test_every_action_pays_until_the_end_pays_once(rolled):
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
        # the log-sum-exp counts every choice's own surprise, whose mean is the entropy
        surprise = -np.log(PI)[own, leaving, each.choices] / BETA
        np.testing.assert_allclose(each.bonuses, np.where(acting, surprise, 0), rtol=1e-12)
    # at once, with the last move, and not at all are among them
    assert ends == set(range(HORIZON + 2))


def test_what_is_to_come_is_a_plain_sum(rolled):
    few = jax.tree.map(lambda leaf: leaf[:2, :, :20], rolled)
    discounts = jnp.asarray([0.8, 1.0])[:, None, None]
    few = eqx.tree_at(lambda few: few.surprises, few, np.random.default_rng(0).normal(size=few.bonuses.shape))
    found = [np.asarray(worth(few, discounts)) for worth in (to_come, returns, said)]
    found = [part.reshape(-1, *part.shape[3:]) for part in found]
    plain = one_by_one(few)
    for index, each in enumerate(plain):
        discount = 0.8 if index < len(plain) / 2 else 1.0
        worths = [each.rewards[HORIZON]]
        for move in reversed(range(HORIZON)):
            gain = each.rewards[move] + each.bonuses[move] - each.surprises[move]
            worths.insert(0, gain + discount * worths[0])
        earned = sum(discount**move * reward for move, reward in enumerate(each.rewards))
        expected = worths, earned, np.array(worths[:-1]) - each.bonuses
        for part, number in zip(found, expected, strict=True):
            np.testing.assert_allclose(part[index], number, rtol=1e-12, atol=1e-12)


def test_roll_outs_are_worth_on_average_what_actions_are(rolled):
    _, q = exact_values(WORLD, WORLD.dynamics.parameters, PI, HORIZON, BONUS)
    discounts = WORLD.tasks.discount[OWN][:, None, None]
    found = np.asarray(said(rolled, discounts))[: len(PLACES), :ACTIONS, :, 0]
    error = found.std(axis=-1) / np.sqrt(SAMPLES)
    assert error.max() < 0.2
    np.testing.assert_array_less(np.abs(found.mean(axis=-1) - np.asarray(q)[WHICH, PLACES]), 3 * error)


def test_first_choices_are_the_policy_s_unless_they_are_given():
    task, state = task_at(WORLD.tasks, 0), jnp.asarray(1)

    def worth(key):
        each = roll_out(WORLD.dynamics, WORLD.policy, task, PEOPLE, key, state, HORIZON)
        return to_come(each, task.discount)[0], each.choices[0]

    drawn = jax.jit(jax.vmap(worth))(jax.random.split(jax.random.key(1), 2000))
    worths, choices = map(np.asarray, drawn)
    values, _ = exact_values(WORLD, WORLD.dynamics.parameters, PI, HORIZON, BONUS)
    assert abs(worths.mean() - values[0, 1]) < 3 * worths.std() / np.sqrt(2000) < 0.2
    shares = np.bincount(choices, minlength=ACTIONS) / 2000
    np.testing.assert_array_less(np.abs(shares - PI[0, 1]), 3 * np.sqrt(PI[0, 1] * (1 - PI[0, 1]) / 2000))


def test_the_same_key_gives_the_same_roll_outs(rolled):
    for part, again in zip(*map(jax.tree.leaves, (rolled, rolled_out(jax.random.key(0)))), strict=True):
        np.testing.assert_array_equal(part, again)
    assert (rolled.states != rolled_out(jax.random.key(1)).states).any()


def test_options_share_random_numbers_but_places_and_samples_do_not(rolled):
    for part in jax.tree.leaves(rolled):
        np.testing.assert_array_equal(part[:, 1], part[:, 3])
    first = rolled.states[0, 1]
    assert (first != rolled.states[-1, 1]).any()  # from the same place
    assert (first[:1] != first[1:]).any(axis=-1).mean() > 0.5
