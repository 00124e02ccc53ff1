"""Transition models of discrete worlds; the names here are the public ones."""

from sidestep.tabular.models.base import TransitionModel as TransitionModel
from sidestep.tabular.models.categorical import FIXED as FIXED
from sidestep.tabular.models.categorical import IMPOSSIBLE as IMPOSSIBLE
from sidestep.tabular.models.categorical import TabularModel as TabularModel
from sidestep.tabular.models.categorical import TiedModel as TiedModel
from sidestep.tabular.models.categorical import tabular_model as tabular_model
from sidestep.tabular.models.obstacle_grid import FeaturedGrid as FeaturedGrid
from sidestep.tabular.models.obstacle_grid import ObstacleGrid as ObstacleGrid
from sidestep.tabular.models.obstacle_grid import borders as borders
from sidestep.tabular.models.obstacle_grid import true_model as true_model
from sidestep.tabular.models.obstacle_grid import walled_grid as walled_grid
from sidestep.tabular.models.roads import closed as closed
from sidestep.tabular.models.roads import road_network as road_network
from sidestep.tabular.models.slippery_grid import SlipperyGrid as SlipperyGrid
