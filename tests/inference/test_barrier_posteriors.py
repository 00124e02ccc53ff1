"""Posteriors of barriers made by hand: what they say of their samples and parts."""

import jax
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.coordinate_ascent import AscentProgress, BarrierMeanField
from sidestep.inference.maximize import Status
from sidestep.inference.sampler import BarrierPosterior, SweepProgress
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid

MODEL, AGENTS = ObstacleGrid(Grid.unknown(1, 4)), behavior_model(Behavior(BoltzmannAverage()))
CHAINS, DRAWS = 2, 6
SAMPLES = np.random.default_rng(0).random((CHAINS, DRAWS, 4)) < 0.5
HEATED, COUNTED = 3, np.arange(6.0)
HISTORY = tuple(
    SweepProgress(number, 9, -9.0 - k, -5.0 - k, -3.0 + k, -1.0 - k, 0.1 * k)
    for number, k in enumerate([100.0] * HEATED + COUNTED.tolist(), 1)
)


def sampled(**changes):
    fields = {
        "model": MODEL,
        "behavior": AGENTS,
        "densities": np.zeros((CHAINS, 0, 2)),
        "sampled": np.array([True, True, True, False]),
        "samples": SAMPLES,
        "closed": SAMPLES.mean(axis=(0, 1)),
        "rhat": np.array([1.0, 1.05, 1.2, 1.0]),
        "effective_sizes": np.array([12.0, 5.0, 3.0, 1.0]),
        "history": HISTORY,
        "status": Status.NOT_MIXED,
    }
    return BarrierPosterior(**(fields | changes))


def mixture(status=Status.CONVERGED):
    parts, weights = np.array([[0.0, 0.2, 1.0], [0.5, 0.9, 0.4]]), np.array([0.3, 0.7])
    history = tuple(AscentProgress(k, 2, -3.0 - k, -2.0, -0.5, -0.5 - k, 0.1 / k) for k in (1, 2))
    return BarrierMeanField(MODEL, AGENTS, np.ones(3, bool), parts, weights, history, status)


def test_final_of_samples_is_the_mean_of_the_sweeps_that_count():
    final, k = sampled().final, COUNTED.mean()
    assert final[:2] == (9, 9)
    np.testing.assert_allclose(final[2:], [-9 - k, -5 - k, -3 + k, -1 - k, 0.1 * k])


def test_fraction_mixed_counts_sampled_barriers_up_to_the_limit():
    assert sampled().fraction_mixed == pytest.approx(2 / 3)
    assert sampled(sampled=np.zeros(4, bool)).fraction_mixed == 1.0


def test_messages_have_the_numbers_of_their_samples():
    assert "for 67% of the sampled barriers, median effective size 5)" in sampled().message
    assert sampled().message.startswith("chains have not mixed (split-R̂ at most 1.05")
    assert sampled(sampled=np.zeros(4, bool)).message == "chains have not mixed (no barrier was unknown)"
    assert sampled().description.startswith("6 samples of each of 2 chains, mean objective -11.5000; chains have not")
    assert HISTORY[-1].description == "objective -14.000, 50.0% of proposals accepted"
    assert mixture().message == "converged (P(closed) is within 0.05 of what the others imply)"
    assert mixture().description == "mean field with objective -5.0000 after 2 sweeps; " + mixture().message
    assert mixture().final.description == "objective -5.000, P(closed) off by at most 0.05"


def test_converged_is_that_of_the_status():
    assert not sampled().converged
    assert sampled(status=Status.MIXED).converged
    assert mixture().converged
    assert not mixture(Status.MAX_ITERATIONS).converged


@pytest.mark.parametrize(("most", "kept"), [(12, range(6)), (11, (1, 3, 5)), (6, (1, 3, 5)), (4, (2, 5)), (2, (5,))])
def test_thinned_keeps_draws_at_equal_distances(most, kept):
    expected = [SAMPLES[chain, draw] for chain in range(CHAINS) for draw in kept]
    np.testing.assert_array_equal(sampled().thinned(most), expected)


def test_sample_draws_maps_of_all_chains():
    drawn = sampled().sample(jax.random.key(0), 4000)
    maps, counts = np.unique(SAMPLES.reshape(-1, 4), axis=0, return_counts=True)
    for each, count in zip(maps, counts, strict=True):
        assert (drawn == each).all(axis=1).mean() == pytest.approx(count / 12, abs=0.04)
    for one in (sampled(), mixture()):
        with pytest.raises(InputError, match="count"):
            one.sample(jax.random.key(0), 0)
        assert len(one.sample(jax.random.key(0), 1)) == 1


def test_sample_of_a_mixture_takes_barriers_of_one_part():
    one = mixture()
    np.testing.assert_allclose(one.closed, [0.35, 0.69, 0.58])
    drawn, count = one.sample(jax.random.key(0), 20_000), 20_000
    np.testing.assert_allclose(drawn.mean(axis=0), one.closed, atol=5 * np.sqrt(0.25 / count))
    # barriers of a part are independent, those of the mixture are not
    both = one.weights @ (one.parts[:, 0] * one.parts[:, 1])
    assert (drawn[:, 0] & drawn[:, 1]).mean() == pytest.approx(both, abs=5 * np.sqrt(0.25 / count))


def test_summaries_have_the_numbers_by_name():
    summary, k = sampled().summary(), COUNTED.mean()
    expected = {
        "objective": -9 - k,
        "log_likelihood_actions": -5 - k,
        "log_likelihood_transitions": -3 + k,
        "log_prior": -1 - k,
        "chains": 2,
        "draws": 6,
        "iterations": 9,
        "accepted": 0.1 * k,
        "largest_rhat": 1.2,
        "fraction_mixed": 2 / 3,
        "smallest_effective_size": 1.0,
    }
    assert {name: summary[name] for name in expected} == pytest.approx(expected)
    assert (summary["converged"], summary["message"]) == (False, sampled().message)
    assert summary.keys() == {*expected, "converged", "message"}
    assert sampled(rhat=np.array([1.0, np.inf, 1.0, 1.0])).summary()["largest_rhat"] is None
    densities = np.random.default_rng(1).normal(size=(CHAINS, DRAWS, 2))
    found = sampled(densities=densities).summary()
    for column, name in enumerate(("prior_density", "prior_strength")):
        own = densities[..., column]
        assert found[name] == pytest.approx({"mean": own.mean(), "deviation": own.std()})
    ascent = mixture().summary()
    assert (ascent["objective"], ascent["log_prior"], ascent["converged"]) == (-5.0, -2.5, True)
    assert ascent["message"] == mixture().message
