"""Planners: how a robot reaches a goal, by planning in a model or by following a policy.

`sidestep.evaluation` needs two things of either: the path that the robot intends, and the length of the path that it
executes in the true world, where it may bump into obstacles. After a bump a robot with a model replans, and a robot
with a policy takes the next most probable action.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.robots.replanning import GridEnvironment, Lengths, Starts, policy_lengths, replanning_lengths
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import followed, plan
from sidestep.tabular.tasks import Task

Paths = Sequence[Int[np.ndarray, " _"]]
"""The states along each of several paths."""


@runtime_checkable
class GoalPlan(Protocol):
    """The plan of a robot to reach one goal."""

    def paths_from(self, starts: Starts) -> Paths:
        """Return the states of the intended path from each start; a path ends before the first repeated state."""
        ...

    def executed_lengths(self, environment: GridEnvironment, starts: Starts) -> Lengths:
        """Return the length of the executed path from each start in cell sides; infinite if it never arrives."""
        ...


@runtime_checkable
class Planner(Protocol):
    """A robot's plans to all goals."""

    def goal_mask(self) -> Bool[np.ndarray, "rows columns"]:
        """Return the cells that can be goals: those not known to be blocked."""
        ...

    def plan_to(self, goal: int) -> GoalPlan:
        """Return the plan to reach a state."""
        ...


@dataclass(frozen=True, eq=False)
class ModelPlanner:
    """A planner that solves a task for each goal in a transition model, and replans after a bump.

    Attributes:
        model: The model in which it plans.
        task_of: The task for each goal (a state).
    """

    model: ObstacleGrid
    task_of: Callable[[int], Task]

    def goal_mask(self) -> Bool[np.ndarray, "rows columns"]:
        """Return the cells with P(blocked) below 1."""
        return np.asarray(self.model.blocked) < 1

    def plan_to(self, goal: int) -> GoalPlan:
        """Return the optimal plan to reach a state."""
        return _OptimalPlan(self.model, self.task_of(goal), goal)


class _OptimalPlan(NamedTuple):
    model: ObstacleGrid
    task: Task
    goal: int

    def paths_from(self, starts: Starts) -> Paths:
        return plan(self.model, self.task).follow(starts)

    def executed_lengths(self, environment: GridEnvironment, starts: Starts) -> Lengths:
        return replanning_lengths(self.model, environment, self.task, self.goal, starts)


@dataclass(frozen=True, eq=False)
class PolicyPlanner:
    """A planner that follows a policy greedily, without a model.

    Attributes:
        grid: The known map.
        policy_of: The policy for each goal (a state).
    """

    grid: Grid
    policy_of: Callable[[int], Float[np.ndarray, "states actions"]]

    def goal_mask(self) -> Bool[np.ndarray, "rows columns"]:
        """Return the cells that are not known to be occupied."""
        return self.grid.known != Cell.OCCUPIED

    def plan_to(self, goal: int) -> GoalPlan:
        """Return the greedy plan; no action leaves the map or enters a cell known to be occupied."""
        required, occupied = moves_into(self.grid), np.append(self.grid.known.ravel() == Cell.OCCUPIED, False)
        possible = (required[..., 0] < self.grid.size) & ~occupied[required].any(axis=-1)
        return _GreedyPlan(np.where(possible, self.policy_of(goal), 0.0), required, goal)


class _GreedyPlan(NamedTuple):
    policy: Float[np.ndarray, "states actions"]
    required: Int[np.ndarray, "states actions 3"]
    goal: int

    def paths_from(self, starts: Starts) -> Paths:
        states, best = np.arange(len(self.policy)), self.policy.argmax(axis=-1)
        moves = self.policy[states, best] > 0
        return followed(np.where(moves, self.required[states, best, 0], states), states == self.goal, starts)

    def executed_lengths(self, environment: GridEnvironment, starts: Starts) -> Lengths:
        return policy_lengths(self.policy, environment, self.goal, starts)
