"""Agents with a wrong belief about gravity, recovered from their actions alone.

The pendulum is that of Gymnasium's `Pendulum-v1`, with some noise. Twenty agents swing it to a stop near where it
hangs, with five torques. They plan for a gravity of 14 while the real one is 10; the transitions, which depend on the
real one, are not used.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import sidestep as ss
import sidestep.continuous as sc
from sidestep.experiments.continuous import ContinuousConfig
from sidestep.experiments.output import Notify, Summary, quiet, write_results
from sidestep.plotting.physics import figure_belief


@dataclass(frozen=True)
class PendulumConfig(ContinuousConfig):
    """Settings of the experiment.

    Attributes:
        real_gravity: In m/s².
        believed_gravity: In m/s².
        goals: The angles to hold the pendulum at, in radians from upright; it hangs at π.
        torques: The actions.
        noise: The standard deviations of angle and speed.
        start_spread: Starts are uniform within these distances of angle and speed from the goal.
        moves: The length of a trajectory.
        discount: γ.
        lattice_points: The numbers of points along angle and speed of the lattice that agents plan on.
    """

    agents_per_goal: int = 5
    beta: float = 10.0
    planner: sc.Planner = field(default_factory=lambda: sc.Planner(horizon=20, learning_rate=0.01))
    schedule: sc.Schedule = field(
        default_factory=lambda: sc.Schedule(300, policy_warmup=150, batch_size=100, learning_rate=0.03)
    )
    real_gravity: float = 10.0
    believed_gravity: float = 14.0
    goals: tuple[float, ...] = (np.pi - 0.25, np.pi, np.pi + 0.25, np.pi)
    torques: tuple[float, ...] = (-2.0, -1.0, 0.0, 1.0, 2.0)
    noise: tuple[float, float] = (0.01, 0.1)
    start_spread: tuple[float, float] = (2.5, 3.0)
    moves: int = 60
    discount: float = 0.9
    lattice_points: tuple[int, int] = (96, 81)

    @property
    def actions(self) -> Float[Array, "torques 1"]:
        """The torques as actions."""
        return jnp.asarray(self.torques)[:, None]

    @property
    def tasks(self) -> list[sc.PendulumTask]:
        """The task of each goal."""
        return [sc.PendulumTask(goal=jnp.asarray(goal), discount=jnp.asarray(self.discount)) for goal in self.goals]

    def trajectories(self, seed: int) -> list[ss.Trajectory]:
        """Simulate the agents.

        Args:
            seed: Draws everything random.

        Returns:
            One trajectory for each agent, those of the first goal first.
        """
        random, spread = np.random.default_rng(seed), np.array(self.start_spread)
        shape = self.agents_per_goal, 2
        starts = [np.array([goal, 0.0]) + random.uniform(-spread, spread, shape) for goal in self.goals]
        lattice = sc.Lattice(jnp.array([-np.pi, -8.0]), jnp.array([np.pi, 8.0]), self.lattice_points, (True, False))
        real, believed = (sc.Pendulum(each, noise=self.noise) for each in (self.real_gravity, self.believed_gravity))
        agent = sc.LatticePlanner(believed, self.actions, self.behavior, lattice)
        return sc.simulate_trajectories(jax.random.key(seed), agent, real, self.tasks, starts, self.moves)


def run(folder: Path, seed: int = 0, notify: Notify = quiet, config: PendulumConfig | None = None) -> Summary:
    """Run the experiment; write `pendulum.png` and `summary.json`.

    Args:
        folder: The folder to write to.
        seed: Draws everything random.
        notify: Called with a line of progress.
        config: The experiment's settings.

    Returns:
        The content of `summary.json`.
    """
    started, config = time.monotonic(), config or PendulumConfig()
    real, believed = config.real_gravity, config.believed_gravity
    notify("agents swing the pendulum to a stop")
    trajectories = config.trajectories(seed)
    walks = sc.gather_trajectories(trajectories, config.tasks)
    notify("planning under the real gravity")
    seen: list[sc.Pendulum] = []
    dynamics, prior = sc.Pendulum(real, noise=config.noise), ss.Normal(np.log(real), 0.5)
    settings = {"prior": prior, "terms": ("actions",), "estimator": "pathwise"}
    fit = config.fit(dynamics, walks, config.actions, seed, notify, "learning gravity", seen.append, **settings)
    estimate = float(fit.dynamics.constant("gravity"))
    gravity = {"gravity_true": believed, "gravity_estimate": estimate, "gravity_real": real}
    results = {**gravity, "relative_error": abs(estimate - believed) / believed, "trajectories": len(trajectories)}
    results |= {"moves": len(walks), "converged": fit.converged, "message": fit.message}
    angles = [trajectory.states[:, 0] for trajectory in trajectories]
    estimates = np.asarray([float(each.constant("gravity")) for each in seen])
    figure = figure_belief(angles, dynamics.time_step, estimates, believed, real)
    return write_results(folder, "pendulum", seed, started, figure, results)
