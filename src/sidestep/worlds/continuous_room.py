"""A room with a wall that reaches into it from below: agents walk around its end, and never touch it.

The room is ten meters a side. A move is a meter long, in one of eight directions. Goals lie on both sides of the wall
and beyond its end.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

import sidestep as ss
import sidestep.continuous as sc
from sidestep.errors import to_count

SIDE, NOISE, RADIUS = 10.0, 0.1, 0.8
"""The length of the room's sides, the standard deviation of moves, and the radius of goals; in meters."""
WALL_LOW, WALL_HIGH = (4.0, 0.0), (6.0, 7.0)
GOALS = ((1.0, 1.0), (9.0, 1.0), (1.0, 5.0), (9.0, 5.0), (2.0, 8.5), (8.0, 8.5), (5.0, 9.0))
RESOLUTION = 0.25
"""The side of a cell in pictures and scores."""
_LEAST_DISTANCE = 4.0
"""Agents start farther than this from their goal."""
_MOVES = 40


class Room(NamedTuple):
    """The real room, and the tasks and actions of agents in it."""

    dynamics: sc.ObstacleMotion
    tasks: list[sc.ReachTask]
    actions: Float[Array, "actions 2"]
    lattice: sc.Lattice

    @property
    def cells(self) -> ss.Grid:
        """The room as a map of small cells."""
        count = round(SIDE / RESOLUTION)
        blank = ss.Grid(np.zeros((count, count), dtype=np.int64), resolution=RESOLUTION)
        inside = self.inside(blank.centers(np.arange(blank.size))).reshape(blank.shape)
        return ss.Grid(np.where(inside, int(ss.Cell.OCCUPIED), int(ss.Cell.FREE)), RESOLUTION)

    def with_field(self, field: sc.Field) -> sc.ObstacleMotion:
        """Return the dynamics of the room with a field in place of its wall.

        Args:
            field: The logit of P(blocked) at each place.
        """
        return sc.ObstacleMotion(field, self.dynamics.low, self.dynamics.high, self.dynamics.noise)

    def inside(self, places: Float[np.ndarray, "places 2"]) -> Bool[np.ndarray, " places"]:
        """Return whether each place lies in the wall.

        Args:
            places: Positions in meters, of shape (places, 2).
        """
        return np.all((places >= WALL_LOW) & (places <= WALL_HIGH), axis=1)


def room(lattice_points: int = 41) -> Room:
    """Return the room, and a lattice with `lattice_points` points along each side for the values of agents.

    Args:
        lattice_points: The number of points, 2 or more.
    """
    lattice_points = to_count(lattice_points, "lattice_points", 2)
    walls = sc.Walls(low=jnp.asarray([WALL_LOW]), high=jnp.asarray([WALL_HIGH]))
    low, high = jnp.zeros(2), jnp.full(2, SIDE)
    angles = np.arange(8) * np.pi / 4
    actions = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=1))
    tasks = [sc.reach_region(goal, RADIUS, discount=1.0, step_cost=1.0) for goal in GOALS]
    dynamics = sc.ObstacleMotion(walls, low, high, jnp.full(2, NOISE))
    return Room(dynamics, tasks, actions, sc.Lattice(low, high, (lattice_points, lattice_points)))


def random_starts(world: Room, count: int, random: np.random.Generator) -> list[Float[np.ndarray, "count 2"]]:
    """Return `count` random starts for each task, outside the wall and not near the goal.

    Args:
        world: The room.
        count: The number of starts for each task.
        random: The source of random numbers.

    Returns:
        For each task, starts of shape (count, 2).
    """
    count, starts = to_count(count, "count"), []
    for goal in GOALS:
        places = random.uniform(0.5, SIDE - 0.5, size=(100 * count, 2))
        free = ~world.inside(places) & (np.linalg.norm(places - goal, axis=1) > _LEAST_DISTANCE)
        starts.append(places[free][:count])
    return starts


def walks_without_collisions(
    key: PRNGKeyArray, world: Room, behavior: ss.Behavior, agents_per_goal: int, seed: int
) -> tuple[ss.Demonstrations, int]:
    """Simulate agents that know the room, and remove every move that aimed at the wall.

    Args:
        key: Draws the moves.
        world: The room.
        behavior: The agents' backup and β.
        agents_per_goal: The number of agents with each of the goals.
        seed: Draws the starts.

    Returns:
        The moves that are left, and the number of those that were removed.
    """
    starts = random_starts(world, agents_per_goal, np.random.default_rng(seed))
    agent = sc.LatticePlanner(world.dynamics, world.actions, behavior, world.lattice)
    walks = sc.simulate_trajectories(key, agent, world.dynamics, world.tasks, starts, _MOVES)
    pieces, collisions = [], 0
    for walk in walks:
        targets = np.clip(walk.states[:-1] + np.asarray(world.actions)[walk.actions], 0, SIDE)
        hits = world.inside(targets)
        collisions += int(hits.sum())
        pieces += without_moves(walk, hits)
    return sc.gather_trajectories(pieces, world.tasks), collisions


def without_moves(trajectory: ss.Trajectory, removed: Bool[np.ndarray, " moves"]) -> list[ss.Trajectory]:
    """Return the pieces of a trajectory before, between and after the moves that are removed.

    Args:
        trajectory: The trajectory.
        removed: Whether each move is removed.
    """
    pieces, begin = [], 0
    for end in (*np.flatnonzero(removed), len(removed)):
        if end > begin:
            states, actions = trajectory.states[begin : end + 1], trajectory.actions[begin:end]
            pieces.append(ss.Trajectory(states, actions, trajectory.task))
        begin = end + 1
    return pieces
