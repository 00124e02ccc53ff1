"""Values and policies over available actions, beside plain sums over them."""

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, plain_backup, plain_policy
from sidestep.errors import InputError
from sidestep.tabular.backups import (
    Behavior,
    BoltzmannAverage,
    HardMax,
    LogSumExp,
    Mellowmax,
    backup_of,
    tied_where_lost,
)

Q = jnp.asarray(np.random.default_rng(0).normal(size=(6, 5)))
AVAILABLE = jnp.asarray(np.random.default_rng(1).random((6, 5)) < 0.6).at[:, 2].set(True)
MASKED = jnp.where(AVAILABLE, Q, -jnp.inf)
BETA = 1.7

each_backup = pytest.mark.parametrize("name", BACKUPS)


@each_backup
def test_value_of_available_actions_is_that_of_these_alone(name):
    """As where the others did not exist."""
    backup = BACKUPS[name]
    values = backup.value(MASKED, jnp.asarray(BETA), AVAILABLE)
    np.testing.assert_allclose(values, plain_backup(name, Q, BETA, AVAILABLE), rtol=1e-10)
    for state in range(6):
        own = Q[state][AVAILABLE[state]]
        assert float(values[state]) == pytest.approx(float(backup.value(own, jnp.asarray(BETA))))
        np.testing.assert_allclose(
            backup.weights(MASKED, jnp.asarray(BETA))[state][AVAILABLE[state]],
            backup.weights(own, jnp.asarray(BETA)),
            rtol=1e-10,
        )


@each_backup
def test_bonus_is_what_a_backup_adds_to_the_mean_of_the_values(name):
    policy = np.asarray(plain_policy(Q, BETA))
    entropy = -(policy * np.log(policy)).sum(axis=-1)
    mean = (policy * np.asarray(Q)).sum(axis=-1)
    if name == "hard max":
        mean = np.asarray(Q).max(axis=-1)  # of the policy that it values, there is nothing to add
    bonus = BACKUPS[name].bonus(jnp.asarray(entropy), 5, jnp.asarray(BETA))
    np.testing.assert_allclose(bonus, plain_backup(name, Q, BETA) - mean, atol=1e-12)


def test_bonus_of_vectors_of_actions_is_known_but_for_the_mellowmax():
    entropy, beta = jnp.asarray([0.5, 2.0]), jnp.asarray(BETA)
    np.testing.assert_allclose(LogSumExp().bonus(entropy, None, beta), entropy / BETA)
    np.testing.assert_allclose(BoltzmannAverage().bonus(entropy, None, beta), 0)
    with pytest.raises(InputError, match="finite number of actions"):
        Mellowmax().bonus(entropy, None, beta)


@pytest.mark.parametrize("lapse", [None, 0.0, 0.3])
def test_log_policy_of_available_actions_has_lapses_among_these(lapse):
    agents = Behavior(LogSumExp(), BETA, lapse)
    chances = (1 - (lapse or 0)) * plain_policy(Q, BETA, AVAILABLE)
    chances += (lapse or 0) * AVAILABLE / AVAILABLE.sum(axis=-1, keepdims=True)
    policy = np.exp(agents.log_policy(MASKED, AVAILABLE))
    np.testing.assert_allclose(policy, chances, rtol=1e-10)
    np.testing.assert_array_equal(policy > 0, AVAILABLE)
    everything = (1 - (lapse or 0)) * plain_policy(Q, BETA) + (lapse or 0) / 5
    np.testing.assert_allclose(np.exp(agents.log_policy(Q)), everything, rtol=1e-10)


@pytest.mark.parametrize("lapse", [None, 0.3])
def test_log_policy_where_all_is_lost_is_uniform_over_available_actions(lapse):
    lost, agents = jnp.full((1, 4), -jnp.inf), Behavior(HardMax(), 2.0, lapse)
    some = jnp.array([[True, False, True, False]])
    np.testing.assert_allclose(np.exp(agents.log_policy(lost)), np.full((1, 4), 0.25))
    np.testing.assert_allclose(np.exp(agents.log_policy(lost, some)), [[0.5, 0, 0.5, 0]])
    q = jnp.array([[-jnp.inf, -jnp.inf], [-jnp.inf, 3.0], [1.0, 2.0]])
    np.testing.assert_array_equal(tied_where_lost(q), [[0, 0], [-np.inf, 3], [1, 2]])
    one = jnp.array([[True, False]] * 3)
    np.testing.assert_array_equal(tied_where_lost(q, one), [[0, -np.inf], [-np.inf, 3], [1, 2]])


@pytest.mark.parametrize("backup", ["boltzmann", BoltzmannAverage, BoltzmannAverage()])
def test_backup_of_names_classes_and_instances_is_a_backup(backup):
    assert isinstance(backup_of(backup), BoltzmannAverage)
    assert isinstance(Behavior(backup).backup, BoltzmannAverage)


@pytest.mark.parametrize("wrong", [{"lapse": -0.1}, {"lapse": 1.0}, {"lapse": np.nan}, {"beta": 0.0}, {"beta": np.inf}])
def test_behavior_of_numbers_out_of_range_raises(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        Behavior(HardMax(), **wrong)
    assert float(Behavior(HardMax(), 1e-9, 0.0).beta) == 1e-9


@pytest.mark.parametrize("name", ["boltzman", "HardMax"])
def test_backup_of_another_name_raises(name):
    with pytest.raises(InputError, match="expected a Backup, or one of boltzmann, max"):
        backup_of(name)


@each_backup
def test_numbers_of_a_behavior_scale_with_rewards(name):
    """β Q decides: ten times the rewards at a tenth of β is the same policy, and ten times the value."""
    backup = BACKUPS[name]
    one, other = backup.value(Q, jnp.asarray(BETA)), backup.value(10 * Q, jnp.asarray(BETA / 10))
    np.testing.assert_allclose(other, 10 * one, rtol=1e-10)
    first, second = Behavior(backup, BETA, 0.1), Behavior(backup, BETA / 10, 0.1)
    np.testing.assert_allclose(second.log_policy(10 * Q), first.log_policy(Q), rtol=1e-10)
