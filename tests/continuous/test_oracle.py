"""A fit beside a lattice: the lattice's likelihood and gradient beside a dense reference, and refusals."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector
from sidestep.continuous.oracle import NoisyPlanner

# Agents on a line move by −1, 0 or 1 at the cost of s² + a²; they look ahead without end.
WAYS, NOISE, DISCOUNT, BETA, TRUTH, VARIANCE = np.array([-1.0, 0.0, 1.0]), 0.4, 0.6, 1.5, 0.3, 4.0
TASK = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(DISCOUNT))
SOFT, LATTICE = ss.Behavior(ss.LogSumExp(), BETA), sc.Lattice(vector(-8), vector(8), (81,))
PLACES = np.linspace(-9, 9, 721)


def log_policy(drift, states):
    """ln π of every action, from values on a fine grid with the normal density as a matrix."""
    values = np.zeros(len(PLACES))

    def action_values(at, values):
        means = at[:, None] + WAYS + drift
        density = np.exp(-(((PLACES - means[..., None]) / NOISE) ** 2) / 2)
        after = density @ values / density.sum(axis=-1)
        return -(at[:, None] ** 2) - WAYS**2 + DISCOUNT * after

    for _ in range(60):
        scaled = BETA * action_values(PLACES, values)
        values = np.logaddexp.reduce(scaled, axis=1) / BETA
    scaled = BETA * action_values(states, values)
    return scaled - np.logaddexp.reduce(scaled, axis=1)[:, None]


@cache
def walks():
    random, count = np.random.default_rng(0), 60
    states = random.uniform(-2, 2, count)
    choices = np.array([random.choice(3, p=np.exp(row)) for row in log_policy(TRUTH, states)])
    return states, choices


@cache
def fitted(terms=("actions",), horizon=10):
    states, choices = walks()
    ends = states + WAYS[choices] + TRUTH
    moves = [
        ss.Trajectory(np.array([[s], [e]]), np.array([c]), 0) for s, c, e in zip(states, choices, ends, strict=True)
    ]
    demos = sc.gather_trajectories(moves, [TASK])
    policy = sc.finite_policy(jax.random.key(1), vector(*WAYS)[:, None], demos.states, width=8)
    planner = sc.Planner(horizon=horizon, samples=2, learning_rate=0.03, critic_width=8)
    return sc.fit_dynamics(
        Drift(vector(0.0), vector(NOISE)), demos, SOFT, policy, planner, prior=ss.Normal(0.0, VARIANCE), terms=terms,
        schedule=sc.Schedule(60, policy_warmup=60, batch_size=60, verification_samples=64),
    )  # fmt: skip


@pytest.mark.slow
def test_compare_with_lattice_has_the_gradient_of_a_dense_reference():
    result = fitted()
    (states, choices), at, step = walks(), float(result.dynamics.parameters[0]), 1e-3

    def total(drift):
        return log_policy(drift, states)[np.arange(len(states)), choices].sum()

    found = sc.compare_with_lattice(result, LATTICE)
    assert found.log_likelihood == pytest.approx(total(at), abs=0.02)
    slope = (total(at + step) - total(at - step)) / (2 * step) - at / VARIANCE
    error = float(result.verification.covariance[0, 0] ** 0.5)
    assert found.gradient[0] * error == pytest.approx(slope * error, abs=0.02)
    assert found.distance == pytest.approx(abs(found.gradient[0]) * error)
    # the rollouts agree, and the fit is near the maximum
    assert abs(found.errors[0]) < 3
    assert found.distance < 1


def test_compare_with_lattice_points_around_an_outcome_have_its_mean_and_variance():
    planner = NoisyPlanner(Drift(vector(0.0), vector(NOISE)), vector(*WAYS)[:, None], SOFT, LATTICE, (6,))
    points, weights = planner.landing(vector(0.37))
    places = np.asarray(LATTICE.points())[np.asarray(points), 0]
    assert float(weights.sum()) == pytest.approx(1)
    assert places @ np.asarray(weights) == pytest.approx(0.37, abs=2e-3)
    assert (places - 0.37) ** 2 @ np.asarray(weights) == pytest.approx(NOISE**2, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("lattice", "match"), [
    (sc.Lattice(vector(-8), vector(8), (11,)), "'lattice': expected a spacing of at most 1.5 times the noise"),
    (sc.Lattice(vector(-8, -8), vector(8, 8), (9, 9)), "'lattice': expected 1 dimensions, at most 3, found 2"),
])  # fmt: skip
def test_compare_with_lattice_that_does_not_fit_is_refused(lattice, match):
    with pytest.raises(ss.InputError, match=match):
        sc.compare_with_lattice(fitted(), lattice)


@pytest.mark.slow
def test_compare_with_lattice_of_another_fit_is_refused():
    with pytest.raises(ss.InputError, match="'terms': expected a fit with the actions' term"):
        sc.compare_with_lattice(fitted(("transitions",)), LATTICE)
