"""A risk-averse robot: the cells that it takes to be free, and the task that it solves in a learned map.

In a learned map each move fails with a probability, independently each time. The robot knows more: obstacles do not
move. So a cell that a walk passed is free, and a move that failed fails again. A bump therefore costs the way back and
around, and not only the expected number of repeated moves (two at P(blocked) = 1/2).

After a bump the robot tries another part of the wall, which is near. So it plans as if behind each obstacle there were
another one with the same P(blocked): P/(1 − P) expected bumps until it passes, at least one with probability P. The
first bump costs `bump_cost`, each further one a fifth of that. With the lengths of the moves, this is the value of

    R(s, a) = −length(a) − bump_cost · P · (1 − P + P/5),        P = P(a fails in s),        γ = 1,

in the model in which all visited cells are free. The moves are charged independently of each other.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import equinox as eqx
import numpy as np
from jaxtyping import Int

from sidestep._arguments import to_states
from sidestep.errors import check_instance, to_number
from sidestep.robots.planners import ModelPlanner
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.grid import Cell
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import Task, reach

BUMP_COST = 40.0
"""The cost of the first bump at a place beside that of the move, in cell sides: a long detour."""
_FURTHER_BUMPS = 0.2
"""The cost of each further bump as a fraction of the first: the way to the next part of a wall."""


def risk_averse_robot(
    model: ObstacleGrid, visited: Int[np.ndarray, " visits"] | Sequence[int], bump_cost: float = BUMP_COST
) -> ModelPlanner:
    """Return a planner that avoids bumps in a learned map.

    Args:
        model: The learned map.
        visited: The cells (states) that walks passed.
        bump_cost: The cost of the first bump at a place in cell sides, at least 0.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> robot = risk_averse_robot(ObstacleGrid(Grid.unknown(rows=1, columns=3)), visited=[0, 1])
        >>> robot.plan_to(2).paths_from(np.array([0]))[0].tolist()
        [0, 1, 2]
    """
    check_instance(model, ObstacleGrid, "model")
    to_number(bump_cost, "bump_cost", least=0)
    known = mark_visited_free(model, visited)
    return ModelPlanner(known, partial(risk_averse_task, known, bump_cost=bump_cost))


def mark_visited_free(model: ObstacleGrid, visited: Int[np.ndarray, " visits"] | Sequence[int]) -> ObstacleGrid:
    """Return the model in which unknown cells (states) that walks passed are known to be free.

    Args:
        model: The map.
        visited: The states.
    """
    known = np.array(model.known).reshape(-1)
    states = to_states(visited, known.size, "visited")
    known[states[known[states] == Cell.UNKNOWN]] = Cell.FREE
    return eqx.tree_at(lambda model: model.known, model, to_jax(known.reshape(model.known.shape)))


def risk_averse_task(model: ObstacleGrid, goal: int, bump_cost: float = BUMP_COST) -> Task:
    """Return the task of reaching a state by a short path with few bumps.

    Args:
        model: The map in which the robot plans.
        goal: The goal state; it may lie in an obstacle of the model.
        bump_cost: The cost of the first bump at a place in cell sides, at least 0.

    Raises:
        InputError: For a cost out of range or a goal that is not a state.
    """
    to_number(bump_cost, "bump_cost", least=0)
    task = reach(model.blank, goal, discount=1.0, step_cost=1.0)
    probabilities, successors = np.asarray(model.probabilities()), np.asarray(model.graph.successors)
    fails = np.where(successors == np.arange(len(successors))[:, None, None], probabilities, 0).sum(axis=-1)
    bumps = bump_cost * fails * (1 - fails + _FURTHER_BUMPS * fails)
    return replace(task, reward=to_jax(np.asarray(task.reward) - bumps))
