"""Eq. 11 by roll-outs beside exact gradients: dynamic programming in a table, moments in a linear-Gaussian world."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import sidestep as ss
import sidestep.continuous as sc
from helpers import small_worlds
from helpers.small_worlds import ACTIONS, GAIN, OFFSET, PLACES, SPREAD, STATES, TASKS, WHICH, Linear, exact_values
from sidestep.continuous.estimators import check_estimator, jackknife, with_control_variates
from sidestep.continuous.policies import ScaledNetwork

BETA, HORIZON = 2.0, 5
TABLE, LINEAR = small_worlds.table(), small_worlds.linear()
SOFT = ss.Behavior(ss.LogSumExp(), BETA)
BEHAVIORS = {"log-sum-exp": SOFT, "Boltzmann": ss.Behavior(ss.BoltzmannAverage(), BETA)}
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(len(PLACES), ACTIONS)))
COUNTS = (10, 60, 500, 4500)
EACH = 10  # rollouts of a candidate for one estimate
MANY = 450  # estimates; always the same number, because each one is compiled for


EVERYWHERE = sc.Starts(sc.task_at(TABLE.tasks, WHICH), PLACES, jnp.broadcast_to(jnp.arange(ACTIONS), WEIGHTS.shape))


@eqx.filter_jit
def estimates(world, behavior, keys, starts, level, tilt, critic=None, estimator="score", horizon=HORIZON):
    """Independent estimates of Σ (level + tilt · Q) ∇Q, in rows; each has `EACH` rollouts of a candidate."""
    agent = sc.Agent(world.dynamics, world.policy, behavior)
    settings = {"horizon": horizon, "samples": EACH, "critic": critic, "estimator": estimator}

    def one(key):
        return ravel_pytree(sc.value_gradient(agent, starts, key, lambda q: level + tilt * q, **settings)[0])[0]

    return jax.lax.map(one, keys, batch_size=50)


def drawn(seed, count, world, behavior, starts, level, tilt=0.0, **settings):
    """`count` estimates, in a plain array."""
    keys = jax.random.split(jax.random.key(seed), count)
    # numbers would be compiled into functions of their own
    return np.asarray(estimates(world, behavior, keys, starts, level, jnp.asarray(tilt), **settings))


def standard_error(sample):
    return sample.std(axis=0, ddof=1) / np.sqrt(len(sample))


def assert_agrees(sample, exact, precision, uncertain=0.0):
    """Within three standard errors and a half in every component, and these are small beside the largest component."""
    error = np.hypot(standard_error(sample), uncertain)
    assert error.max() < precision * np.abs(exact).max()
    # transitions from a terminal state have gradient 0 without noise; those of small ones have rare large estimates
    allowed = 3.5 * error + 0.003 * np.abs(exact).max()
    np.testing.assert_array_less(np.abs(sample.mean(axis=0) - exact), allowed)


def assert_falls_as_root(sample, exact):
    """The root-mean-square error of means over N rollouts falls as 1/√N, for N over 2.6 decades."""
    errors = []
    for count in COUNTS:
        means = sample.reshape(-1, count // EACH, sample.shape[-1]).mean(axis=1)
        errors.append(np.sqrt(((means - exact) ** 2).mean()))
    slope, _ = np.polyfit(np.log(COUNTS), np.log(errors), 1)
    assert slope == pytest.approx(-0.5, abs=0.1)


def critic_of(values) -> sc.Critic:
    """A critic with one value for every task and state of the table world, whatever the fraction left."""
    count = TASKS * STATES + 1
    layer = eqx.nn.Linear(count, 1, use_bias=False, key=jax.random.key(0))
    layer = eqx.tree_at(lambda layer: layer.weight, layer, jnp.append(values, 0)[None])
    return sc.Critic(ScaledNetwork(layer, jnp.zeros(count), jnp.ones(count)), jnp.zeros(()), jnp.ones(()))


@jax.jit
def by_programming(pi, level, tilt, temperature):
    """V of a policy in the table, and Σ (level + tilt · Q) ∇Q, by dynamic programming."""

    def total(parameters):
        values, q = exact_values(TABLE, parameters, pi, HORIZON, small_worlds.entropies(pi) * temperature)
        return jnp.sum(level * q[WHICH, PLACES] + 0.5 * tilt * q[WHICH, PLACES] ** 2), (values, q)

    return jax.grad(total, has_aux=True)(TABLE.dynamics.parameters)


def exact_table(name, world, level, tilt=0.0):
    """The same, with the gradient in a plain array."""
    temperature = 1 / BETA if name == "log-sum-exp" else 0.0
    gradient, (values, q) = by_programming(small_worlds.policy_table(world.policy), level, tilt, temperature)
    return values, q, np.asarray(gradient).ravel()


@pytest.mark.parametrize(("name", "critic"), [
    ("log-sum-exp", "no"), ("log-sum-exp", "an exact"), ("log-sum-exp", "a wrong"), ("Boltzmann", "a wrong"),
])  # fmt: skip
def test_value_gradient_score_in_table_is_unbiased_for_any_critic(name, critic):
    values, _, exact = exact_table(name, TABLE, WEIGHTS)
    wrong = 1 + 0.5 * jnp.asarray(np.random.default_rng(2).normal(size=values.shape))
    critics = {"no": None, "an exact": critic_of(values), "a wrong": critic_of(wrong)}
    sample = drawn(12, MANY, TABLE, BEHAVIORS[name], EVERYWHERE, WEIGHTS, critic=critics[critic])
    assert_agrees(sample, exact, precision=0.03)


@eqx.filter_jit
def quadratic_estimates(keys):
    """Independent estimates of Σ Q² ∇Q in the table, in rows."""
    agent = sc.Agent(TABLE.dynamics, TABLE.policy, SOFT)

    def one(key):
        found, _ = sc.value_gradient(agent, EVERYWHERE, key, jnp.square, horizon=HORIZON, samples=4)
        return ravel_pytree(found)[0]

    return jax.lax.map(one, keys, batch_size=100)


@pytest.mark.slow
def test_value_gradient_quadratic_weights_of_two_rollouts_are_unbiased():
    """The jackknife leaves no bias of a quadratic function; without it, the variance of Q̂ would be added to Q²."""

    def total(parameters):
        pi = small_worlds.policy_table(TABLE.policy)
        _, q = exact_values(TABLE, parameters, pi, HORIZON, small_worlds.entropies(pi) / BETA)
        return jnp.sum(q[WHICH, PLACES] ** 3) / 3

    exact = np.asarray(ravel_pytree(jax.grad(total)(TABLE.dynamics.parameters))[0])
    sample = np.asarray(quadratic_estimates(jax.random.split(jax.random.key(4), 4000)))
    assert_agrees(sample, exact, precision=0.03)


def test_jackknife_of_a_square_subtracts_the_variance_of_the_mean():
    q = jnp.asarray(np.random.default_rng(3).normal(size=(2, 3, 5)))
    expected = np.mean(q, axis=-1) ** 2 - np.var(q, axis=-1, ddof=1) / 5
    np.testing.assert_allclose(jackknife(jnp.square, q), expected)
    np.testing.assert_allclose(jackknife(jnp.square, q[..., :1]), q[..., 0] ** 2)


def test_jackknife_of_a_softmax_has_a_tenth_of_the_bias():
    values, noise = np.array([0.5, 0.0, -1.0]), np.random.default_rng(4).normal(size=(40_000, 3, 4))
    q, right = jnp.asarray(values[:, None] + 0.7 * noise), jax.nn.softmax(jnp.asarray(values))
    plain = jax.nn.softmax(q.mean(axis=-1), axis=1).mean(axis=0) - right
    corrected = jackknife(lambda mean: jax.nn.softmax(mean, axis=1), q).mean(axis=0) - right
    assert np.abs(plain).max() > 0.005
    assert np.abs(corrected).max() < 0.1 * np.abs(plain).max() + 0.001


def test_value_gradient_score_error_falls_as_root_of_rollouts():
    _, _, exact = exact_table("log-sum-exp", TABLE, WEIGHTS)
    assert_falls_as_root(drawn(3, MANY, TABLE, SOFT, EVERYWHERE, WEIGHTS), exact)


@pytest.mark.slow
def test_value_gradient_exact_critic_halves_the_variance():
    world = TABLE
    for _ in range(4):  # nearly to π ∝ exp βQ^π
        values, q, _ = exact_table("log-sum-exp", world, WEIGHTS)
        world = TABLE._replace(policy=small_worlds.with_logits(BETA * q))
    values, _, _ = exact_table("log-sum-exp", world, WEIGHTS)
    draw = partial(drawn, 4, MANY, world, SOFT, EVERYWHERE, WEIGHTS)
    assert draw(critic=critic_of(values)).var(axis=0).sum() < 0.5 * draw().var(axis=0).sum()


def test_with_control_variates_exact_critic_removes_all_noise():
    pi = small_worlds.exact_policy(TABLE, SOFT)
    values, q = exact_values(TABLE, TABLE.dynamics.parameters, pi, 40, small_worlds.entropies(pi) / BETA)
    agent = sc.Agent(TABLE.dynamics, small_worlds.with_logits(jnp.log(pi)), SOFT)

    @eqx.filter_jit
    def estimate(critic):
        rolled = sc.sample_rollouts(agent, EVERYWHERE, jax.random.key(0), horizon=40, samples=20)
        known = with_control_variates(agent, rolled, critic)
        return [sc.q_estimates(each)[..., 0] for each in (rolled, known)]

    plain, known = map(np.asarray, estimate(critic_of(values)))
    assert plain.std(axis=-1).max() > 0.1
    np.testing.assert_allclose(known, np.broadcast_to(q[WHICH, PLACES][..., None], known.shape), atol=1e-3)


def test_value_gradient_control_variate_removes_the_noise_of_a_single_draw():
    """With one move only terminal rewards follow, which are known."""
    pi = small_worlds.policy_table(TABLE.policy)

    def total(parameters):
        _, q = exact_values(TABLE, parameters, pi, 1, small_worlds.entropies(pi) / BETA)
        return jnp.sum(WEIGHTS * q[WHICH, PLACES])

    exact = np.asarray(ravel_pytree(jax.grad(total)(TABLE.dynamics.parameters))[0])
    estimate = partial(drawn, 6, 50, TABLE, SOFT, EVERYWHERE, WEIGHTS, horizon=1)
    known = estimate(critic=critic_of(jnp.zeros((TASKS, STATES))))
    np.testing.assert_allclose(known, np.broadcast_to(exact, known.shape), atol=1e-6)
    assert estimate().std(axis=0).max() > 0.1 * np.abs(exact).max()


def test_value_gradient_weights_are_independent_of_gradients():
    level = jnp.zeros_like(WEIGHTS)
    values, _, exact = exact_table("log-sum-exp", TABLE, level, tilt=1.0)
    sample = drawn(5, MANY, TABLE, SOFT, EVERYWHERE, level, tilt=1.0, critic=critic_of(values))
    assert_agrees(sample, exact, precision=0.03)


CANDIDATES = jnp.asarray([[[0.5], [-1.0]], [[0.0], [1.5]]])
AROUND = sc.Starts(LINEAR.tasks, jnp.asarray([[1.0, 0.5], [-0.5, -1.0]]), CANDIDATES)
WEIGHTS_AROUND = jnp.asarray([[1.0, -0.5], [0.3, 0.8]])


def wrong_critic() -> sc.Critic:
    """A critic for the linear world, with random weights."""
    network = eqx.nn.MLP(3, 1, 8, 1, jnp.tanh, key=jax.random.key(5))
    return sc.Critic(ScaledNetwork(network, jnp.zeros(3), jnp.ones(3)), jnp.asarray(0.5), jnp.asarray(2.0))


def expected_cost(mean, covariance, weight):
    """E[xᵀ weight x]."""
    return mean @ weight @ mean + jnp.trace(weight @ covariance)


def value_by_moments(parameters, task, state, action):
    """Q without bonuses, by the mean and the covariance of later states."""
    shaking, moving = SPREAD**2 * jnp.eye(1), jnp.diag(LINEAR.dynamics.noise**2)
    a, b = parameters["state"], parameters["action"]
    mean, covariance = a @ state + b @ action, moving
    value = task.reward(state, action)
    for power in range(1, HORIZON):
        acting, shaken = GAIN @ (mean - task.goal) + OFFSET, GAIN @ covariance @ GAIN.T + shaking
        cost = expected_cost(mean - task.goal, covariance, task.state_cost)
        value = value - task.discount**power * (cost + expected_cost(acting, shaken, task.action_cost))
        closed = a + b @ GAIN
        mean, covariance = a @ mean + b @ acting, closed @ covariance @ closed.T + b @ shaking @ b.T + moving
    return value


def exact_linear(value, inputs, weights):
    """The gradient of Σ weights · Q, for Q a function of θ, a task, a state and an input."""

    def total(parameters):
        values = jax.vmap(jax.vmap(value, (None, None, None, 0)), (None, 0, 0, 0))
        return jnp.sum(weights * values(parameters, LINEAR.tasks, AROUND.states, inputs))

    return np.asarray(ravel_pytree(jax.jit(jax.grad(total))(LINEAR.dynamics.parameters))[0])


@pytest.fixture(scope="module")
def closed_form():
    return exact_linear(value_by_moments, AROUND.choices, WEIGHTS_AROUND)


@pytest.fixture(scope="module")
def along_paths():
    return drawn(7, 10 * MANY, LINEAR, SOFT, AROUND, WEIGHTS_AROUND, estimator="pathwise")


def test_value_gradient_pathwise_in_linear_world_matches_closed_form(along_paths, closed_form):
    assert_agrees(along_paths, closed_form, precision=0.005)


def test_value_gradient_pathwise_error_falls_as_root_of_rollouts(along_paths, closed_form):
    assert_falls_as_root(along_paths, closed_form)


@pytest.mark.parametrize("critic", [None, wrong_critic()], ids=["no critic", "a wrong critic"])
def test_value_gradient_score_in_linear_world_matches_closed_form_with_more_noise(along_paths, closed_form, critic):
    scores = drawn(8, MANY, LINEAR, SOFT, AROUND, WEIGHTS_AROUND, critic=critic)
    assert_agrees(scores, closed_form, precision=0.1)
    assert (scores.var(axis=0) > 10 * along_paths.var(axis=0)).all()


PUSHES = jnp.asarray([[-1.0], [0.2], [1.0]])
MOVES = 3
PUSHED = replace(AROUND, choices=jnp.broadcast_to(jnp.arange(len(PUSHES)), (2, len(PUSHES))))
PARTS = jnp.asarray([[1.0, -0.5, 0.2], [0.3, 0.8, -1.0]])


def choosing(noise) -> Linear:
    """The linear world with the noise, and a policy over three actions."""
    network = eqx.nn.Linear(2, len(PUSHES), key=jax.random.key(1))
    network = ScaledNetwork(jax.tree.map(lambda leaf: 3.0 * leaf, network), jnp.zeros(2), jnp.ones(2))
    state, action = LINEAR.dynamics.parameters["state"], LINEAR.dynamics.parameters["action"]
    dynamics = sc.LinearGaussian(state, action, jnp.full(2, noise))
    return Linear(dynamics, LINEAR.tasks, sc.FinitePolicy(network, PUSHES))


def value_by_all_paths(policy):
    """Q as the sum over all action sequences, in a world without noise."""

    def value(parameters, task, state, action, moves=MOVES):
        now = task.reward(state, action)
        if moves == 1:
            return now
        after = parameters["state"] @ state + parameters["action"] @ action
        log_probs = policy.log_probs(task.features(after))
        later = [value(parameters, task, after, push, moves - 1) for push in PUSHES]
        return now + task.discount * jnp.exp(log_probs) @ (jnp.stack(later) - log_probs / BETA)

    return value


@pytest.mark.parametrize("critic", [None, wrong_critic()], ids=["no critic", "a wrong critic"])
def test_value_gradient_pathwise_over_finite_actions_matches_exact_sum(critic):
    world = choosing(noise=1e-3)
    exact = exact_linear(value_by_all_paths(world.policy), PUSHES[PUSHED.choices], PARTS)
    sample = drawn(9, MANY, world, SOFT, PUSHED, PARTS, estimator="pathwise", horizon=MOVES, critic=critic)
    assert_agrees(sample, exact, precision=0.03)


def test_value_gradient_pathwise_and_score_agree_over_finite_actions():
    world = choosing(noise=0.3)
    draw = partial(drawn, 10, MANY, world, SOFT, PUSHED, PARTS, horizon=MOVES)
    along_paths, scores = draw(estimator="pathwise"), draw(estimator="score")
    assert_agrees(along_paths, scores.mean(axis=0), precision=0.1, uncertain=standard_error(scores))


def short_gradient(horizon=2, samples=2, **settings):
    """An estimate in the table, by default of two moves and rollouts."""
    problem = sc.Agent(TABLE.dynamics, TABLE.policy, SOFT), EVERYWHERE, jax.random.key(0), jnp.ones_like
    return sc.value_gradient(*problem, horizon=horizon, samples=samples, **settings)


def test_check_estimator_refuses_biased_ones():
    for dynamics, tasks in ((TABLE.dynamics, LINEAR.tasks), (LINEAR.dynamics, TABLE.tasks)):
        check_estimator("score", dynamics, tasks)
        with pytest.raises(ss.InputError, match=r"jump.*expected 'score'"):
            check_estimator("pathwise", dynamics, tasks)
    check_estimator("pathwise", LINEAR.dynamics, LINEAR.tasks)
    with pytest.raises(ss.InputError, match="jump"):
        short_gradient(estimator="pathwise")


@pytest.mark.parametrize(("setting", "value"), [("horizon", 0), ("samples", 0)])
def test_value_gradient_horizon_or_samples_below_1_are_refused(setting, value):
    with pytest.raises(ss.InputError, match=f"{setting}.*at least 1, found {value}"):
        short_gradient(**{setting: value})
