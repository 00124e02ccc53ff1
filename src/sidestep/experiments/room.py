"""A room with a wall that nobody touches, learned as a field of radial basis functions.

Twenty-four people walk to each of seven goals; moves that aimed at the wall are taken out. The field is learned from
actions and transitions, and from transitions alone, which say nothing about the wall. Then new walks are planned in the
learned room, by people who believe in it and walk in the real one.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from sklearn.metrics import roc_auc_score

from sidestep._files import write_json
from sidestep.continuous.fit import ContinuousFit, Schedule, fit
from sidestep.continuous.likelihood import FitProgress
from sidestep.continuous.obstacles import Field, ObstacleMotion, radial_field
from sidestep.continuous.planner import Planner
from sidestep.continuous.policies import finite_policy
from sidestep.continuous.simulation import simulate
from sidestep.continuous.tasks import task_at
from sidestep.inference.priors import Normal, Prior
from sidestep.plotting.maps import Panel, figure_learned, save
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Term
from sidestep.worlds.continuous_room import Room, room, walks_without_collisions

WALKERS, CENTRES = 24, 16
"""People to each goal, and centres of basis functions a side."""
BETA, PRIOR_MEAN, PRIOR_VARIANCE = 4.0, -2.5, 10.0
PLANNER = Planner(horizon=24, learning_rate=0.02)
SCHEDULE = Schedule(iterations=300, rehearsals=80, learning_rate=0.15, lag=0.2)
_WIDTH = 48
_TRIPS = (((1.0, 2.0), 1), ((9.0, 3.0), 2), ((3.0, 4.0), 3), ((7.0, 1.0), 4))
"""Where planned walks start, and which goals they have."""

Report = Callable[[str], None]


class Scores(NamedTuple):
    """How well P(blocked) tells the wall from the rest of the room, over small cells."""

    auc: float
    mean_inside: float
    mean_outside: float


def people() -> Behavior:
    """How people walk in the room."""
    return Behavior(LogSumExp(), BETA)


def demonstrated(world: Room, seed: int) -> tuple[Demonstrations, int]:
    """The walks that everything is learned from, and how many moves were taken out of them."""
    return walks_without_collisions(jax.random.key(seed), world, people(), WALKERS, seed)


def learned(
    world: Room,
    field: Field,
    prior: Prior,
    demonstrations: Demonstrations,
    seed: int,
    terms: tuple[Term, ...] = ALL_TERMS,
    rate: float = SCHEDULE.learning_rate,
    report: Callable[[FitProgress, ObstacleMotion], None] | None = None,
) -> ContinuousFit:
    """The fit of a field to walks in the room; `rate` is the learning rate of the field's parameters."""
    real = world.dynamics
    own = task_at(demonstrations.tasks, demonstrations.task)
    seen = jax.vmap(lambda task, state: task.features(state))(own, demonstrations.states)
    policy = finite_policy(jax.random.key(seed), world.actions, seen, width=_WIDTH)
    return fit(
        ObstacleMotion(field, real.low, real.high, real.noise),
        demonstrations,
        people(),
        policy,
        PLANNER,
        prior=prior,
        terms=terms,
        schedule=replace(SCHEDULE, learning_rate=rate),
        seed=seed,
        report=report,
    )


def blocked_in(dynamics: ObstacleMotion, world: Room) -> Float[np.ndarray, "rows columns"]:
    """P(blocked) at the centre of every small cell."""
    cells = world.cells
    return np.asarray(jax.vmap(dynamics.blocked)(jnp.asarray(cells.centres(np.arange(cells.size))))).reshape(
        cells.shape
    )


def scores(blocked: Float[np.ndarray, "rows columns"], world: Room) -> Scores:
    """P(blocked) against the wall."""
    wall = world.cells.known == 1
    return Scores(
        float(roc_auc_score(wall.ravel(), blocked.ravel())), float(blocked[wall].mean()), float(blocked[~wall].mean())
    )


def run(folder: Path, seed: int = 0, report: Report = lambda _: None) -> dict[str, Any]:
    """Runs the experiment, writes `room.png` and `summary.json` to a folder, and returns the summary."""
    started = time.monotonic()
    world = room()
    report("people walk around the wall")
    demonstrations, collisions = demonstrated(world, seed)
    prior = Normal(PRIOR_MEAN, PRIOR_VARIANCE)
    field = radial_field(world.dynamics.low, world.dynamics.high, (CENTRES, CENTRES), PRIOR_MEAN)

    def say(progress: FitProgress, _: ObstacleMotion) -> None:
        report(f"learning the wall, iteration {progress.iteration} of {SCHEDULE.iterations}")

    report("finding the people's policy in an empty room")
    found = learned(world, field, prior, demonstrations, seed, report=say)
    report("learning from transitions alone")
    without = learned(world, field, prior, demonstrations, seed, ("transitions",))
    blocked, blind = blocked_in(found.dynamics, world), blocked_in(without.dynamics, world)
    report("planning in the learned room")
    trips = _trips(world, found.dynamics, seed)
    transitions_only, walks = scores(blind, world), WALKERS * len(world.tasks)
    summary = {
        "command": "experiment room",
        "seed": seed,
        **scores(blocked, world)._asdict(),
        "transitions_only": transitions_only._asdict(),
        "walks": walks,
        "moves": len(demonstrations),
        "collisions_removed": collisions,
        "planned_walks_arrived": sum(arrived for _, arrived in trips),
        "planned_walks": len(trips),
        "converged": found.converged,
        "message": found.message,
        "seconds": round(time.monotonic() - started, 1),
    }
    cells, goals = world.cells, np.asarray([task.goal for task in world.tasks])
    demonstrated_paths = demonstrations.paths()
    planned = [walk for walk, _ in trips]
    panels = [
        Panel(f"{walks} walks", cells, paths=demonstrated_paths, goals=goals),
        Panel(
            "What they say, and new plans",
            cells,
            blocked,
            cells,
            planned,
            np.asarray([walk[0] for walk in planned]),
            goals,
        ),
        Panel("By transitions alone", cells, blind, cells),
    ]
    save(figure_learned(panels), folder / "room.png")
    write_json(folder / "summary.json", summary)
    return summary


def tasks_of(demonstrations: Demonstrations) -> Int[np.ndarray, " trajectories"]:
    """The task of each trajectory."""
    first = demonstrations.first_moves()
    return np.asarray(demonstrations.task)[first]


def _trips(
    world: Room, mark_visited_free: ObstacleMotion, seed: int
) -> list[tuple[Float[np.ndarray, "places 2"], bool]]:
    """New walks of people who believe in the learned room and walk in the real one, and whether they arrive."""
    tasks = [world.tasks[goal] for _, goal in _TRIPS]
    begins = [np.asarray([start]) for start, _ in _TRIPS]
    walked = simulate(
        jax.random.key(seed + 1),
        world.dynamics,
        mark_visited_free,
        tasks,
        begins,
        world.actions,
        Behavior(LogSumExp(), 30.0),
        world.lattice,
        moves=30,
    )
    return [(each.states, bool(tasks[each.task].terminal(jnp.asarray(each.states[-1])))) for each in walked]
