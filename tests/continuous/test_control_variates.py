"""Control variates of values that jump where a task ends: their mean, what they remove, and that of smooth values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from sidestep.continuous.control_variates import Mixture, ValueFunction, score_variate, transition_variate

EDGE, PAYMENT, NOISE = 0.3, 2.0, 0.5
POINTS = np.linspace(-5.0, 5.0, 2001)
JUMP = ValueFunction(lambda s: -1.0 + 0.5 * s[0], lambda s: s[0] > EDGE, lambda s: PAYMENT + 0.0 * s[0])
MEANS = {"goes on": [0.1], "has ended": [0.4], "either": [0.1, 0.4]}
KEYS = jax.random.split(jax.random.key(0), 4000)


def mixture(shift=0.0, means=(0.1,)) -> Mixture:
    """Outcomes that are equally probable; all means are shifted."""
    return Mixture(jnp.full(len(means), -jnp.log(len(means))), jnp.asarray(means)[:, None] + shift, jnp.full(1, NOISE))


def density(means):
    return np.mean([norm.pdf(POINTS, mean, NOISE) for mean in means], axis=0) * (POINTS[1] - POINTS[0])


def over_keys(function):
    """The mean over keys at every point, and the standard deviation over keys: all of one jitted program."""
    values = np.asarray(jax.jit(lambda: jax.vmap(lambda s: jax.vmap(lambda key: function(s, key))(KEYS[:200]))(NEXT))())
    return values.mean(axis=1), values.std(axis=1)


NEXT = jnp.asarray(POINTS)[:, None]


def test_value_function_of_a_state_where_the_task_ends_is_that_at_the_end():
    assert [float(JUMP(jnp.full(1, s))) for s in (0.2, 0.4)] == pytest.approx([-0.9, PAYMENT])
    shifted = JUMP.times(jnp.asarray(0.5), plus=jnp.asarray(3.0))
    assert [float(shifted(jnp.full(1, s))) for s in (0.2, 0.4)] == pytest.approx([2.55, 4.0])
    assert float(ValueFunction(lambda s: s[0])(jnp.full(1, 7.0))) == 7


@pytest.mark.parametrize("name", MEANS)
def test_transition_variate_of_a_jump_has_mean_0_and_leaves_no_noise_of_the_value(name):
    """The value is linear but for its jump: with one outcome, the rest is the noise of 16 draws of the jump."""
    means = MEANS[name]
    each, spread = over_keys(lambda s, key: transition_variate(JUMP, mixture(means=means), s, key))
    masses, value = density(means), np.where(POINTS > EDGE, PAYMENT, -1 + 0.5 * POINTS)
    error = spread.mean() / np.sqrt(200)  # all points share the keys
    assert masses @ each == pytest.approx(0, abs=4 * error)
    if len(means) == 1:
        np.testing.assert_allclose(each, value - masses @ value, atol=4 * error)
    jump = PAYMENT - (-1 + 0.5 * POINTS)
    mean = np.asarray(means)[:, None]
    weights = np.stack([norm.pdf(POINTS, one, NOISE) for one in means]) * (POINTS[1] - POINTS[0])
    differs = np.where((POINTS > EDGE) == (mean > EDGE), 0.0, np.sign(POINTS - EDGE) * jump)
    variances = (weights * differs**2).sum(axis=1) - (weights * differs).sum(axis=1) ** 2
    expected = np.sqrt(variances.sum() / 16) / len(means)
    assert spread[0] == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize("name", MEANS)
def test_score_variate_of_a_jump_has_mean_0_and_the_score_of_the_value(name):
    means = MEANS[name]

    def slope(state, key):
        return jax.grad(lambda shift: score_variate(JUMP, mixture(shift, means), state, key))(0.0)

    each, spread = over_keys(slope)
    masses, error = density(means), spread.mean() / np.sqrt(200)
    assert masses @ each == pytest.approx(0, abs=4 * error)
    if len(means) == 1:
        value = np.where(POINTS > EDGE, PAYMENT, -1 + 0.5 * POINTS)
        score = (POINTS - means[0]) / NOISE**2
        np.testing.assert_allclose(each, score * value - masses @ (score * value), atol=4 * error)


def test_variates_of_a_value_without_an_end_draw_nothing():
    smooth = ValueFunction(lambda s: jnp.sin(s[0]))
    for function in (transition_variate, score_variate):
        first, second = (float(function(smooth, mixture(), jnp.full(1, 0.7), key)) for key in KEYS[:2])
        assert first == second
    assert float(transition_variate(smooth, mixture(), jnp.full(1, 0.7), KEYS[0])) == pytest.approx(0.6 * np.cos(0.1))
