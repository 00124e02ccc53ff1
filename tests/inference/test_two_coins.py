"""Diagnostics of the No-U-Turn sampler for several numbers: two coins, one of which was never tossed."""

import jax
import numpy as np
import pytest

from sidestep.inference.fit import fit
from sidestep.inference.nuts import sample
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import graph
from sidestep.tabular.models import FIXED, TiedModel
from sidestep.tabular.tasks import task


@pytest.mark.slow
def test_sample_of_several_numbers_has_diagnostics_of_each():
    world = graph([[[1, 0]], [[2, 1]], [[2, 2]]])
    coins = TiedModel(world, np.array([[[0, FIXED]], [[1, FIXED]], [[FIXED, FIXED]]]))
    end = task(np.array([-1.0, -1.0, 0.0]), 0.9, np.array([False, False, True]))
    walk = Trajectory(np.array([0, 0, 1]), np.zeros(2, int), task=0, truncated=True)
    shown = gather([walk] * 3, [end])
    learned = fit(coins, shown, Behavior(BoltzmannAverage()), prior=Normal(0.5, 1.0), terms=("transitions",))
    draws = sample(learned, jax.random.key(0), 400, chains=2, warmup=150)
    theta = np.asarray(draws.parameters.model)
    assert theta.shape == (2, 400, 2)
    for each in (draws.rhat.model, draws.effective_sizes.model):
        assert np.shape(each) == (2,)
    assert (np.asarray(draws.rhat.model) < 1.1).all()
    assert (np.asarray(draws.effective_sizes.model) > 50).all()
    # what nothing was seen of is as in the prior, also in its spread
    np.testing.assert_allclose(theta[..., 1].mean(), 0.5, atol=0.25)
    np.testing.assert_allclose(theta[..., 1].std(), 1.0, rtol=0.2)
