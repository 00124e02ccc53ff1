"""Behavior-aware modeling: learn transition dynamics, and so hidden obstacles, from what people do.

The names here are the public ones; `docs/mathematics.md` explains what they compute.
"""

from sidestep.errors import ImproperTask, InputError, NotConverged, SidestepError
from sidestep.evaluation.evaluate import evaluate, plan_paths
from sidestep.inference.calibration import effective_sample_ratio, scores
from sidestep.inference.fit import Fit, fit
from sidestep.inference.goals import GoalFit, fit_goals, goal_posterior
from sidestep.inference.maximize import Progress
from sidestep.inference.objective import tasks_mesh
from sidestep.inference.optimizers import LBFGS, Adam, Rprop
from sidestep.inference.priors import FreeCellEvidence, GaussianMRF, Normal, Prior, WallPrior, sensor_prior
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.gymnasium import collect, from_gymnasium, slip_of, slippery
from sidestep.io.maps import read_map, write_map
from sidestep.io.minari.demonstrations import read_demonstrations, write_demonstrations
from sidestep.io.sensors import read_sensor_map, read_sensor_variance
from sidestep.io.walks import Walks, read_walks, write_walks
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
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
from sidestep.tabular.planning import Plan, RollOuts, plan, roll_out
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import Solution, SolveOptions, check_proper, solve
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Reward, Task, reach, stack_tasks, task

__all__ = [
    "LBFGS",
    "Adam",
    "Behavior",
    "BehaviorModel",
    "BoltzmannAverage",
    "Cell",
    "Demonstrations",
    "FeaturedGrid",
    "Fit",
    "FreeCellEvidence",
    "GaussSeidel",
    "GaussianMRF",
    "GoalFit",
    "Graph",
    "Grid",
    "HardMax",
    "ImproperTask",
    "InputError",
    "Jacobi",
    "LogLikelihood",
    "LogSumExp",
    "Mellowmax",
    "Normal",
    "NotConverged",
    "ObstacleGrid",
    "Plan",
    "Prior",
    "Progress",
    "Reward",
    "RollOuts",
    "Rprop",
    "SidestepError",
    "SlipperyGrid",
    "Solution",
    "SolveOptions",
    "TabularModel",
    "Task",
    "TiedModel",
    "Trajectory",
    "TransitionModel",
    "Walks",
    "WallPrior",
    "behavior_model",
    "borders",
    "check_proper",
    "closed",
    "collect",
    "demonstrations_from_walks",
    "effective_sample_ratio",
    "evaluate",
    "fit",
    "fit_goals",
    "from_gymnasium",
    "gather",
    "goal_posterior",
    "graph",
    "grid_graph",
    "log_likelihood",
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
    "sensor_prior",
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
