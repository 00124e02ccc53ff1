"""What every method makes of walks: what a robot does, how people are taken to act, and a ranking of cells.

A method is a function of a map, demonstrations on it and settings (`Method`). Behavior-aware modeling is one of them;
so are the simplest things that one could do instead: the transitions alone, and counting visits.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from sidestep.evaluation.metrics import visit_ranking
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import behavior_of, fit_map
from sidestep.robots.planners import Planner
from sidestep.robots.robot import risk_averse_robot
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_policies
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.tabular.tasks import stack_tasks

_SELDOM = 0.98
"""P(blocked) of a cell that nobody visited, to who only counts visits."""


@runtime_checkable
class BaselineResult(Protocol):
    """What a method has learned from walks, as far as it is scored."""

    @property
    def planner(self) -> Planner:
        """What a robot does with it."""
        ...

    @property
    def ranking(self) -> Float[np.ndarray, "rows columns"] | None:
        """Of cells, higher for those that are more surely obstacles; None where nothing is learned of cells."""
        ...

    @property
    def shares(self) -> Float[np.ndarray, "rows columns"] | None:
        """The same from 0 to 1, to be drawn: P(blocked), where there is such a thing."""
        ...

    @property
    def converged(self) -> bool:
        """Whether the search for it ended where it was meant to; so it does where nothing is searched for."""
        ...

    def log_policies(self, demonstrations: Demonstrations) -> Float[np.ndarray, " moves"]:
        """How probable every action of some demonstrations is taken to be, in nats.

        All are NaN if the values of a task are not found.
        """
        ...


class ModelResult(NamedTuple):
    """What is learned by a method that has a model.

    - `model`: what is known of the world. `reward`: what people pursue in it. `behavior`: how they act on it.
    - `ranking`: of cells, higher for those that are more surely obstacles; P(blocked) where there is such a thing.
    - `planner`: what a robot does that knows all this.
    - `converged`: as in `BaselineResult`.
    """

    model: ObstacleGrid
    reward: Reward
    behavior: Behavior
    ranking: Float[np.ndarray, "rows columns"]
    planner: Planner
    converged: bool

    @property
    def shares(self) -> Float[np.ndarray, "rows columns"]:
        """P(blocked), or for those who know of none the ranking from 0 to 1."""
        blocked = np.asarray(self.model.blocked, dtype=np.float64)
        if np.ptp(self.ranking) and (self.ranking.max() > 1 or not np.ptp(blocked)):
            return (self.ranking - self.ranking.min()) / np.ptp(self.ranking)
        return blocked

    def log_policies(self, demonstrations: Demonstrations) -> Float[np.ndarray, " moves"]:
        """Of people who know the model and pursue the reward."""
        goals = np.asarray(demonstrations.tasks.terminal).argmax(axis=-1)
        tasks = stack_tasks([self.reward.reach(self.model.blank, int(goal)) for goal in goals])
        pursued = eqx.tree_at(lambda demos: demos.tasks, demonstrations, tasks)
        return np.asarray(log_policies(self.model, pursued, self.behavior))


Method = Callable[[Grid, Demonstrations, MapConfig], BaselineResult]


def reward_of(config: MapConfig) -> Reward:
    """What people are taken to pursue."""
    return config.reward


def model_result(
    model: ObstacleGrid,
    demonstrations: Demonstrations,
    config: MapConfig,
    ranking: Float[np.ndarray, "rows columns"] | None = None,
) -> ModelResult:
    """A map as what was learned: robots know it and where people walked. Without a ranking, cells have P(blocked)."""
    ranking = np.asarray(model.blocked, dtype=np.float64) if ranking is None else ranking
    planner = risk_averse_robot(model, np.concatenate(demonstrations.paths()))
    return ModelResult(model, reward_of(config), behavior_of(config.behavior), ranking, planner, converged=True)


def behavior_aware(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Behavior-aware modeling, as `sidestep learn` has it."""
    found = fit_map(ObstacleGrid(grid, config.prior.mean), demonstrations, config)
    learned = model_result(found.model, demonstrations, config)
    return learned._replace(behavior=found.people.behavior_of(), converged=found.converged)


def transitions_only(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """What transitions and first cells alone make most probable, whatever people wanted."""
    return behavior_aware(grid, demonstrations, replace(config, fit=replace(config.fit, terms="transitions")))


def visit_counts(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Counting: a cell visited n times is blocked with probability 1/(n + 1), one that was never visited with .98."""
    ranking = visit_ranking(np.concatenate(demonstrations.paths()), grid)
    blocked = np.clip(1 / (1 - ranking), None, _SELDOM).ravel()
    model = ObstacleGrid(grid, np.log(blocked) - np.log1p(-blocked))
    return model_result(model, demonstrations, config, ranking)
