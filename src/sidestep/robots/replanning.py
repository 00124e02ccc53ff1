"""Execution in the true world: a robot bumps into obstacles that it did not know, and replans after each bump.

A bump tells the robot that one cell or a few are blocked. Only states with best actions through these cells change
their values. They are repaired by the dynamic shortest-path algorithm of Ramalingam and Reps: (1) from the blocked cell
outwards, collect the states with values that no action supports any longer; (2) from their border inwards, assign new
values, the best first, as in Dijkstra's algorithm. It differs from the published algorithm in two ways:
1. moves are stochastic: a move may fail, and the robot then tries it again;
2. values are discounted rewards, compared within a relative tolerance.
The order is correct because the value of an action never exceeds that of the state it leads to.

A robot with a policy but no model replans nothing. It avoids actions that it has seen fail and takes the next most
probable one. Without a new bump it acts alike in the same state, so it never arrives once it returns to a state.

References:
    G. Ramalingam and T. Reps (1996). An incremental algorithm for a generalization of the shortest-path problem.
    Journal of Algorithms 21(2), 267-305.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.tabular.backups import HardMax
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan
from sidestep.tabular.solvers.base import is_reachable
from sidestep.tabular.tasks import Task

Starts = Int[np.ndarray, " starts"]
Lengths = Float[np.ndarray, " starts"]


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


class BeliefState(NamedTuple):
    """A robot's current model, its values in it, and its task.

    Attributes:
        success: P(success) of each move; 0 for moves off the map and moves known to fail.
        values: The value of each state, of the goal too; −∞ at discount 1 where no path exists.
        reward: R(s, a).
        discount: γ in (0, 1].
        goal: The goal state.
        tolerance: The relative difference within which values count as equal.
    """

    success: Float[np.ndarray, "states actions"]
    values: Float[np.ndarray, " states"]
    reward: Float[np.ndarray, "states actions"]
    discount: float
    goal: int
    tolerance: float


def grid_environment(truth: Grid) -> GridEnvironment:
    """Return the environment of a true map; cells that the map does not know count as obstacles."""
    return GridEnvironment(moves_into(truth), truth.lengths, np.append(truth.known.reshape(-1) != Cell.FREE, False))


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
    from sidestep.robots.replanning_kernels import length_by_replanning

    values = plan(model, task).solution.values
    tolerance = max(HardMax().tie, 64 * float(np.finfo(values.dtype).eps))
    initial_values = np.where(is_reachable(values), values, -np.inf).astype(np.float64)
    on_map = environment.required[..., 0] < len(initial_values)
    success = np.where(on_map, np.asarray(model.probabilities(), dtype=np.float64)[..., 0], 0.0)
    reward = np.array(np.broadcast_to(task.reward, success.shape), dtype=np.float64)

    def length(start: int) -> float:
        belief = BeliefState(success.copy(), initial_values.copy(), reward, float(task.discount), goal, tolerance)
        return length_by_replanning(environment, belief, start)

    return np.array([length(start) for start in starts.tolist()])


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
    from sidestep.robots.replanning_kernels import length_by_policy

    order = np.argsort(-policy, axis=-1, kind="stable")
    return np.array([length_by_policy(policy, order, environment, goal, start) for start in starts.tolist()])
