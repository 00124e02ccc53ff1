"""Behavior-aware modeling: learn transition dynamics, and so hidden obstacles, from what people do.

The names here are the public ones; `docs/mathematics.md` explains what they compute.
"""

from sidestep.demonstrations import Demonstrations, Trajectory, gather
from sidestep.errors import ImproperTask, InputError, NotConverged, SidestepError
from sidestep.evaluation import Reward, evaluate, plan_paths
from sidestep.inference.climb import Progress
from sidestep.inference.fit import Fit, fit
from sidestep.inference.objective import tasks_mesh
from sidestep.inference.optimisers import LBFGS, Ascent, Resilient
from sidestep.inference.priors import Lines, Normal, Prior, Smooth
from sidestep.io.demonstrations import demonstrations
from sidestep.io.gymnasium import collect, from_gymnasium, slip_of, slippery
from sidestep.io.maps import read_map, write_map
from sidestep.io.walks import Walks, read_walks, write_walks
from sidestep.simulation import simulate
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.graph import Graph, graph, grid_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import LogLikelihood, log_likelihood
from sidestep.tabular.models import (
    FeaturedGrid,
    ObstacleGrid,
    TabularModel,
    TiedModel,
    TransitionModel,
    borders,
    closed,
    road_network,
    true_model,
    walled_grid,
)
from sidestep.tabular.planning import Plan, RollOuts, plan, roll_out
from sidestep.tabular.solve import Solution, check_proper, solve
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.ordered import Ordered
from sidestep.tasks import Task, reach, stack_tasks, task

__all__ = [
    "LBFGS",
    "Ascent",
    "Behavior",
    "BoltzmannAverage",
    "Cell",
    "Demonstrations",
    "FeaturedGrid",
    "Fit",
    "Graph",
    "Grid",
    "HardMax",
    "ImproperTask",
    "InputError",
    "Jacobi",
    "Lines",
    "LogLikelihood",
    "LogSumExp",
    "Mellowmax",
    "Normal",
    "NotConverged",
    "ObstacleGrid",
    "Ordered",
    "Plan",
    "Prior",
    "Progress",
    "Resilient",
    "Reward",
    "RollOuts",
    "SidestepError",
    "Smooth",
    "Solution",
    "TabularModel",
    "Task",
    "TiedModel",
    "Trajectory",
    "TransitionModel",
    "Walks",
    "borders",
    "check_proper",
    "closed",
    "collect",
    "demonstrations",
    "evaluate",
    "fit",
    "from_gymnasium",
    "gather",
    "graph",
    "grid_graph",
    "log_likelihood",
    "plan",
    "plan_paths",
    "reach",
    "read_map",
    "read_walks",
    "road_network",
    "roll_out",
    "simulate",
    "slip_of",
    "slippery",
    "solve",
    "stack_tasks",
    "task",
    "tasks_mesh",
    "true_model",
    "walled_grid",
    "write_map",
    "write_walks",
]
