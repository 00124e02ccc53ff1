"""Behavior-aware modeling with the interface of the baselines, and with the likelihood of transitions only."""

from dataclasses import replace

from sidestep.baselines.interface import ModelResult, model_result
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import fit_map
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid


def behavior_aware(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Learn P(blocked) from actions and transitions, by the fit of `learn_map`."""
    fit = fit_map(ObstacleGrid(grid, config.prior.mean), demonstrations, config)
    result = model_result(fit.model, demonstrations, config)
    return result._replace(behavior=fit.behavior.behavior_of(), converged=fit.converged)


def transitions_only(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Learn P(blocked) from transitions and first cells, whatever the goals of agents."""
    return behavior_aware(grid, demonstrations, replace(config, fit=replace(config.fit, terms="transitions")))
