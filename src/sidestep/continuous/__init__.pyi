# The public names in groups. `__init__.py` reads this file and imports each name at its first use.
# ruff: noqa: I001

# dynamics
from .control_variates import ValueFunction as ValueFunction
from .dynamics import (
    Dynamics as Dynamics,
    GaussianDynamics as GaussianDynamics,
    LinearGaussian as LinearGaussian,
    Outcomes as Outcomes,
    TableDynamics as TableDynamics,
)
from .obstacles import (
    Field as Field,
    NetworkField as NetworkField,
    ObstacleMotion as ObstacleMotion,
    RadialField as RadialField,
    Walls as Walls,
    network_field as network_field,
    radial_field as radial_field,
)
from .physical import Pendulum as Pendulum, PointMass as PointMass

# tasks
from .tasks import (
    ContinuousTask as ContinuousTask,
    PendulumTask as PendulumTask,
    QuadraticTask as QuadraticTask,
    ReachTask as ReachTask,
    TableTask as TableTask,
    batch_tasks as batch_tasks,
    reach_region as reach_region,
    task_at as task_at,
    task_features as task_features,
)

# agents, policies and critics
from .policies import (
    Agent as Agent,
    Critic as Critic,
    FinitePolicy as FinitePolicy,
    GaussianPolicy as GaussianPolicy,
    Policy as Policy,
    Starts as Starts,
    finite_policy as finite_policy,
    gaussian_policy as gaussian_policy,
    make_critic as make_critic,
)

# rollouts and gradients
from .rollouts import (
    Rollout as Rollout,
    discounted_returns as discounted_returns,
    q_estimates as q_estimates,
    returns_to_go as returns_to_go,
    sample_rollout as sample_rollout,
    sample_rollouts as sample_rollouts,
)
from .estimators import score_surrogate as score_surrogate, value_gradient as value_gradient

# planning and learning
from .planner import (
    Planner as Planner,
    PlannerState as PlannerState,
    PlanProgress as PlanProgress,
    PolicyPlan as PolicyPlan,
    plan_policy as plan_policy,
)
from .likelihood import FitProgress as FitProgress, Schedule as Schedule
from .fit import ContinuousFit as ContinuousFit, fit_dynamics as fit_dynamics
from .verification import Verification as Verification

# lattices and demonstrations
from .lattice import Lattice as Lattice, LatticePlanner as LatticePlanner
from .oracle import LatticeComparison as LatticeComparison, compare_with_lattice as compare_with_lattice
from .simulation import gather_trajectories as gather_trajectories, simulate_trajectories as simulate_trajectories
