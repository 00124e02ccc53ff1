"""Policies and critics: probabilities, advantages and entropies; scalings are never learned."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import sidestep as ss
import sidestep.continuous as sc

KEY = jax.random.key(0)
EXAMPLES = jnp.asarray(np.random.default_rng(0).normal([5, -3, 1], [2, 0.1, 0], (30, 3)))
ACTIONS = jnp.asarray([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0], [2.0, 0.5]])
X = EXAMPLES[0]
FRESH = sc.finite_policy(KEY, ACTIONS, EXAMPLES, width=4, depth=1)
WIDE = sc.gaussian_policy(KEY, 2, EXAMPLES, spread=1.5, width=4, depth=1)


def with_large_weights(policy):
    """A policy whose network is no longer near 0."""
    return eqx.tree_at(lambda each: each.network.network.layers[-1].weight, policy, replace_fn=lambda old: 200 * old)


FINITE, GAUSSIAN = with_large_weights(FRESH), with_large_weights(WIDE)
GAUSSIAN = eqx.tree_at(lambda policy: policy.log_spread, GAUSSIAN, jnp.log(jnp.asarray([0.5, 1.2])))
log_probs = eqx.filter_jit(lambda policy, x, choices: jax.vmap(policy.log_prob, (None, 0))(x, choices))
drawn = eqx.filter_jit(lambda policy, keys, x: jax.vmap(policy.sample, (0, None))(keys, x))


# Over a finite set


def test_finite_policy_begins_uniform():
    np.testing.assert_allclose(jax.vmap(FRESH.log_probs)(EXAMPLES), -np.log(4), atol=0.05)
    assert np.abs(FINITE.log_probs(X) + np.log(4)).max() > 0.2


def test_finite_policy_is_proportional_to_exp_of_advantages():
    log_pi = np.asarray(log_probs(FINITE, X, jnp.arange(4)))
    pi, entropy = np.exp(log_pi), float(FINITE.entropy(X))
    assert pi.sum() == pytest.approx(1, abs=1e-12)
    assert entropy == pytest.approx(stats.entropy(pi), abs=1e-12)
    advantages = log_pi + entropy
    assert pi @ advantages == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(np.exp(advantages) / np.exp(advantages).sum(), pi, atol=1e-12)
    np.testing.assert_allclose(log_pi, FINITE.log_probs(X), atol=1e-12)


def test_finite_policy_sample_frequencies_match_probabilities():
    choices = drawn(FINITE, jax.random.split(KEY, 20_000), X)
    np.testing.assert_allclose(np.bincount(choices, minlength=4) / 20_000, np.exp(FINITE.log_probs(X)), atol=0.015)
    np.testing.assert_array_equal(FINITE.action(jnp.asarray(2)), ACTIONS[2])


# Over vectors


def test_gaussian_policy_begins_near_0_with_its_spread():
    np.testing.assert_allclose(jax.vmap(WIDE.network)(EXAMPLES), 0, atol=0.05)
    np.testing.assert_allclose(WIDE.log_spread, np.log(1.5))
    assert np.abs(GAUSSIAN.network(X)).max() > 0.2


def test_gaussian_policy_density_integrates_to_one_and_has_its_entropy():
    """Summed over a lattice as wide as half the spread, which is exact to 1e-8 for Gaussians."""
    mean, spread = np.asarray(GAUSSIAN.network(X)), np.exp(np.asarray(GAUSSIAN.log_spread))
    steps = np.stack(np.meshgrid(*[np.arange(-7, 7, 0.5)] * 2), axis=-1).reshape(-1, 2)
    actions = mean + steps * spread
    log_pi = np.asarray(log_probs(GAUSSIAN, X, jnp.asarray(actions)))
    np.testing.assert_allclose(log_pi, stats.norm.logpdf(actions, mean, spread).sum(axis=1), atol=1e-10)
    masses = np.exp(log_pi) * spread.prod() * 0.25
    assert masses.sum() == pytest.approx(1, abs=1e-8)
    assert -masses @ log_pi == pytest.approx(float(GAUSSIAN.entropy(X)), abs=1e-8)
    assert masses @ (log_pi + float(GAUSSIAN.entropy(X))) == pytest.approx(0, abs=1e-8)


def test_gaussian_policy_samples_have_its_moments():
    choices = np.asarray(drawn(GAUSSIAN, jax.random.split(KEY, 20_000), X))
    np.testing.assert_allclose(choices.mean(axis=0), GAUSSIAN.network(X), atol=0.03)
    np.testing.assert_allclose(choices.std(axis=0), [0.5, 1.2], rtol=0.02)
    np.testing.assert_array_equal(GAUSSIAN.action(jnp.asarray(choices[0])), choices[0])


def test_gaussian_policy_sample_with_fixed_key_moves_with_the_mean():
    moved = eqx.tree_at(lambda each: each.network.network.layers[-1].bias, GAUSSIAN, replace_fn=lambda old: old + 0.7)
    np.testing.assert_allclose(moved.sample(KEY, X) - GAUSSIAN.sample(KEY, X), 0.7, atol=1e-12)
    assert GAUSSIAN.reparameterized
    assert not FINITE.reparameterized


# What is learned


@pytest.mark.parametrize("policy", [FINITE, GAUSSIAN])
def test_policy_gradient_of_scaling_and_actions_is_0(policy):
    choice = jnp.asarray(1) if isinstance(policy, sc.FinitePolicy) else jnp.ones(2)

    @eqx.filter_jit
    @eqx.filter_grad
    def slopes(policy):
        return policy.log_prob(X, choice) + policy.entropy(X) + jnp.sum(policy.action(choice))

    slope = slopes(policy)
    fixed = slope.network.center, slope.network.scale, getattr(slope, "actions", jnp.zeros(1))
    assert all(np.abs(leaf).max() == 0 for leaf in fixed)
    learned = jax.tree.leaves(slope.network.network)
    assert all(np.abs(leaf).max() > 0 for leaf in learned)


def test_scaled_network_standardizes_by_examples():
    """A constant feature is not scaled."""
    np.testing.assert_allclose(FRESH.network.center, EXAMPLES.mean(axis=0))
    np.testing.assert_allclose(FRESH.network.scale, [*EXAMPLES.std(axis=0)[:2], 1])


def test_make_critic_begins_at_the_mean_and_learns_its_network_only():
    random, left = np.random.default_rng(1), jnp.linspace(0, 1, 30)
    returns = jnp.asarray(random.normal(-40, 7, 30))
    critic = sc.make_critic(KEY, EXAMPLES, left, returns, width=4, depth=1)
    np.testing.assert_allclose(jax.vmap(critic)(EXAMPLES, left), returns.mean(), atol=1)
    np.testing.assert_allclose(critic.network.center, [*EXAMPLES.mean(axis=0), 0.5])
    assert float(critic.spread) == pytest.approx(float(returns.std()))
    slopes = eqx.filter_jit(eqx.filter_grad(lambda critic: critic(X, left[3])))(critic)
    assert [float(slope) for slope in (slopes.center, slopes.spread)] == [0, 0]
    assert np.abs(slopes.network.center).max() == np.abs(slopes.network.scale).max() == 0
    assert (np.abs(slopes.network.network.layers[-1].weight) > 0).all()


def test_make_critic_constant_returns_have_spread_1():
    assert float(sc.make_critic(KEY, EXAMPLES, jnp.ones(30), jnp.full(30, 2.0), width=4, depth=1).spread) == 1


# Refusals


@pytest.mark.parametrize("actions", [jnp.ones((1, 2)), jnp.zeros((0, 2)), jnp.asarray([[1.0], [np.nan]])])
def test_finite_policy_fewer_than_two_finite_actions_are_refused(actions):
    with pytest.raises(ss.InputError, match=r"field 'actions': expected (two or more|finite numbers), found"):
        sc.finite_policy(KEY, actions, EXAMPLES)


@pytest.mark.parametrize("spread", [0.0, -1.0, np.nan, np.inf])
def test_gaussian_policy_spread_not_above_0_is_refused(spread):
    with pytest.raises(ss.InputError, match=f"field 'spread': expected a finite number above 0, found {spread}"):
        sc.gaussian_policy(KEY, 1, EXAMPLES, spread=spread)


@pytest.mark.parametrize("examples", [jnp.zeros((0, 3)), EXAMPLES.at[1, 1].set(jnp.inf)])
def test_policy_without_finite_examples_is_refused(examples):
    match = r"field 'examples': expected (one or more rows|finite numbers), found"
    with pytest.raises(ss.InputError, match=match):
        sc.finite_policy(KEY, ACTIONS, examples)
    with pytest.raises(ss.InputError, match=match):
        sc.gaussian_policy(KEY, 1, examples)
