"""What the experiments in continuous worlds share: the settings of agents and of fits to their walks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
from jaxtyping import Array, Float

import sidestep as ss
import sidestep.continuous as sc
from sidestep.experiments.output import Notify


@dataclass(frozen=True)
class ContinuousConfig:
    """Settings of agents in a continuous world, and of the fit to their walks.

    Attributes:
        agents_per_goal: The number of agents with each of the goals.
        beta: Their inverse temperature β, in units of one over reward.
        planner: Rollouts and the policy's optimizers.
        schedule: The length and the steps of the fit.
        width: The units in each hidden layer of the policy.
    """

    agents_per_goal: int
    beta: float
    planner: sc.Planner
    schedule: sc.Schedule
    width: int = 48

    @property
    def behavior(self) -> ss.Behavior:
        """The agents' backup and β."""
        return ss.Behavior(ss.LogSumExp(), self.beta)

    def fit(
        self,
        dynamics: sc.Dynamics,
        walks: ss.Demonstrations,
        actions: Float[Array, "actions inputs"],
        seed: int,
        notify: Notify,
        title: str,
        observe: Callable[[Any], object] = lambda _: None,
        **settings: Any,
    ) -> sc.ContinuousFit[Any, Any]:
        """Fit dynamics to walks.

        Args:
            dynamics: The family at the initial parameters.
            walks: The moves to learn from.
            actions: The actions that the agents choose from.
            seed: Draws everything random.
            notify: Called with the title and the number of the iteration after every iteration.
            title: Says what is learned.
            observe: Called with the present dynamics after every iteration.
            settings: Other settings of `fit_dynamics`.

        Returns:
            The learned dynamics and policy, the progress of every iteration, and whether the fit converged.
        """
        features = sc.task_features(sc.task_at(walks.tasks, walks.task), walks.states)
        policy = sc.finite_policy(jax.random.key(seed), actions, features, width=self.width)

        def report(progress: sc.FitProgress, dynamics: sc.Dynamics) -> None:
            observe(dynamics)
            notify(f"{title}, iteration {progress.iteration} of {self.schedule.iterations}")

        settings |= {"schedule": self.schedule, "seed": seed, "report": report}
        return sc.fit_dynamics(dynamics, walks, self.behavior, policy, self.planner, **settings)
