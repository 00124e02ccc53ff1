"""Baselines: other methods that learn from the same walks, with one interface and one evaluation."""

from collections.abc import Mapping

from sidestep.baselines.behavior_aware import behavior_aware, transitions_only, visit_counts
from sidestep.baselines.behavior_cloning import behavior_cloning
from sidestep.baselines.constraint_inference import constraint_inference
from sidestep.baselines.interface import Method
from sidestep.baselines.maxent_irl import joint_estimation, maxent_irl

BASELINES: Mapping[str, Method] = {
    "transitions": transitions_only,
    "visits": visit_counts,
    "constraints": constraint_inference,
    "costs": maxent_irl,
    "joint": joint_estimation,
    "cloning": behavior_cloning,
}
"""The baselines by name."""
METHODS: Mapping[str, Method] = {"behavior": behavior_aware, **BASELINES}
"""Behavior-aware modeling and the baselines by name."""

__all__ = ["BASELINES", "METHODS"]
