"""The interface of methods: a function of a map, demonstrations and a configuration, and its result."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from sidestep.errors import check, check_instance
from sidestep.evaluation.study import MethodResult
from sidestep.maps.config import MapConfig, PriorConfig
from sidestep.maps.fit import behavior_of
from sidestep.robots.planners import Planner
from sidestep.robots.robot import risk_averse_robot
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_policies
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.tasks import Task, stack_tasks

_Cells = Float[np.ndarray, "rows columns"]


@runtime_checkable
class BaselineResult(MethodResult, Protocol):
    """The result of a method: what a study evaluates, and a picture."""

    @property
    def heatmap(self) -> _Cells | None:
        """The ranking of cells from 0 to 1: P(blocked), if the method has it; None without a ranking."""
        ...


Method = Callable[[Grid, Demonstrations, MapConfig], BaselineResult]
"""A method: it learns from demonstrations on a map."""


class ModelResult(NamedTuple):
    """The result of a method that learns a transition model, a reward, or both.

    Attributes:
        model: The transition model.
        reward: The reward that agents pursue.
        behavior: How agents choose their actions.
        ranking: P(blocked) of each cell, or other numbers that are higher for obstacles.
        planner: The robot's planner.
        converged: Whether the method's optimization converged.
        options: How values are computed, such as with the horizon of agents.
    """

    model: ObstacleGrid
    reward: Reward
    behavior: Behavior
    ranking: _Cells
    planner: Planner
    converged: bool
    options: SolveOptions = SolveOptions()

    @property
    def ranks_by_probability(self) -> bool:
        """Whether the ranking is P(blocked)."""
        return np.allclose(self.ranking, self.model.blocked)

    @property
    def heatmap(self) -> _Cells:
        """P(blocked), or the ranking from 0 to 1 if P(blocked) is constant or the ranking is no probability."""
        blocked = np.asarray(self.model.blocked, dtype=np.float64)
        if np.ptp(self.ranking) and (self.ranking.max() > 1 or not np.ptp(blocked)):
            return (self.ranking - self.ranking.min()) / np.ptp(self.ranking)
        return blocked

    def log_policies(self, demonstrations: Demonstrations) -> Float[np.ndarray, " moves"]:
        """Return log π(a | s) of every move for agents that know the model and pursue the reward.

        Args:
            demonstrations: Moves on the same map.
        """
        goals = np.asarray(demonstrations.tasks.terminal).argmax(axis=-1)
        tasks = stack_tasks([self.reward.reach(self.model.blank, int(goal)) for goal in goals])
        moves = eqx.tree_at(lambda moves: moves.tasks, demonstrations, tasks)
        return np.asarray(log_policies(self.model, moves, self.behavior, options=self.options))


def check_arguments(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> None:
    """Check the arguments that all methods take.

    Args:
        grid: A map.
        demonstrations: Demonstrations on it.
        config: How they learn.

    Raises:
        InputError: For arguments of other types, and demonstrations in another world.
    """
    check_instance(grid, Grid, "grid")
    check_instance(config, MapConfig, "config")
    check_instance(demonstrations, Demonstrations, "demonstrations")
    check_instance(demonstrations.tasks, Task, "demonstrations")
    shape, actions = demonstrations.tasks.terminal.shape, int(np.asarray(demonstrations.actions).max(initial=-1))
    message = f"expected the grid's {grid.size} states and {grid.connectivity} actions, found {shape[-1]} states and "
    fits = shape[-1] == grid.size and actions < grid.connectivity
    check(fits, f"{message}actions up to {actions}", field="demonstrations")


def with_normal_prior(config: MapConfig) -> MapConfig:
    """Return a configuration of a baseline: the mode of the posterior after a normal prior of logits, the same agents.

    Args:
        config: The configuration of the comparison.
    """
    prior = config.prior if config.prior.kind == "normal" else PriorConfig("normal")
    return replace(config.completed(), prior=prior, posterior=replace(config.posterior, method="mode"))


def visited_states(demonstrations: Demonstrations) -> Int[np.ndarray, " visited"]:
    """Return the distinct states that moves of a weight above 0 leave or lead to.

    Args:
        demonstrations: The walks.
    """
    counts = np.asarray(demonstrations.weights) > 0
    return np.unique([np.asarray(demonstrations.states)[counts], np.asarray(demonstrations.next_states)[counts]])


def model_result(
    model: ObstacleGrid, demonstrations: Demonstrations, config: MapConfig, ranking: _Cells | None = None
) -> ModelResult:
    """Return a learned map as a result, with a risk-averse robot that knows the visited cells.

    Args:
        model: The learned map.
        demonstrations: What it was learned from.
        config: The configuration, with the reward and the behavior of agents.
        ranking: The ranking of cells; by default P(blocked).
    """
    ranking = np.asarray(model.blocked, dtype=np.float64) if ranking is None else ranking
    planner = risk_averse_robot(model, visited_states(demonstrations))
    behavior, options = behavior_of(config), SolveOptions(horizon=config.behavior.horizon)
    return ModelResult(model, config.reward, behavior, ranking, planner, converged=True, options=options)
