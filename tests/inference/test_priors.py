"""The log densities of priors by hand, and the arguments that they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.priors import MIN_PROBABILITY, FreeCellEvidence, GaussianMRF, Normal, WallPrior, sensor_prior
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import borders


@pytest.mark.parametrize(("prior", "parameters", "expected"), [
    (Normal(), [-2.0, -2.0], 0),
    (Normal(), [0.0, -5.0], -1 - 9 / 4),
    (Normal(jnp.array([0.0, 1.0]), jnp.array([0.5, 2.0])), [2.0, 5.0], -4 - 4),
    (Normal(jnp.array([0.0, 1.0]), 1.0), [[2.0, 1.0], [0.0, 3.0]], -2 - 2),
    (Normal(0.0, 0.5), {"a": [1.0], "b": [[2.0, 3.0]]}, -14),
])  # fmt: skip
def test_normal_log_density_by_hand(prior, parameters, expected):
    named = parameters if isinstance(parameters, dict) else {"a": parameters}
    log_density = prior.log_density({name: jnp.asarray(leaf) for name, leaf in named.items()})
    assert float(log_density) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("mean", "variance", "field"), [
    (np.nan, 4.0, "prior mean"),
    (-2.0, 0.0, "prior variance"),
    (-2.0, np.inf, "prior variance"),
    (np.array([0.0, np.inf]), 4.0, "prior mean"),
    (-2.0, np.array([1.0, -1.0]), "prior variance"),
])  # fmt: skip
def test_normal_refuses_infinite_means_and_variances_that_are_not_positive(mean, variance, field):
    mean, variance = (number if isinstance(number, float) else jnp.asarray(number) for number in (mean, variance))
    with pytest.raises(InputError, match=field):
        Normal(mean, variance)


INDEPENDENT = Normal(0.5, 4.0)


def test_gaussian_mrf_penalizes_differences_of_neighbors():
    """A square of four cells; the pairs are its sides: (1, 2), (0, 4), (1, 0) and (2, 4)."""
    theta = jnp.asarray([1.0, 2.0, 0.0, 4.0])
    prior = GaussianMRF(INDEPENDENT, borders(Grid.unknown(2, 2)), 0.3)
    differences = 1 + 16 + 1 + 4
    assert float(prior.log_density(theta)) == pytest.approx(float(INDEPENDENT.log_density(theta)) - 0.3 * differences)


@pytest.mark.parametrize(("drawing", "expected"), [
    ("### ... ...", 1),  # the middle cell of a row
    ("#.. #.. #..", 1),  # and of a column
    (".#. ### .#.", 1),  # a cross counts once
    ("### ### ###", 5),  # the middle cell and those of the sides
    ("##. ##. ...", 0),  # a block two cells wide
    ("#.# ... #.#", 0),
])  # fmt: skip
def test_wall_prior_counts_blocked_cells_in_lines(drawing, expected):
    """The probabilities are almost 0 and 1, so that each cell in a line counts as one."""
    signs = np.array([list(row) for row in drawing.split()])
    theta = jnp.asarray(np.where(signs == "#", 30.0, -30.0).ravel())
    for known in (np.full((3, 3), -1), np.where(signs == "#", 1, -1), np.where(signs == "#", 1, 0)):
        gain = WallPrior(INDEPENDENT, known, 2.0).log_density(theta) - INDEPENDENT.log_density(theta)
        assert float(gain) == pytest.approx(2 * expected, abs=1e-6)


@pytest.mark.slow
def test_wall_prior_fills_a_gap_in_a_known_wall():
    known = np.array([[0, 1, 0], [0, -1, 0], [0, 1, 0]])
    theta = jnp.full(9, 0.5)
    gradient = jax.grad(WallPrior(INDEPENDENT, known, 3.0).log_density)(theta).reshape(3, 3)
    p_blocked = 1 / (1 + np.exp(-0.5))
    np.testing.assert_allclose(gradient[1, 1], 3 * p_blocked * (1 - p_blocked), rtol=1e-9)
    assert (np.delete(np.asarray(gradient).ravel(), 4) == 0).all()


def test_free_cell_evidence_counts_as_much_as_moves_into_the_cell():
    theta = jnp.asarray([3.0, 0.5, 7.0, -1.0])
    prior = FreeCellEvidence(INDEPENDENT, jnp.asarray([0.0, 2.0, 0.0, 0.5]))
    free = 1 / (1 + np.exp(np.asarray(theta)))
    expected = 2 * np.log(free[1]) + 0.5 * np.log(free[3])
    assert float(prior.log_density(theta) - INDEPENDENT.log_density(theta)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("strength", [-1.0, np.nan, np.inf])
def test_priors_refuse_negative_and_infinite_strengths(strength):
    with pytest.raises(InputError, match="strength"):
        GaussianMRF(INDEPENDENT, borders(Grid.unknown(2, 2)), strength)
    with pytest.raises(InputError, match="strength"):
        WallPrior(INDEPENDENT, np.full((2, 2), -1), strength)


NAN, INF = np.nan, np.inf


def test_sensor_prior_changes_observed_cells_only():
    prior = sensor_prior(np.array([[0.5, 0.9], [NAN, 0.2]]), np.array([[2.0, 0.5], [1.0, INF]]), Normal(-1.0, 7.0))
    np.testing.assert_allclose(prior.mean, [0, np.log(9), -1, -1], atol=1e-12)
    np.testing.assert_allclose(prior.variance, [2, 0.5, 7, 7])
    each = sensor_prior(np.array([[NAN, 0.5]]), 3.0, Normal(jnp.array([4.0, 5.0]), jnp.array([6.0, 7.0])))
    np.testing.assert_allclose([each.mean, each.variance], [[4, 0], [6, 3]], atol=1e-12)
    nothing = sensor_prior(np.array([[0.5, 0.9]]), np.array([[NAN, NAN]]), Normal(-1.0, 7.0))
    np.testing.assert_allclose([nothing.mean, nothing.variance], [[-1, -1], [7, 7]])


def test_sensor_prior_clips_certain_probabilities():
    prior = sensor_prior(np.array([[0.0, 1.0]]), 1.0, Normal())
    np.testing.assert_allclose(jax.nn.sigmoid(prior.mean), [MIN_PROBABILITY, 1 - MIN_PROBABILITY], rtol=1e-9)


@pytest.mark.parametrize(("probability", "variance", "match"), [
    (0.5, 0.0, "'sensor variance': expected numbers above 0, found 0.0"),
    (0.5, -1.0, "'sensor variance'.*found -1.0"),
    (0.5, -INF, "'sensor variance'"),
    (1.1, 1.0, "'sensor map': expected finite numbers from 0 to 1"),
    (-0.1, 1.0, "'sensor map'"),
])  # fmt: skip
def test_sensor_prior_refuses_impossible_numbers(probability, variance, match):
    with pytest.raises(InputError, match=match):
        sensor_prior(np.array([[0.5, probability]]), np.array([[1.0, variance]]), Normal())
