"""The Gaussian prior by hand, and what it refuses."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.priors import Normal


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
