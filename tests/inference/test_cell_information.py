"""The information of each barrier: closed forms, and the prior's probabilities against a sum over all maps."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidestep.errors import InputError
from sidestep.inference.cell_information import information, prior_closed
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.prior_chains import sample_prior

probabilities = st.floats(0, 1)
inner = st.floats(1e-6, 1 - 1e-6)


def one(posterior: float, prior: float) -> float:
    return float(information(np.array([posterior]), np.array([prior]))[0])


@given(inner, inner)
def test_information_is_the_relative_entropy_of_bernoulli_distributions(p, q):
    expected = p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))
    assert one(p, q) == pytest.approx(expected, abs=1e-9)


@given(inner)
def test_information_of_an_open_barrier_is_the_surprise_of_it(q):
    assert one(0.0, q) == pytest.approx(-np.log1p(-q))
    assert one(1.0, q) == pytest.approx(-np.log(q))


@given(probabilities, probabilities)
def test_information_is_never_below_0(p, q):
    assert one(p, q) >= 0
    assert one(p, p) == 0


def test_information_where_the_prior_excluded_is_infinite():
    assert one(0.5, 0.0) == np.inf
    assert one(0.5, 1.0) == np.inf


@pytest.mark.parametrize("bad", [-0.1, 1.1, float("nan")])
def test_information_of_other_numbers_raises(bad):
    with pytest.raises(InputError, match="'posterior': expected numbers from 0 to 1"):
        one(bad, 0.5)
    with pytest.raises(InputError, match="'prior': expected numbers from 0 to 1"):
        one(0.5, bad)


def test_prior_closed_without_shapes_is_exact():
    field = np.array([-2.0, 0.0, 3.0, 1.0, 1.0])
    found = prior_closed(BinaryMRF(field), np.array([-1, -1, -1, 0, 1]))
    np.testing.assert_allclose(found, [*(1 / (1 + np.exp(-field[:3]))), 0, 1])


def test_prior_closed_with_shapes_is_that_of_all_maps():
    known = np.array([-1, -1, -1, -1, 1, -1, -1, 0, -1])
    prior = BinaryMRF(np.full(9, -0.5), (3, 3), lines=1.5, blocks=-2.0, isolated=-1.0)
    free = np.flatnonzero(known == -1)
    maps = np.tile(known == 1, (2 ** len(free), 1))
    maps[:, free] = list(product([False, True], repeat=len(free)))
    weights = np.exp([prior.log_density(each) for each in maps])
    expected = weights @ maps / weights.sum()
    found = prior_closed(prior, known, seed=2)
    # means of 200 samples: four standard errors
    np.testing.assert_allclose(found, expected, atol=4 * 0.5 / np.sqrt(200))
    assert (found[4], found[7]) == (1, 0)
    assert ((found[free] > 0) & (found[free] < 1)).all()
    np.testing.assert_array_equal(found, prior_closed(prior, known, seed=2))


@pytest.mark.parametrize("wrong", [{"count": 0}, {"apart": 0}])
def test_sample_prior_of_no_samples_raises(wrong):
    settings = {"count": 3, "apart": 2} | wrong
    with pytest.raises(InputError, match="at least 1, found 0"):
        sample_prior(BinaryMRF(np.zeros(2)), np.full(2, -1), **settings)
