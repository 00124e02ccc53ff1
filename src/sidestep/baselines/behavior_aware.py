"""Behavior-aware modeling with the interface of the baselines, and two baselines that ignore the goals of agents.

The baselines learn from transitions only, and from the number of visits: the fewer, the more
probable an obstacle.
"""

from dataclasses import replace

import numpy as np

from sidestep.baselines.interface import ModelResult, check_arguments, model_result, with_normal_prior
from sidestep.evaluation.metrics import visit_ranking
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import infer_map
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid

_UNVISITED = 0.98
"""P(blocked) of a cell without visits."""


def behavior_aware(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Learn P(blocked) from actions and transitions, by the posterior of `learn_map`.

    Args:
        grid: The known map.
        demonstrations: The walks on it.
        config: The configuration.

    Returns:
        The learned model and behavior, P(blocked) of each cell, and whether the fit converged or the chains mixed.

    Raises:
        InputError: As `infer_map` does.
    """
    check_arguments(grid, demonstrations, config)
    posterior = infer_map(ObstacleGrid(grid, config.prior.first_logit), demonstrations, config)
    result = model_result(posterior.model, demonstrations, config)
    return result._replace(behavior=posterior.behavior.behavior_of(), converged=posterior.converged)


def transitions_only(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Learn P(blocked) from transitions and first cells, whatever the goals of agents.

    Args:
        grid: The known map.
        demonstrations: The walks on it.
        config: The configuration of the fit.

    Returns:
        The learned model and P(blocked) of each cell, and whether the fit converged.
    """
    check_arguments(grid, demonstrations, config)
    config = with_normal_prior(config)
    return behavior_aware(grid, demonstrations, replace(config, fit=replace(config.fit, terms="transitions")))


def visit_counts(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Count visits: P(blocked) = 1/(n + 1) of a cell with n > 0 visits, and at most .98.

    A visit counts by the weight of its move, the last one by that of the move that led to it.

    Args:
        grid: The known map.
        demonstrations: The walks on it.
        config: The reward and the behavior, for the log-likelihood of other walks.

    Returns:
        The map, ranked by minus the number of visits.
    """
    check_arguments(grid, demonstrations, config)
    last = np.append(demonstrations.first_moves()[1:], len(demonstrations)) - 1
    states, ends = np.asarray(demonstrations.states), np.asarray(demonstrations.next_states)[last]
    weights = np.asarray(demonstrations.weights, np.float64)
    ranking = visit_ranking(np.append(states, ends), grid, np.append(weights, weights[last]))
    blocked = np.clip(1 / (1 - ranking), None, _UNVISITED).ravel()
    return model_result(ObstacleGrid(grid, np.log(blocked) - np.log1p(-blocked)), demonstrations, config, ranking)
