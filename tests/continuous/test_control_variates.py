"""Control variates of values that jump where a task ends: their mean, what they remove, and that of smooth values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector
from sidestep.continuous.control_variates import Mixture, score_variate, transition_variate

EDGE, NOISE = 0.3, 0.5
POINTS = np.linspace(-5.0, 5.0, 2001)
NEXT = jnp.asarray(POINTS)[:, None]
JUMP = sc.ValueFunction(lambda s: -1.0 + 0.5 * s[0], lambda s: s[0] > EDGE, lambda s: 2.0 + jnp.sin(s[0]))
VALUE = np.where(POINTS > EDGE, 2 + np.sin(POINTS), -1 + 0.5 * POINTS)
KEYS = jax.random.split(jax.random.key(0), 20_000)
OUTCOMES = pytest.mark.parametrize(("means", "chances"), [((0.1,), (1.0,)), ((0.4,), (1.0,)), ((0.1, 0.4), (0.3, 0.7))])


def mixture(means, chances, shift=0.0) -> Mixture:
    """The outcomes; `shift` moves all means, and the logit of the last outcome."""
    logits = jnp.log(jnp.asarray(chances)) + shift * (jnp.arange(len(means)) == len(means) - 1)
    return Mixture(jax.nn.log_softmax(logits), jnp.asarray(means)[:, None] + shift, jnp.full(1, NOISE))


def masses(means):
    """The probability of each point, for each outcome."""
    return np.stack([norm.pdf(POINTS, mean, NOISE) for mean in means]) * (POINTS[1] - POINTS[0])


def over_keys(function):
    """The mean over keys at every point, the standard deviation, and the error of the mean.

    What keys change is the same at every point.
    """
    at_points = jax.jit(jax.vmap(lambda state: function(state, KEYS[0])))(NEXT)
    of_keys = np.asarray(jax.jit(jax.vmap(lambda key: function(NEXT[0], key)))(KEYS))
    spread = of_keys.std()
    return np.asarray(at_points) + of_keys.mean() - of_keys[0], spread, spread / np.sqrt(len(KEYS))


def test_value_function_of_a_state_where_the_task_ends_is_that_at_the_end():
    assert [float(JUMP(jnp.full(1, s))) for s in (0.2, 0.4)] == pytest.approx([-0.9, 2 + np.sin(0.4)])
    half = JUMP.times(jnp.asarray(0.5), plus=jnp.asarray(3.0))
    assert [float(half(jnp.full(1, s))) for s in (0.2, 0.4)] == pytest.approx([2.55, 4 + np.sin(0.4) / 2])
    assert float(sc.ValueFunction(lambda s: s[0])(jnp.full(1, 7.0))) == 7


@OUTCOMES
def test_transition_variate_of_a_jump_has_mean_0_and_the_noise_of_16_draws(means, chances):
    each, spread, error = over_keys(lambda s, key: transition_variate(JUMP, mixture(means, chances), s, key))
    of_outcomes = masses(means)
    total = np.asarray(chances) @ of_outcomes
    assert total @ each == pytest.approx(0, abs=4 * error)
    if len(means) == 1:  # the value is linear but for its end: nothing else is left
        np.testing.assert_allclose(each, VALUE - total @ VALUE, atol=4 * error)
    ended = [mean > EDGE for mean in means]
    tangents = [
        2 + np.sin(mean) + np.cos(mean) * (POINTS - mean) if over else -1 + 0.5 * POINTS
        for mean, over in zip(means, ended, strict=True)
    ]
    jumps = VALUE - np.stack(tangents)
    variances = (of_outcomes * jumps**2).sum(axis=1) - (of_outcomes * jumps).sum(axis=1) ** 2
    assert spread == pytest.approx(np.sqrt(np.asarray(chances) ** 2 @ variances / 16), rel=0.05)


@OUTCOMES
def test_score_variate_of_a_jump_has_mean_0_and_the_score_of_the_value(means, chances):
    def slope(state, key):
        return jax.grad(lambda shift: score_variate(JUMP, mixture(means, chances, shift), state, key))(0.0)

    each, _, error = over_keys(slope)
    total = np.asarray(chances) @ masses(means)
    assert total @ each == pytest.approx(0, abs=4 * error)
    if len(means) == 1:
        score = (POINTS - means[0]) / NOISE**2
        np.testing.assert_allclose(each, score * VALUE - total @ (score * VALUE), atol=4 * error)


def test_variates_of_a_value_without_an_end_draw_nothing():
    smooth, one = sc.ValueFunction(lambda s: jnp.sin(s[0])), mixture((0.1,), (1.0,))
    for function in (transition_variate, score_variate):
        first, second = (float(function(smooth, one, jnp.full(1, 0.7), key)) for key in KEYS[:2])
        assert first == second
    assert float(transition_variate(smooth, one, jnp.full(1, 0.7), KEYS[0])) == pytest.approx(0.6 * np.cos(0.1))


# Estimates by rollouts: s′ = s + a + θ + noise · ε, to a goal around 0; two moves, and a critic that is wrong

WAYS, SPEED, START, DISCOUNT, RADIUS = jnp.array([[-1.0], [1.0]]), 0.2, 1.3, 0.9, 0.6
GOAL = sc.ReachTask(
    goal=jnp.zeros(1),
    radius=jnp.asarray(RADIUS),
    step_cost=jnp.asarray(1.0),
    goal_reward=jnp.asarray(2.0),
    discount=jnp.asarray(DISCOUNT),
)
EXAMPLES = jax.vmap(GOAL.features)(jnp.linspace(-2, 2, 9)[:, None])
POLICY = sc.finite_policy(jax.random.key(3), WAYS, EXAMPLES, width=4)


def arrives(places, speed):
    """The probability that a move from these places, the action added, ends at the goal."""
    above, below = (RADIUS - places - speed) / NOISE, (-RADIUS - places - speed) / NOISE
    return jax.scipy.stats.norm.cdf(above) - jax.scipy.stats.norm.cdf(below)


def action_values(speed):
    """Q of both actions of agents that look two moves ahead, by a sum over next states."""
    step = POINTS[1] - POINTS[0]
    later = jnp.exp(jax.vmap(lambda s: POLICY.log_probs(GOAL.features(s)))(NEXT))
    after = jnp.sum(later * (-1 + DISCOUNT * 2 * arrives(NEXT + WAYS.T, speed)), axis=1)
    worth = jnp.where(jnp.abs(NEXT[:, 0]) <= RADIUS, 0.0, after)
    means = START + WAYS[:, 0, None] + speed
    goes_on = jax.scipy.stats.norm.pdf(POINTS, means, NOISE) @ worth * step
    return -1 + DISCOUNT * (2 * arrives(START + WAYS[:, 0], speed) + goes_on)


def test_value_gradient_near_a_goal_with_a_wrong_critic_is_that_of_a_sum():
    agent = sc.Agent(Drift(vector(SPEED), vector(NOISE)), POLICY, ss.Behavior(ss.HardMax()))
    critic = sc.make_critic(jax.random.key(5), EXAMPLES, jnp.ones(9), jnp.ones(9))
    starts = sc.Starts(sc.batch_tasks([GOAL]), jnp.full((1, 1), START), jnp.arange(2)[None])

    @jax.jit
    @jax.vmap
    def estimate(key):
        gradient, rollouts = sc.value_gradient(agent, starts, key, jnp.ones_like, horizon=2, samples=500, critic=critic)
        return gradient, sc.q_estimates(rollouts)[0, :, :, 0].mean(axis=-1), rollouts.seeds

    gradient, q, seeds = map(np.asarray, estimate(jax.random.split(jax.random.key(1), 40)))
    for found, expected in (
        (q, np.asarray(action_values(SPEED))),
        (gradient, jax.jacfwd(action_values)(SPEED).sum()),
    ):
        error = found.std(axis=0) / np.sqrt(len(found))
        assert (np.abs(found.mean(axis=0) - expected) <= 4 * error + 1e-3).all()
        assert error.max() < 0.05
    # candidates share their draws, other moves have draws of their own
    assert (seeds[:, :, 0] == seeds[:, :, 1]).all()
    assert len(np.unique(seeds)) > 0.999 * seeds[:, :, 0].size
