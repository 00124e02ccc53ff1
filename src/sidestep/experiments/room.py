"""A room with a wall that no agent touches, learned as a field of radial basis functions.

Twenty-four agents walk to each of seven goals; moves that aimed at the wall are removed. The field is learned from
actions and transitions, and from transitions alone, which hold no information about the wall. Then agents plan new
walks in the learned room, and walk them in the real one.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep._files import write_json
from sidestep.continuous.fit import ContinuousFit, fit_dynamics
from sidestep.continuous.likelihood import FitProgress, Schedule
from sidestep.continuous.obstacles import Field, ObstacleMotion, RadialField, radial_field
from sidestep.continuous.planner import Planner
from sidestep.continuous.policies import finite_policy
from sidestep.continuous.simulation import simulate_trajectories
from sidestep.continuous.tasks import task_at, task_features
from sidestep.evaluation.metrics import ranking_scores
from sidestep.inference.priors import Normal, Prior
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.likelihood import ALL_TERMS, Term
from sidestep.worlds.continuous_room import Room, room, walks_without_collisions

_NEW_WALKS = (((1.0, 2.0), 1), ((9.0, 3.0), 2), ((3.0, 4.0), 3), ((7.0, 1.0), 4))
"""The starts of planned walks, and the indices of their goals."""

Report = Callable[[str], None]


@dataclass(frozen=True)
class RoomConfig:
    """Settings of the experiments in the room.

    Attributes:
        agents_per_goal: agents that walk to each goal.
        beta: their inverse temperature β, in units of one over meters.
        prior_mean: of the logit of P(blocked).
        prior_variance: of the logit of P(blocked).
        centers: centers of basis functions along each side.
        width: units in each hidden layer of the policy.
        lattice_points: points along each side of the lattice that agents plan on.
        planner: rollouts and the policy's optimizers.
        schedule: length and steps of the fit.
    """

    agents_per_goal: int = 24
    beta: float = 4.0
    prior_mean: float = -2.5
    prior_variance: float = 10.0
    centers: int = 16
    width: int = 48
    lattice_points: int = 41
    planner: Planner = field(default_factory=lambda: Planner(horizon=24, learning_rate=0.02))
    schedule: Schedule = field(
        default_factory=lambda: Schedule(300, policy_warmup=80, learning_rate=0.15, policy_gap_tolerance=0.2)
    )

    @property
    def behavior(self) -> Behavior:
        """The agents' backup and β."""
        return Behavior(LogSumExp(), self.beta)

    @property
    def prior(self) -> Normal:
        """The prior over logits."""
        return Normal(self.prior_mean, self.prior_variance)

    def radial_field(self, world: Room) -> RadialField:
        """Return basis functions at the prior's mean."""
        return radial_field(world.dynamics.low, world.dynamics.high, (self.centers, self.centers), self.prior_mean)

    def demonstrations(self, world: Room, seed: int) -> tuple[Demonstrations, int]:
        """Return the moves to learn from, and the number of those that were removed."""
        return walks_without_collisions(jax.random.key(seed), world, self.behavior, self.agents_per_goal, seed)


class Scores(NamedTuple):
    """The separation of the wall from the rest of the room by P(blocked), over small cells."""

    auc: float
    mean_inside: float
    mean_outside: float


def fit_field(
    world: Room,
    field: Field,
    prior: Prior,
    demonstrations: Demonstrations,
    config: RoomConfig,
    *,
    seed: int,
    terms: tuple[Term, ...] = ALL_TERMS,
    report: Callable[[FitProgress, ObstacleMotion], None] | None = None,
) -> ContinuousFit:
    """Fit a field to walks in the room; the arguments are those of `fit_dynamics`."""
    real = world.dynamics
    own = task_at(demonstrations.tasks, demonstrations.task)
    features = task_features(own, demonstrations.states)
    return fit_dynamics(
        ObstacleMotion(field, real.low, real.high, real.noise),
        demonstrations,
        config.behavior,
        finite_policy(jax.random.key(seed), world.actions, features, width=config.width),
        config.planner,
        prior=prior,
        terms=terms,
        schedule=config.schedule,
        seed=seed,
        report=report,
    )


def blocked_map(dynamics: ObstacleMotion, world: Room) -> Float[np.ndarray, "rows columns"]:
    """Return P(blocked) at the center of every small cell."""
    cells = world.cells
    places = jnp.asarray(cells.centers(np.arange(cells.size)))
    return np.asarray(jax.vmap(dynamics.blocked)(places)).reshape(cells.shape)


def score_map(blocked: Float[np.ndarray, "rows columns"], world: Room) -> Scores:
    """Compare P(blocked) with the wall."""
    wall = world.cells.known == Cell.OCCUPIED
    auc, _ = ranking_scores(blocked[wall], blocked[~wall])
    return Scores(auc or 0.0, float(blocked[wall].mean()), float(blocked[~wall].mean()))


def run(
    folder: Path, seed: int = 0, report: Report = lambda _: None, config: RoomConfig | None = None
) -> dict[str, Any]:
    """Run the experiment, and write `room.png` and `summary.json` to a folder.

    Args:
        folder: the folder to write to.
        seed: draws everything random.
        report: called with a line of progress.
        config: the experiment's settings.

    Returns:
        The summary.
    """
    started, config = time.monotonic(), config or RoomConfig()
    world = room(config.lattice_points)
    report("agents walk around the wall")
    demonstrations, collisions = config.demonstrations(world, seed)

    def progress(progress: FitProgress, _: ObstacleMotion) -> None:
        report(f"learning the wall, iteration {progress.iteration} of {config.schedule.iterations}")

    report("planning in an empty room")
    data = world, config.radial_field(world), config.prior, demonstrations, config
    fit = fit_field(*data, seed=seed, report=progress)
    report("learning from transitions alone")
    transitions_fit = fit_field(*data, seed=seed, terms=("transitions",))
    blocked, by_transitions = (blocked_map(each.dynamics, world) for each in (fit, transitions_fit))
    report("planning in the learned room")
    planned, arrived = _new_walks(world, fit.dynamics, seed)
    summary = {
        "command": "experiment room",
        "seed": seed,
        **score_map(blocked, world)._asdict(),
        "transitions_only": score_map(by_transitions, world)._asdict(),
        "walks": config.agents_per_goal * len(world.tasks),
        "moves": len(demonstrations),
        "collisions_removed": collisions,
        "planned_walks_arrived": arrived,
        "planned_walks": len(planned),
        "converged": fit.converged,
        "message": fit.message,
        "seconds": round(time.monotonic() - started, 1),
    }
    _draw(folder / "room.png", world, demonstrations, (blocked, by_transitions), planned, summary["walks"])
    write_json(folder / "summary.json", summary)
    return summary


def _draw(
    path: Path,
    world: Room,
    demonstrations: Demonstrations,
    maps: tuple[np.ndarray, np.ndarray],
    planned: list[np.ndarray],
    walks: int,
) -> None:
    from sidestep.plotting.maps import Panel, figure_learned, save

    cells, goals = world.cells, np.asarray([task.goal for task in world.tasks])
    starts = np.asarray([walk[0] for walk in planned])
    panels = [
        Panel(f"{walks} walks", cells, paths=demonstrations.paths(), goals=goals),
        Panel("The learned wall, and new plans", cells, maps[0], cells, planned, starts, goals),
        Panel("By transitions alone", cells, maps[1], cells),
    ]
    save(figure_learned(panels), path)


def _new_walks(world: Room, believed: ObstacleMotion, seed: int) -> tuple[list[Float[np.ndarray, "places 2"]], int]:
    """Return walks planned in the learned room and made in the real one, and the number that arrive."""
    tasks = [world.tasks[goal] for _, goal in _NEW_WALKS]
    starts = [np.asarray([start]) for start, _ in _NEW_WALKS]
    behavior = Behavior(LogSumExp(), 30.0)
    walks = simulate_trajectories(
        jax.random.key(seed + 1), world.dynamics, believed, tasks, starts, world.actions, behavior, world.lattice, 30
    )
    arrived = sum(bool(tasks[walk.task].terminal(jnp.asarray(walk.states[-1]))) for walk in walks)
    return [walk.states for walk in walks], arrived
