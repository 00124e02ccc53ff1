"""The No-U-Turn sampler, beside a posterior that is computed on a grid."""

import sys
from typing import Any

import jax
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.fit import Fit, fit
from sidestep.inference.laplace import laplace
from sidestep.inference.nuts import sample
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import graph
from sidestep.tabular.models import FIXED, TiedModel
from sidestep.tabular.tasks import task

SUCCESSES, FAILURES, VARIANCE = 2, 5, 2.0


def fit_of_coin() -> Fit:
    """An action that succeeds with the unknown probability σ(θ)."""
    coin = TiedModel(graph(np.array([[[1, 0]], [[1, 1]]])), np.array([[[0, FIXED]], [[0, FIXED]]]))
    walks = [Trajectory(np.repeat([0, 1], [FAILURES + 1, 1]), np.zeros(FAILURES + 1, int), task=0)]
    walks += [Trajectory(np.array([0, 1]), np.array([0]), task=0)] * (SUCCESSES - 1)
    shown = gather(walks, [task(np.array([-1.0, 0.0]), 0.9, np.array([False, True]))])
    return fit(coin, shown, Behavior(BoltzmannAverage()), prior=Normal(0.0, VARIANCE))


@pytest.mark.slow
def test_sample_has_the_moments_of_the_posterior():
    draws = sample(fit_of_coin(), jax.random.key(0), 1_000, chains=4, warmup=200)
    grid = np.linspace(-9, 9, 20_001)
    log_posterior = SUCCESSES * grid - (SUCCESSES + FAILURES) * np.logaddexp(0, grid) - grid**2 / (2 * VARIANCE)
    weights = np.exp(log_posterior - log_posterior.max())
    mean = np.average(grid, weights=weights)
    deviation = np.average((grid - mean) ** 2, weights=weights) ** 0.5
    theta = np.asarray(draws.parameters.model)
    assert theta.shape == (4, 1_000, 1)
    np.testing.assert_allclose(theta.mean(), mean, atol=0.1 * deviation)
    np.testing.assert_allclose(theta.std(), deviation, rtol=0.1)
    assert float(draws.rhat.model[0]) < 1.02
    assert 500 < float(draws.effective_sizes.model[0]) < 8_000
    assert not draws.divergent.any()


@pytest.mark.slow
def test_to_arviz_has_chains_and_draws():
    result = fit_of_coin()
    draws: Any = sample(result, jax.random.key(0), 10, chains=2, warmup=20).to_arviz()
    assert dict(draws.posterior.sizes)["draw"] == 10
    assert draws.sample_stats["diverging"].shape == (2, 10)
    normal: Any = laplace(result).to_arviz(jax.random.key(0), 7)
    assert normal.posterior["model"].shape == (1, 7, 1)


def test_sample_without_the_extra_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(InputError, match=r"^sample: needs blackjax.*pip install 'sidestep\[samplers\]'"):
        sample(fit_of_coin(), jax.random.key(0))


def test_to_arviz_without_the_extra_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(InputError, match=r"^to_arviz: needs arviz.*pip install 'sidestep\[samplers\]'"):
        laplace(fit_of_coin()).to_arviz(jax.random.key(0))


@pytest.mark.parametrize(("counts", "field"), [({"n": 3}, "n"), ({"chains": 0}, "chains"), ({"warmup": 0}, "warmup")])
def test_sample_with_wrong_counts_raises(counts, field):
    with pytest.raises(InputError, match=f"'{field}'"):
        sample(fit_of_coin(), jax.random.key(0), **counts)
