"""What a robot makes of a learned map: what it takes for known, and what it pursues.

A learned map says how probable a move is to fail, each time anew. A robot may assume more: obstacles stay where they
are. Then a cell through which somebody walked is free, and what failed once fails again, so that a bump costs the way
back and around. Who only counted tries would expect two at a wall with P(blocked) = ½, and think little of it.

But who has bumped into a wall tries the next piece of it, and that is near. So a robot plans as if behind every
obstacle there were another one to try, as probably blocked: P/(1 − P) bumps until it gets through, at least one with
probability P. The first costs `bump_cost`, each further one a fifth of that. This comes out, together with the lengths
of the tries, if it pursues

    R(s, a) = −length(a) − bump_cost · P · (1 − P + P/5),        P = P(a leads nowhere from s),        γ = 1,

in the model in which cells that people walked through are known to be free. Every doubtful move is charged by itself.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sidestep.errors import InputError
from sidestep.robots.planners import ModelPlanner
from sidestep.tabular.grid import Cell
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import Task, reach

BUMP_COST = 40.0
"""What the first bump at a place costs beside the move itself, in cell sides: a long way around."""
_FURTHER = 0.2
"""The share of it that every further bump costs: the way to the next piece of a wall."""


def risk_averse_robot(
    model: ObstacleGrid, walked: Int[np.ndarray, " visits"] | Sequence[int], bump_cost: float = BUMP_COST
) -> ModelPlanner:
    """Who plans so in a learned map, where people walked through some cells (states)."""
    known = mark_visited_free(model, walked)
    return ModelPlanner(known, partial(risk_averse_task, known, bump_cost=bump_cost))


def mark_visited_free(model: ObstacleGrid, walked: Int[np.ndarray, " visits"] | Sequence[int]) -> ObstacleGrid:
    """The model, with the unknown cells (states) that people walked through known to be free."""
    known = np.array(model.known).reshape(-1)
    seen = np.asarray(walked, dtype=np.int64)
    known[seen[known[seen] == Cell.UNKNOWN]] = Cell.FREE
    return eqx.tree_at(lambda model: model.known, model, jnp.asarray(known.reshape(model.known.shape)))


def risk_averse_task(model: ObstacleGrid, goal: int, bump_cost: float = BUMP_COST) -> Task:
    """The task of reaching a state soon, and of bumping into little on the way.

    - `bump_cost`: in cell sides, 0 or more. Raises `InputError` for another, or a goal that is not a state.
    """
    if not (np.isfinite(bump_cost) and bump_cost >= 0):
        raise InputError(f"expected a number of at least 0, found {bump_cost}", field="bump_cost")
    # what the model takes for an obstacle may be a goal all the same
    task = reach(model.blank, goal, discount=1.0, step_cost=1.0)
    states = jnp.arange(model.graph.states)[:, None, None]
    nowhere = jnp.sum(jnp.where(model.graph.successors == states, model.probabilities(), 0), axis=-1)
    bumps = bump_cost * nowhere * (1 - nowhere + _FURTHER * nowhere)
    return Task(task.reward - bumps, task.terminal_reward, task.terminal, task.discount)
