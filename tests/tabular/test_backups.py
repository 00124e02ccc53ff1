"""Each backup by hand, its weights as its gradient, and its limits at large and small β."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.problems import BACKUPS
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax

each_backup = pytest.mark.parametrize("name", BACKUPS)

# At β = log 3 the actions' values 0 and 1 are chosen as 1 : 3.
LOG3 = float(np.log(3))
AT_LOG3 = {  # value, weights, fixed-policy weights
    "hard max": (1, [0, 1], [0, 1]),
    "Boltzmann": (3 / 4, [(1 - LOG3 * 3 / 4) / 4, (1 + LOG3 / 4) * 3 / 4], [1 / 4, 3 / 4]),
    "log-sum-exp": (np.log(4) / LOG3, [1 / 4, 3 / 4], [1 / 4, 3 / 4]),
    "mellowmax": (np.log(2) / LOG3, [1 / 4, 3 / 4], [1 / 4, 3 / 4]),
}
AT_LARGE_BETA = dict.fromkeys(BACKUPS, 2.0)  # of the values 2, 2, 0.5, −1
AT_SMALL_BETA = {"hard max": 2, "Boltzmann": 3.5 / 4, "log-sum-exp": np.inf, "mellowmax": 3.5 / 4}


@each_backup
def test_backup_of_two_values_equals_the_values_by_hand(name):
    q, beta = jnp.asarray([0.0, 1.0]), jnp.asarray(LOG3)
    value, weights, policy = AT_LOG3[name]
    assert float(BACKUPS[name].value(q, beta)) == pytest.approx(value)
    np.testing.assert_allclose(BACKUPS[name].weights(q, beta), weights, rtol=1e-12)
    np.testing.assert_allclose(BACKUPS[name].fixed_policy_weights(q, beta), policy, rtol=1e-12)


@pytest.mark.slow
@each_backup
@given(seed=st.integers(0, 2**32 - 1))
def test_weights_of_random_values_are_the_gradient_and_sum_to_one(name, seed):
    rng = np.random.default_rng(seed)
    backup, q, beta = (BACKUPS[name], jnp.asarray(rng.normal(size=(3, 5))), jnp.asarray(10 ** rng.uniform(-1, 2)))
    gradient = jax.vmap(jax.grad(lambda q: backup.value(q, beta)))(q)
    np.testing.assert_allclose(backup.weights(q, beta), gradient, atol=1e-12)
    for weights in (backup.weights(q, beta), backup.fixed_policy_weights(q, beta)):
        np.testing.assert_allclose(weights.sum(axis=-1), 1, rtol=1e-12)


@each_backup
@given(seed=st.integers(0, 2**32 - 1), shift=st.floats(-100, 100))
def test_value_of_values_plus_a_constant_moves_by_the_constant(name, seed, shift):
    rng = np.random.default_rng(seed)
    q, beta = jnp.asarray(rng.normal(size=4)), jnp.asarray(3.0)
    moved = BACKUPS[name].value(q + shift, beta)
    assert float(moved) == pytest.approx(float(BACKUPS[name].value(q, beta)) + shift, rel=1e-9, abs=1e-9)


@each_backup
def test_value_at_extreme_beta_tends_to_its_limit(name):
    q = jnp.asarray([2.0, 2.0, 0.5, -1.0])
    for beta in (1e6, 1e300):
        assert float(BACKUPS[name].value(q, jnp.asarray(beta))) == pytest.approx(AT_LARGE_BETA[name], rel=1e-5)
        np.testing.assert_allclose(BACKUPS[name].weights(q, jnp.asarray(beta)), [0.5, 0.5, 0, 0], atol=1e-12)
    small = float(BACKUPS[name].value(q, jnp.asarray(1e-9)))
    assert small == pytest.approx(AT_SMALL_BETA[name], abs=1e-6) if np.isfinite(AT_SMALL_BETA[name]) else small > 1e8


def test_hard_max_weights_of_near_ties_are_equal():
    q = jnp.asarray([1.0, 1.0 + 1e-12, 1.0 - 1e-6])
    np.testing.assert_allclose(HardMax().weights(q, jnp.asarray(1.0)), [0.5, 0.5, 0])
    np.testing.assert_allclose(HardMax(tie=1e-3).weights(q, jnp.asarray(1.0)), np.full(3, 1 / 3))


def test_log_policy_of_a_behavior_is_proportional_to_exp_beta_q():
    log_policy = Behavior(BoltzmannAverage(), LOG3).log_policy(jnp.asarray([[0.0, 1.0]]))
    np.testing.assert_allclose(np.exp(log_policy), [[1 / 4, 3 / 4]], rtol=1e-12)


@pytest.mark.parametrize("beta", [0.0, -1.0, float("inf"), float("nan")])
def test_behavior_with_beta_not_above_0_raises(beta):
    with pytest.raises(InputError, match=r"beta.*above 0"):
        Behavior(BoltzmannAverage(), beta)
