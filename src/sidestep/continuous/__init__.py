"""Continuous worlds: behavior-aware modeling with vectors for states, and values by rollouts.

This is the paper's section "Continuous State Spaces". `value_gradient` has eq. 11, `plan_policy` follows eq. 12, and
`fit_dynamics` uses both. The names here are the public ones.
"""

from sidestep.continuous.critic import Critic, make_critic
from sidestep.continuous.dynamics import Dynamics, GaussianDynamics, LinearGaussian, Outcomes, TableDynamics
from sidestep.continuous.estimators import score_surrogate, value_gradient
from sidestep.continuous.fit import ContinuousFit, fit_dynamics
from sidestep.continuous.lattice import Lattice
from sidestep.continuous.likelihood import FitProgress, Schedule
from sidestep.continuous.obstacles import (
    Field,
    NetworkField,
    ObstacleMotion,
    RadialField,
    Walls,
    network_field,
    radial_field,
)
from sidestep.continuous.physical import Pendulum, PointMass
from sidestep.continuous.planner import Planner, PlannerState, PlanProgress, PolicyPlan, plan_policy
from sidestep.continuous.policies import FinitePolicy, GaussianPolicy, Policy, finite_policy, gaussian_policy
from sidestep.continuous.rollouts import (
    Rollout,
    discounted_returns,
    q_estimates,
    returns_to_go,
    sample_rollout,
    sample_rollouts,
)
from sidestep.continuous.simulation import simulate_trajectories
from sidestep.continuous.tasks import (
    ContinuousTask,
    PendulumTask,
    QuadraticTask,
    ReachTask,
    TableTask,
    batch_tasks,
    reach_region,
    task_at,
    task_features,
)
from sidestep.continuous.trajectories import gather_trajectories

__all__ = ["Dynamics", "GaussianDynamics", "LinearGaussian", "Outcomes", "TableDynamics"]
__all__ += ["Field", "NetworkField", "ObstacleMotion", "RadialField", "Walls", "network_field", "radial_field"]
__all__ += ["Pendulum", "PointMass"]
__all__ += ["ContinuousTask", "PendulumTask", "QuadraticTask", "ReachTask", "TableTask"]
__all__ += ["batch_tasks", "reach_region", "task_at", "task_features"]
__all__ += ["FinitePolicy", "GaussianPolicy", "Policy", "finite_policy", "gaussian_policy"]
__all__ += ["Critic", "make_critic"]
__all__ += ["Rollout", "discounted_returns", "q_estimates", "returns_to_go", "sample_rollout", "sample_rollouts"]
__all__ += ["score_surrogate", "value_gradient"]
__all__ += ["PlanProgress", "Planner", "PlannerState", "PolicyPlan", "plan_policy"]
__all__ += ["ContinuousFit", "FitProgress", "Schedule", "fit_dynamics"]
__all__ += ["Lattice", "gather_trajectories", "simulate_trajectories"]
