"""Tasks: what a walker wants. A complete reward, a discount, and the states at which the task ends.

An action a in a state s pays R(s, a). A terminal state ends the task: no action is taken there, it pays its final
reward once. The paper's reward R(s) "1 at the goal and 0 elsewhere" is a final reward of 1 at a terminal goal.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import InputError
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid


class Task(eqx.Module):
    """One task, or (with a leading `tasks` axis on every field) several.

    - `reward`: R(s, a) of acting; an axis of length 1 holds for all states or all actions.
    - `terminal_reward`: what a terminal state pays; read at terminal states only.
    - `terminal`: where the task ends.
    - `discount`: γ in (0, 1].
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
    """A task from a complete reward: per state, R(s), or per state and action, R(s, a).

    A terminal state pays R(s) in the first form and nothing in the second. Raises `InputError` for a reward that is
    not finite or has another shape, and for a discount outside (0, 1].
    """
    reward, terminal = jnp.asarray(reward), jnp.asarray(terminal)
    if reward.ndim not in (1, 2) or terminal.shape != reward.shape[:1] or terminal.dtype != bool:
        raise InputError(
            f"expected shapes (states,) or (states, actions) and booleans (states,), found {reward.shape} and "
            f"{terminal.dtype} {terminal.shape}",
            field="reward, terminal",
        )
    if not jnp.isfinite(reward).all():
        raise InputError("expected finite numbers", field="reward")
    check_discount(discount)
    reward = reward.astype(jnp.result_type(float))
    per_state = reward.ndim == 1
    final = reward if per_state else jnp.zeros(1)
    return Task(reward[:, None] if per_state else reward, final, terminal, jnp.asarray(discount, reward.dtype))


def reach(
    world: Grid | Graph,
    goal: int | tuple[float, float],
    *,
    discount: float = 0.95,
    step_cost: float | None = None,
) -> Task:
    """The task of reaching a goal.

    - `goal`: a state, or on a `Grid` a position (x, y) in metres.
    - `discount`: γ.
    - `step_cost`: without it, the goal pays 1 and γ < 1 makes haste worthwhile (the paper's form). With it, every
      action costs `step_cost` per unit of length (a cell side on grids) and the goal pays nothing; γ may be 1.

    Raises `InputError` for a goal outside the world or in a known obstacle, a discount outside (0, 1] (with a goal
    reward: (0, 1)), or a step cost that is not above 0.

    >>> grid = Grid.unknown(rows=7, columns=4)
    >>> task = reach(grid, (3.5, 6.5))
    >>> int(jnp.argmax(task.terminal))  # the top right cell
    3
    """
    check_discount(discount)
    if step_cost is None and discount == 1:
        raise InputError("a goal that pays 1 needs a discount below 1 (or give a step cost)", field="discount")
    if step_cost is not None and not (np.isfinite(step_cost) and step_cost > 0):
        raise InputError(f"expected a number above 0, found {step_cost}", field="step_cost")
    state, states = _goal_state(world, goal)
    terminal = jnp.zeros(states, dtype=bool).at[state].set(True)
    gamma = jnp.asarray(discount, jnp.result_type(float))
    if step_cost is None:
        return Task(jnp.zeros((1, 1)), jnp.ones(1), terminal, gamma)
    return Task(-step_cost * jnp.atleast_2d(jnp.asarray(world.lengths)), jnp.zeros(1), terminal, gamma)


def stack_tasks(tasks: Sequence[Task]) -> Task:
    """Several tasks as one `Task` with a leading axis."""
    if not tasks:
        raise InputError("expected at least one task", field="tasks")

    def stacked(field: str) -> Array:
        leaves = [getattr(task, field) for task in tasks]
        shape = np.broadcast_shapes(*(leaf.shape for leaf in leaves))
        return jnp.stack([jnp.broadcast_to(leaf, shape) for leaf in leaves])

    return Task(stacked("reward"), stacked("terminal_reward"), stacked("terminal"), stacked("discount"))


def with_state_costs(tasks: Task, costs: Float[Array, " states"], aimed_at: Int[Array, "states actions"]) -> Task:
    """One task or a stack, in which a move also pays the cost of the state that it aims at.

    >>> from sidestep.tabular.graph import grid_graph
    >>> grid = Grid.unknown(rows=1, columns=3)
    >>> aimed_at = grid_graph(grid).successors[..., 0]
    >>> with_state_costs(reach(grid, 2), jnp.array([0.0, 0.25, 0.0]), aimed_at).reward[0].tolist()
    [0.0, 0.0, 0.0, -0.25]
    """
    return Task(tasks.reward - costs[aimed_at], tasks.terminal_reward, tasks.terminal, tasks.discount)


def check_discount(discount: float) -> None:
    """Raises `InputError` unless the discount lies in (0, 1]."""
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
