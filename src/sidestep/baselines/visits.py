"""Visit counts: cells are more probably blocked the less they are visited."""

import numpy as np

from sidestep.baselines.interface import ModelResult, model_result
from sidestep.evaluation.metrics import visit_ranking
from sidestep.maps.config import MapConfig
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid

_UNVISITED = 0.98
"""P(blocked) of a cell without visits."""


def visit_counts(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Count visits: P(blocked) = 1/(n + 1) of a cell with n > 0 visits and .98 of one without."""
    ranking = visit_ranking(np.concatenate(demonstrations.paths()), grid)
    blocked = np.clip(1 / (1 - ranking), None, _UNVISITED).ravel()
    model = ObstacleGrid(grid, np.log(blocked) - np.log1p(-blocked))
    return model_result(model, demonstrations, config, ranking)
