"""The gap between a policy and its own Q estimates, by plain sums over starts."""

import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
from sidestep.continuous.gaps import policy_gaps

BETA, STARTS, CANDIDATES = 1.7, 6, 4
RANDOM = np.random.default_rng(0)
PI = RANDOM.dirichlet(np.ones(CANDIDATES), STARTS)
Q = RANDOM.normal(size=(STARTS, CANDIDATES))
SOFT, OPTIMAL = ss.Behavior(ss.LogSumExp(), BETA), ss.Behavior(ss.HardMax())


def advantages(pi):
    """ln π + H(π) of each candidate."""
    return np.log(pi) - np.sum(pi * np.log(pi), axis=1, keepdims=True)


def gaps(behavior, samples, pi=PI):
    parts = (jnp.asarray(part) for part in (advantages(pi), samples, pi))
    return np.asarray(policy_gaps(behavior, *parts))


@pytest.mark.parametrize("count", [2, 3, 4])
def test_policy_gaps_of_soft_agents_without_noise_are_divergences(count):
    aim = np.exp(BETA * Q)
    aim /= aim.sum(axis=1, keepdims=True)
    expected = np.sum(PI * np.log(PI / aim), axis=1)
    np.testing.assert_allclose(gaps(SOFT, np.repeat(Q[..., None], count, axis=-1)), expected, rtol=1e-10)
    np.testing.assert_allclose(gaps(SOFT, np.repeat(Q[..., None], count, axis=-1), aim), 0, atol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_policy_gaps_of_optimal_agents_without_noise_are_gains(count):
    expected = Q.max(axis=1) - np.sum(PI * Q, axis=1)
    np.testing.assert_allclose(gaps(OPTIMAL, np.repeat(Q[..., None], count, axis=-1)), expected, rtol=1e-10)


def test_policy_gaps_of_optimal_agents_choose_by_one_half_and_count_by_the_other():
    """So noise alone has no gain on average."""
    samples = np.repeat(np.stack([Q, -Q], axis=-1), 2, axis=-1)
    expected = -Q.max(axis=1) + np.sum(PI * Q, axis=1)
    np.testing.assert_allclose(gaps(OPTIMAL, samples), expected, rtol=1e-10)


def test_policy_gaps_of_soft_agents_subtract_half_the_variance_of_noise_between_halves():
    """The halves are Q ± d; their mean is Q, and the noise of that mean is β d."""
    noise = 0.3 * RANDOM.normal(size=(STARTS, CANDIDATES))
    samples = np.stack([Q + noise, Q + noise, Q - noise, Q - noise], axis=-1)
    plain = gaps(SOFT, np.repeat(Q[..., None], 4, axis=-1))
    mean = np.sum(PI * noise, axis=1)
    variance = BETA**2 * (np.sum(PI * noise**2, axis=1) - mean**2)
    np.testing.assert_allclose(gaps(SOFT, samples), plain - variance / 2, rtol=1e-10)


def test_policy_gaps_of_an_agent_with_noise_are_near_0():
    """Without the subtraction the mean would be β² .2² / 4 times the degrees of freedom over candidates, .02."""
    many = 20_000
    aim = np.full((many, CANDIDATES), 1 / CANDIDATES)
    samples = 0.2 * np.random.default_rng(1).normal(size=(many, CANDIDATES, 2))
    assert abs(gaps(SOFT, samples, aim).mean()) < 1e-3
    assert abs(gaps(OPTIMAL, samples, aim).mean()) < 4 * 0.2 / np.sqrt(many)
