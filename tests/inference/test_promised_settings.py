"""Settings that the documentation gives numbers for, and how often a checkpoint is saved."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.chain_evidence import PASSING
from sidestep.inference.checkpoints import Checkpoint, Saver
from sidestep.inference.hierarchical import as_hierarchical, hierarchical_mrf
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.priors import MIN_PROBABILITY, Normal


def test_min_probability_is_a_quarter_of_a_gray_level():
    assert pytest.approx(1 / 255 / 4) == MIN_PROBABILITY


def test_normal_by_default_is_the_penalty_of_the_paper():
    """−Σ (θ + 2)²/4."""
    theta = np.array([-2.0, 0.0, 3.0])
    assert float(Normal().log_density(jnp.asarray(theta))) == pytest.approx(-((theta + 2) ** 2).sum() / 4)


def test_binary_mrf_without_weights_is_independent():
    field = np.array([0.3, -1.0, 2.0, 0.5])
    for closed in (np.ones(4, bool), np.array([True, False, True, False])):
        assert BinaryMRF(field, (2, 2)).log_density(closed) == pytest.approx(field[closed].sum())


def test_passing_is_a_probability_and_its_complement():
    assert sum(PASSING) == pytest.approx(1)
    assert PASSING[0] > 0.99


def test_hierarchical_prior_has_known_log_odds_and_varies_the_others():
    """A closed cell of varied density loses 9/4 of log-odds for each unit of strength."""
    prior = hierarchical_mrf(np.array([np.nan, 0.7, np.nan, -0.2]), (2, 2), lines=0.5)
    for odds in (-0.5, 1.0):
        for strength in (0.0, 0.75):
            at = prior.at(odds, strength)
            np.testing.assert_allclose(at.field, [odds - 2.25 * strength, 0.7, odds - 2.25 * strength, -0.2])
            np.testing.assert_allclose(at.weights[0], 0.5 * strength)
    modes = prior.log_prior
    at_density, at_strength = np.unravel_index(modes.argmax(), modes.shape)
    assert prior.log_odds[at_density] == pytest.approx(-0.25)  # the value nearest to −.3
    assert prior.strengths[at_strength] == pytest.approx(1.0)


def test_as_hierarchical_of_a_known_prior_has_one_density_and_strength():
    known = BinaryMRF(np.array([0.3, -1.0]), (1, 2), pairs=0.4)
    prior = as_hierarchical(known)
    assert prior.log_prior.shape == (1, 1)
    np.testing.assert_allclose(prior.at(0.0, 1.0).field, known.field)
    assert as_hierarchical(prior) is prior


def test_saver_saves_again_only_after_its_interval(tmp_path):
    path, like = tmp_path / "often", np.zeros(1)
    often, rarely = Saver(Checkpoint(path, 0.0, 1.0), "fit"), Saver(Checkpoint(tmp_path / "rarely", 1e6), "fit")
    for number in (1.0, 2.0):
        for saver in (often, rarely):
            saver.save(np.full(1, number), [[number]])
    for saver, last in ((often, 2.0), (rarely, 1.0)):
        state, history, _ = saver.load(like)
        assert (float(state[0]), history) == (last, [[last]])


@pytest.mark.parametrize("setting", [{"max_fraction": 0.0}, {"max_fraction": 1.01}, {"min_interval": -1.0}])
def test_saver_of_a_checkpoint_with_numbers_out_of_range_raises(tmp_path, setting):
    with pytest.raises(InputError, match=next(iter(setting))):
        Saver(Checkpoint(tmp_path / "file", **setting), "fit")
    Saver(Checkpoint(tmp_path / "file", 0.0, 1.0), "fit")


def test_saver_without_a_file_begins_anew_and_without_a_checkpoint_raises(tmp_path):
    state, history, optional = Saver(tmp_path / "none", "fit").load(np.ones(2), np.ones(3))
    np.testing.assert_array_equal(state, np.ones(2))
    np.testing.assert_array_equal(optional, np.ones(3))
    assert history == []
    Saver(None, "fit").save(np.ones(2), [])
    with pytest.raises(InputError, match="resume"):
        Saver(None, "fit").load(np.ones(2))
