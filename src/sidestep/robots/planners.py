"""Planners: how a robot reaches a goal, by planning in a model or by following a policy.

`sidestep.evaluation` needs two things of either: the path that the robot intends, and the length of the path that it
executes in the true world, where it may bump into obstacles.

A bump tells a robot with a model that one cell or a few are blocked, and it replans. Only states with best actions
through these cells change their values. They are repaired by the dynamic shortest-path algorithm of Ramalingam and
Reps: (1) from the blocked cell outwards, collect the states with values that no action supports any longer; (2) from
their border inwards, assign new values, the best first, as in Dijkstra's algorithm. It differs from the published
algorithm in two ways:
1. moves are stochastic: a move may fail, and the robot then tries it again;
2. values are discounted rewards, compared within a relative tolerance.
The order is correct because the value of an action never exceeds that of the state it leads to.

A robot with a policy but no model replans nothing. It avoids actions that it has seen fail and takes the next most
probable one. Without a new bump it acts alike in the same state, so it never arrives once it returns to a state.

References:
    G. Ramalingam and T. Reps (1996). An incremental algorithm for a generalization of the shortest-path problem.
    Journal of Algorithms 21(2), 267-305.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import check
from sidestep.tabular.backups import HardMax
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import followed, plan, rounding_of
from sidestep.tabular.tasks import Task

Starts = Int[np.ndarray, " starts"]
Lengths = Float[np.ndarray, " starts"]
Paths = Sequence[Int[np.ndarray, " _"]]
"""The states along each of several paths."""


class GridEnvironment(NamedTuple):
    """The true world that a robot moves in.

    Attributes:
        required: The cells that must be free for each move (`moves_into`).
        lengths: The length of each action in cell sides.
        obstacles: Whether each cell is not free; False in one more entry, which `required` uses for "no such cell".
    """

    required: Int[np.ndarray, "states actions 3"]
    lengths: Float[np.ndarray, " actions"]
    obstacles: Bool[np.ndarray, " cells"]


class GoalPlan(NamedTuple):
    """The plan of a robot to reach one goal.

    Attributes:
        paths_from: Returns the states of the intended path from each start; a path ends before the first repeated
            state.
        executed_lengths: Returns the length of the executed path from each start in an environment, in cell sides;
            infinite if the robot never arrives.
    """

    paths_from: Callable[[Starts], Paths]
    executed_lengths: Callable[[GridEnvironment, Starts], Lengths]


@runtime_checkable
class Planner(Protocol):
    """A robot's plans to all goals."""

    def goal_mask(self) -> Bool[np.ndarray, "rows columns"]:
        """Return the cells that can be goals: those not known to be blocked."""
        ...

    def plan_to(self, goal: int) -> GoalPlan:
        """Return the plan to reach a state.

        Args:
            goal: The goal state.
        """
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
        """Return the optimal plan to reach a state.

        Args:
            goal: The goal state.
        """
        task = self.task_of(goal)
        planned = cache(lambda: plan(self.model, task))
        belief = cache(lambda: _first_belief(self.model, planned().solution.values, task, goal))
        return GoalPlan(
            lambda starts: planned().follow(starts),
            lambda environment, starts: _executed_lengths(belief(), environment, starts),
        )


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
        """Return the greedy plan; no action leaves the map or enters a cell known to be occupied.

        Args:
            goal: The goal state.
        """
        required, occupied = moves_into(self.grid), np.append(self.grid.known.ravel() == Cell.OCCUPIED, False)
        possible = (required[..., 0] < self.grid.size) & ~occupied[required].any(axis=-1)
        policy = np.where(possible, self.policy_of(goal), 0.0)
        states, best = np.arange(len(policy)), policy.argmax(axis=-1)
        intended = np.where(policy[states, best] > 0, required[states, best, 0], states)
        return GoalPlan(
            lambda starts: followed(intended, states == goal, starts),
            lambda environment, starts: policy_lengths(policy, environment, goal, starts),
        )


def grid_environment(truth: Grid) -> GridEnvironment:
    """Return the environment of a true map; cells that the map does not know count as obstacles.

    Args:
        truth: The true map.
    """
    return GridEnvironment(moves_into(truth), truth.lengths, np.append(truth.known.reshape(-1) != Cell.FREE, False))


class BeliefState(NamedTuple):
    """A robot's current model, its values in it, and its task.

    Attributes:
        success: P(success) of each move; 0 for moves off the map and moves known to fail. Of a robot without a model,
            π(a | s), with the same zeros.
        values: The value of each state, of the goal too; −∞ at discount 1 where no path exists. Empty without a model.
        reward: R(s, a).
        discount: γ in (0, 1].
        goal: The goal state.
        tolerance: The relative difference within which values count as equal.
        rounding: The error of an advantage as a part of what it is summed from.
    """

    success: Float[np.ndarray, "states actions"]
    values: Float[np.ndarray, " #states"]
    reward: Float[np.ndarray, "#states #actions"]
    discount: float
    goal: int
    tolerance: float
    rounding: float


def replanning_lengths(
    model: ObstacleGrid, environment: GridEnvironment, task: Task, goal: int, starts: Starts
) -> Lengths:
    """Return how far a robot goes from each start that plans in a learned map and replans after each bump.

    Args:
        model: The learned map. Each robot starts from it, without what the other robots learn from bumps.
        environment: The true world.
        task: The task of reaching `goal`.
        goal: The goal state.
        starts: The start states.

    Returns:
        Lengths in cell sides, failed moves included; infinite if the robot never arrives because the learned map is
        sure of an obstacle that does not exist.

    Raises:
        NotConverged: If the values of the first plan do not converge.
    """
    values = plan(model, task).solution.values
    return _executed_lengths(_first_belief(model, values, task, goal), environment, starts)


def _first_belief(model: ObstacleGrid, values: Float[Array, " states"], task: Task, goal: int) -> BeliefState:
    """Return what a robot believes before its first bump."""
    check(task.outcome_reward is None, "expected rewards R(s, a), found R(s, a, s′)", field="task")
    known = np.asarray(values)
    tolerance = max(HardMax().tie, 64 * float(np.finfo(known.dtype).eps))
    initial_values = known.astype(np.float64)
    on_map = moves_into(model.blank)[..., 0] < len(initial_values)
    success = np.where(on_map, np.asarray(model.probabilities(), dtype=np.float64)[..., 0], 0.0)
    reward = np.array(np.broadcast_to(task.reward, success.shape), dtype=np.float64)
    return BeliefState(success, initial_values, reward, float(task.discount), goal, tolerance, rounding_of(known.dtype))


def policy_lengths(
    policy: Float[np.ndarray, "states actions"], environment: GridEnvironment, goal: int, starts: Starts
) -> Lengths:
    """Return how far a robot goes from each start that takes the most probable action, and after a bump the next.

    Args:
        policy: π(a | s); actions of probability 0 are never taken.
        environment: The true world.
        goal: The goal state.
        starts: The start states.

    Returns:
        Lengths in cell sides, failed moves included; infinite if the robot moves in a cycle or has no action left.
    """
    belief = BeliefState(np.array(policy, dtype=np.float64), np.empty(0), np.empty((0, 0)), 1.0, goal, 0.0, 0.0)
    return _executed_lengths(belief, environment, starts)


def _executed_lengths(belief: BeliefState, environment: GridEnvironment, starts: Starts) -> Lengths:
    """Return the length of the executed path from each start; each robot starts with the same belief."""
    from sidestep.robots.replanning_kernels import executed_length

    own = (belief._replace(success=belief.success.copy(), values=belief.values.copy()) for _ in starts)
    return np.array([executed_length(environment, *each) for each in zip(own, starts.tolist(), strict=True)])
