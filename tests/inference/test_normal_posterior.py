"""A normal approximation made by hand: its covariance, errors, intervals and samples, beside the dense matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.normal_posterior import Laplace
from sidestep.inference.objective import Parameters
from sidestep.tabular.behavior_model import BehaviorParameters

SCALE = np.array([0.5, 2.0, 0.3, 1.5])
MODE = np.array([0.4, -1.0, 1.2, -0.7])
VECTORS = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 2)))[0]
EIGENVALUES = np.array([4.0, 0.25])
DENSE = np.diag(SCALE) @ (np.eye(4) + VECTORS @ np.diag(1 / EIGENVALUES - 1) @ VECTORS.T) @ np.diag(SCALE)
ERRORS = np.sqrt(np.diag(DENSE))


@pytest.fixture
def normal():
    """Two logits of a model, ln β and the logit of a lapse."""
    behavior = BehaviorParameters(log_beta=jnp.asarray(MODE[2:3]), logit_lapse=jnp.asarray(MODE[3]))
    return Laplace(Parameters(jnp.asarray(MODE[:2]), behavior), SCALE, VECTORS, EIGENVALUES, neglected=0.0)


def test_covariance_is_the_dense_product(normal):
    np.testing.assert_allclose(normal.covariance, DENSE, rtol=1e-12)
    vectors = np.random.default_rng(1).normal(size=(3, 4))
    np.testing.assert_allclose(normal.covariance_products(vectors), vectors @ DENSE, rtol=1e-12)


def test_standard_errors_are_roots_of_the_diagonal(normal):
    np.testing.assert_allclose(np.concatenate([np.ravel(x) for x in jax.tree.leaves(normal.standard_errors)]), ERRORS)


def test_natural_errors_are_those_of_the_delta_method(normal):
    errors, lapse = normal.natural_errors, 1 / (1 + np.exp(-MODE[3]))
    np.testing.assert_allclose(errors.model, ERRORS[:2])
    np.testing.assert_allclose(errors.beta, np.exp(MODE[2:3]) * ERRORS[2:3])
    np.testing.assert_allclose(errors.lapse, lapse * (1 - lapse) * ERRORS[3])
    assert errors.discount is None


def test_error_of_functions_is_that_of_their_jacobian(normal):
    def one(parameters):
        return parameters.model[0] ** 2 * jnp.exp(parameters.behavior.log_beta[0])

    def several(parameters):
        return jnp.stack([one(parameters), parameters.model[1] - 3 * parameters.behavior.logit_lapse])

    a, b = MODE[0], np.exp(MODE[2])
    jacobian = np.array([[2 * a * b, 0, a**2 * b, 0], [0, 1, 0, -3]])
    expected = np.sqrt(np.diag(jacobian @ DENSE @ jacobian.T))
    np.testing.assert_allclose(normal.error_of(several), expected, rtol=1e-10)
    np.testing.assert_allclose(normal.error_of(one), expected[0], rtol=1e-10)


@pytest.mark.parametrize(("level", "width"), [(0.95, 1.959964), (0.5, 0.6744898), (0.998, 3.090232)])
def test_interval_is_mapped_from_the_unconstrained_scale(normal, level, width):
    lower, upper = normal.interval(level)
    for sign, ends in ((-1, lower), (1, upper)):
        x = MODE + sign * width * ERRORS
        np.testing.assert_allclose(ends.model, x[:2], rtol=1e-6)
        np.testing.assert_allclose(ends.beta, np.exp(x[2:3]), rtol=1e-6)
        np.testing.assert_allclose(ends.lapse, 1 / (1 + np.exp(-x[3])), rtol=1e-6)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.5, 1.5, np.nan])
def test_interval_of_a_level_that_is_no_probability_raises(normal, level):
    with pytest.raises(InputError, match="level"):
        normal.interval(level)


def test_sample_has_the_mode_and_the_covariance(normal):
    count = 40_000
    samples = normal.sample(jax.random.key(0), count)
    drawn = np.concatenate([np.asarray(leaf).reshape(count, -1) for leaf in jax.tree.leaves(samples)], axis=1)
    np.testing.assert_allclose(drawn.mean(axis=0), MODE, atol=5 * ERRORS.max() / np.sqrt(count))
    deviation = (np.cov(drawn.T) - DENSE) / np.outer(ERRORS, ERRORS)
    assert np.abs(deviation).max() < 5 * np.sqrt(2 / count)
    assert normal.sample(jax.random.key(0), 1).model.shape == (1, 2)
    with pytest.raises(InputError, match="n"):
        normal.sample(jax.random.key(0), 0)
