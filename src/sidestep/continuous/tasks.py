"""Tasks in continuous worlds: the tabular ones with functions where those have arrays.

An action a in a state s pays R(s, a). A terminal state ends the task: no action is taken there, it pays its final
reward once. `features` are what a policy for many tasks sees of a state and of the goal.
"""

import abc
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Scalar, Shaped

from sidestep.continuous.dynamics import Action, State
from sidestep.errors import InputError
from sidestep.tabular.tasks import Task, check_discount

_Task = TypeVar("_Task", bound="ContinuousTask")


class ContinuousTask(eqx.Module):
    """One task, or (with a leading `tasks` axis on every array, see `stack`) several.

    - `discount`: γ in (0, 1].
    - `smooth`: whether returns move smoothly with the states passed, so that gradients may pass along a path.

    A new kind of task is a subclass with `reward` and `features`, and with the other two if tasks end.
    """

    discount: eqx.AbstractVar[Float[Array, "*tasks"]]
    smooth: ClassVar[bool]

    @abc.abstractmethod
    def reward(self, state: State, action: Action) -> Float[Scalar, ""]:
        """R(s, a)."""

    @abc.abstractmethod
    def features(self, state: State) -> Float[Array, " features"]:
        """What a policy sees: the state and the goal as a vector."""

    def terminal_reward(self, state: State) -> Float[Scalar, ""]:
        """What a terminal state pays."""
        del state
        return jnp.zeros((), self.discount.dtype)

    def terminal(self, state: State) -> Bool[Scalar, ""]:
        """Whether the task ends here."""
        del state
        return jnp.zeros((), bool)


class Reach(ContinuousTask):
    """The task of coming within `radius` of a goal.

    - `goal`: a place, compared with the first components of the state.
    - `step_cost`: what an action costs; `goal_reward`: what arriving pays.
    """

    goal: Float[Array, "*tasks dimensions"]
    radius: Float[Array, "*tasks"]
    step_cost: Float[Array, "*tasks"]
    goal_reward: Float[Array, "*tasks"]
    discount: Float[Array, "*tasks"]
    smooth: ClassVar[bool] = False

    def reward(self, state: State, action: Action) -> Float[Scalar, ""]:
        """Minus the cost of a step."""
        del state, action
        return -self.step_cost

    def features(self, state: State) -> Float[Array, " features"]:
        """The state, the goal, and the way to it."""
        return jnp.concatenate([state, self.goal, self.goal - state[: len(self.goal)]])

    def terminal_reward(self, state: State) -> Float[Scalar, ""]:
        """The goal's reward."""
        del state
        return self.goal_reward

    def terminal(self, state: State) -> Bool[Scalar, ""]:
        """Whether the goal is within the radius."""
        return jnp.sum((state[: len(self.goal)] - self.goal) ** 2) <= self.radius**2


def reach(goal: Sequence[float], radius: float, *, discount: float = 0.95, step_cost: float | None = None) -> Reach:
    """The task of coming within `radius` of a goal.

    `discount` and `step_cost` as for the tabular `reach`: without a step cost the goal pays 1. Raises `InputError` for
    a goal that is not finite, a radius or step cost not above 0, and a discount outside (0, 1], or 1 without a cost.
    """
    check_discount(discount)
    if step_cost is None and discount == 1:
        raise InputError("a goal that pays 1 needs a discount below 1 (or give a step cost)", field="discount")
    if not np.isfinite(np.asarray(goal)).all():
        raise InputError(f"expected finite numbers, found {tuple(goal)}", field="goal")
    for name, value in (("radius", radius), ("step_cost", step_cost)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"expected a finite number above 0, found {value}", field=name)
    pays = 1.0 if step_cost is None else 0.0
    real = jnp.result_type(float)
    numbers = (jnp.asarray(value, real) for value in (goal, radius, step_cost or 0.0, pays, discount))
    return Reach(*numbers)


class QuadraticTask(ContinuousTask):
    """The task of staying near a goal at a quadratic cost: R(s, a) = −(s − g)ᵀ C (s − g) − aᵀ D a; it never ends.

    - `goal`: g; `state_cost`, `action_cost`: C and D.
    """

    goal: Float[Array, "*tasks dimensions"]
    state_cost: Float[Array, "*tasks dimensions dimensions"]
    action_cost: Float[Array, "*tasks inputs inputs"]
    discount: Float[Array, "*tasks"]
    smooth: ClassVar[bool] = True

    def reward(self, state: State, action: Action) -> Float[Scalar, ""]:
        """Minus the quadratic costs."""
        away = state - self.goal
        return -away @ self.state_cost @ away - action @ self.action_cost @ action

    def features(self, state: State) -> Float[Array, " features"]:
        """The way from the goal."""
        return state - self.goal


class Hold(ContinuousTask):
    """The task of holding a pendulum at an angle, with the reward of Gymnasium's `Pendulum-v1`.

    R = −(φ − g)² − 0.1 ω² − 0.001 u² with φ − g in [−π, π); `Pendulum-v1` itself has the goal g = 0, upright.
    """

    goal: Float[Array, "*tasks"]
    discount: Float[Array, "*tasks"]
    smooth: ClassVar[bool] = True

    def reward(self, state: State, action: Action) -> Float[Scalar, ""]:
        """Minus the costs of being away, of speed and of torque."""
        away = jnp.mod(state[0] - self.goal + jnp.pi, 2 * jnp.pi) - jnp.pi
        return -(away**2) - 0.1 * state[1] ** 2 - 0.001 * action[0] ** 2

    def features(self, state: State) -> Float[Array, " features"]:
        """Where the pendulum is seen from the goal, how fast it is, and where it would stand upright."""
        away = state[0] - self.goal
        seen = [jnp.cos(away), jnp.sin(away), state[1], jnp.cos(self.goal), jnp.sin(self.goal)]
        return jnp.stack(jnp.broadcast_arrays(*seen))


class TableTask(ContinuousTask):
    """A tabular task seen as a continuous one, for `TableDynamics`; its features are one 1, where state and task are.

    - `task`: with rewards for every state and action.
    - `index`: which of the tasks it is, so that a policy can tell them apart.
    """

    task: Task
    index: Float[Array, "*tasks indices"]
    discount: Float[Array, "*tasks"]
    smooth: ClassVar[bool] = False

    def reward(self, state: State, action: Action) -> Float[Scalar, ""]:
        """R(s, a), from the table."""
        return self.task.reward[state, action]

    def terminal_reward(self, state: State) -> Float[Scalar, ""]:
        """What a terminal state pays, from the table."""
        return self.task.terminal_reward[state]

    def terminal(self, state: State) -> Bool[Scalar, ""]:
        """From the table."""
        return self.task.terminal[state]

    def features(self, state: State) -> Float[Array, " features"]:
        """One where both the state and the task are these."""
        states = jax.nn.one_hot(state, self.task.terminal.shape[-1], dtype=self.discount.dtype)
        return jnp.outer(self.index, states).ravel()


def table_tasks(tasks: Task, states: int, actions: int) -> TableTask:
    """Stacked tabular tasks as continuous ones, in a world of so many states and actions."""
    count = len(tasks.terminal)
    reward = jnp.broadcast_to(tasks.reward, (count, states, actions))
    final = jnp.broadcast_to(tasks.terminal_reward, (count, states))
    table = Task(reward, final, tasks.terminal, tasks.discount)
    return TableTask(task=table, index=jnp.eye(count, dtype=reward.dtype), discount=tasks.discount)


def stack(tasks: Sequence[_Task]) -> _Task:
    """Several tasks of a kind as one with a leading axis; raises `InputError` for none, or tasks of different kinds."""
    kinds = {(jax.tree.structure(task), *map(np.shape, jax.tree.leaves(task))) for task in tasks}
    if len(kinds) != 1:
        raise InputError("expected at least one task, all of a kind", field="tasks")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tasks)


def task_at(tasks: _Task, index: Array | int) -> _Task:
    """One of stacked tasks (or several, for several indices)."""
    return jax.tree.map(lambda leaf: leaf[index], tasks)


def ended_at(
    tasks: ContinuousTask, task: Int[Array, " places"], states: Shaped[Array, "places *state"]
) -> Bool[np.ndarray, " places"]:
    """Whether the task of each place has ended there; `task` are indices into stacked tasks."""
    return np.asarray(jax.vmap(lambda own, state: own.terminal(state))(task_at(tasks, task), states))


def check_tasks(tasks: ContinuousTask) -> None:
    """Raises `InputError` unless all discounts lie in (0, 1] and everything in the tasks is finite."""
    for leaf in jax.tree.leaves(tasks):
        if not isinstance(leaf, Tracer) and not np.isfinite(leaf).all():
            raise InputError("expected finite numbers", field="tasks")
    for discount in np.ravel(tasks.discount):
        check_discount(float(discount))
