"""`HierarchicalMRF`: its normalizers beside sums over all maps, and its posterior beside enumeration."""

from itertools import product

import numpy as np
import pytest

from helpers.barrier_worlds import world
from sidestep.errors import InputError
from sidestep.inference.enumeration import enumerate_barriers
from sidestep.inference.hierarchical import (
    HierarchicalMRF,
    as_hierarchical,
    evidence_normalizers,
    hierarchical_mrf,
    log_normalizers,
)
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.sampler import sample_barriers
from sidestep.tabular.grid import Cell

MAPS = np.array(list(product([False, True], repeat=12)))


def log_sums(prior: HierarchicalMRF, maps: np.ndarray) -> np.ndarray:
    """Return log Z(δ, λ) by a sum over maps."""
    return np.logaddexp.reduce([prior.log_densities(closed) - prior.log_prior for closed in maps])


def small_prior(most_crossed: float = 3.0) -> HierarchicalMRF:
    shapes = BinaryMRF(np.full(12, -0.5), (3, 4), lines=1.0, blocks=-1.5, isolated=-0.5)
    log_odds, strengths = np.array([-2.0, -0.5, 1.0]), np.linspace(0, 1.5, 7)
    varied = np.arange(12) > 1
    field = np.where(varied, 0.0, 0.7)
    return HierarchicalMRF(shapes, field, varied, log_odds, strengths, np.zeros((3, 7)), most_crossed)


def test_log_normalizers_of_all_cells_equal_sums_over_maps():
    prior = small_prior()
    found = log_normalizers(prior, np.arange(12), np.zeros(12, bool), seed=0)
    np.testing.assert_allclose(found, log_sums(prior, MAPS), atol=0.2)


def test_log_normalizers_given_some_cells_equal_sums_over_the_others():
    prior, closed = small_prior(), np.arange(12) == 5
    free = np.array([cell for cell in range(12) if cell not in (5, 6)])
    found = log_normalizers(prior, free, closed, seed=0)
    np.testing.assert_allclose(found, log_sums(prior, MAPS[MAPS[:, 5] & ~MAPS[:, 6]]), atol=0.2)


def test_log_normalizers_without_shapes_are_those_of_independent_barriers():
    prior = hierarchical_mrf(np.array([np.nan] * 3 + [0.4]))
    found = log_normalizers(prior, np.arange(4), np.zeros(4, bool), seed=0)
    expected = 3 * np.log1p(np.exp(prior.log_odds)) + np.log1p(np.exp(0.4))
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-12)


@pytest.mark.parametrize(("most_crossed", "part"), [(2.0, 2 / 4), (0.1, 12 / 36 / 4)])
def test_evidence_normalizers_count_crossed_cells_by_their_weight(most_crossed, part):
    """Of 4 crossed cells, 2 or a 36th of the 12 count: log Z is between that of cells not crossed and that of all."""
    known = np.full(12, int(Cell.UNKNOWN))
    free = np.arange(4, 12)
    found = evidence_normalizers(small_prior(most_crossed), known, free, seed=0)
    given = log_sums(small_prior(), MAPS[~MAPS[:, :4].any(axis=1)])
    np.testing.assert_allclose(found, (1 - part) * given + part * log_sums(small_prior(), MAPS), atol=0.2)


def test_as_hierarchical_has_the_density_of_the_prior():
    prior = BinaryMRF(np.linspace(-1, 1, 12), (3, 4), lines=0.5, pairs=0.2)
    found = as_hierarchical(prior).log_densities(MAPS[77])
    np.testing.assert_allclose(found, [[prior.log_density(MAPS[77])]], rtol=1e-12)
    assert as_hierarchical(prior).at(0.0, 1.0).log_density(MAPS[77]) == prior.log_density(MAPS[77])


def test_at_a_density_and_strength_has_the_density_of_the_field():
    prior = small_prior()
    of_field = np.array([prior.at(1.0, 0.75).log_density(closed) for closed in MAPS[::97]])
    np.testing.assert_allclose(of_field, [prior.log_densities(closed)[2, 3] for closed in MAPS[::97]], rtol=1e-12)


@pytest.mark.slow
def test_sample_barriers_with_unknown_density_has_the_exact_probabilities():
    """With half of the chains' density wrong, cells that no walk informs about would err by tenths."""
    one = world("4 moves")
    shapes = BinaryMRF(np.full(16, -0.5), (4, 4), lines=1.0, blocks=-1.5, isolated=-0.5)
    unsure = np.zeros((3, 7))
    prior = HierarchicalMRF(
        shapes, np.zeros(16), np.ones(16, bool), np.array([-2.0, 0.0, 2.0]), np.linspace(0, 1.5, 7), unsure
    )
    exact = enumerate_barriers(*one.problem, prior).closed
    known_density = enumerate_barriers(*one.problem, prior.at(2.0, 0.0)).closed
    found = sample_barriers(*one.problem, prior=prior, sweeps=3000)
    sampled = found.sampled
    assert np.abs(found.closed - exact)[sampled].mean() < 0.03
    assert np.abs(known_density - exact)[sampled].mean() > 0.1
    assert 0 < found.summary()["prior_density"]["deviation"] < 2
    known = sample_barriers(*one.problem, prior=prior.at(-2.0, 0.75), sweeps=12)
    assert "prior_density" not in known.summary()


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"strengths": np.linspace(0.5, 1, 7)}, "strengths"),
        ({"strengths": np.array([0.0, 1, 0.5, 2, 3, 4, 5])}, "strengths"),
        ({"log_odds": np.array([0.0, 1.0, np.nan])}, "log_odds"),
        ({"log_prior": np.full((3, 7), np.inf)}, "log_prior"),
        ({"field": np.full(12, np.nan)}, "field"),
        ({"most_crossed": -1.0}, "most_crossed"),
        ({"strengths": np.ones(1), "log_prior": np.zeros((3, 1))}, "strengths"),
    ],
)
def test_hierarchical_mrf_with_numbers_out_of_range_is_refused(changes, field):
    good = {name: getattr(small_prior(), name) for name in ("shapes", "field", "varied", "log_odds", "strengths")}
    with pytest.raises(InputError) as error:
        HierarchicalMRF(**{**good, "log_prior": np.zeros((3, 7)), **changes})
    assert error.value.field == field
