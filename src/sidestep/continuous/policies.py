"""Policies with learned parameters λ: one policy for all tasks, over features of the state and the goal.

A policy gives π_λ(c | x) over *choices* c, by the features x of a state. Over a finite set of actions a choice is the
index of an action; otherwise it is the action itself. Its *advantages* are

    q_λ(x, c) = ln π_λ(c | x) + H(π_λ(· | x)),       so that  π_λ ∝ exp q_λ  and  Σ_c π_λ q_λ = 0,

as eq. 12 of the paper requires, for every family.
"""

import abc
import math
from typing import ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from sidestep._arguments import to_finite, to_key
from sidestep._repr import short_repr
from sidestep.continuous.dynamics import Action, Dynamics, Real
from sidestep.continuous.tasks import ContinuousTask, States
from sidestep.errors import check, check_instance, check_positive, to_count
from sidestep.tabular.backups import Behavior, HardMax

Features = Float[Array, " features"]
Choice = Shaped[Array, "*choice"]
Examples = Float[Array, "examples features"]
PerExample = Float[Array, " examples"]


class ScaledNetwork(eqx.Module):
    """A network with standardized inputs: network((x − center) / scale); the scaling is never learned."""

    network: eqx.Module
    center: Features
    scale: Features

    def __call__(self, x: Features) -> Float[Array, "..."]:
        """Return the network's output."""
        center, scale = jax.lax.stop_gradient((self.center, self.scale))
        return self.network((x - center) / scale)  # pyright: ignore[reportCallIssue]


def scaled_network(key: PRNGKeyArray, examples: Examples, outputs: int, width: int, depth: int) -> ScaledNetwork:
    """Return a network of `depth` hidden layers (0: linear), scaled by examples of its inputs, with outputs near 0.

    Args:
        key: Draws everything random.
        examples: Typical inputs.
        outputs: The number of outputs.
        width: The units in each hidden layer.
        depth: The number of hidden layers.

    Raises:
        InputError: For no examples, any that are not finite, and counts that are none.
    """
    rows = to_finite(examples, "examples", ("examples", "features"))
    check(len(rows) > 0, "expected one or more rows, found none", field="examples")
    key, examples = to_key(key), jnp.asarray(rows)
    width, depth = to_count(width, "width"), to_count(depth, "depth", 0)
    network = eqx.filter_jit(eqx.nn.MLP)(examples.shape[-1], outputs, width, depth, jnp.tanh, key=key)
    last = jax.tree.map(lambda leaf: jax.device_put(0.01 * np.asarray(leaf)), network.layers[-1])
    return ScaledNetwork(eqx.tree_at(lambda net: net.layers[-1], network, last), *_center_and_scale(examples, 1e-6))


def _center_and_scale(rows: Float[Array, "rows *_"], least: float) -> tuple[Float[Array, "*_"], Float[Array, "*_"]]:
    """Return the mean of the rows, and their standard deviation where it is above `least`, elsewhere 1."""
    spread = np.asarray(rows.std(axis=0))
    return rows.mean(axis=0), jax.device_put(np.where(spread > least, spread, 1.0))


@short_repr()
class Policy(eqx.Module):
    """A distribution π_λ(c | x); λ are all its floating-point arrays that gradients reach.

    Attributes:
        reparameterized: Whether `sample` is smooth in λ and x while the key is held fixed; no by default.
    """

    reparameterized: ClassVar[bool] = False

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, x: Features) -> Choice:
        """Draw a choice c ~ π_λ(· | x).

        Args:
            key: Draws everything random.
            x: The features of the state.

        Returns:
            An index or a vector, as the policy has it.
        """

    @abc.abstractmethod
    def log_prob(self, x: Features, choice: Choice) -> Real:
        """Return ln π_λ(c | x), in nats.

        Args:
            x: The features of the state.
            choice: The choice c: an index or a vector.
        """

    @abc.abstractmethod
    def entropy(self, x: Features) -> Real:
        """Return H(π_λ(· | x)), in nats.

        Args:
            x: The features of the state.
        """

    @abc.abstractmethod
    def action(self, choice: Choice) -> Action:
        """Return the action that a choice stands for.

        Args:
            choice: The choice c: an index or a vector.
        """


SomePolicy = TypeVar("SomePolicy", bound=Policy)


class Critic(eqx.Module):
    """A value estimate V_w(x, l) = center + spread · network(x, l), fitted to returns-to-go W_i of earlier rollouts.

    l = 1 − i/τ is the fraction of the horizon that is left, because little can follow when little is left. A critic
    only serves as a baseline or control variate (Greensmith, Bartlett and Baxter 2004): every term made from it has
    mean 0.
    """

    network: ScaledNetwork
    center: Float[Array, ""]
    spread: Float[Array, ""]

    def __call__(self, x: Features, left: Real) -> Real:
        """Return the estimate."""
        center, spread = jax.lax.stop_gradient((self.center, self.spread))
        return center + spread * self.network(jnp.append(x, left))[0]


class Agent(eqx.Module, Generic[SomePolicy]):
    """An agent in a world.

    Attributes:
        dynamics: T_θ, by which it moves.
        policy: π_λ, by which it chooses.
        behavior: Its backup and β, which set the bonuses.

    Raises:
        InputError: For anything else in their places.
    """

    dynamics: Dynamics
    policy: SomePolicy
    behavior: Behavior

    def __check_init__(self) -> None:
        for name, kind in {"dynamics": Dynamics, "policy": Policy, "behavior": Behavior}.items():
            check_instance(getattr(self, name), kind, name)

    @property
    def temperature(self) -> Float[Array, ""]:
        """1/β, or 0 for an optimal agent (`HardMax`)."""
        beta = self.behavior.beta
        return jnp.zeros_like(beta) if isinstance(self.behavior.backup, HardMax) else 1 / beta


class Starts(eqx.Module):
    """The beginnings of rollouts.

    Attributes:
        tasks: The task of each start (a leading axis of starts).
        states: The state s_0 of each start.
        choices: The first choices to try from each start.
    """

    tasks: ContinuousTask
    states: States
    choices: Shaped[Array, "starts candidates *choice"]


class FinitePolicy(Policy):
    """A softmax policy over a finite set of actions.

    Attributes:
        network: From features to a logit of every action.
        actions: The action of each choice.
    """

    network: ScaledNetwork
    actions: Shaped[Array, "actions *action"]

    def log_probs(self, x: Features) -> Float[Array, " actions"]:
        """Return ln π_λ of every action.

        Args:
            x: The features of the state.
        """
        return jax.nn.log_softmax(self.network(x))

    def sample(self, key: PRNGKeyArray, x: Features) -> Choice:
        """Draw the index of an action.

        Args:
            key: Draws everything random.
            x: The features of the state.

        Returns:
            A whole number from 0 to the number of actions less 1.
        """
        return jax.random.categorical(key, self.network(x))

    def log_prob(self, x: Features, choice: Choice) -> Real:
        """Return ln π_λ of the index of an action.

        Args:
            x: The features of the state.
            choice: The choice c: an index or a vector.

        Returns:
            A number in nats, at most 0.
        """
        return self.log_probs(x)[choice]

    def entropy(self, x: Features) -> Real:
        """Return the entropy in nats, from 0 to ln(actions).

        Args:
            x: The features of the state.
        """
        log_probs = self.log_probs(x)
        return -jnp.sum(jnp.exp(log_probs) * log_probs)

    def action(self, choice: Choice) -> Action:
        """Return the action with this index.

        Args:
            choice: The choice c: an index or a vector.
        """
        return jax.lax.stop_gradient(self.actions)[choice]


class GaussianPolicy(Policy):
    """A Gaussian policy over vectors.

    Attributes:
        network: From features to the mean.
        log_spread: The logarithm of the standard deviation of each component, the same in all states.
    """

    network: ScaledNetwork
    log_spread: Float[Array, " inputs"]
    reparameterized: ClassVar[bool] = True

    def sample(self, key: PRNGKeyArray, x: Features) -> Choice:
        """Draw the mean plus noise.

        Args:
            key: Draws everything random.
            x: The features of the state.

        Returns:
            A vector, with one number for each component of an action.
        """
        noise = jax.random.normal(key, self.log_spread.shape, self.log_spread.dtype)
        return self.network(x) + jnp.exp(self.log_spread) * noise

    def log_prob(self, x: Features, choice: Choice) -> Real:
        """Return ln π_λ of an action.

        Args:
            x: The features of the state.
            choice: The choice c: an index or a vector.

        Returns:
            A number in nats.
        """
        return norm.logpdf(choice, self.network(x), jnp.exp(self.log_spread)).sum()

    def entropy(self, x: Features) -> Real:
        """Return the entropy in nats; below 0 for narrow policies.

        Args:
            x: The features of the state.
        """
        return jnp.sum(self.log_spread + 0.5 * math.log(2 * math.pi * math.e))

    def action(self, choice: Choice) -> Action:
        """Return the choice itself.

        Args:
            choice: The choice c: an index or a vector.
        """
        return choice


def finite_policy(
    key: PRNGKeyArray, actions: Shaped[Array, "actions *action"], examples: Examples, *, width: int = 64, depth: int = 2
) -> FinitePolicy:
    """Return a network policy over a finite set of actions that begins uniform.

    Args:
        key: Draws the initial weights.
        actions: Two or more.
        examples: Typical features, which scale the network's inputs.
        width: Units in each hidden layer.
        depth: Hidden layers.

    Raises:
        InputError: For fewer than two actions, or actions or examples that are not finite.

    Example:
        >>> policy = finite_policy(jax.random.key(0), jnp.array([[-1.0], [1.0]]), jnp.eye(3))
        >>> jnp.exp(policy.log_probs(jnp.zeros(3))).round(1).tolist()
        [0.5, 0.5]
    """
    finite, whole = to_finite(actions, "actions"), np.asarray(actions)
    check(whole.ndim and len(whole) >= 2, f"expected two or more, found shape {whole.shape}", field="actions")
    own = jnp.asarray(whole if whole.dtype.kind in "iu" else finite)
    return FinitePolicy(scaled_network(key, examples, len(own), width, depth), own)


def gaussian_policy(
    key: PRNGKeyArray, inputs: int, examples: Examples, *, spread: float = 1.0, width: int = 64, depth: int = 2
) -> GaussianPolicy:
    """Return a Gaussian policy over vectors with a mean that begins near 0.

    Args:
        key: Draws the initial weights.
        inputs: Components of an action.
        examples: Typical features, which scale the network's inputs.
        spread: The initial standard deviation, above 0.
        width: Units in each hidden layer.
        depth: Hidden layers; with 0 the mean is linear in the features.

    Raises:
        InputError: For a spread not above 0, or examples that are not finite.

    Example:
        >>> gaussian_policy(jax.random.key(0), 2, jnp.eye(3)).log_spread.tolist()
        [0.0, 0.0]
    """
    check_positive(spread, "spread")
    inputs = to_count(inputs, "inputs")
    network = scaled_network(key, examples, inputs, width, depth)
    return GaussianPolicy(network, jnp.full(inputs, math.log(spread), network.center.dtype))


def make_critic(
    key: PRNGKeyArray, examples: Examples, left: PerExample, returns: PerExample, *, width: int = 64, depth: int = 2
) -> Critic:
    """Return a critic that begins at the mean of observed returns-to-go.

    Args:
        key: Draws the initial weights.
        examples: The features of states.
        left: The fraction of the horizon that was left there, in [0, 1].
        returns: The returns-to-go from there, in units of reward.
        width: Units in each hidden layer.
        depth: Hidden layers.

    Raises:
        InputError: For no examples, or any that are not finite.

    Example:
        >>> critic = make_critic(jax.random.key(0), jnp.eye(2), jnp.ones(2), jnp.array([1.0, 3.0]))
        >>> float(critic.center), float(critic.spread)
        (2.0, 1.0)
    """
    examples = to_finite(examples, "examples", ("examples", "features"))
    count = (len(examples),)
    left, returns = to_finite(left, "left", count, least=0, most=1), to_finite(returns, "returns", count)
    network = scaled_network(key, jax.device_put(np.column_stack([examples, left])), 1, width, depth)
    return Critic(network, *_center_and_scale(returns, 0.0))
