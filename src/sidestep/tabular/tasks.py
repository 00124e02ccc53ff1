"""Tasks: the goals of agents, each a reward function, a discount and terminal states.

An action a in a state s pays R(s, a), and R(s, a, s′) where the reward depends on what follows:

    Q(s, a) = R(s, a) + Σ_s′ T_θ(s, a, s′) (R(s, a, s′) + γ V(s′)).

A terminal state ends the task: no action is taken there, it pays its terminal reward once. The paper's reward R(s)
"1 at the goal and 0 elsewhere" is a terminal reward of 1 at the goal.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from sidestep._arguments import to_finite, to_floats, to_integers, to_mask
from sidestep._repr import short_repr
from sidestep.errors import InputError, check, check_instance, check_positive, describe, to_list, to_number
from sidestep.tabular.arrays import is_traced, to_jax
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
        outcome_reward: R(s, a, s′) of each outcome of the model's graph, beside R(s, a); None for none. An axis of
            length 1 holds for all states, actions or outcomes.

    Example:
        >>> reach(Grid.unknown(rows=1, columns=3), 2, discount=1.0, step_cost=1.0).reward.tolist()
        [[-1.0, -1.0, -1.0, -1.0]]
    """

    reward: Float[Array, "*tasks #states #actions"]
    terminal_reward: Float[Array, "*tasks #states"]
    terminal: Bool[Array, "*tasks states"]
    discount: Float[Array, "*tasks"]
    outcome_reward: Float[Array, "*tasks #states #actions #outcomes"] | None = None


def task(
    reward: Shaped[ArrayLike, "..."] | Sequence[Any],
    discount: float,
    terminal: Shaped[ArrayLike, "..."] | Sequence[bool],
    *,
    world: Graph | None = None,
) -> Task:
    """Return a task from a complete reward function.

    Args:
        reward: R(s), which terminal states pay too, R(s, a), or R(s, a, s′) for every state s′ with `world`; terminal
            states pay nothing with the last two.
        discount: γ in (0, 1].
        terminal: Whether the task ends in each state.
        world: The graph of the model, for R(s, a, s′).

    Raises:
        InputError: For a reward that is not finite or has another shape, and for a discount outside (0, 1].

    Example:
        >>> task(np.array([-1.0, -1.0, 5.0]), 0.9, np.array([False, False, True])).reward.shape
        (3, 1)
    """
    shapes = ("states",), ("states", "actions"), ("states", "actions", "states")
    rewards = np.asarray(to_finite(reward, "reward", *shapes))
    check(rewards.size, f"expected rewards, found shape {rewards.shape}", field="reward")
    ends = np.asarray(to_mask(terminal, "terminal", rewards.shape[:1]))
    check_discount(discount)
    rewards = rewards.astype(jnp.result_type(float))
    if rewards.ndim == 1:
        return _task(rewards[:, None], rewards, ends, discount)
    if rewards.ndim == 2:
        return _task(rewards, np.zeros(1), ends, discount)
    check(
        isinstance(world, Graph),
        "expected `world`, the graph of the model, for R(s, a, s′); found none",
        field="reward",
    )
    assert world is not None
    shape = world.states, world.actions, world.states
    check(rewards.shape == shape, f"expected R(s, a, s′) of shape {shape}, found {rewards.shape}", field="reward")
    successors = np.asarray(world.successors)
    of_outcomes = np.take_along_axis(rewards, successors, axis=-1)
    made = _task(np.zeros((1, 1)), np.zeros(1), ends, discount)
    return with_outcome_reward(made, of_outcomes)


def with_outcome_reward(made: Task, rewards: Float[ArrayLike, "states actions outcomes"]) -> Task:
    """Return a task that also pays R(s, a, s′), one number for each outcome of the model's graph.

    Args:
        made: One task.
        rewards: R(s, a, s′ₖ) of every outcome k.
    """
    return replace(made, outcome_reward=to_jax(np.asarray(rewards), jnp.result_type(float)))


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
    check_instance(world, (Grid, Graph), "world")
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
        InputError: For no tasks, something else than single tasks, and tasks of different worlds.

    Example:
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> stack_tasks([reach(grid, 0), reach(grid, 2)]).terminal.shape
        (2, 3)
    """
    tasks = to_list(tasks, Task, "tasks")
    for index, each in enumerate(tasks):
        check(each.terminal.ndim == 1, f"expected single tasks, found a stack of tasks at {index}", field="tasks")
    sizes = sorted({len(each.terminal) for each in tasks})
    check(len(sizes) == 1, f"expected tasks of one world, found worlds of {sizes} states", field="tasks")
    if any(each.outcome_reward is not None for each in tasks):
        zero = to_jax(np.zeros((1, 1, 1)))
        tasks = [replace(each, outcome_reward=zero) if each.outcome_reward is None else each for each in tasks]

    def stacked(*leaves: Array) -> Array:
        shape = np.broadcast_shapes(*(leaf.shape for leaf in leaves))
        if is_traced(leaves):
            return jnp.stack([jnp.broadcast_to(leaf, shape) for leaf in leaves])
        return to_jax(np.stack([np.broadcast_to(np.asarray(leaf), shape) for leaf in leaves]))

    return jax.tree.map(stacked, *tasks)


def task_at(tasks: Task, index: int) -> Task:
    """Return one task of a stack.

    Args:
        tasks: The stack.
        index: The index of the task; negative ones count from the end.

    Raises:
        InputError: For a single task, and the index of a task that does not exist.

    Example:
        >>> grid = Grid.unknown(rows=1, columns=3)
        >>> task_at(stack_tasks([reach(grid, 0), reach(grid, 2)]), 1).terminal.tolist()
        [False, False, True]
    """
    check_instance(tasks, Task, "tasks")
    check(tasks.terminal.ndim > 1, "expected a stack of tasks, found a single task", field="tasks")
    count = len(tasks.terminal)
    at = int(to_integers(index, "index", (), least=-count, most=count - 1))
    return jax.tree.map(lambda leaf: leaf[at], tasks)


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
    return replace(tasks, reward=tasks.reward - costs[aimed_at])


def _task(reward: np.ndarray, terminal_reward: np.ndarray, terminal: np.ndarray, discount: float) -> Task:
    gamma = to_jax(discount, jnp.result_type(float))
    return Task(to_jax(reward), to_jax(terminal_reward), to_jax(terminal), gamma)


def check_discount(discount: float) -> None:
    """Raise `InputError` unless the discount lies in (0, 1].

    Args:
        discount: γ.
    """
    to_number(discount, "discount", above=0, most=1)


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
    if not isinstance(place, (int, np.integer)) or isinstance(place, bool):
        if isinstance(world, Graph):
            message = f"expected a state (on a graph the {field} is a state, not a position)"
            raise InputError(f"{message}, found {describe(place)}", field=field)
        position = np.asarray(to_floats(place, field, (2,)), np.float64)[None]
        on_map = world.contains(position)[0]
        check(on_map, f"expected a position on the map, {world.extent()}, found {place}", field=field)
        place = world.state((float(position[0, 0]), float(position[0, 1])))
    check(0 <= place < states, f"expected a state in 0…{states - 1}, found {place}", field=field)
    if isinstance(world, Grid):
        x, y = world.centers(np.array([place]))[0]
        message = f"the {field} lies in a known obstacle (state {place}, the cell around x = {x:g} m, y = {y:g} m)"
        check(world.known.flat[place] != Cell.OCCUPIED, message, field=field)
    return int(place)


def _states_of(world: Grid | Graph) -> int:
    return world.states if isinstance(world, Graph) else world.size
