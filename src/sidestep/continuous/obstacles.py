"""Motion among obstacles that form a field: the probability of being blocked at every place.

A field gives the logit f_θ(x) of being blocked at a place x, P(blocked at x) = σ(f_θ(x)). An action is a displacement a
that aims at x = s + a (clipped to the room). Obstacles either *stop* a move that aims at them,

    s′ ~ N(x, noise²) with probability 1 − σ(f_θ(x)),    s′ ~ N(s, noise²) with probability σ(f_θ(x)),

as in the paper's grids, or they *slow* it, s′ ~ N(s + (1 − σ(f_θ(x))) (x − s), noise²), which is smooth in θ.

There are three fields: normalized radial basis functions, f(x) = Σ_k θ_k φ_k(x) / Σ_k φ_k(x) with
φ_k(x) = exp(−|x − c_k|²/2w²), where θ_k is the logit around c_k and takes the same prior as a cell's logit; a neural
network; and known walls.
"""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from sidestep._arguments import to_key
from sidestep._typing import FloatTree, Tree
from sidestep.continuous.dynamics import (
    GaussianDynamics,
    Outcomes,
    Vector,
    check_corners,
    check_finite,
    checked_counts,
    checked_noise,
)
from sidestep.errors import check_instance, to_count, to_number


class Field(eqx.Module):
    """The logit of being blocked at each place.

    Attributes:
        parameters: θ, a pytree of floating-point arrays.
    """

    parameters: eqx.AbstractVar[FloatTree]

    @abc.abstractmethod
    def logit(self, place: Vector) -> Float[Scalar, ""]:
        """Return f_θ(x).

        Args:
            place: The place, in the units of the state.
        """


class RadialField(Field):
    """Normalized radial basis functions.

    Attributes:
        parameters: θ_k, the logit around each center.
        centers: The centers c_k, in the units of places.
        width: The width w, in the units of places.
    """

    parameters: Float[Array, " centers"]
    centers: Float[Array, "centers dimensions"]
    width: float = eqx.field(static=True)

    def logit(self, place: Vector) -> Float[Scalar, ""]:
        """Return the weighted mean of the logits around a place.

        Args:
            place: The place, in the units of the state.
        """
        distance = jnp.sum((place - jax.lax.stop_gradient(self.centers)) ** 2, axis=-1)
        return self.parameters @ jax.nn.softmax(-0.5 * distance / self.width**2)


def radial_field(low: Vector, high: Vector, counts: Sequence[int], logit: float = -2.0) -> RadialField:
    """Return radial basis functions with centers on a lattice, 0.7 times as wide as the centers' distance.

    Args:
        low: The lower corner of the room.
        high: The upper corner, above `low` in every component.
        counts: Centers along each side, two or more.
        logit: The logit everywhere at the beginning.

    Returns:
        A field with one weight for each center.

    Raises:
        InputError: For corners out of order, or fewer than two centers along a side.

    Example:
        >>> radial_field(jnp.zeros(2), jnp.ones(2), (2, 2)).centers.tolist()
        [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    check_corners(low, high)
    counts, logit = checked_counts(counts, len(low)), to_number(logit, "logit")
    axes = [np.linspace(*ends) for ends in zip(np.asarray(low), np.asarray(high), counts, strict=True)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))
    spacing = max(float(axis[1] - axis[0]) for axis in axes)
    return RadialField(jnp.full(len(centers), logit, jnp.result_type(float)), jnp.asarray(centers), width=0.7 * spacing)


class NetworkField(Field):
    """A small neural network over places.

    Attributes:
        parameters: The weights and biases.
        center: The middle of the room.
        scale: A quarter of each side of the room.
        offset: The logit that is added to the network's output.
        structure: The rest of the network.
    """

    parameters: FloatTree
    center: Vector
    scale: Vector
    offset: float = eqx.field(static=True)
    structure: Tree = eqx.field(static=True)

    def logit(self, place: Vector) -> Float[Scalar, ""]:
        """Return the network's output plus the offset.

        Args:
            place: The place, in the units of the state.
        """
        center, scale = jax.lax.stop_gradient((self.center, self.scale))
        return eqx.combine(self.parameters, self.structure)((place - center) / scale) + self.offset


def network_field(
    key: PRNGKeyArray, low: Vector, high: Vector, width: int = 32, depth: int = 2, logit: float = -2.0
) -> NetworkField:
    """Return a network that begins near `logit` everywhere; its inputs are scaled to [−2, 2] along each side.

    Args:
        key: Draws the initial weights.
        low: The lower corner of the room.
        high: The upper corner, above `low` in every component.
        width: Units in each hidden layer.
        depth: Hidden layers.
        logit: The offset of the output.

    Returns:
        A field with the network's weights as parameters.

    Raises:
        InputError: For corners out of order, and counts or a logit that are none.

    Example:
        >>> network_field(jax.random.key(0), jnp.zeros(2), jnp.ones(2)).scale.tolist()
        [0.25, 0.25]
    """
    check_corners(low, high)
    key, logit = to_key(key), to_number(logit, "logit")
    width, depth = to_count(width, "width"), to_count(depth, "depth", 0)
    low, high = jnp.asarray(low), jnp.asarray(high)
    network = eqx.filter_jit(eqx.nn.MLP)(len(low), "scalar", width, depth, jnp.tanh, key=key)
    parameters, structure = eqx.partition(network, eqx.is_inexact_array)
    return NetworkField(parameters, (low + high) / 2, (high - low) / 4, logit, structure)


class Walls(Field):
    """Known walls: boxes that block; nothing is learned.

    Attributes:
        low: One corner of each box.
        high: The opposite corner of each box.
    """

    low: Float[Array, "boxes dimensions"]
    high: Float[Array, "boxes dimensions"]
    parameters: tuple[()] = ()

    def logit(self, place: Vector) -> Float[Scalar, ""]:
        """Return 12 inside a box and −12 outside: P = 6e-6 changes no choice, and keeps all values finite.

        Args:
            place: The place, in the units of the state.
        """
        return jnp.where(self.inside(place), 12.0, -12.0).astype(place.dtype)

    def inside(self, place: Vector) -> jax.Array:
        """Return whether a place lies in a box.

        Args:
            place: The place, in the units of the state.
        """
        return ((place >= self.low) & (place <= self.high)).all(axis=-1).any()


class ObstacleMotion(GaussianDynamics):
    """Moves that a field of obstacles stops or slows.

    Args:
        field: The field f_θ.
        low: The lower corner of the room.
        high: The upper corner; moves aim at most at the room's border.
        noise: The standard deviation of each component of the end of a move, above 0.
        stops: Whether obstacles stop moves (True) or slow them (False).

    Raises:
        InputError: For corners out of order, noise not above 0, or parameters that are not finite.

    Example:
        >>> field = radial_field(jnp.zeros(2), jnp.ones(2), (2, 2), logit=0.0)
        >>> float(ObstacleMotion(field, jnp.zeros(2), jnp.ones(2), jnp.full(2, 0.1)).blocked(jnp.zeros(2)))
        0.5
    """

    field: Field
    low: Vector
    high: Vector
    noise: Vector
    stops: bool = eqx.field(static=True)

    def __init__(self, field: Field, low: Vector, high: Vector, noise: Vector, *, stops: bool = True):
        check_instance(field, Field, "field")
        check_corners(low, high)
        check_finite(field.parameters)
        self.field, self.stops = field, stops
        self.low, self.high, self.noise = jnp.asarray(low), jnp.asarray(high), checked_noise(noise, len(low))

    @property
    def parameters(self) -> Tree:
        """The parameters θ of the field."""
        return self.field.parameters

    def blocked(self, place: Vector) -> Float[Scalar, ""]:
        """Return P(blocked) at a place.

        Args:
            place: The place, in the units of the state.
        """
        return jax.nn.sigmoid(self.field.logit(place))

    def outcomes(self, state: Vector, action: Float[Array, " dimensions"]) -> Outcomes:
        """Return the place that the move aims at and, where obstacles stop moves, the present place.

        Args:
            state: The state s.
            action: The action a.

        Returns:
            One or two places, and the logarithm of the probability of each.
        """
        low, high = jax.lax.stop_gradient((self.low, self.high))
        target = jnp.clip(state + action, low, high)
        logit = self.field.logit(target)
        if not self.stops:
            return Outcomes.single(state + jax.nn.sigmoid(-logit) * (target - state))
        return Outcomes(jnp.stack([jax.nn.log_sigmoid(-logit), jax.nn.log_sigmoid(logit)]), jnp.stack([target, state]))
