"""Agents with a wrong belief about gravity, recovered from their actions alone.

The pendulum is that of Gymnasium's `Pendulum-v1`, with some noise. Twenty agents swing it to a stop near where it
hangs, with five torques. They plan for a gravity of 14 while the real one is 10; the transitions, which depend on the
real one, are not used.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._files import write_json
from sidestep.continuous.fit import fit_dynamics
from sidestep.continuous.lattice import Lattice
from sidestep.continuous.likelihood import FitProgress, Schedule
from sidestep.continuous.physical import Pendulum
from sidestep.continuous.planner import Planner
from sidestep.continuous.policies import finite_policy
from sidestep.continuous.simulation import simulate_trajectories
from sidestep.continuous.tasks import PendulumTask, task_at, task_features
from sidestep.continuous.trajectories import gather_trajectories
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import Trajectory


@dataclass(frozen=True)
class PendulumConfig:
    """Settings of the experiment.

    Attributes:
        real_gravity: in m/s².
        believed_gravity: in m/s².
        goals: the angles to hold the pendulum at, in radians from upright; it hangs at π.
        torques: the actions.
        noise: the standard deviations of angle and speed.
        start_spread: starts are uniform within these distances of angle and speed from the goal.
        agents_per_goal: agents with each of the goals.
        moves: the length of a trajectory.
        beta: the agents' inverse temperature β.
        discount: γ.
        width: units in each hidden layer of the policy.
        lattice_points: points along angle and speed of the lattice that agents plan on.
        planner: rollouts and the policy's optimizers.
        schedule: length and steps of the fit.
    """

    real_gravity: float = 10.0
    believed_gravity: float = 14.0
    goals: tuple[float, ...] = (np.pi - 0.25, np.pi, np.pi + 0.25, np.pi)
    torques: tuple[float, ...] = (-2.0, -1.0, 0.0, 1.0, 2.0)
    noise: tuple[float, float] = (0.01, 0.1)
    start_spread: tuple[float, float] = (2.5, 3.0)
    agents_per_goal: int = 5
    moves: int = 60
    beta: float = 10.0
    discount: float = 0.9
    width: int = 48
    lattice_points: tuple[int, int] = (96, 81)
    planner: Planner = field(default_factory=lambda: Planner(horizon=20, learning_rate=0.01))
    schedule: Schedule = field(
        default_factory=lambda: Schedule(iterations=300, policy_warmup=150, batch_size=100, learning_rate=0.03)
    )

    @property
    def behavior(self) -> Behavior:
        """The agents' backup and β."""
        return Behavior(LogSumExp(), self.beta)

    @property
    def actions(self) -> Float[Array, "torques 1"]:
        """The torques as actions."""
        return jnp.asarray(self.torques)[:, None]

    @property
    def tasks(self) -> list[PendulumTask]:
        """The task of each goal."""
        return [PendulumTask(goal=jnp.asarray(goal), discount=jnp.asarray(self.discount)) for goal in self.goals]

    def trajectories(self, seed: int) -> list[Trajectory]:
        """Simulate the agents."""
        random, spread = np.random.default_rng(seed), np.array(self.start_spread)
        shape = self.agents_per_goal, 2
        starts = [np.array([goal, 0.0]) + random.uniform(-spread, spread, shape) for goal in self.goals]
        lattice = Lattice(jnp.array([-np.pi, -8.0]), jnp.array([np.pi, 8.0]), self.lattice_points, (True, False))
        real, believed = (Pendulum(gravity, noise=self.noise) for gravity in (self.real_gravity, self.believed_gravity))
        key, actions, behavior = jax.random.key(seed), self.actions, self.behavior
        return simulate_trajectories(key, real, believed, self.tasks, starts, actions, behavior, lattice, self.moves)


def run(
    folder: Path, seed: int = 0, report: Callable[[str], None] = lambda _: None, config: PendulumConfig | None = None
) -> dict[str, Any]:
    """Run the experiment, and write `pendulum.png` and `summary.json` to a folder.

    Args:
        folder: the folder to write to.
        seed: draws everything random.
        report: called with a line of progress.
        config: the experiment's settings.

    Returns:
        The summary.
    """
    from sidestep.plotting.maps import save
    from sidestep.plotting.physics import figure_belief

    started, config = time.monotonic(), config or PendulumConfig()
    real, believed = config.real_gravity, config.believed_gravity
    report("agents swing the pendulum to a stop")
    trajectories = config.trajectories(seed)
    demonstrations = gather_trajectories(trajectories, config.tasks)

    report("planning under the real gravity")
    own = task_at(demonstrations.tasks, demonstrations.task)
    features = task_features(own, demonstrations.states)
    estimates: list[float] = []

    def progress(progress: FitProgress, dynamics: Pendulum) -> None:
        estimates.append(float(dynamics.constant("gravity")))
        report(f"learning gravity, iteration {progress.iteration} of {config.schedule.iterations}")

    dynamics = Pendulum(real, noise=config.noise)
    fit = fit_dynamics(
        dynamics,
        demonstrations,
        config.behavior,
        finite_policy(jax.random.key(seed), config.actions, features, width=config.width),
        config.planner,
        prior=Normal(np.log(real), 0.5),
        terms=("actions",),
        estimator="pathwise",
        schedule=config.schedule,
        seed=seed,
        report=progress,
    )
    estimate = float(fit.dynamics.constant("gravity"))
    summary = {
        "command": "experiment pendulum",
        "seed": seed,
        "gravity_true": believed,
        "gravity_estimate": estimate,
        "gravity_real": real,
        "relative_error": abs(estimate - believed) / believed,
        "trajectories": len(trajectories),
        "moves": len(demonstrations),
        "converged": fit.converged,
        "message": fit.message,
        "seconds": round(time.monotonic() - started, 1),
    }
    angles = [trajectory.states[:, 0] for trajectory in trajectories]
    figure = figure_belief(angles, dynamics.time_step, np.asarray(estimates), believed, real)
    save(figure, folder / "pendulum.png")
    write_json(folder / "summary.json", summary)
    return summary
