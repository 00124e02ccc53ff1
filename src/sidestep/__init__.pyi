# The public names in groups. `__init__.py` reads this file and imports each name at its first use.
# ruff: noqa: I001

# errors
from .errors import (
    ImproperTask as ImproperTask,
    InputError as InputError,
    NotConverged as NotConverged,
    SidestepError as SidestepError,
    SidestepWarning as SidestepWarning,
)
from ._version import __version__ as __version__

# data: maps, walks and demonstrations
from .io.demonstrations import demonstrations_from_walks as demonstrations_from_walks
from .io.dense_tables import from_dense as from_dense
from .io.enumeration import enumerate_env as enumerate_env
from .io.environments import Environment as Environment
from .io.episodes import collect as collect
from .io.gymnasium import from_gymnasium as from_gymnasium, slip_of as slip_of, slippery as slippery
from .io.keys import observation_key as observation_key
from .io.maps import read_map as read_map, write_map as write_map
from .io.minari.demonstrations import (
    read_demonstrations as read_demonstrations,
    write_demonstrations as write_demonstrations,
)
from .io.maps import read_sensor_map as read_sensor_map, read_sensor_variance as read_sensor_variance
from .io.saving import load as load, save as save
from .io.walks import Walks as Walks, read_walks as read_walks, write_walks as write_walks
from .tabular.demonstration_tables import Labels as Labels
from .tabular.demonstrations import (
    Demonstrations as Demonstrations,
    Trajectory as Trajectory,
    gather as gather,
    split_by_person as split_by_person,
)
from .tabular.graph import Graph as Graph, graph as graph, grid_graph as grid_graph
from .tabular.grid import Cell as Cell, Grid as Grid
from .tabular.reward import Reward as Reward
from .tabular.selection import join as join
from .tabular.simulation import simulate as simulate
from .tabular.tasks import Task as Task, reach as reach, stack_tasks as stack_tasks, task as task, task_at as task_at

# models: transition models of discrete worlds
from .tabular.models import (
    FIXED as FIXED,
    IMPOSSIBLE as IMPOSSIBLE,
    FeaturedGrid as FeaturedGrid,
    ObstacleGrid as ObstacleGrid,
    SlipperyGrid as SlipperyGrid,
    TabularModel as TabularModel,
    TiedModel as TiedModel,
    TransitionModel as TransitionModel,
    borders as borders,
    closed as closed,
    road_network as road_network,
    tabular_model as tabular_model,
    true_model as true_model,
    walled_grid as walled_grid,
)
from .tabular.models.barriers import Barriers as Barriers, barriers_of as barriers_of

# behavior: how agents choose their actions
from .tabular.backups import (
    Backup as Backup,
    Behavior as Behavior,
    BoltzmannAverage as BoltzmannAverage,
    HardMax as HardMax,
    LogSumExp as LogSumExp,
    Mellowmax as Mellowmax,
)
from .tabular.behavior_model import BehaviorModel as BehaviorModel, behavior_model as behavior_model
from .tabular.likelihood import (
    LogLikelihood as LogLikelihood,
    log_likelihood as log_likelihood,
    log_policies as log_policies,
)
from .tabular.proper import check_proper as check_proper
from .tabular.solve import Solution as Solution, SolveOptions as SolveOptions, solve as solve
from .tabular.solvers.base import Solver as Solver
from .tabular.solvers.gauss_seidel import GaussSeidel as GaussSeidel
from .tabular.solvers.jacobi import Jacobi as Jacobi

# learning: maps from walks, and any model from demonstrations
from .inference.calibration import (
    ScoreStatistics as ScoreStatistics,
    effective_sample_ratio as effective_sample_ratio,
    score_statistics as score_statistics,
)
from .inference.checkpoints import Checkpoint as Checkpoint
from .inference.coordinate_ascent import (
    AscentProgress as AscentProgress,
    BarrierMeanField as BarrierMeanField,
    mean_field_barriers as mean_field_barriers,
)
from .inference.criteria import (
    InformationCriteria as InformationCriteria,
    information_criteria as information_criteria,
)
from .inference.cross_validation import CrossValidation as CrossValidation, cross_validate as cross_validate
from .inference.diagnostics import effective_sizes as effective_sizes, split_rhat as split_rhat
from .inference.devices import tasks_mesh as tasks_mesh
from .inference.enumeration import ExactPosterior as ExactPosterior, enumerate_barriers as enumerate_barriers
from .inference.fit import Estimate as Estimate, Fit as Fit, fit as fit
from .inference.maximize import Progress as Progress, Status as Status
from .inference.goals import GoalFit as GoalFit, fit_goals as fit_goals, goal_posterior as goal_posterior
from .inference.laplace import laplace as laplace
from .inference.natural_scale import NaturalScale as NaturalScale, natural_scale as natural_scale
from .inference.normal_posterior import Laplace as Laplace
from .inference.mean_field import MeanField as MeanField
from .inference.hierarchical import HierarchicalMRF as HierarchicalMRF, hierarchical_mrf as hierarchical_mrf
from .inference.mrf import BinaryMRF as BinaryMRF
from .inference.nuts import Draws as Draws, sample as sample
from .inference.objective import Parameters as Parameters
from .inference.optimizers import LBFGS as LBFGS, Adam as Adam, Optimizer as Optimizer, Rprop as Rprop
from .inference.pointwise import (
    PointwiseLogLikelihood as PointwiseLogLikelihood,
    pointwise_log_likelihood as pointwise_log_likelihood,
)
from .inference.priors import (
    FreeCellEvidence as FreeCellEvidence,
    GaussianMRF as GaussianMRF,
    Normal as Normal,
    Prior as Prior,
    WallPrior as WallPrior,
    sensor_prior as sensor_prior,
)
from .inference.pseudolikelihood import MRFFit as MRFFit, fit_mrf as fit_mrf
from .inference.sampler import (
    BarrierPosterior as BarrierPosterior,
    SweepProgress as SweepProgress,
    sample_barriers as sample_barriers,
)
from .maps.annotations import WalkAnnotations as WalkAnnotations
from .maps.config import (
    BehaviorConfig as BehaviorConfig,
    FitConfig as FitConfig,
    MapConfig as MapConfig,
    PosteriorConfig as PosteriorConfig,
    PriorConfig as PriorConfig,
)
from .maps.goal_candidates import GoalCandidates as GoalCandidates, read_goal_candidates as read_goal_candidates
from .maps.learn import learn_map as learn_map
from .maps.learned_map import LearnedMap as LearnedMap, load_map as load_map
from .maps.sensors import SensorMap as SensorMap, read_sensor as read_sensor

# planning
from .robots.robot import risk_averse_robot as risk_averse_robot
from .tabular.planning import Plan as Plan, plan as plan
from .tabular.roll_outs import RollOuts as RollOuts, roll_out as roll_out

# evaluation
from .evaluation.evaluate import evaluate as evaluate, plan_paths as plan_paths

# pictures of small worlds
from .plotting.graphs import figure_graph as figure_graph
from .plotting.heat_maps import figure_plan as figure_plan
