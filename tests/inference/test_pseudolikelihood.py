"""Weights of a Markov random field by pseudo-likelihood: features by brute force, and weights of sampled maps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from sidestep.errors import InputError
from sidestep.inference.mrf import SHAPE_TERMS, BinaryMRF, shape_counts
from sidestep.inference.pseudolikelihood import closing_changes, fit_mrf
from sidestep.tabular.grid import Grid

WALL = np.zeros((6, 7), dtype=int)
WALL[1:5, 3] = 1


@given(rows=st.integers(1, 7), columns=st.integers(1, 7), seed=st.integers(0, 2**32 - 1))
def test_closing_changes_are_differences_of_counts_of_whole_maps(rows, columns, seed):
    closed = np.random.default_rng(seed).random((rows, columns)) < 0.4
    changes = closing_changes(closed)
    for cell in np.ndindex(rows, columns):
        one, other = closed.copy(), closed.copy()
        one[cell], other[cell] = True, False
        np.testing.assert_array_equal(changes[cell], shape_counts(one) - shape_counts(other))


def gibbs_map(prior, sweeps, seed):
    """A map of a field, sampled cell by cell from P(z_i = 1 | z_−i).

    Cells of a class have four rows or columns between them, so they are independent given the others.
    """
    random = np.random.default_rng(seed)
    closed, field = random.random(prior.shape) < 0.2, prior.field.reshape(prior.shape)
    for _ in range(sweeps):
        for row, column in np.ndindex(5, 5):
            own = np.s_[row::5, column::5]
            chance = expit(field + closing_changes(closed) @ prior.weights)[own]
            closed[own] = random.random(chance.shape) < chance
    return Grid(closed.astype(int))


@pytest.mark.slow
def test_fit_mrf_recovers_the_weights_of_a_sampled_map():
    truth = {"lines": 1.2, "pairs": -0.4, "blocks": -0.8, "isolated": 0.6}
    prior = BinaryMRF(np.full(160 * 160, -1.0), (160, 160), **truth)
    fit = fit_mrf([gibbs_map(prior, sweeps=5, seed=0)])
    assert fit.field == pytest.approx([-1.0], abs=0.15)
    assert {name: getattr(fit, name) for name in SHAPE_TERMS} == pytest.approx(truth, abs=0.25)


def test_fit_mrf_without_terms_returns_the_log_odds_of_each_map():
    random = np.random.default_rng(0)
    maps = [Grid((random.random((20, 20)) < share).astype(int)) for share in (0.1, 0.4)]
    shares = np.array([grid.known.mean() for grid in maps])
    fit = fit_mrf(maps, [], separate_fields=True, standard_deviation=1e3)
    assert fit.field == pytest.approx(np.log(shares / (1 - shares)), abs=1e-4)
    entropy = -(shares * np.log(shares) + (1 - shares) * np.log(1 - shares))
    assert fit.log_pseudolikelihood == pytest.approx(-entropy.mean(), abs=1e-6)
    pooled = shares.mean()
    assert fit_mrf(maps, [], standard_deviation=1e3).field == pytest.approx([np.log(pooled / (1 - pooled))], abs=1e-4)


def test_fit_mrf_separate_fields_share_the_shape():
    thin, thick = WALL, np.roll(WALL, 1, axis=1) | WALL
    fit = fit_mrf([Grid(thin), Grid(thick)], ["pairs"], separate_fields=True)
    assert len(fit.field) == 2
    assert (fit.pairs, fit.lines) == (pytest.approx(fit.prior((6, 7)).pairs), 0.0)


def test_fit_mrf_is_a_maximum_of_the_penalized_pseudolikelihood():
    """Around the fitted weights, the sum of log P(z_i | z_−i) less Σ w²/(2σ²) is lower."""
    closed, deviation = WALL == 1, 2.0
    fit = fit_mrf([Grid(WALL)], standard_deviation=deviation)
    best = np.array([fit.field[0], *(getattr(fit, name) for name in SHAPE_TERMS)])
    features = np.concatenate([np.ones((*closed.shape, 1)), closing_changes(closed)], axis=-1)

    def penalized(weights):
        logits = np.where(closed, 1, -1) * (features @ weights)
        return -np.logaddexp(0, -logits).sum() - (weights**2).sum() / (2 * deviation**2)

    for step in (*np.eye(5), *-np.eye(5), np.ones(5)):
        assert penalized(best) > penalized(best + 0.01 * step)


def test_fit_mrf_unknown_cells_do_not_count():
    known = WALL.copy()
    known[:, -1] = -1
    fit, cut = fit_mrf([Grid(known)]), fit_mrf([Grid(WALL[:, :-1])])
    assert fit.cells == cut.cells == 36
    assert fit.lines == pytest.approx(cut.lines)


def test_prior_has_the_weights_of_the_fit():
    fit = fit_mrf([Grid(WALL)])
    prior = fit.prior((2, 3))
    assert prior.field == pytest.approx(np.full(6, fit.field[0]))
    assert prior.weights == pytest.approx([fit.lines, fit.pairs, fit.blocks, fit.isolated])
    assert (fit.prior((2, 3), field=-2.0).field == -2.0).all()


@pytest.mark.parametrize(("maps", "arguments", "match"), [
    ([], {}, "'maps': expected at least 1, found 0"),
    ([Grid(np.zeros((2, 2), dtype=int))], {}, "'maps': expected free and occupied cells"),
    ([Grid(WALL)], {"terms": ["corners"]}, "'terms': expected some of lines, pairs, blocks, isolated, found"),
    ([Grid(WALL)], {"standard_deviation": 0.0}, "'standard_deviation'"),
])  # fmt: skip
def test_fit_mrf_bad_input_is_refused(maps, arguments, match):
    with pytest.raises(InputError, match=match):
        fit_mrf(maps, **arguments)
