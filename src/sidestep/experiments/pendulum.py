"""People who believe in another gravity than the real one, recovered from their actions alone.

The pendulum is that of Gymnasium's `Pendulum-v1`, shaken a little. Twenty people swing it to a stop near where it
hangs, with five torques. They plan for a gravity of 14 while the real one is 10; what really happens, which would
betray the real one, is not used.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sidestep._files import write_json
from sidestep.continuous.demonstrations import gather
from sidestep.continuous.fit import Schedule, fit
from sidestep.continuous.lattice import Lattice
from sidestep.continuous.likelihood import FitProgress
from sidestep.continuous.physical import Pendulum
from sidestep.continuous.planner import Planner
from sidestep.continuous.policies import finite_policy
from sidestep.continuous.simulation import simulate
from sidestep.continuous.tasks import Hold, task_at
from sidestep.inference.priors import Normal
from sidestep.plotting.maps import save
from sidestep.plotting.physics import figure_belief
from sidestep.tabular.backups import Behavior, LogSumExp

REAL, BELIEVED = 10.0, 14.0
GOALS = (np.pi - 0.25, np.pi, np.pi + 0.25, np.pi)
"""Angles to hold the pendulum at; it hangs at π."""
WALKERS, MOVES, BETA, DISCOUNT = 5, 60, 10.0, 0.9
TORQUES = (-2.0, -1.0, 0.0, 1.0, 2.0)
NOISE = (0.01, 0.1)
PLANNER = Planner(horizon=20, learning_rate=0.01)
SCHEDULE = Schedule(iterations=300, rehearsals=150, moves=100, learning_rate=0.03)
_ANGLES, _SPEEDS, _WIDTH = 2.5, 3.0, 48


def run(folder: Path, seed: int = 0, report: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Runs the experiment, writes `pendulum.png` and `summary.json` to a folder, and returns the summary."""
    started = time.monotonic()
    report("people swing the pendulum to a stop")
    people = Behavior(LogSumExp(), BETA)
    tasks = [Hold(goal=jnp.asarray(goal), discount=jnp.asarray(DISCOUNT)) for goal in GOALS]
    torques = jnp.asarray(TORQUES)[:, None]
    random = np.random.default_rng(seed)
    spread = np.array([_ANGLES, _SPEEDS])
    starts = [np.array([goal, 0.0]) + random.uniform(-spread, spread, (WALKERS, 2)) for goal in GOALS]
    lattice = Lattice(jnp.array([-np.pi, -8.0]), jnp.array([np.pi, 8.0]), (96, 81), (True, False))
    real, mark_visited_free = Pendulum(gravity=REAL, noise=NOISE), Pendulum(gravity=BELIEVED, noise=NOISE)
    walked = simulate(jax.random.key(seed), real, mark_visited_free, tasks, starts, torques, people, lattice, MOVES)
    demonstrations = gather(walked, tasks)

    report("finding the people's policy under the real gravity")
    own = task_at(demonstrations.tasks, demonstrations.task)
    seen = jax.vmap(lambda task, state: task.features(state))(own, demonstrations.states)
    way: list[float] = []

    def say(progress: FitProgress, dynamics: Pendulum) -> None:
        way.append(float(dynamics.constant("gravity")))
        report(f"learning gravity, iteration {progress.iteration} of {SCHEDULE.iterations}")

    found = fit(
        real,
        demonstrations,
        people,
        finite_policy(jax.random.key(seed), torques, seen, width=_WIDTH),
        PLANNER,
        prior=Normal(np.log(REAL), 0.5),
        terms=("actions",),
        estimator="pathwise",
        schedule=SCHEDULE,
        seed=seed,
        report=say,
    )
    estimate = float(found.dynamics.constant("gravity"))
    summary = {
        "command": "experiment pendulum",
        "seed": seed,
        "gravity_true": BELIEVED,
        "gravity_estimate": estimate,
        "gravity_real": REAL,
        "relative_error": abs(estimate - BELIEVED) / BELIEVED,
        "trajectories": len(walked),
        "moves": len(demonstrations),
        "converged": found.converged,
        "message": found.message,
        "seconds": round(time.monotonic() - started, 1),
    }
    angles = [trajectory.states[:, 0] for trajectory in walked]
    save(figure_belief(angles, real.time_step, np.asarray(way), BELIEVED, REAL), folder / "pendulum.png")
    write_json(folder / "summary.json", summary)
    return summary
