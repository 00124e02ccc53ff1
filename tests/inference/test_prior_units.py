"""The units of priors, and the shapes of parameters that they refuse."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.priors import FreeCellEvidence, GaussianMRF, Normal, Prior, WallPrior

TIGHT = Normal(jnp.zeros(4), jnp.array([1e-8, 0.25, 1.0, 9.0]))
UNITS = [1e-4, 0.5, 1.0, 1.0]
PAIRS = np.array([[0, 1], [2, 3]])
WRAPPED = {
    "none": TIGHT,
    "neighbors": GaussianMRF(TIGHT, PAIRS, 0.3),
    "walls": WallPrior(TIGHT, np.full((2, 2), -1), 2.0),
    "evidence": FreeCellEvidence(TIGHT, jnp.ones(4)),
    "evidence on walls": FreeCellEvidence(WallPrior(TIGHT, np.full((2, 2), -1), 2.0), jnp.ones(4)),
}


class Flat(Prior):
    def log_density(self, parameters):
        return jnp.zeros(())


class Vector(Prior):
    def log_density(self, parameters):
        return parameters


@pytest.mark.parametrize("name", WRAPPED)
def test_scale_is_the_standard_deviation_where_it_is_below_1(name):
    np.testing.assert_allclose(WRAPPED[name].scale(jnp.zeros(4)), UNITS, rtol=1e-6)


def test_scale_of_trees_has_their_shapes():
    tree = {"a": jnp.zeros((2, 4)), "b": jnp.zeros(4)}
    scale = Normal(0.0, 0.25).scale(tree)
    np.testing.assert_allclose(scale["a"], np.full((2, 4), 0.5))
    np.testing.assert_allclose(TIGHT.scale(tree)["a"], np.tile(UNITS, (2, 1)), rtol=1e-6)
    np.testing.assert_array_equal(Flat().scale(tree)["a"], np.ones((2, 4)))


@pytest.mark.parametrize("prior", WRAPPED.values())
def test_check_parameters_accepts_vectors_of_its_length(prior):
    prior.check_parameters(jnp.zeros(4))


@pytest.mark.parametrize(("prior", "parameters", "found"), [
    (TIGHT, jnp.zeros(3), r"found shape \(4,\)"),
    (Vector(), jnp.zeros(3), r"found shape \(3,\)"),
    (GaussianMRF(Normal(), PAIRS, 0.3), jnp.zeros(3), "found a pair with 3"),
    (GaussianMRF(Normal(), PAIRS, 0.3), jnp.zeros((2, 2)), "found a pair"),
    (GaussianMRF(Normal(), PAIRS, 0.3), {"a": jnp.zeros(4)}, "found a pair"),
    (GaussianMRF(TIGHT, PAIRS, 0.3), jnp.zeros(5), r"found shape \(4,\)"),
    (FreeCellEvidence(Normal(), jnp.ones(4)), jnp.zeros(5), "found another"),
    (Normal(jnp.zeros((4, 1))), jnp.zeros(4), r"found shape \(4, 1\)"),
    (Normal(jnp.zeros((3, 4))), jnp.zeros(4), r"found shape \(3, 4\)"),
    (Normal(0.0, jnp.ones((4, 1))), jnp.zeros(4), r"variance.*found shape \(4, 1\)"),
    (Normal(jnp.zeros(4)), {"cells": jnp.zeros(4), "slip": jnp.zeros(())}, r"shape \(\), found shape \(4,\)"),
    (FreeCellEvidence(Normal(jnp.zeros((3, 4))), jnp.ones(4)), jnp.zeros(4), r"found shape \(3, 4\)"),
])  # fmt: skip
def test_check_parameters_of_other_shapes_raises(prior, parameters, found):
    with pytest.raises(InputError, match=f"prior.*{found}"):
        prior.check_parameters(parameters)


@pytest.mark.parametrize("pairs", [[[0, -1]], [[0, 1, 2]]])
def test_gaussian_mrf_of_other_pairs_raises(pairs):
    with pytest.raises(InputError, match="pairs"):
        GaussianMRF(TIGHT, pairs, 0.3)


@pytest.mark.parametrize("known", [np.full((2, 2), 2), np.full((2, 2), -2)])
def test_wall_prior_of_other_cells_raises(known):
    with pytest.raises(InputError, match="known"):
        WallPrior(TIGHT, known, 1.0)


def test_free_cell_evidence_of_negative_counts_raises():
    with pytest.raises(InputError, match="counts"):
        FreeCellEvidence(TIGHT, [0.0, -0.5, 0.0, 1.0])
    FreeCellEvidence(TIGHT, [0.0, 0.5, 0.0, 1.0])


def test_strengths_and_pairs_of_zero_are_those_of_independent_parameters():
    theta = jnp.array([1e-4, 0.3, -2.0, 1.0])
    for prior in (GaussianMRF(TIGHT, PAIRS, 0.0), WallPrior(TIGHT, np.full((2, 2), -1), 0.0)):
        assert float(prior.log_density(theta)) == pytest.approx(float(TIGHT.log_density(theta)))
