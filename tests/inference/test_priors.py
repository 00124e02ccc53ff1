"""Priors by hand, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.priors import NEAREST, FreeCellEvidence, GaussianMRF, Normal, WallPrior, sensor_prior
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import borders


@pytest.mark.parametrize(("prior", "parameters", "expected"), [
    (Normal(), [-2.0, -2.0], 0),
    (Normal(), [0.0, -5.0], -1 - 9 / 4),
    (Normal(1.0, 2.0), [3.0], -2),
    (Normal(jnp.array([0.0, 1.0]), jnp.array([1.0, 4.0])), [2.0, 5.0], -4 - 4),
    (Normal(jnp.array([0.0, 1.0]), 2.0), [[2.0, 1.0], [0.0, 3.0]], -2 - 2),
    (Normal(0.0, 1.0), {"a": [1.0], "b": [[2.0, 3.0]]}, -14),
])  # fmt: skip
def test_by_hand(prior, parameters, expected):
    named = parameters if isinstance(parameters, dict) else {"a": parameters}
    found = prior.log_density({name: jnp.asarray(leaf) for name, leaf in named.items()})
    assert float(found) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("mean", "variance", "field"), [
    (np.nan, 4.0, "prior mean"),
    (-2.0, 0.0, "prior variance"),
    (-2.0, -1.0, "prior variance"),
    (-2.0, np.inf, "prior variance"),
    (np.array([0.0, np.inf]), 4.0, "prior mean"),
    (-2.0, np.array([1.0, 0.0]), "prior variance"),
])  # fmt: skip
def test_refusals(mean, variance, field):
    mean, variance = (number if isinstance(number, float) else jnp.asarray(number) for number in (mean, variance))
    with pytest.raises(InputError, match=field):
        Normal(mean, variance)


EACH = Normal(0.5, 8.0)


def test_smooth_parameters_are_like_their_neighbours():
    """A square of four cells, whose pairs are its sides: (1, 2), (0, 4), (1, 0) and (2, 4)."""
    theta = jnp.asarray([1.0, 2.0, 0.0, 4.0])
    prior = GaussianMRF(EACH, borders(Grid.unknown(2, 2)), 0.3)
    differences = 1 + 16 + 1 + 4
    assert float(prior.log_density(theta)) == pytest.approx(float(EACH.log_density(theta)) - 0.3 * differences)


@pytest.mark.parametrize(
    ("drawing", "expected"),
    [
        ("### ... ...", 1),  # the middle one of a row
        ("#.. #.. #..", 1),  # and of a column
        (".#. ### .#.", 1),  # a cross counts once
        ("### ### ###", 5),  # the middle, and those of every side
        ("##. ##. ...", 0),  # a block two wide is no line
        ("#.# ... #.#", 0),
    ],
)
def test_walls_are_lines(drawing, expected):
    """Cells that are all but sure, so that what lies in a line counts as one."""
    signs = np.array([list(row) for row in drawing.split()])
    theta = jnp.asarray(np.where(signs == "#", 30.0, -30.0).ravel())
    for known in (np.full((3, 3), -1), np.where(signs == "#", 1, -1), np.where(signs == "#", 1, 0)):
        lines = WallPrior(EACH, known, 2.0).log_density(theta) - EACH.log_density(theta)
        assert float(lines) == pytest.approx(2 * expected, abs=1e-6)


def test_a_gap_in_a_wall_is_more_probably_wall():
    known = np.array([[0, 1, 0], [0, -1, 0], [0, 1, 0]])
    theta = jnp.full(9, 0.5)
    slope = jax.grad(WallPrior(EACH, known, 3.0).log_density)(theta).reshape(3, 3)
    chance = 1 / (1 + np.exp(-0.5))
    np.testing.assert_allclose(slope[1, 1], 3 * chance * (1 - chance), rtol=1e-9)
    assert (np.delete(np.asarray(slope).ravel(), 4) == 0).all()


def test_who_stands_somewhere_counts_as_much_as_a_move_into_the_cell():
    theta = jnp.asarray([3.0, 0.5, 7.0, -1.0])
    prior = FreeCellEvidence(EACH, jnp.asarray([0.0, 2.0, 0.0, 0.5]))
    free = 1 / (1 + np.exp(np.asarray(theta)))
    expected = 2 * np.log(free[1]) + 0.5 * np.log(free[3])
    assert float(prior.log_density(theta) - EACH.log_density(theta)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("strength", [-1.0, np.nan, np.inf])
def test_strengths_that_are_none_are_refused(strength):
    with pytest.raises(InputError, match="strength"):
        GaussianMRF(EACH, borders(Grid.unknown(2, 2)), strength)
    with pytest.raises(InputError, match="strength"):
        WallPrior(EACH, np.full((2, 2), -1), strength)


NAN, INF = np.nan, np.inf


def test_what_a_sensor_saw_is_the_mean_and_the_rest_stays_as_it_was():
    prior = sensor_prior(np.array([[0.5, 0.9], [NAN, 0.2]]), np.array([[2.0, 0.5], [1.0, INF]]), Normal(-1.0, 7.0))
    np.testing.assert_allclose(prior.mean, [0, np.log(9), -1, -1], atol=1e-12)
    np.testing.assert_allclose(prior.variance, [2, 0.5, 7, 7])
    each = sensor_prior(np.array([[NAN, 0.5]]), 3.0, Normal(jnp.array([4.0, 5.0]), jnp.array([6.0, 7.0])))
    np.testing.assert_allclose([each.mean, each.variance], [[4, 0], [6, 3]], atol=1e-12)
    nothing = sensor_prior(np.array([[0.5, 0.9]]), np.array([[NAN, NAN]]), Normal(-1.0, 7.0))
    np.testing.assert_allclose([nothing.mean, nothing.variance], [[-1, -1], [7, 7]])


def test_no_sensor_is_so_sure_that_nobody_could_change_its_mind():
    prior = sensor_prior(np.array([[0.0, 1.0]]), 1.0, Normal())
    np.testing.assert_allclose(jax.nn.sigmoid(prior.mean), [NEAREST, 1 - NEAREST], rtol=1e-9)


@pytest.mark.parametrize(
    ("probability", "variance", "match"),
    [
        (0.5, 0.0, "'sensor variance': expected numbers above 0, found 0.0"),
        (0.5, -1.0, "'sensor variance'.*found -1.0"),
        (0.5, -INF, "'sensor variance'"),
        (1.1, 1.0, "'sensor map': expected numbers from 0 to 1"),
        (-0.1, 1.0, "'sensor map'"),
    ],
)
def test_sensors_that_cannot_be(probability, variance, match):
    with pytest.raises(InputError, match=match):
        sensor_prior(np.array([[0.5, probability]]), np.array([[1.0, variance]]), Normal())
