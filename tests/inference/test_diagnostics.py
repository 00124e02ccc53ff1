"""Diagnostics of chains: closed forms, and beside ArviZ."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidestep.errors import InputError
from sidestep.inference.diagnostics import effective_sizes, split_rhat


def autoregressive(rho: float, chains: int, draws: int, quantities: int = 1, seed: int = 0) -> np.ndarray:
    """Chains x ← ρ x + √(1 − ρ²) ε from their stationary distribution: n draws are worth n (1 − ρ)/(1 + ρ)."""
    noise = np.random.default_rng(seed).normal(size=(chains, draws, quantities))
    result = noise.copy()
    for at in range(1, draws):
        result[:, at] = rho * result[:, at - 1] + np.sqrt(1 - rho**2) * noise[:, at]
    return result


def test_independent_draws_have_rhat_1_and_as_many_effective_draws():
    draws = autoregressive(0.0, chains=4, draws=2000, quantities=20)
    np.testing.assert_allclose(split_rhat(draws), 1, atol=0.01)
    np.testing.assert_allclose(effective_sizes(draws), 8000, rtol=0.1)


@pytest.mark.parametrize("rho", [0.3, 0.6, 0.9])
def test_effective_sizes_of_autoregressive_chains_are_those_of_theory(rho):
    draws = autoregressive(rho, chains=4, draws=10_000, quantities=8)
    sizes = effective_sizes(draws)
    np.testing.assert_allclose(sizes.mean(), 40_000 * (1 - rho) / (1 + rho), rtol=0.05)
    np.testing.assert_allclose(sizes, 40_000 * (1 - rho) / (1 + rho), rtol=0.2)
    np.testing.assert_allclose(split_rhat(draws), 1, atol=0.01)


def test_effective_sizes_of_alternating_draws_are_at_most_their_number():
    draws = autoregressive(-0.7, chains=2, draws=1000)
    assert effective_sizes(draws)[0] == 2000


@pytest.mark.parametrize("kind", [bool, float])
def test_constants_have_rhat_1_where_equal_and_no_end_where_not(kind):
    draws = np.zeros((2, 10, 3), kind)
    draws[1, :, 1] = 1  # one chain is always 1
    draws[:, 5:, 2] = 1  # both change in the middle
    np.testing.assert_array_equal(split_rhat(draws), [1, np.inf, np.inf])
    np.testing.assert_array_equal(effective_sizes(draws), [20, 4, 4])


def test_split_rhat_of_chains_apart_is_that_of_the_formula():
    """Means ±d and variance 1 in four halves: the variance of means is 4 d²/3."""
    half = np.array([-1.0, 1.0] * 50)
    half /= half.std(ddof=1)
    for distance in (0.1, 1.0, 5.0):
        draws = np.stack([np.tile(half + mean, 2) for mean in (-distance, distance)])[:, :, None]
        expected = np.sqrt(99 / 100 + 4 * distance**2 / 3)
        assert split_rhat(draws)[0] == pytest.approx(expected)


def test_split_rhat_of_chains_that_drift_alike_is_large():
    """Whole chains agree, their halves do not."""
    draws = np.linspace(0, 10, 100) + np.random.default_rng(0).normal(size=(2, 100))
    assert split_rhat(draws[:, :, None])[0] > 1.5


def test_effective_sizes_of_chains_apart_are_few():
    draws = autoregressive(0.0, 2, 500) + np.array([-10, 10])[:, None, None]
    assert effective_sizes(draws)[0] < 5


def test_last_draw_of_an_odd_number_does_not_count():
    draws = autoregressive(0.5, 2, 101)
    np.testing.assert_array_equal(split_rhat(draws), split_rhat(draws[:, :-1]))
    np.testing.assert_array_equal(effective_sizes(draws), effective_sizes(draws[:, :-1]))


@given(st.floats(-0.8, 0.95), st.integers(0, 2**16), st.booleans())
def test_split_rhat_equals_that_of_arviz(rho, seed, binary):
    arviz = pytest.importorskip("arviz")
    draws = autoregressive(rho, chains=3, draws=60, seed=seed)
    draws = draws > 0.3 if binary else draws
    expected = float(arviz.rhat(draws[:, :, 0].astype(float), method="split"))
    assert split_rhat(draws)[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("rho", [-0.5, 0.0, 0.5, 0.9])
def test_effective_sizes_are_nearly_those_of_arviz(rho):
    """ArviZ sums one more correlation where they turn negative."""
    arviz = pytest.importorskip("arviz")
    draws = autoregressive(rho, chains=3, draws=2000, quantities=5)
    expected = [min(6000, float(arviz.ess(draws[:, :, at], method="mean"))) for at in range(5)]
    np.testing.assert_allclose(effective_sizes(draws), expected, rtol=0.05)


@pytest.mark.parametrize("draws", [0, 1, 3])
def test_diagnostics_of_too_few_draws_raise(draws):
    for function in (split_rhat, effective_sizes):
        with pytest.raises(InputError, match=f"'draws'.*found {draws}"):
            function(np.zeros((2, draws, 1)))
