"""A room with a wall that no agent touches, learned as a field of radial basis functions.

Twenty-four agents walk to each of seven goals; moves that aimed at the wall are removed. The field is learned from
actions and transitions, and from transitions alone, which hold no information about the wall. Then agents plan new
walks in the learned room, and walk them in the real one.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import sidestep as ss
import sidestep.continuous as sc
from sidestep.evaluation.metrics import ranking_scores
from sidestep.experiments.continuous import ContinuousConfig
from sidestep.experiments.output import Notify, Summary, quiet, write_results
from sidestep.plotting.maps import Panel, figure_learned
from sidestep.worlds.continuous_room import Room, room, walks_without_collisions

_NEW_WALKS = (((1.0, 2.0), 1), ((9.0, 3.0), 2), ((3.0, 4.0), 3), ((7.0, 1.0), 4))
"""The starts of planned walks, and the indices of their goals."""


@dataclass(frozen=True)
class RoomConfig(ContinuousConfig):
    """Settings of the experiments in the room; rewards are in meters.

    Attributes:
        prior_mean: The mean of the logit of P(blocked).
        prior_variance: The variance of the logit of P(blocked).
        centers: The number of centers of basis functions along each side.
        lattice_points: The number of points along each side of the lattice that agents plan on.
    """

    agents_per_goal: int = 24
    beta: float = 4.0
    planner: sc.Planner = field(default_factory=lambda: sc.Planner(horizon=24, learning_rate=0.02))
    schedule: sc.Schedule = field(
        default_factory=lambda: sc.Schedule(
            300,
            policy_warmup=80,
            policy_steps=2,
            learning_rate=0.15,
            distance_tolerance=0.75,
            policy_gap_tolerance=0.2,
        )
    )
    prior_mean: float = -2.5
    prior_variance: float = 10.0
    centers: int = 16
    lattice_points: int = 41

    @property
    def prior(self) -> ss.Normal:
        """The prior over logits."""
        return ss.Normal(self.prior_mean, self.prior_variance)

    def radial_field(self, world: Room) -> sc.RadialField:
        """Return basis functions at the prior's mean.

        Args:
            world: The room.

        Returns:
            A field with `centers`² weights.
        """
        return sc.radial_field(world.dynamics.low, world.dynamics.high, (self.centers, self.centers), self.prior_mean)

    def demonstrations(self, world: Room, seed: int) -> tuple[ss.Demonstrations, int]:
        """Return the moves to learn from, and the number of those that were removed.

        Args:
            world: The room.
            seed: Draws everything random.
        """
        return walks_without_collisions(jax.random.key(seed), world, self.behavior, self.agents_per_goal, seed)


def blocked_map(dynamics: sc.ObstacleMotion, world: Room) -> Float[np.ndarray, "rows columns"]:
    """Return P(blocked) at the center of every small cell.

    Args:
        dynamics: The learned dynamics.
        world: The room.

    Returns:
        P(blocked) in [0, 1], one number a cell.
    """
    cells = world.cells
    places = jnp.asarray(cells.centers(np.arange(cells.size)))
    return np.asarray(jax.vmap(dynamics.blocked)(places)).reshape(cells.shape)


def score_map(blocked: Float[np.ndarray, "rows columns"], world: Room) -> dict[str, float]:
    """Return how P(blocked) separates the wall from the rest of the room, over small cells.

    Args:
        blocked: P(blocked) of each cell, in [0, 1].
        world: The room.

    Returns:
        The area under the ROC curve and the mean P(blocked) inside and outside the wall.
    """
    wall = world.cells.known == ss.Cell.OCCUPIED
    auc, _ = ranking_scores(blocked[wall], blocked[~wall])
    means = {"mean_inside": float(blocked[wall].mean()), "mean_outside": float(blocked[~wall].mean())}
    return {"auc": auc or 0.0, **means}


def run(folder: Path, seed: int = 0, notify: Notify = quiet, config: RoomConfig | None = None) -> Summary:
    """Run the experiment; write `room.png` and `summary.json`.

    Args:
        folder: The folder to write to.
        seed: Draws everything random.
        notify: Called with a line of progress.
        config: The experiment's settings.

    Returns:
        The content of `summary.json`.
    """
    started, config = time.monotonic(), config or RoomConfig()
    world = room(config.lattice_points)
    notify("agents walk around the wall")
    demonstrations, collisions = config.demonstrations(world, seed)

    notify("planning in an empty room")
    data = world.with_field(config.radial_field(world)), demonstrations, world.actions, seed, notify
    fit = config.fit(*data, "learning the wall", prior=config.prior)
    transitions_fit = config.fit(*data, "learning from transitions alone", prior=config.prior, terms=("transitions",))
    blocked, by_transitions = (blocked_map(each.dynamics, world) for each in (fit, transitions_fit))
    notify("planning in the learned room")
    planned, arrived = _new_walks(world, fit.dynamics, seed)
    walks, cells = config.agents_per_goal * len(world.tasks), world.cells
    starts, goals = np.asarray([walk[0] for walk in planned]), np.asarray([task.goal for task in world.tasks])
    panels = [
        Panel(f"{walks} walks", cells, paths=demonstrations.paths(), goals=goals),
        Panel("The learned wall, and new plans", cells, blocked, cells, planned, starts, goals),
        Panel("By transitions alone", cells, by_transitions, cells),
    ]
    scores = {**score_map(blocked, world), "transitions_only": score_map(by_transitions, world)}
    counts = {"walks": walks, "moves": len(demonstrations), "collisions_removed": collisions}
    plans = {"planned_walks_arrived": arrived, "planned_walks": len(planned)}
    results = {**scores, **counts, **plans, "converged": fit.converged, "message": fit.message}
    return write_results(folder, "room", seed, started, figure_learned(panels), results)


def _new_walks(world: Room, believed: sc.ObstacleMotion, seed: int) -> tuple[list[Float[np.ndarray, "places 2"]], int]:
    """Return walks planned in the learned room and made in the real one, and the number that arrive."""
    tasks = [world.tasks[goal] for _, goal in _NEW_WALKS]
    starts = [np.asarray([start]) for start, _ in _NEW_WALKS]
    agent = sc.LatticePlanner(believed, world.actions, ss.Behavior(ss.LogSumExp(), 30.0), world.lattice)
    walks = sc.simulate_trajectories(jax.random.key(seed + 1), agent, world.dynamics, tasks, starts, 30)
    arrived = sum(bool(tasks[walk.task].terminal(jnp.asarray(walk.states[-1]))) for walk in walks)
    return [walk.states for walk in walks], arrived
