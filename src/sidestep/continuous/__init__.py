"""Continuous worlds: behavior-aware modeling where states are vectors, and values are found by roll-outs.

The paper's section "Continuous State Spaces" (eqs. 11 and 12). The names here are the public ones.
"""

from sidestep.continuous.critic import Critic, critic
from sidestep.continuous.demonstrations import gather
from sidestep.continuous.dynamics import Dynamics, GaussianDynamics, LinearGaussian, Outcomes, TableDynamics
from sidestep.continuous.estimators import score_surrogate, value_gradient
from sidestep.continuous.fit import ContinuousFit, Schedule, fit
from sidestep.continuous.lattice import Lattice
from sidestep.continuous.likelihood import FitProgress
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
from sidestep.continuous.planner import Planner, Planning, PlanProgress
from sidestep.continuous.planning import Plan, plan
from sidestep.continuous.policies import FinitePolicy, GaussianPolicy, Policy, finite_policy, gaussian_policy
from sidestep.continuous.rollouts import RollOut, returns, roll_out, roll_outs, said, to_come
from sidestep.continuous.simulation import simulate
from sidestep.continuous.tasks import ContinuousTask, Hold, QuadraticTask, Reach, TableTask, reach, stack

__all__ = [
    "ContinuousFit",
    "ContinuousTask",
    "Critic",
    "Dynamics",
    "Field",
    "FinitePolicy",
    "FitProgress",
    "GaussianDynamics",
    "GaussianPolicy",
    "Hold",
    "Lattice",
    "LinearGaussian",
    "NetworkField",
    "ObstacleMotion",
    "Outcomes",
    "Pendulum",
    "Plan",
    "PlanProgress",
    "Planner",
    "Planning",
    "PointMass",
    "Policy",
    "QuadraticTask",
    "RadialField",
    "Reach",
    "RollOut",
    "Schedule",
    "TableDynamics",
    "TableTask",
    "Walls",
    "critic",
    "finite_policy",
    "fit",
    "gather",
    "gaussian_policy",
    "network_field",
    "plan",
    "radial_field",
    "reach",
    "returns",
    "roll_out",
    "roll_outs",
    "said",
    "score_surrogate",
    "simulate",
    "stack",
    "to_come",
    "value_gradient",
]
