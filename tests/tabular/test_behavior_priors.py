"""The prior of what is learned of behavior, beside normal densities without their constants."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.behavior_model import LEARNABLE, behavior_model

AIMS = np.array([[0, 1], [0, 1]])
MODEL = behavior_model(
    Behavior(LogSumExp(), 4.0),
    LEARNABLE,
    discount=0.9,
    person=np.array([0, 1, 1, 2]),
    features=np.ones((2, 1, 3)),
    reward_weights=[0.1, 0.2, 0.3],
    aimed_at=AIMS,
)


def density_after(field, change):
    """The log-density after one field of the parameters has changed."""
    moved = getattr(MODEL.parameters, field) + jnp.asarray(change)
    return float(MODEL.with_parameters(MODEL.parameters._replace(**{field: moved})).log_density())


def test_log_density_at_the_start_is_0():
    assert float(MODEL.log_density()) == pytest.approx(0, abs=1e-24)


def test_log_density_of_persons_betas_has_spread_1_of_their_mean_and_a_half_of_each():
    """The mean moves by .4, and the three persons lie .5, −.7 and .2 from it."""
    differences = np.array([0.5, -0.7, 0.2])
    expected = -(0.4**2) / 2 - np.sum((differences / 0.5) ** 2) / 2
    assert density_after("log_beta", 0.4 + differences) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("field", "change", "spread"), [
    ("logit_lapse", -1.3, 1.0),
    ("logit_discount", 0.7, 1.0),
    ("reward_weights", [0.5, -1.0, 0.25], 1.0),
    ("cost_parameters", [3.0, -1.0], 2.0),
])  # fmt: skip
def test_log_density_of_other_numbers_is_normal_around_the_start(field, change, spread):
    expected = -np.sum((np.asarray(change) / spread) ** 2) / 2
    assert density_after(field, change) == pytest.approx(expected, rel=1e-12)
