"""Policies that are found by gradients: one for all tasks, over features of the state and the goal.

A policy gives π_λ(c | x) over *choices* c, given the features x that a task makes of a state. Over a finite set of
actions a choice is an action's index; otherwise it is the action itself. Its *advantages* are

    q_λ(x, c) = ln π_λ(c | x) + H(π_λ(· | x)),       so that  π_λ ∝ exp q_λ  and  Σ_c π_λ q_λ = 0,

as eq. 12 wants them, whatever the family.
"""

import abc
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float, PRNGKeyArray, Scalar, Shaped

from sidestep.continuous.dynamics import Action
from sidestep.errors import InputError

Features = Float[Array, " features"]
Choice = Shaped[Array, "*choice"]


class Scaled(eqx.Module):
    """A network whose inputs are brought to the order of 1: network((x − centre) / scale)."""

    network: eqx.Module
    centre: Features
    scale: Features

    def __call__(self, x: Features) -> Float[Array, "..."]:
        """The network's output; the scaling itself is never learned."""
        centre, scale = jax.lax.stop_gradient((self.centre, self.scale))
        return self.network((x - centre) / scale)  # pyright: ignore[reportCallIssue]


def scaled_network(
    key: PRNGKeyArray, examples: Float[Array, "examples features"], outputs: int, width: int, depth: int
) -> Scaled:
    """A network of `depth` hidden layers (0: linear) whose outputs begin near 0, scaled by examples of its inputs."""
    network = eqx.nn.MLP(examples.shape[-1], outputs, width, depth, jnp.tanh, key=key)
    last = network.layers[-1]
    network = eqx.tree_at(lambda net: net.layers[-1], network, jax.tree.map(lambda leaf: 0.01 * leaf, last))
    spread = examples.std(axis=0)
    return Scaled(network, examples.mean(axis=0), jnp.where(spread > 1e-6, spread, 1.0))


class Policy(eqx.Module):
    """π_λ(c | x); λ are all its floating-point arrays that gradients reach.

    - `reparameterised`: whether `sample` moves smoothly with λ and x while the key is held fixed.
    """

    reparameterised: ClassVar[bool]

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, x: Features) -> Choice:
        """A choice c ~ π_λ(· | x)."""

    @abc.abstractmethod
    def log_prob(self, x: Features, choice: Choice) -> Float[Scalar, ""]:
        """ln π_λ(c | x), in nats."""

    @abc.abstractmethod
    def entropy(self, x: Features) -> Float[Scalar, ""]:
        """H(π_λ(· | x)), in nats."""

    @abc.abstractmethod
    def action(self, choice: Choice) -> Action:
        """The action that a choice stands for."""


class FinitePolicy(Policy):
    """A policy over a finite set of actions, π_λ ∝ exp of a network's outputs.

    - `network`: from features to a number an action.
    - `actions`: what each choice stands for.
    """

    network: Scaled
    actions: Shaped[Array, "actions *action"]
    reparameterised: ClassVar[bool] = False

    def log_probs(self, x: Features) -> Float[Array, " actions"]:
        """ln π_λ of every action."""
        return jax.nn.log_softmax(self.network(x))

    def sample(self, key: PRNGKeyArray, x: Features) -> Choice:
        """An action's index."""
        return jax.random.categorical(key, self.network(x))

    def log_prob(self, x: Features, choice: Choice) -> Float[Scalar, ""]:
        """ln π_λ of an action's index."""
        return self.log_probs(x)[choice]

    def entropy(self, x: Features) -> Float[Scalar, ""]:
        """In nats, from 0 to ln(actions)."""
        log_probs = self.log_probs(x)
        return -jnp.sum(jnp.exp(log_probs) * log_probs)

    def action(self, choice: Choice) -> Action:
        """The action with this index."""
        return jax.lax.stop_gradient(self.actions)[choice]


class GaussianPolicy(Policy):
    """A policy over vectors: Gaussian with a network's mean, and a standard deviation of its own for each component."""

    network: Scaled
    log_spread: Float[Array, " inputs"]
    reparameterised: ClassVar[bool] = True

    def sample(self, key: PRNGKeyArray, x: Features) -> Choice:
        """The mean plus noise."""
        noise = jax.random.normal(key, self.log_spread.shape, self.log_spread.dtype)
        return self.network(x) + jnp.exp(self.log_spread) * noise

    def log_prob(self, x: Features, choice: Choice) -> Float[Scalar, ""]:
        """ln π_λ of an action."""
        return norm.logpdf(choice, self.network(x), jnp.exp(self.log_spread)).sum()

    def entropy(self, x: Features) -> Float[Scalar, ""]:
        """In nats; below 0 for narrow policies."""
        del x
        return jnp.sum(self.log_spread + 0.5 * math.log(2 * math.pi * math.e))

    def action(self, choice: Choice) -> Action:
        """The choice itself."""
        return choice


def finite_policy(
    key: PRNGKeyArray,
    actions: Shaped[Array, "actions *action"],
    examples: Float[Array, "examples features"],
    *,
    width: int = 64,
    depth: int = 2,
) -> FinitePolicy:
    """A network policy over a finite set of actions that begins uniform.

    `examples` are features that are likely to be met; they scale the network's inputs. Raises `InputError` for fewer
    than two actions, actions or examples that are not finite.
    """
    if len(actions) < 2 or not np.isfinite(actions).all():
        raise InputError("expected two or more actions of finite numbers", field="actions")
    _check_examples(examples)
    return FinitePolicy(scaled_network(key, examples, len(actions), width, depth), jnp.asarray(actions))


def table_policy(actions: int, features: int) -> FinitePolicy:
    """A policy with a number of its own for every feature and action, for features that are one 1 among zeros."""
    real = jnp.result_type(float)
    linear = eqx.nn.Linear(features, actions, use_bias=False, key=jax.random.key(0))
    linear = eqx.tree_at(lambda layer: layer.weight, linear, jnp.zeros((actions, features), real))
    return FinitePolicy(Scaled(linear, jnp.zeros(features), jnp.ones(features)), jnp.arange(actions))


def gaussian_policy(
    key: PRNGKeyArray,
    inputs: int,
    examples: Float[Array, "examples features"],
    *,
    spread: float = 1.0,
    width: int = 64,
    depth: int = 2,
) -> GaussianPolicy:
    """A Gaussian policy over vectors of `inputs` components that begins around 0 with standard deviation `spread`.

    With `depth` 0 the mean is linear in the features. Raises `InputError` for a spread not above 0, or examples that
    are not finite.
    """
    if not (np.isfinite(spread) and spread > 0):
        raise InputError(f"expected a finite number above 0, found {spread}", field="spread")
    _check_examples(examples)
    network = scaled_network(key, examples, inputs, width, depth)
    return GaussianPolicy(network, jnp.full(inputs, math.log(spread), examples.dtype))


def _check_examples(examples: Float[Array, "examples features"]) -> None:
    if len(examples) == 0 or not np.isfinite(examples).all():
        raise InputError("expected one or more rows of finite numbers", field="examples")
