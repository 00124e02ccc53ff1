"""Ranks with ties, and the band of uniform ranks: by enumeration, by the binomial distribution, and by simulation."""

from itertools import product

import numpy as np
import pytest
from scipy.stats import binom

from sidestep.errors import InputError
from sidestep.evaluation.ranks import band_excess, outside_fraction, rank, rank_difference, uniform_band


@pytest.fixture
def random():
    return np.random.default_rng(0)


def test_rank_without_ties_is_the_number_of_draws_below(random):
    assert rank(2.5, np.array([3.0, 1.0, 2.0]), random) == 2


def test_rank_with_ties_is_uniform_over_them(random):
    ranks = [rank(2.0, np.array([1.0, 2.0, 2.0, 3.0]), random) for _ in range(3000)]
    numbers, counts = np.unique(ranks, return_counts=True)
    assert numbers.tolist() == [1, 2, 3]
    assert np.abs(counts / 3000 - 1 / 3).max() < 4 * np.sqrt(2 / 9 / 3000)


def test_rank_of_infinite_truth_ties_with_infinite_draws(random):
    ranks = {rank(np.inf, np.array([np.inf, 4.0, np.inf]), random) for _ in range(100)}
    assert ranks == {1, 2, 3}


def test_rank_of_nan_is_refused(random):
    with pytest.raises(InputError, match="NaN"):
        rank(1.0, np.array([np.nan, 1.0]), random)


def test_rank_of_a_discrete_quantity_is_uniform_where_truth_and_draws_have_one_distribution(random):
    band = uniform_band(400, 9)
    same = np.array([rank(*draw_of_binary(random, 0.3, 0.3), random) for _ in range(400)])
    other = np.array([rank(*draw_of_binary(random, 0.3, 0.5), random) for _ in range(400)])
    assert band_excess(same, band) == 0
    assert band_excess(other, band) > 0.02


def draw_of_binary(random, truth, draws):
    """Return a binary truth and nine binary draws with these probabilities of 1."""
    return float(random.random() < truth), (random.random(9) < draws).astype(float)


def test_rank_difference_is_the_distribution_less_the_uniform_one():
    ranks = np.array([0, 1, 1, 3])
    np.testing.assert_allclose(rank_difference(ranks, 3), [1 / 4 - 1 / 4, 3 / 4 - 2 / 4, 3 / 4 - 3 / 4])


@pytest.mark.parametrize("ranks", [[0, 4], [-1, 0], []])
def test_rank_difference_of_ranks_out_of_range_is_refused(ranks):
    with pytest.raises(InputError, match="'ranks': expected"):
        rank_difference(np.array(ranks, dtype=np.int64), 3)


@pytest.mark.parametrize(("ranks", "draws", "probability"), [(3, 2, 0.8), (4, 3, 0.7), (5, 2, 0.9)])
def test_uniform_band_has_the_coverage_of_all_equally_probable_ranks(ranks, draws, probability):
    band = uniform_band(ranks, draws, probability)
    every = np.array(list(product(range(draws + 1), repeat=ranks)))
    inside = [band_excess(each, band) == 0 for each in every]
    assert band.coverage == pytest.approx(np.mean(inside))
    assert band.coverage >= probability


@pytest.mark.parametrize("ranks", [10, 100, 101])
def test_uniform_band_of_one_draw_is_the_binomial_interval(ranks):
    band = uniform_band(ranks, 1, 0.95)
    low, high = binom.interval(0.95, ranks, 0.5)
    assert (band.low.item(), band.high.item()) == (low, high)
    assert band.coverage == pytest.approx(binom.cdf(high, ranks, 0.5) - binom.cdf(low - 1, ranks, 0.5))


def test_uniform_band_holds_simulated_uniform_ranks_as_often_as_it_says(random):
    band, trials = uniform_band(100, 60), 3000
    inside = np.mean([band_excess(random.integers(0, 61, 100), band) == 0 for _ in range(trials)])
    assert 0.95 <= band.coverage < 0.96
    assert abs(inside - band.coverage) < 4 * np.sqrt(0.05 * 0.95 / trials)


@pytest.mark.parametrize(("ranks", "draws", "probability"), [(0, 1, 0.5), (1, 0, 0.5), (1, 1, 1.0), (1, 1, 0.0)])
def test_uniform_band_refuses_settings_out_of_range(ranks, draws, probability):
    with pytest.raises(InputError, match="expected"):
        uniform_band(ranks, draws, probability)


def test_band_excess_is_the_part_of_the_ranks_beyond_the_band():
    band = uniform_band(100, 60)
    lowest, highest = (np.full(100, each) for each in (0, 60))
    assert band_excess(lowest, band) == pytest.approx(1 - (band.high / 100).min())
    assert band_excess(highest, band) == pytest.approx((band.low / 100).max())
    on_the_edge = np.concatenate([np.zeros(band.high[0], np.int64), np.linspace(1, 60, 100 - band.high[0]).astype(int)])
    assert band_excess(on_the_edge, band) == 0
    assert band_excess(np.linspace(0, 60, 100).round().astype(int), band) == 0


def test_band_excess_of_another_number_of_ranks_is_refused():
    with pytest.raises(InputError, match="expected 100 ranks, found 2"):
        band_excess(np.array([0, 1]), uniform_band(100, 60))


def test_outside_fraction_counts_both_tails():
    assert outside_fraction(np.array([0, 2, 3, 57, 58, 60]), draws=60) == pytest.approx(4 / 6)
    assert outside_fraction(np.arange(61), draws=60) == pytest.approx(6 / 61)
    assert outside_fraction(np.arange(100), draws=99, probability=0.8) == pytest.approx(0.2)
