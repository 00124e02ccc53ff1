"""A lattice laid over a continuous world: its tabular stand-in, to check against and to plan exactly with.

An outcome of an action hardly ever falls on a point of the lattice; it is shared among the corners of the cell that it
falls into, with the weights of multilinear interpolation (the Markov chain approximation; Munos and Moore 2002). That
blurs an outcome by about half a cell a move, and stands in for noise of about that size. Values between points are
interpolated likewise. Points grow with the power of the dimensions, so this serves two or three of them.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.continuous.dynamics import GaussianDynamics
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import InputError
from sidestep.tabular.graph import Graph
from sidestep.tabular.models import TabularModel
from sidestep.tabular.tasks import Task

Vector = Float[Array, " dimensions"]


class Lattice(eqx.Module):
    """Equally spaced points between two corners.

    - `low`, `high`: the corners. `counts`: the points a side, two or more each.
    - `periodic`: which sides close to a ring (angles): there the last point is one step before `high`, which is `low`.
    """

    low: Vector
    high: Vector
    counts: tuple[int, ...] = eqx.field(static=True)
    periodic: tuple[bool, ...] = eqx.field(static=True)

    def __init__(self, low: Vector, high: Vector, counts: tuple[int, ...], periodic: tuple[bool, ...] | None = None):
        """Raises `InputError` for corners that are not in order, and fewer than two points a side."""
        self.low, self.high = jnp.asarray(low), jnp.asarray(high)
        self.counts, self.periodic = counts, periodic or (False,) * len(counts)
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (np.asarray(low) < np.asarray(high)).all()):
            raise InputError(f"expected corners in order, found {low} and {high}", field="low, high")
        if not len(counts) == len(self.periodic) == len(low) or min(counts) < 2:
            raise InputError(f"expected {len(low)} numbers of at least 2, found {counts}", field="counts")

    @property
    def size(self) -> int:
        """How many points there are."""
        return int(np.prod(self.counts))

    @property
    def spacing(self) -> Vector:
        """How far apart points are, along each side."""
        gaps = [count if ring else count - 1 for count, ring in zip(self.counts, self.periodic, strict=True)]
        return (self.high - self.low) / jnp.asarray(gaps)

    def points(self) -> Float[Array, "points dimensions"]:
        """The points, the last side's running fastest."""
        steps = jnp.stack(jnp.meshgrid(*(jnp.arange(count) for count in self.counts), indexing="ij"), axis=-1)
        return self.low + steps.reshape(-1, len(self.counts)) * self.spacing

    def _position(self, place: Vector) -> Vector:
        """A place in steps from the first point, kept in the lattice."""
        position = (place - self.low) / self.spacing
        counts, rings = jnp.asarray(self.counts), jnp.asarray(self.periodic)
        return jnp.where(rings, jnp.mod(position, counts), jnp.clip(position, 0, counts - 1))

    def shares(self, place: Vector) -> tuple[Int[Array, " corners"], Float[Array, " corners"]]:
        """The points around a place, and the share of it that each has; they add up to one."""
        position, counts = self._position(place), jnp.asarray(self.counts)
        first = jnp.floor(position).astype(jnp.int32)
        first = jnp.where(jnp.asarray(self.periodic), first, jnp.minimum(first, counts - 2))
        beyond = position - first
        corners = jnp.asarray(list(product((0, 1), repeat=len(self.counts))))
        weights = jnp.prod(jnp.where(corners == 1, beyond, 1 - beyond), axis=-1)
        strides = jnp.asarray(np.append(np.cumprod(self.counts[:0:-1])[::-1], 1).astype(np.int32))
        return ((first + corners) % counts) @ strides, weights

    def interpolated(self, values: Float[Array, " points"], place: Vector) -> Float[Array, ""]:
        """Values of points at any place, those beyond the corners as at the border."""
        points, weights = self.shares(place)
        return values[points] @ weights


def tabular(dynamics: GaussianDynamics, lattice: Lattice, actions: Float[Array, "actions inputs"]) -> TabularModel:
    """The transition model of a lattice laid over a continuous world."""

    def outcomes(state: Vector, action: Array) -> tuple[Array, Array]:
        log_probabilities, means = dynamics.outcomes(state, action)
        points, weights = jax.vmap(lattice.shares)(means)
        return points.ravel(), (jnp.exp(log_probabilities)[:, None] * weights).ravel()

    successors, probabilities = jax.vmap(jax.vmap(outcomes, (None, 0)), (0, None))(lattice.points(), actions)
    possible = probabilities > 0
    logits = jnp.log(jnp.where(possible, probabilities, 1.0))
    return TabularModel(Graph(successors, jnp.ones((1, 1))), logits, possible)


def tabular_task(task: ContinuousTask, lattice: Lattice, actions: Float[Array, "actions inputs"]) -> Task:
    """A continuous task on the points of a lattice."""
    points = lattice.points()
    reward = jax.vmap(jax.vmap(task.reward, (None, 0)), (0, None))(points, actions)
    return Task(reward, jax.vmap(task.terminal_reward)(points), jax.vmap(task.terminal)(points), task.discount)


def action_values(
    dynamics: GaussianDynamics,
    lattice: Lattice,
    task: ContinuousTask,
    values: Float[Array, " points"],
    state: Vector,
    actions: Float[Array, "actions inputs"],
) -> Float[Array, " actions"]:
    """Q(s, a) at any place by one move ahead, from the values of a lattice's points."""

    def value(action: Array) -> Array:
        log_probabilities, means = dynamics.outcomes(state, action)
        after = jax.vmap(lambda place: lattice.interpolated(values, place))(means)
        return task.reward(state, action) + task.discount * jnp.exp(log_probabilities) @ after

    return jax.vmap(value)(actions)
