"""What every method makes of walks: a model to plan in, a reward to plan for, and a ranking of cells.

A method is a function of a map, demonstrations on it and settings (`Method`). Behavior-aware modeling is one of them;
so are the simplest things that one could do instead: the likelihood of transitions alone, and counting visits.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sidestep.demonstrations import Demonstrations
from sidestep.evaluation import Reward
from sidestep.scoring import visit_ranking
from sidestep.settings import Settings, fit_map
from sidestep.tabular.backups import Behavior
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid

_SELDOM = 0.98
"""P(blocked) of a cell that nobody visited, to who only counts visits."""


class Learned(NamedTuple):
    """What a method has learned.

    - `model`: to plan in. `reward`: what plans pursue in it. `behavior`: how people are taken to act on it.
    - `ranking`: of cells, higher for those that are more surely obstacles; P(blocked) where there is such a thing.
    """

    model: ObstacleGrid
    reward: Reward
    behavior: Behavior
    ranking: Float[np.ndarray, "rows columns"]


Method = Callable[[Grid, Demonstrations, Settings], Learned]


def people_of(settings: Settings) -> Behavior:
    """How people are taken to behave."""
    return settings.behavior()


def reward_of(settings: Settings) -> Reward:
    """What people are taken to pursue."""
    return Reward(settings.discount, settings.step_cost)


def by_behavior(grid: Grid, demonstrations: Demonstrations, settings: Settings) -> Learned:
    """Behavior-aware modeling, as `sidestep learn` has it."""
    model = fit_map(ObstacleGrid(grid, settings.prior_mean), demonstrations, settings).model
    return Learned(model, reward_of(settings), people_of(settings), np.asarray(model.blocked, dtype=np.float64))


def by_transitions(grid: Grid, demonstrations: Demonstrations, settings: Settings) -> Learned:
    """Maximum likelihood of the observed transitions alone, whatever people wanted."""
    return by_behavior(grid, demonstrations, replace(settings, terms="transitions"))


def by_visits(grid: Grid, demonstrations: Demonstrations, settings: Settings) -> Learned:
    """Counting: a cell visited n times is blocked with probability 1/(n + 1), one that was never visited with .98."""
    ranking = visit_ranking(np.concatenate(demonstrations.paths()), grid)
    blocked = np.clip(1 / (1 - ranking), None, _SELDOM).ravel()
    model = ObstacleGrid(grid, np.log(blocked) - np.log1p(-blocked))
    return Learned(model, reward_of(settings), people_of(settings), ranking)
