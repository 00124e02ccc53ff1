"""Tasks: the goals of agents, each a reward function, a discount and terminal states.

An action a in a state s pays R(s, a). A terminal state ends the task: no action is taken there, it pays its terminal
reward once. The paper's reward R(s) "1 at the goal and 0 elsewhere" is a terminal reward of 1 at the goal.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from sidestep._repr import short_repr
from sidestep.errors import InputError, check, check_positive
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Cell, Grid


@short_repr()
class Task(eqx.Module):
    """One task, or with a leading `tasks` axis on every field several; made by `reach`, `task` and `stack_tasks`.

    Attributes:
        reward: R(s, a); an axis of length 1 holds for all states or all actions.
        terminal_reward: The reward of terminal states; ignored elsewhere.
        terminal: Where the task ends.
        discount: γ in (0, 1].

    Example:
        >>> reach(Grid.unknown(rows=1, columns=3), 2, discount=1.0, step_cost=1.0).reward.tolist()
        [[-1.0, -1.0, -1.0, -1.0]]
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
        terminal: Whether the task ends in each state.

    Raises:
        InputError: For a reward that is not finite or has another shape, and for a discount outside (0, 1].

    Example:
        >>> task(np.array([-1.0, -1.0, 5.0]), 0.9, np.array([False, False, True])).reward.shape
        (3, 1)
    """
    reward, terminal = np.asarray(reward), np.asarray(terminal)
    check(
        reward.ndim in (1, 2) and terminal.shape == reward.shape[:1] and terminal.dtype == bool,
        f"expected shapes (states,) or (states, actions) and booleans (states,), found {reward.shape} and "
        f"{terminal.dtype} {terminal.shape}",
        field="reward, terminal",
    )
    check(np.isfinite(reward).all(), "expected finite numbers", field="reward")
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
        world: Where; rewards are paid by the length of its actions.
        goal: A state, or on a `Grid` a position (x, y) in metres.
        discount: γ in (0, 1]; below 1 without a step cost.
        step_cost: The cost of an action per unit of length (a cell side on grids), above 0; the goal then pays
            nothing. Without it actions cost nothing and the goal pays 1 (the paper's form).

    Returns:
        The task, which ends at the goal.

    Raises:
        InputError: For a goal outside the world or in a known obstacle, and for a discount or step cost out of range.

    Example:
        >>> grid = Grid.unknown(rows=7, columns=4)
        >>> int(jnp.argmax(reach(grid, (3.5, 6.5)).terminal))  # the top right cell
        3
    """
    check_discount(discount)
    terminal = np.arange(_states_of(world)) == state_at(world, goal, "goal")
    if step_cost is None:
        check(discount < 1, "a goal that pays 1 needs a discount below 1 (or give a step cost)", field="discount")
        return _task(np.zeros((1, 1)), np.ones(1), terminal, discount)
    check_positive(step_cost, "step_cost")
    lengths = np.atleast_2d(np.asarray(world.lengths, dtype=jnp.result_type(float)))
    return _task(-step_cost * lengths, np.zeros(1), terminal, discount)


def stack_tasks(tasks: Sequence[Task]) -> Task:
    """Return several tasks as one `Task` with a leading axis.

    Args:
        tasks: At least one, all in the same world.

    Raises:
        InputError: For no tasks.

    Example:
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> stack_tasks([reach(grid, 0), reach(grid, 2)]).terminal.shape
        (2, 3)
    """
    check(tasks, "expected at least one task", field="tasks")

    def stacked(*leaves: Array) -> Array:
        shape = np.broadcast_shapes(*(leaf.shape for leaf in leaves))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return jnp.stack([jnp.broadcast_to(leaf, shape) for leaf in leaves])
        return to_jax(np.stack([np.broadcast_to(np.asarray(leaf), shape) for leaf in leaves]))

    return jax.tree.map(stacked, *tasks)


def with_state_costs(tasks: Task, costs: Float[Array, " states"], aimed_at: Int[Array, "states actions"]) -> Task:
    """Return tasks in which an action also pays the cost of the state that it aims at.

    Args:
        tasks: One task or a stack.
        costs: Of each state, in units of reward.
        aimed_at: The state that each action aims at.

    Returns:
        As many tasks as given.

    Example:
        >>> from sidestep.tabular.graph import grid_graph
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> aimed_at = grid_graph(grid).successors[..., 0]
        >>> with_state_costs(reach(grid, 2), jnp.array([0.0, 0.25, 0.0]), aimed_at).reward[0].tolist()
        [0.0, 0.0, 0.0, -0.25]
    """
    return Task(tasks.reward - costs[aimed_at], tasks.terminal_reward, tasks.terminal, tasks.discount)


def _task(reward: np.ndarray, terminal_reward: np.ndarray, terminal: np.ndarray, discount: float) -> Task:
    gamma = to_jax(discount, jnp.result_type(float))
    return Task(to_jax(reward), to_jax(terminal_reward), to_jax(terminal), gamma)


def check_discount(discount: float) -> None:
    """Raise `InputError` unless the discount lies in (0, 1].

    Args:
        discount: γ.
    """
    check(0 < discount <= 1, f"expected a number above 0 and at most 1, found {discount}", field="discount")


def state_at(world: Grid | Graph, place: int | tuple[float, float], field: str) -> int:
    """Return the state at a place: a state, or on a grid a position (x, y) in metres.

    Args:
        world: A grid or a graph.
        place: The state or the position.
        field: What it is, for error messages.

    Returns:
        A number from 0 to the number of states less 1.

    Raises:
        InputError: For a place that is outside the world or in a known obstacle.
    """
    states = _states_of(world)
    if not isinstance(place, (int, np.integer)):
        if isinstance(world, Graph):
            raise InputError(f"on a graph the {field} is a state, not a position", field=field)
        position = np.asarray([place], dtype=np.float64)
        on_map = position.shape == (1, 2) and world.contains(position)[0]
        check(on_map, f"expected a position on the map, {world.extent()}, found {place}", field=field)
        place = world.state(place)
    check(0 <= place < states, f"expected a state in 0…{states - 1}, found {place}", field=field)
    if isinstance(world, Grid):
        x, y = world.centers(np.array([place]))[0]
        message = f"the {field} lies in a known obstacle (state {place}, the cell around x = {x:g} m, y = {y:g} m)"
        check(world.known.flat[place] != Cell.OCCUPIED, message, field=field)
    return int(place)


def _states_of(world: Grid | Graph) -> int:
    return world.states if isinstance(world, Graph) else world.size
