"""Planners: what a robot does to reach a goal, whether it plans in a model or follows a policy.

From either, `evaluation` learns the same two things: which states the robot means to pass, and how far it goes in the
true world, where it may bump into something. Who plans in a model then plans again; who has but a policy takes the next
most probable action.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.robots.replanning import World, lengths_by_policy, lengths_with_bumps
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import followed, plan
from sidestep.tabular.tasks import Task


@runtime_checkable
class GoalPlan(Protocol):
    """What a robot does to reach one goal."""

    def follow(self, starts: Int[np.ndarray, " starts"]) -> Sequence[Int[np.ndarray, " _"]]:
        """The states that it means to pass from each start on; they end before the first that would repeat."""
        ...

    def lengths_with_bumps(self, world: World, starts: Int[np.ndarray, " starts"]) -> Float[np.ndarray, " starts"]:
        """How far it goes from each start in the true world, in cell sides; infinite if it never arrives."""
        ...


@runtime_checkable
class Planner(Protocol):
    """What a robot does, whatever the goal."""

    def possible(self) -> Bool[np.ndarray, "rows columns"]:
        """The cells that may be goals: those not known to be blocked."""
        ...

    def plan_to(self, goal: int) -> GoalPlan:
        """What the robot does to reach a state."""
        ...


@dataclass(frozen=True, eq=False)
class ModelPlanner:
    """A planner that plans in a model the task that it is given for each goal."""

    model: ObstacleGrid
    task_of: Callable[[int], Task]

    def possible(self) -> Bool[np.ndarray, "rows columns"]:
        """The cells that the model is not sure are blocked."""
        return np.asarray(self.model.blocked) < 1

    def plan_to(self, goal: int) -> GoalPlan:
        """The optimal plan, and after a bump another."""
        return _Planned(self.model, self.task_of(goal), goal)


class _Planned(NamedTuple):
    model: ObstacleGrid
    task: Task
    goal: int

    def follow(self, starts: Int[np.ndarray, " starts"]) -> Sequence[Int[np.ndarray, " _"]]:
        return plan(self.model, self.task).follow(starts)

    def lengths_with_bumps(self, world: World, starts: Int[np.ndarray, " starts"]) -> Float[np.ndarray, " starts"]:
        return lengths_with_bumps(self.model, world, self.task, self.goal, starts)


@dataclass(frozen=True, eq=False)
class PolicyPlanner:
    """A planner that follows a policy of each goal greedily, without a model; `grid` is what it knows of the map."""

    grid: Grid
    policy_of: Callable[[int], Float[np.ndarray, "states actions"]]

    def possible(self) -> Bool[np.ndarray, "rows columns"]:
        """The cells that the map does not say are occupied."""
        return self.grid.known != Cell.OCCUPIED

    def plan_to(self, goal: int) -> GoalPlan:
        """The most probable action everywhere; none that leaves the map or leads into what is known to be occupied."""
        needed, occupied = moves_into(self.grid), np.append(self.grid.known.ravel() == Cell.OCCUPIED, False)
        possible = (needed[..., 0] < self.grid.size) & ~occupied[needed].any(axis=-1)
        return _Greedy(np.where(possible, self.policy_of(goal), 0.0), needed, goal)


class _Greedy(NamedTuple):
    policy: Float[np.ndarray, "states actions"]
    needed: Int[np.ndarray, "states actions 3"]
    goal: int

    def follow(self, starts: Int[np.ndarray, " starts"]) -> Sequence[Int[np.ndarray, " _"]]:
        states = np.arange(len(self.policy))
        best = self.policy.argmax(axis=-1)
        moves = self.policy[states, best] > 0
        return followed(np.where(moves, self.needed[states, best, 0], states), states == self.goal, starts)

    def lengths_with_bumps(self, world: World, starts: Int[np.ndarray, " starts"]) -> Float[np.ndarray, " starts"]:
        return lengths_by_policy(self.policy, world, self.goal, starts)
