"""Dynamics of every kind for the tests; some are defined here, as a user would."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep.continuous.dynamics import Dynamics, GaussianDynamics, LinearGaussian, Outcomes, TableDynamics
from sidestep.continuous.obstacles import ObstacleMotion, Walls, network_field, radial_field
from sidestep.continuous.physical import Pendulum, PointMass
from sidestep.tabular.graph import graph
from sidestep.tabular.models import TabularModel


class Drift(GaussianDynamics):
    """s′ = s + a + θ + noise · ε, on a line."""

    parameters: jax.Array
    noise: jax.Array

    def outcomes(self, state, action):
        return Outcomes.single(state + action + self.parameters)


class LaplaceDrift(Dynamics):
    """s′ = s + a + θ + ε with ε from Laplace's distribution, whose density is ½ exp(−|ε|)."""

    parameters: jax.Array

    @property
    def reparameterized(self):
        return True

    def sample(self, key, state, action):
        return state + action + self.parameters + jax.random.laplace(key, state.shape, state.dtype)

    def log_prob(self, state, action, next_state):
        return jnp.sum(-jnp.abs(next_state - state - action - self.parameters) - jnp.log(2.0))


class Gusts(GaussianDynamics):
    """A move on a line that succeeds, goes one further or one back; the parameters are the logits of the three."""

    parameters: jax.Array
    noise: jax.Array = eqx.field(default_factory=lambda: jnp.full(1, 0.3))

    def outcomes(self, state, action):
        means = state + action + jnp.asarray([[0.0], [1.0], [-1.0]])
        return Outcomes(jax.nn.log_softmax(self.parameters), means)


class Example(NamedTuple):
    """Dynamics, and a state and an action to evaluate them at."""

    dynamics: Any
    state: jax.Array
    action: jax.Array


LOW, HIGH, NOISE = jnp.zeros(2), jnp.full(2, 4.0), jnp.asarray([0.3, 0.2])
LINEAR = LinearGaussian(jnp.asarray([[0.9, 0.2], [-0.1, 0.8]]), jnp.asarray([[0.0], [0.5]]), NOISE)


def radial(stops):
    """Obstacles as radial basis functions with logits that differ from place to place."""
    field = radial_field(LOW, HIGH, (3, 3))
    moved = field.parameters + jnp.asarray(np.random.default_rng(0).normal(1.5, 1.0, 9))
    return ObstacleMotion(field, LOW, HIGH, NOISE, stops=stops).with_parameters(moved)


def vector(*numbers):
    return jnp.asarray(numbers, float)


NETWORK = network_field(jax.random.key(0), LOW, HIGH, width=3, depth=1, logit=0.5)
WALLS = Walls(low=vector(2, 0)[None], high=vector(3, 2)[None])
PLACE, STEP = vector(1.2, 0.7), vector(0.9, 0.4)

GAUSSIAN: dict[str, Example] = {
    "linear": Example(LINEAR, vector(0.5, -1), vector(0.7)),
    "pendulum": Example(Pendulum(9.0, 1.3, 0.8, unknown=("gravity", "mass", "length")), vector(2, -1), vector(1.5)),
    "point mass": Example(PointMass(0.5, (0.3, -0.2)), vector(1, 2, -0.5, 1.5), vector(0.4, -1)),
    "stopping": Example(radial(True), PLACE, STEP),
    "slowing": Example(radial(False), PLACE, STEP),
    "network, stopping": Example(ObstacleMotion(NETWORK, LOW, HIGH, NOISE), PLACE, STEP),
    "walls": Example(ObstacleMotion(WALLS, LOW, HIGH, NOISE), PLACE, STEP),
    "gusts": Example(Gusts(vector(0.5, 0, -1)), vector(1), vector(-1)),
}


def table_example():
    """A discrete world in which an action has three outcomes."""
    successors = np.array([[[0, 1, 2], [2, 3, 1]], [[1, 2, 3], [3, 0, 1]], [[2, 3, 0], [0, 1, 2]], [[3, 0, 1]] * 2])
    logits = jnp.asarray(np.random.default_rng(1).normal(size=successors.shape))
    return Example(TableDynamics(TabularModel(graph(successors), logits)), jnp.asarray(1), jnp.asarray(1))


TABLE = table_example()
EVERY: dict[str, Example] = {
    **GAUSSIAN,
    "Laplace": Example(LaplaceDrift(vector(0.3)), vector(1), vector(1)),
    "table": TABLE,
}
