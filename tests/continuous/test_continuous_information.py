"""Standard errors of continuous dynamics: closed forms, errors by rollouts, refusals."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector

pytestmark = pytest.mark.slow

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


def learn(terms, backup=ss.HardMax(), **settings):
    return sc.fit_dynamics(
        Drift(vector(0.5), vector(NOISE)), demonstrations_of(*walks()), ss.Behavior(backup, BETA), POLICY, PLANNER,
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


@pytest.mark.parametrize("terms", [("actions",), ("transitions",), ("actions", "transitions")])
def test_laplace_of_continuous_dynamics_has_the_second_difference_of_the_objective(terms):
    result = fitted(terms)
    normal, at, step = ss.laplace(result), float(result.dynamics.parameters[0]), 1e-3
    curvature = (loss(terms, at + step) - 2 * loss(terms, at) + loss(terms, at - step)) / step**2
    slope = (loss(terms, at + step) - loss(terms, at - step)) / (2 * step)
    np.testing.assert_allclose(
        normal.standard_errors.model, [curvature**-0.5], rtol=0.02 if "actions" in terms else 1e-5
    )
    np.testing.assert_allclose(normal.distance, abs(slope) / np.sqrt(curvature), atol=0.05)
    print(
        normal.simulated,
        normal.distance,
        abs(slope) / np.sqrt(curvature),
        normal.standard_errors.model,
        curvature**-0.5,
    )
