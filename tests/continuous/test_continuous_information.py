"""Standard errors of continuous dynamics: closed forms, errors by rollouts, refusals."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector
from sidestep.continuous.information import RolloutInformation
from sidestep.inference.decomposition import whole
from sidestep.inference.normal_posterior import Laplace

# Agents on a line move by −1, 0 or 1 and look two moves ahead, to stay near 0: R(s, a) = −s². A later choice counts
# for nothing, so that Q(s, a) = −s² − γ E(s + a + θ + noise)², ∇Q = −2γ(s + a + θ), and ∇²Q is the same for all a.
WAYS, DISCOUNT, NOISE, TRUTH, MOVES, BETA = np.array([-1.0, 0.0, 1.0]), 0.9, 0.4, 0.6, 90, 1.5
NEAR = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.zeros((1, 1)), jnp.asarray(DISCOUNT))
VARIANCE = 50.0
POLICY = sc.finite_policy(jax.random.key(1), vector(*WAYS)[:, None], jnp.linspace(-2, 2, 9)[:, None], width=4, depth=1)
PLANNER = sc.Planner(horizon=2, batch_size=8, samples=2, learning_rate=0.03, critic_width=4)
SCHEDULE = sc.Schedule(100, policy_warmup=0, batch_size=MOVES, learning_rate=0.1, policy_gap_tolerance=1e3)


def log_policy(drift, states):
    """The log-probability of every action."""
    values = -BETA * DISCOUNT * (states[:, None] + WAYS + drift) ** 2
    return values - np.log(np.exp(values).sum(axis=1, keepdims=True))


@cache
def walks():
    """States, choices and next states of agents that know the drift."""
    random = np.random.default_rng(0)
    states = random.uniform(-2, 2, MOVES)
    choices = np.array([random.choice(3, p=np.exp(row)) for row in log_policy(TRUTH, states)])
    return states, choices, states + WAYS[choices] + TRUTH + NOISE * random.normal(size=MOVES)


def demonstrations_of(states, actions, following, task=NEAR):
    moves = zip(np.stack([states, following], axis=1).reshape(len(states), 2, -1), actions, strict=True)
    return sc.gather_trajectories([ss.Trajectory(places, action[None], 0) for places, action in moves], [task])


BEST = ss.Behavior(ss.HardMax(), BETA)


def learn(terms, agents=BEST, **settings):
    return sc.fit_dynamics(
        Drift(vector(0.5), vector(NOISE)), demonstrations_of(*walks()), agents, POLICY, PLANNER,
        prior=ss.Normal(0.0, VARIANCE), terms=terms, **{"estimator": "pathwise", "schedule": SCHEDULE, **settings},
    )  # fmt: skip


@cache
def fitted(terms, estimator="pathwise"):
    return learn(terms, estimator=estimator)


def loss(terms, drift):
    """Minus the objective, but for a constant."""
    states, choices, following = walks()
    total = drift**2 / (2 * VARIANCE)
    if "actions" in terms:
        total -= log_policy(drift, states)[np.arange(MOVES), choices].sum()
    if "transitions" in terms:
        total += np.sum((following - states - WAYS[choices] - drift) ** 2) / (2 * NOISE**2)
    return total


@pytest.mark.slow
@pytest.mark.parametrize("terms", [("actions",), ("transitions",), ("actions", "transitions")])
def test_laplace_of_continuous_dynamics_has_the_second_difference_of_the_objective(terms):
    result = fitted(terms)
    normal, at, step = ss.laplace(result), float(result.dynamics.parameters[0]), 1e-3
    curvature = (loss(terms, at + step) - 2 * loss(terms, at) + loss(terms, at - step)) / step**2
    slope = (loss(terms, at + step) - loss(terms, at - step)) / (2 * step)
    tolerance = 0.01 if "actions" in terms else 1e-5  # there is noise of rollouts
    np.testing.assert_allclose(normal.standard_errors.model, [curvature**-0.5], rtol=tolerance)
    np.testing.assert_allclose(normal.distance, abs(slope) / np.sqrt(curvature), atol=0.05)
    assert (normal.simulated > 0) == ("actions" in terms)
    lower, upper = normal.interval(0.95)
    np.testing.assert_allclose((upper.model - lower.model) / 2, 1.959964 * normal.standard_errors.model, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["score", "pathwise"])
def test_laplace_of_continuous_dynamics_knows_the_errors_by_rollouts(estimator):
    """The error of a standard error, and the noise of a gradient, over draws of rollouts."""
    result = fitted(("actions",), estimator)
    at, step, terms = float(result.dynamics.parameters[0]), 1e-3, ("actions",)
    expected = ((loss(terms, at + step) - 2 * loss(terms, at) + loss(terms, at - step)) / step**2) ** -0.5
    slope = -(loss(terms, at + step) - loss(terms, at - step)) / (2 * step)
    drawn = [result.information(samples=64, seed=seed) for seed in range(16)]
    normals = [Laplace(each.parameters, *whole(each)) for each in drawn]
    relative = [float(each.standard_errors.model[0]) / expected - 1 for each in normals]
    noise = [float(each.gradient[0] - slope) * expected for each in drawn]
    errors, squared = zip(*(each.simulation(own) for each, own in zip(drawn, normals, strict=True)), strict=True)
    assert np.mean(errors) / 2 < np.sqrt(np.mean(np.square(relative))) < 2 * np.mean(errors)
    assert np.mean(squared) / 4 < np.mean(np.square(noise)) < 4 * np.mean(squared)


@pytest.mark.slow
def test_laplace_of_vector_actions_has_the_information_of_a_normal_policy():
    """With R(s, a) = −s² − a² the policy is normal, by Riccati's equation, with a mean that is linear in θ."""
    discount, count, beta, random = 0.6, 300, 4.0, np.random.default_rng(2)
    task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(discount))
    curve = 1.0  # V(s) = −curve s² − 2 tilt θ s, whatever else
    for _ in range(100):
        curve = 1 + discount * curve / (1 + discount * curve)
    steepness = 1 + discount * curve
    tilt = discount * curve / (steepness - discount)
    states, spread = random.uniform(-2, 2, count), 1 / np.sqrt(2 * beta * steepness)
    means = -discount * (curve * (states + TRUTH) + tilt * TRUTH) / steepness
    actions = means + spread * random.normal(size=count)
    demos = demonstrations_of(states, actions[:, None], states + actions + TRUTH, task)
    result = sc.fit_dynamics(
        Drift(vector(TRUTH), vector(NOISE)), demos, ss.Behavior(ss.LogSumExp(), beta),
        sc.gaussian_policy(jax.random.key(0), 1, demos.states, depth=0, spread=0.3),
        sc.Planner(horizon=8, batch_size=16, samples=2, candidates=16, learning_rate=0.03, critic_width=4),
        prior=ss.Normal(0.0, VARIANCE), terms=("actions",), estimator="pathwise",
        schedule=sc.Schedule(iterations=200, policy_warmup=60, batch_size=60, learning_rate=0.02),
    )  # fmt: skip
    information = count * (discount * (curve + tilt) / steepness / spread) ** 2 + 1 / VARIANCE
    np.testing.assert_allclose(ss.laplace(result).standard_errors.model, [information**-0.5], rtol=0.05)


@pytest.mark.slow
def test_information_of_vector_actions_knows_the_noise_of_drawn_choices():
    """The noise of the gradient over draws of choices and rollouts is what the difference of its halves says."""
    task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.6))
    random = np.random.default_rng(3)
    states, actions = random.uniform(-2, 2, 60), random.normal(size=(60, 1))
    demos = demonstrations_of(states, actions, states + actions[:, 0] + TRUTH, task)
    result = sc.fit_dynamics(
        Drift(vector(TRUTH), vector(NOISE)), demos, ss.Behavior(ss.LogSumExp(), 4.0),
        sc.gaussian_policy(jax.random.key(0), 1, demos.states, depth=0, spread=0.5),
        sc.Planner(horizon=2, batch_size=16, samples=2, candidates=4, critic_width=4),
        prior=ss.Normal(0.0, VARIANCE), terms=("actions",), estimator="pathwise",
        schedule=sc.Schedule(iterations=2, policy_warmup=0, verification_samples=8),
    )  # fmt: skip
    problem, dynamics, planner_state = result.problem, result.dynamics, result.planner_state
    drawn = [RolloutInformation(problem, dynamics, planner_state, samples=8, seed=seed) for seed in range(24)]
    noise = np.var([each.gradient[0] for each in drawn], ddof=1)
    known = [
        each.simulation(Laplace(each.parameters, *whole(each)))[1] * each.products(np.eye(1))[0, 0] for each in drawn
    ]
    assert np.mean(known) / 2 < noise < 2 * np.mean(known)


def test_laplace_of_linear_dynamics_has_the_covariance_of_least_squares():
    states, choices, _ = walks()
    seen = np.column_stack([WAYS[choices], states])  # in the order of the parameters' names
    following = seen @ [0.5, 0.7] + NOISE * np.random.default_rng(0).normal(size=MOVES)
    begin = sc.LinearGaussian(jnp.full((1, 1), 0.7), jnp.full((1, 1), 0.5), vector(NOISE))
    result = sc.fit_dynamics(
        begin, demonstrations_of(states, choices, following), BEST, POLICY, PLANNER,
        prior=ss.Normal(0.0, VARIANCE), terms=("transitions",),
        schedule=sc.Schedule(300, batch_size=MOVES, learning_rate=0.05),
    )  # fmt: skip
    expected = seen.T @ seen / NOISE**2 + np.eye(2) / VARIANCE
    np.testing.assert_allclose(ss.laplace(result).covariance, np.linalg.inv(expected), rtol=1e-5)
    information = result.information()
    np.testing.assert_allclose(information.of_prior(np.eye(2)), np.eye(2) / VARIANCE, rtol=1e-6)
    np.testing.assert_allclose(information.products(np.array([[1.0, -2.0]])), [expected @ [1, -2]], rtol=1e-5)


# Refusals


def test_laplace_of_a_continuous_fit_away_from_its_maximum_raises():
    away = eqx.tree_at(lambda fit: fit.dynamics.parameters, fitted(("transitions",)), vector(1.0))
    with pytest.raises(ss.InputError, match=r"standard errors from it \(the maximum is"):
        ss.laplace(away)


@pytest.mark.slow
def test_laplace_of_a_continuous_fit_that_has_not_converged_raises():
    early = learn(("actions",), schedule=sc.Schedule(2, policy_warmup=0, learning_rate=1e-3, distance_tolerance=1e-9))
    with pytest.raises(ss.InputError, match="'fit': expected a fit that converged: the maximum is"):
        ss.laplace(early)


@pytest.mark.slow
def test_laplace_of_few_rollouts_raises():
    with_wrong_critic = eqx.tree_at(
        lambda fit: fit.planner_state.critic.spread, fitted(("actions",), "score"), jnp.asarray(10.0)
    )
    few = with_wrong_critic.information(samples=2)
    with pytest.raises(ss.InputError, match="'samples': expected a gradient without much noise"):
        ss.laplace(few)


def test_fit_dynamics_of_agents_with_lapses_raises():
    with pytest.raises(ss.InputError, match="'lapse': expected an agent without lapses"):
        learn(("actions",), ss.Behavior(ss.HardMax(), BETA, 0.1))


def test_information_of_transitions_is_exact_and_has_no_errors_by_rollouts():
    """A drift's information is moves / noise², and 1 / variance by the prior."""
    fit = fitted(("transitions",))
    information, vectors = fit.information(), np.array([[1.0], [-2.0], [0.5]])
    np.testing.assert_allclose(information.of_prior(vectors), vectors / VARIANCE)
    np.testing.assert_allclose(information.products(vectors), vectors * (MOVES / NOISE**2 + 1 / VARIANCE), rtol=1e-6)
    normal = ss.laplace(fit)
    assert information.simulation(normal) == (0.0, 0.0)
    np.testing.assert_allclose(
        normal.covariance_products(vectors), vectors / (MOVES / NOISE**2 + 1 / VARIANCE), rtol=1e-6
    )
