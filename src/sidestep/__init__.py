"""Behavior-aware modeling: learn transition dynamics, and so hidden obstacles, from what people do.

The names here are the public ones; `docs/mathematics.md` explains what they compute.
"""

from sidestep.demonstrations import Demonstrations, Trajectory, gather
from sidestep.errors import ImproperTask, InputError, NotConverged, SidestepError
from sidestep.evaluation import Reward, evaluate, plan_paths
from sidestep.inference.calibration import effective_share, scores
from sidestep.inference.climb import Progress
from sidestep.inference.fit import Fit, fit
from sidestep.inference.goals import GoalFit, fit_goals, goal_posterior
from sidestep.inference.objective import tasks_mesh
from sidestep.inference.optimisers import LBFGS, Ascent, Resilient
from sidestep.inference.priors import Lines, Normal, Prior, Smooth, Stood, sensed
from sidestep.io.demonstrations import demonstrations
from sidestep.io.gymnasium import collect, from_gymnasium, slip_of, slippery
from sidestep.io.maps import read_map, write_map
from sidestep.io.minari.demonstrations import read_demonstrations, write_demonstrations
from sidestep.io.sensors import read_sensor_map, read_sensor_variance
from sidestep.io.walks import Walks, read_walks, write_walks
from sidestep.simulation import simulate
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.graph import Graph, graph, grid_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import LogLikelihood, log_likelihood
from sidestep.tabular.models import (
    FeaturedGrid,
    ObstacleGrid,
    SlipperyGrid,
    TabularModel,
    TiedModel,
    TransitionModel,
    borders,
    closed,
    road_network,
    true_model,
    walled_grid,
)
from sidestep.tabular.people import People, people
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
    "GoalFit",
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
    "People",
    "Plan",
    "Prior",
    "Progress",
    "Resilient",
    "Reward",
    "RollOuts",
    "SidestepError",
    "SlipperyGrid",
    "Smooth",
    "Solution",
    "Stood",
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
    "effective_share",
    "evaluate",
    "fit",
    "fit_goals",
    "from_gymnasium",
    "gather",
    "goal_posterior",
    "graph",
    "grid_graph",
    "log_likelihood",
    "people",
    "plan",
    "plan_paths",
    "reach",
    "read_demonstrations",
    "read_map",
    "read_sensor_map",
    "read_sensor_variance",
    "read_walks",
    "road_network",
    "roll_out",
    "scores",
    "sensed",
    "simulate",
    "slip_of",
    "slippery",
    "solve",
    "stack_tasks",
    "task",
    "tasks_mesh",
    "true_model",
    "walled_grid",
    "write_demonstrations",
    "write_map",
    "write_walks",
]
