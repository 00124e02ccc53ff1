"""Transition models of discrete worlds; the names here are the public ones."""

from sidestep.tabular.models.family import TransitionModel
from sidestep.tabular.models.obstacles import FeaturedGrid, ObstacleGrid, borders, true_model, walled_grid
from sidestep.tabular.models.outcomes import FIXED, IMPOSSIBLE, TabularModel, TiedModel
from sidestep.tabular.models.roads import closed, road_network
from sidestep.tabular.models.slips import SlipperyGrid

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
