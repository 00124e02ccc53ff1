"""The mean field: exact expectations over all maps, and their gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.barrier_worlds import all_maps
from sidestep.errors import InputError
from sidestep.inference.mean_field import MeanField
from sidestep.inference.mrf import BinaryMRF
from sidestep.tabular.grid import Cell

RANDOM = np.random.default_rng(0)
WEIGHTS = {"lines": 0.7, "pairs": -0.4, "blocks": -1.3, "isolated": 0.9}
SHAPE = (2, 3)
FIELD, LOGITS = RANDOM.normal(size=6), RANDOM.normal(0, 1.5, size=6)
KNOWN = {
    "nothing": np.full(SHAPE, -1),
    "some": np.array([[-1, 1, -1], [0, -1, 1]]),
    "a line": np.array([[1, -1, 1], [-1, -1, -1]]),
}


def expected(prior: BinaryMRF, known: np.ndarray, logits: np.ndarray) -> float:
    """E_q[log p(z)] + H(q) as a sum over all maps, without the field of what is known."""
    unknown, p = known.ravel() == Cell.UNKNOWN, 1 / (1 + np.exp(-logits))
    total = 0.0
    for free in all_maps(int(unknown.sum())):
        z = known.ravel() == Cell.OCCUPIED
        z[unknown] = free
        q = np.where(free, p[unknown], 1 - p[unknown]).prod()
        total += q * (prior.log_density(z) - prior.field[~unknown] @ z[~unknown] - np.log(q))
    return total


@pytest.mark.parametrize("name", KNOWN)
def test_log_density_equals_the_sum_over_all_maps(name):
    prior = BinaryMRF(FIELD, SHAPE, **WEIGHTS)
    result = float(MeanField(prior, KNOWN[name]).log_density(jnp.asarray(LOGITS)))
    assert result == pytest.approx(expected(prior, KNOWN[name], LOGITS))


def test_log_density_without_a_shape_ignores_later_parameters():
    """A slippery grid has logits of slips behind those of cells; walls have no shape."""
    prior, known = BinaryMRF(FIELD), np.array([-1, 0, 1, -1, -1, -1])
    result = float(MeanField(prior, known).log_density(jnp.append(LOGITS, 3.0)))
    assert result == pytest.approx(expected(prior, known, LOGITS))


@pytest.mark.parametrize("name", KNOWN)
def test_gradient_equals_finite_differences_and_is_0_for_known_cells(name):
    mean_field, step = MeanField(BinaryMRF(FIELD, SHAPE, **WEIGHTS), KNOWN[name]), 1e-5
    gradient = np.asarray(jax.grad(mean_field.log_density)(jnp.asarray(LOGITS)))
    shifted = jnp.asarray(LOGITS) + step * np.array([[[1]], [[-1]]]) * np.eye(6)
    up, down = jax.vmap(jax.vmap(mean_field.log_density))(shifted)
    np.testing.assert_allclose(gradient, (up - down) / (2 * step), atol=1e-8)
    known = KNOWN[name].ravel() != Cell.UNKNOWN
    assert not gradient[known].any()
    assert gradient[~known].all()


def test_log_density_without_shapes_is_largest_at_the_field():
    """Then the mean field is exact: q = p."""
    mean_field = MeanField(BinaryMRF(FIELD, SHAPE), KNOWN["nothing"])
    np.testing.assert_allclose(jax.grad(mean_field.log_density)(jnp.asarray(FIELD)), 0, atol=1e-12)
    # log Z of independent barriers
    assert float(mean_field.log_density(jnp.asarray(FIELD))) == pytest.approx(np.log1p(np.exp(FIELD)).sum())


def test_log_density_of_barriers_without_a_shape_takes_cells_in_rows():
    prior, known = BinaryMRF(FIELD), KNOWN["some"]
    result = float(MeanField(prior, known).log_density(jnp.asarray(LOGITS)))
    assert result == pytest.approx(expected(prior, known, LOGITS))


@pytest.mark.parametrize(("prior", "known"), [
    (BinaryMRF(FIELD), np.full(5, -1)),
    (BinaryMRF(FIELD), np.full((2, 2), -1)),
    (BinaryMRF(FIELD, SHAPE), np.full(6, -1)),
    (BinaryMRF(FIELD, SHAPE), np.full((3, 2), -1)),
    (BinaryMRF(FIELD, SHAPE), np.full(SHAPE, 2)),
    (BinaryMRF(FIELD, SHAPE), np.full(SHAPE, -2)),
])  # fmt: skip
def test_mean_field_of_other_barriers_raises(prior, known):
    with pytest.raises(InputError, match="known"):
        MeanField(prior, known)
