"""Tasks: the goals of agents, each a reward function, a discount and terminal states.

An action a in a state s pays R(s, a). A terminal state ends the task: no action is taken there, it pays its terminal
reward once. The paper's reward R(s) "1 at the goal and 0 elsewhere" is a terminal reward of 1 at the goal.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import InputError
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid


class Task(eqx.Module):
    """One task, or with a leading `tasks` axis on every field several; made by `reach`, `task` and `stack_tasks`.

    Attributes:
        reward: R(s, a); an axis of length 1 holds for all states or all actions.
        terminal_reward: the reward of terminal states; ignored elsewhere.
        terminal: where the task ends.
        discount: γ in (0, 1].
    """

    reward: Float[Array, "*tasks #states #actions"]
    terminal_reward: Float[Array, "*tasks #states"]
    terminal: Bool[Array, "*tasks states"]
    discount: Float[Array, "*tasks"]


def task(
    reward: Float[Array, " states"] | Float[Array, "states actions"] | np.ndarray,
    discount: float,
    terminal: Bool[Array, " states"] | np.ndarray,
) -> Task:
    """Return a task from a complete reward function.

    Args:
        reward: R(s), which terminal states pay too, or R(s, a), with which terminal states pay nothing.
        discount: γ in (0, 1].
        terminal: whether the task ends in each state.

    Raises:
        InputError: for a reward that is not finite or has another shape, and for a discount outside (0, 1].

    Example:
        >>> task(np.array([-1.0, -1.0, 5.0]), 0.9, np.array([False, False, True])).reward.shape
        (3, 1)
    """
    reward, terminal = np.asarray(reward), np.asarray(terminal)
    if reward.ndim not in (1, 2) or terminal.shape != reward.shape[:1] or terminal.dtype != bool:
        raise InputError(
            f"expected shapes (states,) or (states, actions) and booleans (states,), found {reward.shape} and "
            f"{terminal.dtype} {terminal.shape}",
            field="reward, terminal",
        )
    if not np.isfinite(reward).all():
        raise InputError("expected finite numbers", field="reward")
    check_discount(discount)
    reward = reward.astype(jnp.result_type(float))
    if reward.ndim == 1:
        return _task(reward[:, None], reward, terminal, discount)
    return _task(reward, np.zeros(1), terminal, discount)


def reach(
    world: Grid | Graph, goal: int | tuple[float, float], *, discount: float = 0.95, step_cost: float | None = None
) -> Task:
    """Return the task of reaching a goal.

    Args:
        world: where; rewards are paid by the length of its actions.
        goal: a state, or on a `Grid` a position (x, y) in metres.
        discount: γ in (0, 1]; below 1 without a step cost.
        step_cost: the cost of an action per unit of length (a cell side on grids), above 0; the goal then pays
            nothing. Without it actions cost nothing and the goal pays 1 (the paper's form).

    Raises:
        InputError: for a goal outside the world or in a known obstacle, and for a discount or step cost out of range.

    Example:
        >>> grid = Grid.unknown(rows=7, columns=4)
        >>> int(jnp.argmax(reach(grid, (3.5, 6.5)).terminal))  # the top right cell
        3
    """
    check_discount(discount)
    if step_cost is None and discount == 1:
        raise InputError("a goal that pays 1 needs a discount below 1 (or give a step cost)", field="discount")
    if step_cost is not None and not (np.isfinite(step_cost) and step_cost > 0):
        raise InputError(f"expected a number above 0, found {step_cost}", field="step_cost")
    state, states = _goal_state(world, goal)
    terminal = np.arange(states) == state
    if step_cost is None:
        return _task(np.zeros((1, 1)), np.ones(1), terminal, discount)
    lengths = np.atleast_2d(np.asarray(world.lengths, dtype=jnp.result_type(float)))
    return _task(-step_cost * lengths, np.zeros(1), terminal, discount)


def stack_tasks(tasks: Sequence[Task]) -> Task:
    """Return several tasks as one `Task` with a leading axis.

    Args:
        tasks: at least one, all in the same world.

    Raises:
        InputError: for no tasks.

    Example:
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> stack_tasks([reach(grid, 0), reach(grid, 2)]).terminal.shape
        (2, 3)
    """
    if not tasks:
        raise InputError("expected at least one task", field="tasks")

    def stacked(field: str) -> Array:
        leaves = [getattr(task, field) for task in tasks]
        shape = np.broadcast_shapes(*(leaf.shape for leaf in leaves))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return jnp.stack([jnp.broadcast_to(leaf, shape) for leaf in leaves])
        return to_jax(np.stack([np.broadcast_to(np.asarray(leaf), shape) for leaf in leaves]))

    return Task(stacked("reward"), stacked("terminal_reward"), stacked("terminal"), stacked("discount"))


def with_state_costs(tasks: Task, costs: Float[Array, " states"], aimed_at: Int[Array, "states actions"]) -> Task:
    """Return tasks in which an action also pays the cost of the state that it aims at.

    Args:
        tasks: one task or a stack.
        costs: of each state, in units of reward.
        aimed_at: the state that each action aims at.

    Example:
        >>> from sidestep.tabular.graph import grid_graph
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> aimed_at = grid_graph(grid).successors[..., 0]
        >>> with_state_costs(reach(grid, 2), jnp.array([0.0, 0.25, 0.0]), aimed_at).reward[0].tolist()
        [0.0, 0.0, 0.0, -0.25]
    """
    return Task(tasks.reward - costs[aimed_at], tasks.terminal_reward, tasks.terminal, tasks.discount)


def _task(
    reward: Float[np.ndarray, "#states #actions"],
    terminal_reward: Float[np.ndarray, "#states"],
    terminal: Bool[np.ndarray, " states"],
    discount: float,
) -> Task:
    gamma = to_jax(discount, jnp.result_type(float))
    return Task(to_jax(reward), to_jax(terminal_reward), to_jax(terminal), gamma)


def check_discount(discount: float) -> None:
    """Raise `InputError` unless the discount lies in (0, 1]."""
    if not 0 < discount <= 1:
        raise InputError(f"expected a number above 0 and at most 1, found {discount}", field="discount")


def _goal_state(world: Grid | Graph, goal: int | tuple[float, float]) -> tuple[int, int]:
    if isinstance(world, Graph):
        if not isinstance(goal, (int, np.integer)):
            raise InputError("on a graph the goal is a state, not a position", field="goal")
        states = world.states
    else:
        states = world.size
        if not isinstance(goal, (int, np.integer)):
            position = np.asarray([goal], dtype=np.float64)
            if position.shape != (1, 2) or not world.contains(position)[0]:
                raise InputError(f"the goal {goal} lies outside the map", field="goal")
            goal = world.state(goal)
        if 0 <= goal < states and world.known.flat[goal] == 1:
            raise InputError(f"the goal (state {goal}) lies in a known obstacle", field="goal")
    if not 0 <= goal < states:
        raise InputError(f"expected a state in 0…{states - 1}, found {goal}", field="goal")
    return int(goal), states
