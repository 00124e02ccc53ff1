"""Each backup by hand, its weights as its gradient, and what it becomes as people grow sharper or duller."""

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
SHARP = dict.fromkeys(BACKUPS, 2.0)  # of the values 2, 2, 0.5, −1
DULL = {"hard max": 2, "Boltzmann": 3.5 / 4, "log-sum-exp": np.inf, "mellowmax": 3.5 / 4}


@each_backup
def test_by_hand(name):
    q, beta = jnp.asarray([0.0, 1.0]), jnp.asarray(LOG3)
    value, weights, policy = AT_LOG3[name]
    assert float(BACKUPS[name].value(q, beta)) == pytest.approx(value)
    np.testing.assert_allclose(BACKUPS[name].weights(q, beta), weights, rtol=1e-12)
    np.testing.assert_allclose(BACKUPS[name].fixed_policy_weights(q, beta), policy, rtol=1e-12)


@each_backup
@given(seed=st.integers(0, 2**32 - 1))
def test_weights_are_the_gradient_and_sum_to_one(name, seed):
    rng = np.random.default_rng(seed)
    backup, q, beta = (
        BACKUPS[name],
        jnp.asarray(rng.normal(size=(3, 5))),
        jnp.asarray(10 ** rng.uniform(-1, 2)),
    )
    gradient = jax.vmap(jax.grad(lambda q: backup.value(q, beta)))(q)
    np.testing.assert_allclose(backup.weights(q, beta), gradient, atol=1e-12)
    for weights in (backup.weights(q, beta), backup.fixed_policy_weights(q, beta)):
        np.testing.assert_allclose(weights.sum(axis=-1), 1, rtol=1e-12)


@each_backup
@given(seed=st.integers(0, 2**32 - 1), shift=st.floats(-100, 100))
def test_moves_with_a_constant(name, seed, shift):
    rng = np.random.default_rng(seed)
    q, beta = jnp.asarray(rng.normal(size=4)), jnp.asarray(3.0)
    moved = BACKUPS[name].value(q + shift, beta)
    assert float(moved) == pytest.approx(float(BACKUPS[name].value(q, beta)) + shift, rel=1e-9, abs=1e-9)


@each_backup
def test_limits(name):
    q = jnp.asarray([2.0, 2.0, 0.5, -1.0])
    for beta in (1e6, 1e300):
        assert float(BACKUPS[name].value(q, jnp.asarray(beta))) == pytest.approx(SHARP[name], rel=1e-5)
        np.testing.assert_allclose(BACKUPS[name].weights(q, jnp.asarray(beta)), [0.5, 0.5, 0, 0], atol=1e-12)
    dull = float(BACKUPS[name].value(q, jnp.asarray(1e-9)))
    assert dull == pytest.approx(DULL[name], abs=1e-6) if np.isfinite(DULL[name]) else dull > 1e8


def test_near_ties_share_the_gradient():
    q = jnp.asarray([1.0, 1.0 + 1e-12, 1.0 - 1e-6])
    np.testing.assert_allclose(HardMax().weights(q, jnp.asarray(1.0)), [0.5, 0.5, 0])
    np.testing.assert_allclose(HardMax(tie=1e-3).weights(q, jnp.asarray(1.0)), np.full(3, 1 / 3))


def test_people_act_by_exp_beta_q():
    log_policy = Behavior(BoltzmannAverage(), LOG3).log_policy(jnp.asarray([[0.0, 1.0]]))
    np.testing.assert_allclose(np.exp(log_policy), [[1 / 4, 3 / 4]], rtol=1e-12)


@pytest.mark.parametrize("beta", [0.0, -1.0, float("inf"), float("nan")])
def test_beta_must_be_above_0(beta):
    with pytest.raises(InputError, match=r"beta.*above 0"):
        Behavior(BoltzmannAverage(), beta)
