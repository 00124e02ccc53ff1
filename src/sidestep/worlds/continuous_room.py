"""A room with a wall that reaches into it from below: people walk around its end, and never touch it.

The room is ten metres a side. A move is a metre long, in one of eight directions. Places to go to lie on both sides of
the wall and beyond its end.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sidestep.continuous.demonstrations import gather
from sidestep.continuous.lattice import Lattice
from sidestep.continuous.obstacles import ObstacleMotion, Walls
from sidestep.continuous.simulation import simulate
from sidestep.continuous.tasks import Reach, reach
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations, Trajectory
from sidestep.tabular.grid import Cell, Grid

SIDE, NOISE, RADIUS = 10.0, 0.1, 0.8
"""How long the room's sides are, how noisy moves, and how near a goal is near enough; in metres."""
WALL_LOW, WALL_HIGH = (4.0, 0.0), (6.0, 7.0)
GOALS = ((1.0, 1.0), (9.0, 1.0), (1.0, 5.0), (9.0, 5.0), (2.0, 8.5), (8.0, 8.5), (5.0, 9.0))
RESOLUTION = 0.25
"""The side of a cell in pictures and scores."""
_AWAY = 4.0
"""Walkers start farther than this from their goal."""
_MOVES = 40


class Room(NamedTuple):
    """The room as it is, and what people can do in it."""

    dynamics: ObstacleMotion
    tasks: list[Reach]
    actions: Float[Array, "actions 2"]
    lattice: Lattice

    @property
    def cells(self) -> Grid:
        """The room as a map of small cells."""
        count = round(SIDE / RESOLUTION)
        blank = Grid(np.zeros((count, count), dtype=np.int64), resolution=RESOLUTION)
        inside = self.inside(blank.centres(np.arange(blank.size)))
        return Grid(np.where(inside, Cell.OCCUPIED, Cell.FREE).reshape(blank.shape).astype(np.int64), RESOLUTION)

    def inside(self, places: Float[np.ndarray, "places 2"]) -> Bool[np.ndarray, " places"]:
        """Which places lie in the wall."""
        return np.all((places >= WALL_LOW) & (places <= WALL_HIGH), axis=1)


def room() -> Room:
    """The room."""
    walls = Walls(low=jnp.asarray([WALL_LOW]), high=jnp.asarray([WALL_HIGH]))
    low, high = jnp.zeros(2), jnp.full(2, SIDE)
    angles = np.arange(8) * np.pi / 4
    return Room(
        ObstacleMotion(walls, low, high, jnp.full(2, NOISE)),
        [reach(goal, RADIUS, discount=1.0, step_cost=1.0) for goal in GOALS],
        jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=1)),
        Lattice(low, high, (41, 41)),
    )


def starts(world: Room, walkers: int, random: np.random.Generator) -> list[Float[np.ndarray, "walkers 2"]]:
    """Where the walkers of each task start: anywhere outside the wall, some way from the goal."""
    chosen = []
    for goal in GOALS:
        places = random.uniform(0.5, SIDE - 0.5, size=(100 * walkers, 2))
        free = ~world.inside(places) & (np.linalg.norm(places - goal, axis=1) > _AWAY)
        chosen.append(places[free][:walkers])
    return chosen


def walks_without_collisions(
    key: PRNGKeyArray, world: Room, behavior: Behavior, walkers: int, seed: int
) -> tuple[Demonstrations, int]:
    """Walks of people who know the room, every move taken out that aimed at the wall; and how many these were.

    `walkers` go to each of the goals.
    """
    own = starts(world, walkers, np.random.default_rng(seed))
    known = world.dynamics
    walked = simulate(key, known, known, world.tasks, own, world.actions, behavior, world.lattice, _MOVES)
    pieces, collisions = [], 0
    for trajectory in walked:
        aims = np.clip(trajectory.states[:-1] + np.asarray(world.actions)[trajectory.actions], 0, SIDE)
        hits = world.inside(aims)
        collisions += int(hits.sum())
        pieces += without(hits, trajectory)
    return gather(pieces, world.tasks), collisions


def without(moves: Bool[np.ndarray, " moves"], trajectory: Trajectory) -> list[Trajectory]:
    """What is left of a trajectory when some moves are taken out: the pieces before, between and after them."""
    pieces, begin = [], 0
    for end in (*np.flatnonzero(moves), len(moves)):
        if end > begin:
            states, actions = trajectory.states[begin : end + 1], trajectory.actions[begin:end]
            pieces.append(Trajectory(states, actions, trajectory.task))
        begin = end + 1
    return pieces
