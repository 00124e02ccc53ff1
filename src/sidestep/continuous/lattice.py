"""A lattice over a continuous world: a tabular approximation, for checks and for exact planning.

An outcome of an action rarely falls on a point of the lattice; its probability is split among the corners of the cell
around it, with the weights of multilinear interpolation (the Markov chain approximation; Munos and Moore 2002). This
blurs an outcome by about half a cell a move, and replaces noise of about that size. Values between points are
interpolated with the same weights. The number of points grows exponentially with the dimensions, so that a lattice
serves two or three of them.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._arguments import to_finite, to_mask
from sidestep.continuous.dynamics import GaussianDynamics, Vector, check_corners, checked_counts
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import InputError, check_instance
from sidestep.tabular.backups import Behavior
from sidestep.tabular.graph import Graph
from sidestep.tabular.models import TabularModel
from sidestep.tabular.tasks import Task

PerPoint = Float[Array, " points"]


class Lattice(eqx.Module):
    """Equally spaced points between two corners.

    Args:
        low: The lower corner.
        high: The upper corner, above `low` in every component.
        counts: The number of points along each side, two or more.
        periodic: Whether each side closes to a ring (angles). There the last point is one step before `high`, which
            is `low`. No side does by default.

    Raises:
        InputError: For corners out of order, or fewer than two points along a side.

    Example:
        >>> Lattice(jnp.zeros(1), jnp.ones(1), (3,)).points().tolist()
        [[0.0], [0.5], [1.0]]
    """

    low: Vector
    high: Vector
    counts: tuple[int, ...] = eqx.field(static=True)
    periodic: tuple[bool, ...] = eqx.field(static=True)

    def __init__(self, low: Vector, high: Vector, counts: tuple[int, ...], periodic: tuple[bool, ...] | None = None):
        check_corners(low, high)
        self.low, self.high = jnp.asarray(low), jnp.asarray(high)
        self.counts = checked_counts(counts, len(self.low))
        rings = (
            (False,) * len(self.low) if periodic is None else to_mask(periodic, "periodic", (len(self.low),)).tolist()
        )
        self.periodic = tuple(rings)

    @property
    def size(self) -> int:
        """The number of points."""
        return int(np.prod(self.counts))

    def check_inside(self, places: Float[Array | np.ndarray, "places dimensions"], field: str) -> None:
        """Raise `InputError` for a place beyond the border of the lattice; sides that close have none.

        Args:
            places: The places.
            field: The argument, for the error.
        """
        low, high, numbers = np.asarray(self.low), np.asarray(self.high), np.asarray(places)
        inside = (np.asarray(self.periodic) | ((low <= numbers) & (numbers <= high))).all(axis=1)
        for place in numbers[~inside][:1].tolist():
            message = f"expected places on the lattice from {low.tolist()} to {high.tolist()}, found {place}"
            raise InputError(message, field=field)

    @property
    def spacing(self) -> Vector:
        """The distance between points along each side."""
        gaps = [count if ring else count - 1 for count, ring in zip(self.counts, self.periodic, strict=True)]
        return (self.high - self.low) / jnp.asarray(gaps)

    def points(self) -> Float[Array, "points dimensions"]:
        """Return the points, the last side's running fastest."""
        steps = jnp.stack(jnp.meshgrid(*(jnp.arange(count) for count in self.counts), indexing="ij"), axis=-1)
        return self.low + steps.reshape(-1, len(self.counts)) * self.spacing

    def interpolation_weights(self, place: Vector) -> tuple[Int[Array, " corners"], Float[Array, " corners"]]:
        """Return the points around a place and their weights, which add up to one.

        Args:
            place: The place, in the units of the state.

        Returns:
            The indices of 2^dimensions points, and their weights in [0, 1].
        """
        position = (place - self.low) / self.spacing
        counts, rings = jnp.asarray(self.counts), jnp.asarray(self.periodic)
        position = jnp.where(rings, jnp.mod(position, counts), jnp.clip(position, 0, counts - 1))
        first = jnp.floor(position).astype(jnp.int32)
        first = jnp.where(rings, first, jnp.minimum(first, counts - 2))
        beyond = position - first
        corners = jnp.asarray(list(product((0, 1), repeat=len(self.counts))))
        weights = jnp.prod(jnp.where(corners == 1, beyond, 1 - beyond), axis=-1)
        strides = jnp.asarray(np.append(np.cumprod(self.counts[:0:-1])[::-1], 1).astype(np.int32))
        return ((first + corners) % counts) @ strides, weights

    def interpolate(self, values: PerPoint, place: Vector) -> Float[Array, ""]:
        """Return values of points at any place; outside the corners, those at the border.

        Args:
            values: The value of every point.
            place: The place, in the units of the state.

        Returns:
            A number in the units of `values`.
        """
        points, weights = self.interpolation_weights(place)
        return values[points] @ weights


class LatticePlanner(eqx.Module):
    """An agent that plans exactly, but for a lattice.

    Attributes:
        dynamics: The dynamics that it believes in.
        actions: The actions that it chooses from.
        behavior: Its backup and β.
        lattice: The points of its values.

    Raises:
        InputError: For arguments of other types, and actions that are not finite.

    References:
        Munos and Moore (2002), "Variable Resolution Discretization in Optimal Control".
    """

    dynamics: GaussianDynamics
    actions: Float[Array, "actions inputs"]
    behavior: Behavior
    lattice: Lattice

    def __check_init__(self) -> None:
        check_instance(self.dynamics, GaussianDynamics, "dynamics")
        check_instance(self.behavior, Behavior, "behavior")
        check_instance(self.lattice, Lattice, "lattice")
        to_finite(self.actions, "actions", ("actions", "inputs"))

    def landing(self, mean: Vector) -> tuple[Int[Array, " landing"], Float[Array, " landing"]]:
        """Return the points where an outcome leads, and their probabilities: those of interpolation, without its noise.

        Args:
            mean: The mean next state of the outcome.
        """
        return self.lattice.interpolation_weights(mean)

    def tabular_model(self) -> TabularModel:
        """Return the transition model of the lattice over the world.

        Raises:
            InputError: For an action without a possible outcome, as of dynamics that return NaN.
        """
        successors, logits, possible = self._outcomes()
        return TabularModel(Graph(successors, jnp.ones((1, 1))), logits, possible)

    @eqx.filter_jit
    def _outcomes(self) -> tuple[Array, Array, Array]:
        """Return the next points of every point and action, their logits, and whether each is possible."""

        def outcomes(state: Vector, action: Array) -> tuple[Array, Array]:
            log_probabilities, means = self.dynamics.outcomes(state, action)
            points, weights = jax.vmap(self.landing)(means)
            return points.ravel(), (jnp.exp(log_probabilities)[:, None] * weights).ravel()

        at_points = jax.vmap(jax.vmap(outcomes, (None, 0)), (0, None))
        successors, probabilities = at_points(self.lattice.points(), self.actions)
        possible = probabilities > 0
        return successors, jnp.log(jnp.where(possible, probabilities, 1.0)), possible

    @eqx.filter_jit
    def tabular_task(self, task: ContinuousTask) -> Task:
        """Return a continuous task on the points of the lattice.

        Args:
            task: The task.

        Returns:
            A task with one state for each point, in the order of `points`.
        """
        points = self.lattice.points()
        reward = jax.vmap(jax.vmap(task.reward, (None, 0)), (0, None))(points, self.actions)
        return Task(reward, jax.vmap(task.terminal_reward)(points), jax.vmap(task.terminal)(points), task.discount)

    def action_values(self, task: ContinuousTask, values: PerPoint, state: Vector) -> Float[Array, " actions"]:
        """Return Q(s, a) at any place by one move of look-ahead, from the values of the lattice's points.

        Args:
            task: The task of the values.
            values: V of every point, in units of reward.
            state: The place s.

        Returns:
            Q of every action, in units of reward.
        """

        def value(action: Array) -> Array:
            log_probabilities, means = self.dynamics.outcomes(state, action)
            points, weights = jax.vmap(self.landing)(means)
            after = jnp.sum(values[points] * weights, axis=1)
            return task.reward(state, action) + task.discount * jnp.exp(log_probabilities) @ after

        return jax.vmap(value)(self.actions)
