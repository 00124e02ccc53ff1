"""A drift on a line, agents that know it, and fits of it."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector

# Agents on a line move by −1, 0 or 1 and look two moves ahead, to stay near 0: R(s, a) = −s². With the Boltzmann
# average, Q(s, a) = −s² − γ E(s + a + θ + noise)², for every later choice.
WAYS, DISCOUNT, NOISE, TRUTH, MOVES = np.array([-1.0, 0.0, 1.0]), 0.9, 0.4, 0.6, 90
NEAR = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.zeros((1, 1)), jnp.asarray(DISCOUNT))
BEHAVIOR, PRIOR = ss.Behavior(ss.BoltzmannAverage(), 1.5), ss.Normal(0.0, 50.0)
POLICY = sc.finite_policy(jax.random.key(1), vector(*WAYS)[:, None], jnp.linspace(-2, 2, 9)[:, None], width=4, depth=1)
PLANNER = sc.Planner(horizon=2, batch_size=8, samples=2, learning_rate=0.03, critic_width=4)
INITIAL = Drift(vector(-0.5), vector(NOISE))


def log_policy(drift, states):
    """The log-probability of every action."""
    values = -1.5 * DISCOUNT * (states[:, None] + WAYS + drift) ** 2
    return values - np.log(np.exp(values).sum(axis=1, keepdims=True))


def walks(seed=0):
    """States, choices and next states of agents that know the drift."""
    random = np.random.default_rng(seed)
    states = random.uniform(-2, 2, MOVES)
    choices = np.array([random.choice(3, p=np.exp(row)) for row in log_policy(TRUTH, states)])
    return states, choices, states + WAYS[choices] + TRUTH + NOISE * random.normal(size=MOVES)


def demonstrations_of(states, actions, following, tasks=(NEAR,)):
    moves = zip(np.stack([states, following], axis=1).reshape(len(states), 2, -1), actions, strict=True)
    return sc.gather_trajectories([ss.Trajectory(places, action[None], 0) for places, action in moves], tasks)


STATES, CHOICES, FOLLOWING = walks()
DEMONSTRATIONS = demonstrations_of(STATES, CHOICES, FOLLOWING)
AGENTS = BEHAVIOR, POLICY, PLANNER
learn = partial(sc.fit_dynamics, INITIAL, DEMONSTRATIONS, *AGENTS, prior=PRIOR)
SHORT = sc.Schedule(iterations=16, policy_warmup=2, batch_size=30, learning_rate=0.2)
LONG = sc.Schedule(iterations=100, policy_warmup=0, batch_size=MOVES, learning_rate=0.1)
BOTH = partial(learn, estimator="pathwise", schedule=SHORT)


@cache
def fitted(seed=0):
    """A short fit, and all its reports."""
    reports = []
    return BOTH(seed=seed, report=lambda *report: reports.append(report)), reports
