"""Dynamics: samples have the stated density, and each family follows its equations."""

from functools import cache, partial
from typing import NamedTuple

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy import stats

import sidestep as ss
import sidestep.continuous as sc
from helpers import families
from helpers.families import EVERY, GAUSSIAN, HIGH, LINEAR, LOW, NOISE, PLACE, STEP, TABLE, WALLS, vector
from sidestep.continuous.control_variates import ValueFunction

outcomes = eqx.filter_jit(lambda dynamics, state, action: dynamics.outcomes(state, action))
log_prob = eqx.filter_jit(lambda dynamics, *move: dynamics.log_prob(*move))

JUMPING = {"stopping", "network, stopping", "walls", "gusts", "table"}
SAMPLES = 20_000
gaussian = pytest.mark.parametrize("name", GAUSSIAN)
every = pytest.mark.parametrize("name", EVERY)


class Evaluation(NamedTuple):
    """A family at one state and action, compiled once.

    `log_probs` and `variates` (of a curved function) are at `points`, `linear` (variates of a linear function) at
    `samples`. `slope` and `differences` are the gradient of a log-probability; `moved` is the change of a sample.
    """

    samples: np.ndarray
    points: np.ndarray
    log_probs: np.ndarray
    slope: np.ndarray
    differences: np.ndarray
    variates: np.ndarray
    linear: np.ndarray
    of_scores: np.ndarray
    moved: np.ndarray


@cache
def evaluate(name) -> Evaluation:
    dynamics, state, action = EVERY[name]
    points = np.arange(4) if name == "table" else np.zeros((1, 1)) if name == "Laplace" else around(*EVERY[name])
    flat, to_parameters = ravel_pytree(dynamics.parameters)
    steps = 1e-5 * jnp.eye(len(flat))

    def at(flat):
        return dynamics.with_parameters(to_parameters(flat))

    @jax.jit
    def compute(keys, points, steps):
        samples = jax.vmap(dynamics.sample, (0, None, None))(keys, state, action)
        log_probs = jax.vmap(dynamics.log_prob, (None, None, 0))(state, action, points)
        slope = jax.grad(lambda flat: at(flat).log_prob(state, action, samples[0]))(flat)
        beside = jax.vmap(lambda flat: at(flat).log_prob(state, action, samples[0]))(flat + steps)
        variate = partial(dynamics.transition_control_variate, key=keys[0])
        variates = jax.vmap(variate, (None, None, None, 0))(ValueFunction(curved), state, action, points)
        linear = jax.vmap(variate, (None, None, None, 0))(ValueFunction(straight), state, action, samples)
        scored = ValueFunction(curved), state, action
        of_score = jax.grad(lambda flat, point: at(flat).score_control_variate(*scored, point, keys[0]))
        of_scores = jax.vmap(of_score, (None, 0))(flat, points)
        moved = at(flat + 0.1).sample(keys[0], state, action) - samples[0]
        return samples, log_probs, slope, beside, variates, linear, of_scores, moved

    keys = jax.random.split(jax.random.key(0, impl="unsafe_rbg"), SAMPLES)  # good enough, and compiles quickly
    both = jnp.concatenate([steps, -steps])
    samples, log_probs, slope, beside, *variates, moved = compute(keys, jnp.asarray(points), both)
    differences = (beside[: len(flat)] - beside[len(flat) :]) / 2e-5
    return Evaluation(*map(np.asarray, (samples, points, log_probs, slope, differences, *variates, moved)))


def curved(state):
    """A function of states that is not linear."""
    return jnp.sum(jnp.sin(2.0 * state) + state**2)


def straight(state):
    """A function of states that is linear."""
    return jnp.sum(jnp.arange(1, 1 + jnp.size(state)) * state.ravel()) + 3.0


def around(dynamics, state, action):
    """A lattice of next states around all outcomes, its points as far apart as the noise."""
    means, noise = np.asarray(outcomes(dynamics, state, action).means), np.asarray(dynamics.noise)
    sides = zip(means.min(axis=0) - 6 * noise, means.max(axis=0) + 6 * noise, noise, strict=True)
    return np.stack(np.meshgrid(*(np.arange(*side) for side in sides), indexing="ij"), axis=-1).reshape(-1, len(noise))


# What holds for every family


@gaussian
def test_log_prob_integrates_to_one_and_samples_have_its_moments(name):
    """Sums over a lattice as wide as the noise are exact to 1e-7 for Gaussians."""
    seen = evaluate(name)
    masses = np.exp(seen.log_probs) * np.asarray(GAUSSIAN[name].dynamics.noise).prod()
    assert masses.sum() == pytest.approx(1, abs=1e-7)
    mean = masses @ seen.points
    covariance = (seen.points - mean).T @ (masses[:, None] * (seen.points - mean))
    spread, away = np.sqrt(np.diag(covariance)), seen.samples - mean
    np.testing.assert_allclose(away.mean(axis=0) / spread, 0, atol=0.03)
    np.testing.assert_allclose((away.T @ away / SAMPLES - covariance) / np.outer(spread, spread), 0, atol=0.05)


@pytest.mark.parametrize("name", [*GAUSSIAN, "table"])
def test_transition_control_variate_has_mean_0_and_removes_linear_noise(name):
    seen = evaluate(name)
    volume = 1.0 if name == "table" else np.asarray(GAUSSIAN[name].dynamics.noise).prod()
    masses = np.exp(seen.log_probs) * volume
    assert masses @ seen.variates == pytest.approx(0, abs=1e-6)
    assert masses @ seen.variates**2 > 1e-4
    if EVERY[name].dynamics.reparameterized or name == "table":
        expected = seen.samples.reshape(SAMPLES, -1) @ np.arange(1, 1 + seen.samples[0].size)
        mean = masses @ (seen.points.reshape(len(masses), -1) @ np.arange(1, 1 + seen.samples[0].size))
        np.testing.assert_allclose(seen.linear, expected - mean, atol=1e-6)


@pytest.mark.parametrize("name", sorted((GAUSSIAN.keys() | {"table"}) - {"walls"}))  # known walls have no parameters
def test_score_control_variate_derivative_has_mean_0(name):
    seen = evaluate(name)
    volume = 1.0 if name == "table" else np.asarray(GAUSSIAN[name].dynamics.noise).prod()
    masses = np.exp(seen.log_probs) * volume
    np.testing.assert_allclose(masses @ seen.of_scores, 0, atol=1e-6 * np.abs(seen.of_scores).max())
    assert masses @ seen.of_scores**2 @ np.ones(seen.of_scores.shape[1]) > 1e-6


def test_control_variates_default_is_0():
    assert not evaluate("Laplace").variates.any()
    assert not evaluate("Laplace").of_scores.any()


def test_table_dynamics_sample_frequencies_match_probabilities():
    dynamics, state, action = TABLE
    expected = np.zeros(4)
    expected[np.asarray(dynamics.model.graph.successors[state, action])] = dynamics.model.probabilities()[state, action]
    np.testing.assert_allclose(np.exp(evaluate("table").log_probs), expected, atol=1e-15)
    assert expected.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(np.bincount(evaluate("table").samples, minlength=4) / SAMPLES, expected, atol=0.015)


@every
def test_log_prob_gradient_matches_differences(name):
    slope = evaluate(name).slope
    np.testing.assert_allclose(slope, evaluate(name).differences, rtol=1e-5, atol=1e-7)
    assert (np.abs(slope).max() > 1e-3) if name != "walls" else len(slope) == 0


@every
def test_reparameterized_only_with_one_outcome(name):
    assert EVERY[name].dynamics.reparameterized == (name not in JUMPING)


@pytest.mark.parametrize("name", sorted(GAUSSIAN.keys() - JUMPING))
def test_sample_with_fixed_key_moves_as_the_mean(name):
    dynamics, state, action = GAUSSIAN[name]
    moved = dynamics.with_parameters(jax.tree.map(lambda leaf: leaf + 0.1, dynamics.parameters))
    expected = outcomes(moved, state, action).means[0] - outcomes(dynamics, state, action).means[0]
    assert np.abs(expected).max() > 1e-4
    np.testing.assert_allclose(evaluate(name).moved, expected, atol=1e-12)


@every
def test_with_parameters_changes_only_parameters(name):
    dynamics = EVERY[name].dynamics
    before = jax.tree.map(np.asarray, dynamics.parameters)
    moved = dynamics.with_parameters(jax.tree.map(lambda leaf: leaf + 0.25, dynamics.parameters))
    assert jax.tree.structure(moved) == jax.tree.structure(dynamics)
    for held, old, new in zip(*map(jax.tree.leaves, (dynamics.parameters, before, moved.parameters)), strict=True):
        np.testing.assert_array_equal(held, old)
        np.testing.assert_allclose(new, old + 0.25)


# Linear dynamics


def test_linear_gaussian_log_prob_is_normal():
    state, action, following = vector(1, -2), vector(0.5), vector(0.3, -1.1)
    mean = np.array([0.9 * 1 + 0.2 * -2, -0.1 * 1 + 0.8 * -2 + 0.5 * 0.5])
    expected = stats.norm.logpdf(following, mean, NOISE).sum()
    assert float(log_prob(LINEAR, state, action, following)) == pytest.approx(float(expected), abs=1e-12)


# Physical systems


def gymnasium_pendulum(gravity, mass, length):
    environment = gymnasium.make("Pendulum-v1", g=gravity).unwrapped
    environment.m, environment.l = mass, length  # pyright: ignore[reportAttributeAccessIssue]
    return environment


@pytest.mark.parametrize("constants", [(10.0, 1.0, 1.0), (9.81, 0.7, 1.3)])
def test_pendulum_matches_gymnasium(constants):
    random, environment = np.random.default_rng(0), gymnasium_pendulum(*constants)
    states = np.concatenate([random.uniform([-7, -8], [7, 8], (40, 2)), [[1.5, 7.99], [-1.5, -7.99]]])
    torques = random.uniform(-2, 2, (42, 1))
    pendulum, task = sc.Pendulum(*constants), sc.PendulumTask(goal=jnp.zeros(()), discount=jnp.asarray(0.9))
    means = jax.jit(jax.vmap(lambda *of: pendulum.outcomes(*of).means[0]))(jnp.asarray(states), jnp.asarray(torques))
    rewards = jax.jit(jax.vmap(task.reward))(jnp.asarray(states), jnp.asarray(torques))
    for state, torque, mean, reward in zip(states, torques, means, rewards, strict=True):
        environment.state = state  # pyright: ignore[reportAttributeAccessIssue]
        _, expected, *_ = environment.step(torque)
        np.testing.assert_allclose(mean, environment.state, atol=1e-9)  # pyright: ignore[reportAttributeAccessIssue]
        assert float(reward) == pytest.approx(float(expected), abs=1e-9)


def test_pendulum_clips_torques_as_gymnasium():
    environment, pendulum = gymnasium_pendulum(10.0, 1.0, 1.0), sc.Pendulum()
    for torque in (-5.0, 3.0):
        environment.state = np.array([0.3, -0.2])  # pyright: ignore[reportAttributeAccessIssue]
        environment.step(np.array([torque]))
        mean = outcomes(pendulum, vector(0.3, -0.2), vector(torque)).means[0]
        np.testing.assert_allclose(mean, environment.state, atol=1e-9)  # pyright: ignore[reportAttributeAccessIssue]


def test_pendulum_constants_have_units_and_parameters_are_logarithms():
    pendulum = sc.Pendulum(9.0, 2.0, 0.5, unknown=("mass",))
    assert [float(pendulum.constant(name)) for name in ("gravity", "mass", "length")] == [9, pytest.approx(2), 0.5]
    assert {name: float(value) for name, value in pendulum.parameters.items()} == {"mass": pytest.approx(np.log(2))}


def test_point_mass_step_follows_its_equations():
    mass = sc.PointMass(0.5, (0.3, -0.2), time_step=0.1)
    speed = np.array([-0.5, 1.5]) + 0.1 * (np.array([0.4 + 0.3, -1 - 0.2]) - 0.5 * np.array([-0.5, 1.5]))
    expected = np.concatenate([np.array([1, 2]) + 0.1 * speed, speed])
    log_probabilities, means = outcomes(mass, vector(1, 2, -0.5, 1.5), vector(0.4, -1))
    np.testing.assert_allclose(means, expected[None], atol=1e-12)
    np.testing.assert_array_equal(log_probabilities, [0])


# Obstacles


def test_obstacle_motion_stops_or_slows_moves():
    """At the logit ln 3, a place is blocked with probability 3/4."""
    field = sc.RadialField(jnp.full(2, np.log(3.0)), jnp.asarray([[0.0, 0.0], [4.0, 4.0]]), 1.0)
    stopping, slowing = (sc.ObstacleMotion(field, LOW, HIGH, NOISE, stops=stops) for stops in (True, False))
    assert float(stopping.blocked(PLACE)) == pytest.approx(0.75)
    following = vector(1.4, 0.9)
    moved, stayed = (stats.norm.pdf(following, mean, NOISE).prod() for mean in (PLACE + STEP, PLACE))
    expected = np.log(0.25 * moved + 0.75 * stayed)
    assert float(log_prob(stopping, PLACE, STEP, following)) == pytest.approx(expected, abs=1e-12)
    slowed = stats.norm.logpdf(following, PLACE + 0.25 * STEP, NOISE).sum()
    assert float(log_prob(slowing, PLACE, STEP, following)) == pytest.approx(slowed, abs=1e-12)


@pytest.mark.parametrize("stops", [True, False])
def test_obstacle_motion_blocks_at_the_target(stops):
    """Walls block at their border too, moves that start in one go on, and targets are clipped to the room."""
    motion = sc.ObstacleMotion(WALLS, LOW, HIGH, NOISE, stops=stops)

    def mean(place, step):
        log_probabilities, means = outcomes(motion, vector(*place), vector(*step))
        return jnp.exp(log_probabilities) @ means

    np.testing.assert_allclose(mean((1, 1), (1, 1)), [1, 1], atol=1e-4)
    np.testing.assert_allclose(mean((1, 1), (0.5, 1)), [1.5, 2], atol=1e-4)
    np.testing.assert_allclose(mean((2.5, 1), (1, 0)), [3.5, 1], atol=1e-4)
    np.testing.assert_allclose(mean((3.5, 3.5), (1, -9)), [4, 0], atol=1e-4)


def test_walls_logit_is_high_in_boxes():
    walls = sc.Walls(low=jnp.asarray([[0.0, 0.0], [2.0, 2.0]]), high=jnp.asarray([[1.0, 1.0], [3.0, 3.0]]))
    places = jnp.asarray([[0.5, 0.5], [1.0, 1.0], [1.5, 1.5], [2.5, 0.5], [2.5, 2.9]])
    assert jax.vmap(walls.inside)(places).tolist() == [True, True, False, False, True]
    assert jax.vmap(walls.logit)(places).tolist() == [12, 12, -12, -12, 12]


def test_radial_field_logit_is_weighted_mean():
    field = sc.radial_field(LOW, HIGH, (3, 2), logit=-1.5)
    np.testing.assert_allclose(field.centers, [[x, y] for x in (0, 2, 4) for y in (0, 4)])
    assert float(field.logit(vector(1.3, 9))) == pytest.approx(-1.5)
    narrow = sc.RadialField(jnp.arange(6.0), field.centers, 0.1)
    for index, center in enumerate(narrow.centers):
        assert float(narrow.logit(center)) == pytest.approx(index)
    assert float(narrow.logit(vector(0, 2))) == pytest.approx(0.5)
    place, weights = vector(1, 1), np.exp(-np.sum((np.asarray(field.centers) - 1) ** 2, axis=1) / 2 / field.width**2)
    expected = np.arange(6) @ weights / weights.sum()
    assert float(sc.RadialField(jnp.arange(6.0), field.centers, field.width).logit(place)) == pytest.approx(expected)


def test_network_field_begins_near_its_logit_with_all_gradients():
    places = jnp.asarray(np.random.default_rng(0).uniform(0, 4, (50, 2)))
    logits = jax.jit(jax.vmap(families.NETWORK.logit))(places)
    np.testing.assert_allclose(logits, 0.5, atol=1)
    assert (np.abs(evaluate("network, stopping").slope) > 0).all()


def test_obstacle_motion_gradient_of_room_and_centers_is_0():
    motion = families.radial(True)
    slopes = jax.jit(jax.grad(lambda motion: motion.log_prob(PLACE, vector(5, 5), PLACE)))(motion)
    assert all(np.abs(leaf).max() == 0 for leaf in (slopes.low, slopes.high, slopes.field.centers))
    assert np.abs(slopes.parameters).max() > 0


# New families


def test_gaussian_dynamics_subclass_with_outcomes_has_mixture_density():
    gusts = families.Gusts(jnp.log(vector(0.5, 0.3, 0.2)))
    log_probs = [float(log_prob(gusts, vector(1), vector(2), vector(x))) for x in (3.1, 4.0, 1.9)]
    winds, masses = np.array([0, 1, -1]), np.array([0.5, 0.3, 0.2])
    expected = stats.norm.pdf(np.array([3.1, 4.0, 1.9])[:, None], 3 + winds, 0.3) @ masses
    np.testing.assert_allclose(np.exp(log_probs), expected, atol=1e-12)


# Refusals


def refused(make, *, match):
    with pytest.raises(ss.InputError, match=match):
        make()


@pytest.mark.parametrize("noise", [vector(0.1, 0), vector(-1, 1), vector(np.nan, 1), vector(np.inf, 1)])
def test_noise_not_above_0_is_refused(noise):
    match = "field 'noise': expected finite numbers above 0"
    refused(lambda: sc.LinearGaussian(jnp.eye(2), jnp.eye(2), noise), match=match)
    refused(lambda: sc.ObstacleMotion(WALLS, LOW, HIGH, noise), match=match)
    refused(lambda: sc.Pendulum(noise=tuple(noise.tolist())), match=match)
    refused(lambda: sc.PointMass(noise=(*noise.tolist(), 1.0, 1.0)), match=match)


@pytest.mark.parametrize(
    ("name", "wrong"), [("gravity", 0.0), ("mass", -1.0), ("length", np.nan), ("time_step", np.inf)]
)
def test_pendulum_constants_not_above_0_are_refused(name, wrong):
    match = f"field '{name}': expected a finite number above 0, found {wrong}"
    refused(lambda: sc.Pendulum(**{name: wrong}), match=match)


def test_pendulum_unknown_name_is_refused():
    refused(
        lambda: sc.Pendulum(unknown=("color",)), match="'unknown': expected one of gravity, mass, length, found 'color'"
    )


def test_point_mass_bad_settings_are_refused():
    refused(lambda: sc.PointMass(friction=0.0), match="'friction': expected a finite number above 0, found 0")
    refused(lambda: sc.PointMass(time_step=-0.1), match="'time_step': expected a finite number above 0")
    refused(lambda: sc.PointMass(wind=(np.nan, 0.0)), match="'wind': expected finite numbers")


def test_linear_gaussian_not_finite_is_refused():
    refused(lambda: sc.LinearGaussian(jnp.eye(2) * jnp.inf, jnp.eye(2), NOISE), match="'state': expected finite")


@pytest.mark.parametrize(("low", "high"), [((0, 0), (1, 0)), ((2, 0), (1, 1)), ((0, np.nan), (1, 1))])
def test_corners_out_of_order_are_refused(low, high):
    low, high = vector(*low), vector(*high)
    match = "field 'low, high': expected corners in order|field 'low': expected finite numbers, found nan"
    refused(lambda: sc.ObstacleMotion(WALLS, low, high, NOISE), match=match)
    refused(lambda: sc.radial_field(low, high, (2, 2)), match=match)
    refused(lambda: sc.network_field(jax.random.key(0), low, high), match=match)


@pytest.mark.parametrize("counts", [(2,), (1, 3), (2, 2, 2), (0, 2)])
def test_radial_field_fewer_than_two_centers_a_side_are_refused(counts):
    refused(
        lambda: sc.radial_field(LOW, HIGH, counts),
        match=r"'counts': expected numbers of points(, at least 2,| of shape \(2,\),) found",
    )


def test_obstacle_motion_logits_not_finite_are_refused():
    field = sc.RadialField(jnp.full(4, np.nan), jnp.zeros((4, 2)), width=1.0)
    refused(lambda: sc.ObstacleMotion(field, LOW, HIGH, NOISE), match="'parameters': expected finite numbers")
