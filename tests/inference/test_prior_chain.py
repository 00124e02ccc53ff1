"""Samples of barriers from their prior, beside the probabilities of all maps."""

from itertools import product

import numpy as np
import pytest

from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.prior_chains import is_free_of, native_terms, sample_prior

FIELD = np.array([-0.6, 0.4, 1.1, -1.3, 0.2, -0.1])
WEIGHTS = {"lines": 0.9, "pairs": 0.5, "blocks": -1.2, "isolated": -0.8}
COUNT = 6_000
PRIORS = {
    "cells": (BinaryMRF(FIELD, (2, 3), **WEIGHTS), np.full(6, -1)),
    "a column": (BinaryMRF(FIELD, (6, 1), **WEIGHTS), np.full(6, -1)),
    "a row": (BinaryMRF(FIELD, (1, 6), **WEIGHTS), np.full(6, -1)),
    "known cells": (BinaryMRF(FIELD, (2, 3), **WEIGHTS), np.array([-1, 1, -1, 0, -1, -1])),
    "barriers": (BinaryMRF(FIELD), np.array([-1, -1, 0, -1, 1, -1])),
}


def weight(prior: BinaryMRF, closed: np.ndarray) -> float:
    """exp of the field of closed barriers and of the shapes, counted cell by cell."""
    total = prior.field[closed].sum()
    if prior.shape is None:
        return np.exp(total)
    cells = {divmod(int(i), prior.shape[1]) for i in np.flatnonzero(closed)}
    for r, c in cells:
        across, along = {(r, c - 1), (r, c + 1)}, {(r - 1, c), (r + 1, c)}
        total += WEIGHTS["lines"] * (across <= cells or along <= cells)
        total += WEIGHTS["pairs"] * len((across | along) & cells) / 2
        total += WEIGHTS["blocks"] * ({(r, c + 1), (r + 1, c), (r + 1, c + 1)} <= cells)
        total += WEIGHTS["isolated"] * (not (across | along) & cells)
    return np.exp(total)


@pytest.mark.parametrize("name", PRIORS)
def test_sample_prior_has_the_frequencies_of_all_maps(name):
    prior, known = PRIORS[name]
    maps = np.array(list(product([False, True], repeat=6)))
    possible = ((known == -1) | (maps == (known == 1))).all(axis=1)
    exact = np.array([weight(prior, each) for each in maps]) * possible
    exact /= exact.sum()
    samples = sample_prior(prior, known, COUNT, apart=4)
    found = np.bincount(samples @ (1 << np.arange(6)[::-1]), minlength=64) / COUNT
    assert samples.shape == (COUNT, 6)
    assert (found[~possible] == 0).all()
    # draws four sweeps apart are nearly independent
    np.testing.assert_allclose(found, exact, atol=6 * np.sqrt(exact.max() / COUNT))
    np.testing.assert_allclose(samples.mean(axis=0), exact @ maps, atol=6 * np.sqrt(0.25 / COUNT))


def test_sample_prior_is_that_of_its_seed():
    prior, known = PRIORS["cells"]
    first, again, other = (sample_prior(prior, known, 20, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_native_terms_scale_shapes_but_not_the_field():
    prior, _ = PRIORS["cells"]
    terms = native_terms(prior, 0.5)
    np.testing.assert_allclose(terms.weights, 0.5 * np.array(list(WEIGHTS.values())))
    np.testing.assert_array_equal(terms.field, FIELD)
    assert (terms.rows, terms.columns) == (2, 3)
    assert native_terms(PRIORS["barriers"][0])[2:] == (0, 0)
    np.testing.assert_array_equal(is_free_of(np.array([0, 2]), 4), [True, False, True, False])
