"""Transition models of discrete worlds; the names here are the public ones."""

from sidestep.tabular.models.base import TransitionModel
from sidestep.tabular.models.categorical import FIXED, IMPOSSIBLE, TabularModel, TiedModel
from sidestep.tabular.models.obstacle_grid import FeaturedGrid, ObstacleGrid, borders, true_model, walled_grid
from sidestep.tabular.models.roads import closed, road_network
from sidestep.tabular.models.slippery_grid import SlipperyGrid

__all__ = [
    "FIXED",
    "IMPOSSIBLE",
    "FeaturedGrid",
    "ObstacleGrid",
    "SlipperyGrid",
    "TabularModel",
    "TiedModel",
    "TransitionModel",
    "borders",
    "closed",
    "road_network",
    "true_model",
    "walled_grid",
]
