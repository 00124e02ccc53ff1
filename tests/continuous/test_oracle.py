"""A fit beside a lattice: the lattice's likelihood and gradient beside a dense reference, and refusals."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector
from sidestep.continuous.likelihood import FitProblem
from sidestep.continuous.oracle import NoisyPlanner

# Agents on a line move by −1, 0 or 1 at the cost of s² + a²; they look ahead without end.
WAYS, NOISE, DISCOUNT, BETA, TRUTH, VARIANCE = np.array([-1.0, 0.0, 1.0]), 0.4, 0.6, 1.5, 0.3, 4.0
TASK = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(DISCOUNT))
SOFT, LATTICE = ss.Behavior(ss.LogSumExp(), BETA), sc.Lattice(vector(-8), vector(8), (81,))
COARSE = sc.Lattice(vector(-8), vector(8), (30,))
PLACES = np.linspace(-9, 9, 721)


def log_policy(drift, states):
    """ln π of every action, from values on a fine grid with the normal density as a matrix."""

    def chances(at):
        density = np.exp(-(((PLACES - (at[:, None] + WAYS + drift)[..., None]) / NOISE) ** 2) / 2)
        return density / density.sum(axis=-1, keepdims=True)

    def scaled(at, chances, values):
        return BETA * (-(at[:, None] ** 2) - WAYS**2 + DISCOUNT * chances @ values)

    values, everywhere = np.zeros(len(PLACES)), chances(PLACES)
    for _ in range(60):
        values = np.logaddexp.reduce(scaled(PLACES, everywhere, values), axis=1) / BETA
    own = scaled(states, chances(states), values)
    return own - np.logaddexp.reduce(own, axis=1)[:, None]


@cache
def walks():
    random, count = np.random.default_rng(0), 60
    states = random.uniform(-2, 2, count)
    choices = np.array([random.choice(3, p=np.exp(row)) for row in log_policy(TRUTH, states)])
    return states, choices


@cache
def demonstrations():
    states, choices = walks()
    ends = states + WAYS[choices] + TRUTH
    moves = [
        ss.Trajectory(np.array([[s], [e]]), np.array([c]), 0) for s, c, e in zip(states, choices, ends, strict=True)
    ]
    return sc.gather_trajectories(moves, [TASK])


def agents():
    """A policy to begin with, and settings of its planner."""
    policy = sc.finite_policy(jax.random.key(1), vector(*WAYS)[:, None], demonstrations().states, width=8)
    return policy, sc.Planner(horizon=10, samples=2, learning_rate=0.03, critic_width=8)


@cache
def fitted():
    return sc.fit_dynamics(
        Drift(vector(0.0), vector(NOISE)), demonstrations(), SOFT, *agents(), prior=ss.Normal(0.0, VARIANCE),
        terms=("actions",), schedule=sc.Schedule(60, policy_warmup=60, batch_size=60, verification_samples=64),
    )  # fmt: skip


COVARIANCE, GRADIENT, ERROR = 0.02, 3.0, 0.5


def made(terms=("actions",), at=0.45) -> sc.ContinuousFit:
    """A fit that was not made by rollouts: its verification has numbers of the tests."""
    policy, planner = agents()
    agent = sc.Agent(Drift(vector(at), vector(NOISE)), policy, SOFT)
    problem = FitProblem(agent, demonstrations(), ss.Normal(0.0, VARIANCE), planner, sc.Schedule(2), terms, "score")
    ones = np.ones(1)
    numbers = GRADIENT * ones, ERROR * ones, np.array([[COVARIANCE]]), 0.1 * ones, 0.1, 0.1, 0.0, 0.0, 0.0, 8
    demos = demonstrations()
    state = planner.initialize(jax.random.key(0), agent, sc.task_at(demos.tasks, demos.task), demos.states)
    return sc.ContinuousFit(agent.dynamics, state, problem, (), sc.Verification(*numbers), True, "")


def total(drift):
    """The log-likelihood of the walks."""
    states, choices = walks()
    return log_policy(drift, states)[np.arange(len(states)), choices].sum()


def slope_at(at, step=1e-3):
    return (total(at + step) - total(at - step)) / (2 * step) - at / VARIANCE


@pytest.mark.parametrize("at", [0.45, -0.2])
def test_compare_with_lattice_of_any_parameters_has_the_slope_and_step_of_a_dense_reference(at):
    found, slope, scale = sc.compare_with_lattice(made(at=at), LATTICE), slope_at(at), COVARIANCE**0.5
    assert found.log_likelihood == pytest.approx(total(at), abs=0.02)
    assert found.gradient[0] * scale == pytest.approx(slope * scale, abs=0.02)
    assert found.step[0] == pytest.approx(COVARIANCE * slope, abs=0.01)
    assert found.distance == pytest.approx(scale * abs(slope), abs=0.02)
    assert found.errors[0] * ERROR == pytest.approx(GRADIENT - slope, abs=0.15)


@pytest.mark.slow
def test_compare_with_lattice_has_the_gradient_of_a_dense_reference():
    result = fitted()
    at = float(result.dynamics.parameters[0])
    found, slope = sc.compare_with_lattice(result, LATTICE), slope_at(at)
    assert found.log_likelihood == pytest.approx(total(at), abs=0.02)
    error = float(result.verification.covariance[0, 0] ** 0.5)
    assert found.gradient[0] * error == pytest.approx(slope * error, abs=0.02)
    assert found.distance == pytest.approx(abs(found.gradient[0]) * error)
    # the rollouts agree, and the fit is near the maximum
    assert abs(found.errors[0]) < 3
    assert found.distance < 1


def test_compare_with_lattice_counts_moves_by_their_weights():
    plain, fit = sc.compare_with_lattice(made(), LATTICE), made()
    twice = eqx.tree_at(lambda fit: fit.problem.demonstrations.weights, fit, jnp.full(60, 2.0))
    found, of_prior = sc.compare_with_lattice(twice, LATTICE), -0.45 / VARIANCE
    assert found.log_likelihood == pytest.approx(2 * plain.log_likelihood)
    assert found.gradient[0] - of_prior == pytest.approx(2 * (plain.gradient[0] - of_prior))


def test_compare_with_lattice_points_around_an_outcome_have_its_mean_and_variance():
    planner = NoisyPlanner(Drift(vector(0.0), vector(NOISE)), vector(*WAYS)[:, None], SOFT, LATTICE, (8,))
    points, weights = planner.landing(vector(0.37))
    places = np.asarray(LATTICE.points())[np.asarray(points), 0]
    assert float(weights.sum()) == pytest.approx(1)
    assert places @ np.asarray(weights) == pytest.approx(0.37, abs=2e-3)
    assert (places - 0.37) ** 2 @ np.asarray(weights) == pytest.approx(NOISE**2, rel=2e-3)


@pytest.mark.parametrize(("lattice", "match"), [
    (sc.Lattice(vector(-8), vector(8), (11,)), "'lattice': expected a spacing of at most 1.5 times the noise"),
    (sc.Lattice(vector(-1), vector(8), (81,)), r"'lattice': expected places on the lattice from \[-1.0\] to"),
    (sc.Lattice(vector(-8, -8), vector(8, 8), (9, 9)), "'lattice': expected 1 dimensions, at most 3, found 2"),
])  # fmt: skip
def test_compare_with_lattice_that_does_not_fit_is_refused(lattice, match):
    with pytest.raises(ss.InputError, match=match):
        sc.compare_with_lattice(made(), lattice)


def test_compare_with_lattice_of_the_coarsest_spacing_is_near_a_fine_one():
    """Its 30 points are 1.38 standard deviations of the noise apart."""
    fine, coarse = (sc.compare_with_lattice(made(), each) for each in (LATTICE, COARSE))
    assert coarse.log_likelihood == pytest.approx(fine.log_likelihood, abs=0.5)
    assert coarse.distance == pytest.approx(fine.distance, rel=0.1)


def test_compare_with_lattice_of_another_fit_is_refused():
    with pytest.raises(ss.InputError, match="'terms': expected a fit with the actions' term"):
        sc.compare_with_lattice(made(("transitions",)), LATTICE)
