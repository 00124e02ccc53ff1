"""Motion among obstacles that are a field: how likely it is to be blocked, at every place.

A field gives the logit f_θ(x) of being blocked at a place x, P(blocked at x) = σ(f_θ(x)). An action is a displacement a
that aims at x = s + a (kept in the room). Obstacles either *stop* a move that aims at them,

    s′ ~ N(x, noise²) with probability 1 − σ(f_θ(x)),    s′ ~ N(s, noise²) with probability σ(f_θ(x)),

as the paper's grids do, or they *slow* it, s′ ~ N(s + (1 − σ(f_θ(x))) (x − s), noise²), which is smooth in θ.

Three fields: normalised radial basis functions, f(x) = Σ_k θ_k φ_k(x) / Σ_k φ_k(x) with φ_k(x) = exp(−|x − c_k|²/2w²),
so that θ_k is the logit around c_k and takes the same prior as a cell's; a network; and walls that are known.
"""

import abc
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, Scalar

from sidestep.continuous.dynamics import GaussianDynamics, Outcomes, certain, check_finite, checked_noise
from sidestep.errors import InputError

Place = Float[Array, " dimensions"]


class Field(eqx.Module):
    """The logit of being blocked at each place; `parameters` are learned."""

    parameters: eqx.AbstractVar[PyTree[Float[Array, "..."]]]

    @abc.abstractmethod
    def logit(self, place: Place, parameters: PyTree[Float[Array, "..."]]) -> Float[Scalar, ""]:
        """f_θ(x) at θ = `parameters`."""


class RadialField(Field):
    """Normalised radial basis functions.

    - `parameters`: θ_k, the logit around each centre.
    - `centres`, `width`: c_k and w, in the units of places.
    """

    parameters: Float[Array, " centres"]
    centres: Float[Array, "centres dimensions"]
    width: float = eqx.field(static=True)

    def logit(self, place: Place, parameters: Float[Array, " centres"]) -> Float[Scalar, ""]:
        """The weighted mean of the logits around."""
        distance = jnp.sum((place - jax.lax.stop_gradient(self.centres)) ** 2, axis=-1)
        return parameters @ jax.nn.softmax(-0.5 * distance / self.width**2)


def radial_field(low: Place, high: Place, counts: tuple[int, ...], logit: float = -2.0) -> RadialField:
    """Radial basis functions on a lattice of `counts` centres a side, from corner `low` to `high`, as wide as apart.

    Raises `InputError` unless `high` lies above `low` and there are two centres a side or more.
    """
    check_room(low, high)
    if len(counts) != len(low) or min(counts) < 2:
        raise InputError(f"expected {len(low)} numbers of at least 2, found {counts}", field="counts")
    axes = [np.linspace(*ends) for ends in zip(np.asarray(low), np.asarray(high), counts, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))
    split_by_person = max(float(axis[1] - axis[0]) for axis in axes)
    values = jnp.full(len(centres), logit, jnp.result_type(float))
    return RadialField(values, jnp.asarray(centres), width=0.7 * split_by_person)


class NetworkField(Field):
    """A small network over places; its parameters are the weights and biases."""

    parameters: PyTree[Float[Array, "..."]]
    centre: Place
    scale: Place
    offset: float = eqx.field(static=True)
    structure: PyTree = eqx.field(static=True)

    def logit(self, place: Place, parameters: PyTree[Float[Array, "..."]]) -> Float[Scalar, ""]:
        """The network's number, plus the offset."""
        network = eqx.combine(parameters, self.structure)
        centre, scale = jax.lax.stop_gradient((self.centre, self.scale))
        return network((place - centre) / scale) + self.offset


def network_field(
    key: PRNGKeyArray, low: Place, high: Place, width: int = 32, depth: int = 2, logit: float = -2.0
) -> NetworkField:
    """A network of `depth` hidden layers, that begins near `logit` everywhere.

    Its inputs are places, scaled so that the room is [−2, 2] a side. Raises `InputError` as `radial_field` does.
    """
    check_room(low, high)
    network = eqx.nn.MLP(len(low), "scalar", width, depth, jnp.tanh, key=key)
    parameters, structure = eqx.partition(network, eqx.is_inexact_array)
    return NetworkField(parameters, (low + high) / 2, (high - low) / 4, logit, structure)


class Walls(Field):
    """Known walls: boxes that block surely; there is nothing to learn.

    - `low`, `high`: two opposite corners of each box.
    """

    low: Float[Array, "boxes dimensions"]
    high: Float[Array, "boxes dimensions"]
    parameters: tuple[()] = ()

    def logit(self, place: Place, parameters: tuple[()] = ()) -> Float[Scalar, ""]:
        """12 inside a box and −12 outside: a chance of 6e-6 is nothing to walkers, and no value is beyond a solve."""
        del parameters
        return jnp.where(self.inside(place), 12.0, -12.0).astype(place.dtype)

    def inside(self, place: Place) -> jax.Array:
        """Whether a place lies in a box."""
        return ((place >= self.low) & (place <= self.high)).all(axis=-1).any()


_Motion = TypeVar("_Motion", bound="ObstacleMotion")


class ObstacleMotion(GaussianDynamics):
    """Moves that a field of obstacles stops or slows.

    - `parameters`: those of the field.
    - `field`: f_θ.
    - `low`, `high`: the room's corners; moves aim at most at its border.
    - `noise`: the standard deviation of where a move ends, a component.
    - `stops`: whether obstacles stop moves, or slow them.
    """

    parameters: PyTree[Float[Array, "..."]]
    field: Field
    low: Place
    high: Place
    noise: Place
    stops: bool = eqx.field(static=True)

    def __init__(self, field: Field, low: Place, high: Place, noise: Place, *, stops: bool = True):
        """Raises `InputError` for corners in the wrong order, noise not above 0, and parameters that are not finite."""
        check_room(low, high)
        check_finite(field.parameters)
        self.parameters, self.field, self.stops = field.parameters, field, stops
        self.low, self.high, self.noise = jnp.asarray(low), jnp.asarray(high), checked_noise(noise, len(low))

    def with_parameters(self: _Motion, parameters: PyTree[Float[Array, "..."]]) -> _Motion:
        """The same family at another θ, which is also that of its field."""
        moved = eqx.tree_at(lambda motion: motion.field.parameters, self, parameters)
        return eqx.tree_at(lambda motion: motion.parameters, moved, parameters)

    def blocked(self, place: Place) -> Float[Scalar, ""]:
        """P(blocked) at a place."""
        return jax.nn.sigmoid(self.field.logit(place, self.parameters))

    def outcomes(self, state: Place, action: Float[Array, " dimensions"]) -> Outcomes:
        """Where the move aims, and where it stays."""
        low, high = jax.lax.stop_gradient((self.low, self.high))
        target = jnp.clip(state + action, low, high)
        logit = self.field.logit(target, self.parameters)
        if not self.stops:
            return certain(state + jax.nn.sigmoid(-logit) * (target - state))
        log_probabilities = jnp.stack([jax.nn.log_sigmoid(-logit), jax.nn.log_sigmoid(logit)])
        return Outcomes(log_probabilities, jnp.stack([target, state]))


def check_room(low: Place, high: Place) -> None:
    """Raises `InputError` unless the corners are finite and `high` lies above `low`."""
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (np.asarray(low) < np.asarray(high)).all()):
        raise InputError(f"expected corners in order, found {low} and {high}", field="low, high")
