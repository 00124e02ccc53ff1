"""Tasks in continuous worlds: rewards, ends and features as functions of the state.

An action a in a state s pays R(s, a). A terminal state ends the task: no action is taken there, and it pays its
terminal reward once. `features` are the input of a policy that serves many tasks: state and goal as one vector.
"""

import abc
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from sidestep._arguments import to_finite, to_floats, to_integers
from sidestep._repr import short_repr
from sidestep.continuous.dynamics import Action, Real, State, check_finite
from sidestep.errors import InputError, Limit, check, check_instance, check_positive, to_list
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.tasks import Task, check_discount

States = Shaped[Array, "states *state"]
_Task = TypeVar("_Task", bound="ContinuousTask")


def _to_array(
    value: Shaped[ArrayLike, "..."] | Sequence[Any], field: str, above: Limit = -np.inf
) -> Float[Array, "..."]:
    return to_jax(to_finite(value, field, above=above))


@short_repr()
class ContinuousTask(eqx.Module):
    """One task, or several with a leading `tasks` axis on every array (see `batch_tasks`).

    A new kind of task is a subclass with `reward` and `features`, and with the other two methods if tasks end. The
    tasks of this module take numbers and lists too; under `jit` and `vmap` only their shapes are checked.

    Attributes:
        discount: γ in (0, 1].
        smooth: Whether returns are smooth in the states of a path, so that gradients may pass along it; no by default.
    """

    discount: eqx.AbstractVar[Float[Array, "*tasks"]]
    smooth: ClassVar[bool] = False

    def __check_init__(self) -> None:
        to_finite(self.discount, "discount", above=0, most=1)

    @abc.abstractmethod
    def reward(self, state: State, action: Action) -> Real:
        """Return R(s, a).

        Args:
            state: The state s.
            action: The action a.
        """

    @abc.abstractmethod
    def features(self, state: State) -> Float[Array, " features"]:
        """Return the state and the goal as the input of a policy.

        Args:
            state: The state s.
        """

    def terminal_reward(self, state: State) -> Real:
        """Return the reward of ending in a terminal state.

        Args:
            state: The state s.
        """
        return jnp.zeros((), self.discount.dtype)

    def terminal(self, state: State) -> Bool[Array, ""]:
        """Return whether the task ends in this state.

        Args:
            state: The state s.
        """
        return jnp.zeros((), bool)

    @property
    def can_end(self) -> bool:
        """Whether there are terminal states: whether the task has a `terminal` of its own."""
        return type(self).terminal is not ContinuousTask.terminal


class ReachTask(ContinuousTask):
    """The task of coming within a radius of a goal.

    Attributes:
        goal: A place, compared with the first components of the state.
        radius: In the units of places, above 0.
        step_cost: The cost of an action.
        goal_reward: The reward of arriving.
        discount: γ in (0, 1].

    Raises:
        InputError: For numbers that are not finite, out of range, or of other shapes.
    """

    goal: Float[Array, "*tasks dimensions"] = eqx.field(converter=partial(_to_array, field="goal"))
    radius: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="radius", above=0))
    step_cost: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="step_cost"))
    goal_reward: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="goal_reward"))
    discount: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="discount"))

    def __check_init__(self) -> None:
        _check_shapes(self, goal=("dimensions",), radius=(), step_cost=(), goal_reward=())

    def reward(self, state: State, action: Action) -> Real:
        """Return minus the cost of a step.

        Args:
            state: The state s.
            action: The action a.
        """
        return -self.step_cost

    def features(self, state: State) -> Float[Array, " features"]:
        """Return the state, the goal, and the vector to the goal.

        Args:
            state: The state s.
        """
        return jnp.concatenate([state, self.goal, self.goal - state[: len(self.goal)]])

    def terminal_reward(self, state: State) -> Real:
        """Return the goal's reward.

        Args:
            state: The state s.
        """
        return self.goal_reward

    def terminal(self, state: State) -> Bool[Array, ""]:
        """Return whether the goal is within the radius.

        Args:
            state: The state s.
        """
        return jnp.sum((state[: len(self.goal)] - self.goal) ** 2) <= self.radius**2


def reach_region(
    goal: Sequence[float], radius: float, *, discount: float = 0.95, step_cost: float | None = None
) -> ReachTask:
    """Return the task of coming within `radius` of a goal.

    Args:
        goal: A place, compared with the first components of the state.
        radius: In the units of places, above 0.
        discount: γ in (0, 1]; below 1 without a step cost.
        step_cost: The cost of an action, above 0. Without it the goal pays 1.

    Raises:
        InputError: For a goal that is not finite, a radius or step cost not above 0, or a discount outside its range.

    Example:
        >>> task = reach_region((1.0, 2.0), radius=0.5)
        >>> bool(task.terminal(jnp.array([1.0, 2.4]))), float(task.terminal_reward(jnp.array([1.0, 2.4])))
        (True, 1.0)
    """
    check_discount(discount)
    if step_cost is None and discount == 1:
        raise InputError("a goal that pays 1 needs a discount below 1 (or give a step cost)", field="discount")
    goal = to_finite(goal, "goal", ("dimensions",))
    check_positive(radius, "radius")
    if step_cost is not None:
        check_positive(step_cost, "step_cost")
    numbers = goal, radius, step_cost or 0.0, 1.0 if step_cost is None else 0.0, discount
    return ReachTask(*(jnp.asarray(value, jnp.result_type(float)) for value in numbers))


class QuadraticTask(ContinuousTask):
    """The task of staying near a goal at a quadratic cost: R(s, a) = −(s − g)ᵀ C (s − g) − aᵀ D a; it never ends.

    Attributes:
        goal: The goal g.
        state_cost: C.
        action_cost: D.
        discount: γ in (0, 1].

    Raises:
        InputError: For numbers that are not finite, out of range, or of other shapes.

    Example:
        >>> task = QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(0.9))
        >>> float(task.reward(jnp.array([2.0]), jnp.array([1.0])))
        -5.0
    """

    goal: Float[Array, "*tasks dimensions"] = eqx.field(converter=partial(_to_array, field="goal"))
    state_cost: Float[Array, "*tasks dimensions dimensions"] = eqx.field(
        converter=partial(_to_array, field="state_cost")
    )
    action_cost: Float[Array, "*tasks inputs inputs"] = eqx.field(converter=partial(_to_array, field="action_cost"))
    discount: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="discount"))
    smooth: ClassVar[bool] = True

    def __check_init__(self) -> None:
        _check_shapes(self, goal=("dimensions",), action_cost=("inputs", "inputs"))
        _check_shapes(self, state_cost=2 * self.goal.shape[-1:], action_cost=2 * self.action_cost.shape[-1:])

    def reward(self, state: State, action: Action) -> Real:
        """Return minus the quadratic costs.

        Args:
            state: The state s.
            action: The action a.
        """
        error = state - self.goal
        return -error @ self.state_cost @ error - action @ self.action_cost @ action

    def features(self, state: State) -> Float[Array, " features"]:
        """Return s − g.

        Args:
            state: The state s.
        """
        return state - self.goal


class PendulumTask(ContinuousTask):
    """The task of holding a pendulum at an angle, with the reward of Gymnasium's `Pendulum-v1`; it never ends.

    R = −(φ − g)² − 0.1 ω² − 0.001 u² with φ − g in [−π, π); `Pendulum-v1` itself has the goal g = 0, upright.

    Attributes:
        goal: The goal angle g, in radians from upright.
        discount: γ in (0, 1].

    Raises:
        InputError: For numbers that are not finite, out of range, or of other shapes.

    Example:
        >>> task = PendulumTask(goal=jnp.zeros(()), discount=jnp.asarray(0.9))
        >>> round(float(task.reward(jnp.array([0.0, 1.0]), jnp.array([2.0]))), 3)
        -0.104
    """

    goal: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="goal"))
    discount: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="discount"))
    smooth: ClassVar[bool] = True

    def __check_init__(self) -> None:
        _check_shapes(self, goal=())

    def reward(self, state: State, action: Action) -> Real:
        """Return minus the costs of the angle, the speed and the torque.

        Args:
            state: The state s.
            action: The action a.
        """
        error = jnp.mod(state[0] - self.goal + jnp.pi, 2 * jnp.pi) - jnp.pi
        return -(error**2) - 0.1 * state[1] ** 2 - 0.001 * action[0] ** 2

    def features(self, state: State) -> Float[Array, " features"]:
        """Return cosine and sine of φ − g, the speed, and cosine and sine of g.

        Args:
            state: The state s.
        """
        error = state[0] - self.goal
        parts = [jnp.cos(error), jnp.sin(error), state[1], jnp.cos(self.goal), jnp.sin(self.goal)]
        return jnp.stack(jnp.broadcast_arrays(*parts))


class TableTask(ContinuousTask):
    """A tabular task as a continuous one, for `TableDynamics`; its features are a one-hot code of task and state.

    Attributes:
        task: The tabular task, with rewards for every state and action.
        index: A one-hot code of the task, so that a policy can tell tasks from one another.
        discount: γ in (0, 1].

    Raises:
        InputError: For a task of another type or with R(s, a, s′), and for numbers that are not finite, out of range,
            or of other shapes.
    """

    task: Task
    index: Float[Array, "*tasks indices"] = eqx.field(converter=partial(_to_array, field="index"))
    discount: Float[Array, "*tasks"] = eqx.field(converter=partial(_to_array, field="discount"))

    def __check_init__(self) -> None:
        check_instance(self.task, Task, "task")
        _check_shapes(self, index=("indices",))
        shape, expected = self.task.terminal.shape, (*self.discount.shape, "states")
        fits = shape[:-1] == self.discount.shape
        check(fits, f"expected terminal states of shape {expected}, found {shape}", field="task")
        check(self.task.outcome_reward is None, "expected rewards R(s, a), found R(s, a, s′)", field="task")

    def reward(self, state: State, action: Action) -> Real:
        """Return R(s, a), from the table.

        Args:
            state: The state s.
            action: The action a.
        """
        return self.task.reward[state, action]

    def terminal_reward(self, state: State) -> Real:
        """Return the reward of ending in a terminal state, from the table.

        Args:
            state: The state s.
        """
        return self.task.terminal_reward[state]

    def terminal(self, state: State) -> Bool[Array, ""]:
        """Return whether the task ends in this state, from the table.

        Args:
            state: The state s.
        """
        return self.task.terminal[state]

    def features(self, state: State) -> Float[Array, " features"]:
        """Return a one-hot code of task and state.

        Args:
            state: The state s.
        """
        states = jax.nn.one_hot(state, self.task.terminal.shape[-1], dtype=self.discount.dtype)
        return jnp.outer(self.index, states).ravel()


def _check_shapes(task: ContinuousTask, **axes: tuple[int | str, ...]) -> None:
    """Raise `InputError` unless each array has the axes of tasks that the discount has, and its own."""
    for name, own in axes.items():
        to_floats(getattr(task, name), name, (*np.shape(task.discount), *own))


def batch_tasks(tasks: Sequence[_Task]) -> _Task:
    """Return several tasks of one kind as one object with a leading axis.

    Args:
        tasks: The tasks, all of one kind.

    Raises:
        InputError: For no task, or tasks of different kinds or shapes.

    Example:
        >>> batch_tasks([reach_region((0.0,), 0.1), reach_region((1.0,), 0.1)]).goal.tolist()
        [[0.0], [1.0]]
    """
    tasks = to_list(tasks, ContinuousTask, "tasks")
    kinds = {(jax.tree.structure(task), *map(np.shape, jax.tree.leaves(task))) for task in tasks}
    check(len(kinds) == 1, f"expected tasks of one kind and shape, found {len(kinds)}", field="tasks")
    return _stacked(tasks)


@eqx.filter_jit
def _stacked(tasks: Sequence[_Task]) -> _Task:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tasks)


def task_at(tasks: _Task, index: Array | int) -> _Task:
    """Return one of a batch of tasks, or several for an array of indices.

    Args:
        tasks: The tasks as a batch.
        index: The index of a task, or an array of them.

    Raises:
        InputError: For a single task, and indices of tasks that do not exist.
    """
    check_instance(tasks, ContinuousTask, "tasks")
    message = f"expected a batch of tasks (batch_tasks), found a single {type(tasks).__name__}"
    check(jnp.ndim(tasks.discount) > 0, message, field="tasks")
    # an array, because a function is compiled for each number
    count = tasks.discount.shape[0]
    return _task_at(tasks, jnp.asarray(to_integers(index, "index", (), ("indices",), least=-count, most=count - 1)))


@eqx.filter_jit
def _task_at(tasks: _Task, index: Array) -> _Task:
    return jax.tree.map(lambda leaf: leaf[index], tasks)


def task_features(tasks: ContinuousTask, states: States) -> Float[Array, "states features"]:
    """Return the features of every state under its own task (`tasks` has an axis of states).

    Args:
        tasks: The task of each state.
        states: The states, one a task or an index.

    Raises:
        InputError: For another number of tasks than of states.
    """
    check_instance(tasks, ContinuousTask, "tasks")
    count, shape = np.shape(tasks.discount), np.shape(states)
    message = f"expected a task for each state, found {count} and {shape} of them"
    check(len(count) == 1 and count == shape[:1], message, field="tasks")
    return _features(tasks, states)


@eqx.filter_jit
def _features(tasks: ContinuousTask, states: States) -> Float[Array, "states features"]:
    return jax.vmap(lambda task, state: task.features(state))(tasks, states)


@eqx.filter_jit
def has_ended(tasks: ContinuousTask, task: Int[Array, " states"], states: States) -> Bool[Array, " states"]:
    """Return whether every state is terminal in its task; `task` holds indices into a batch of tasks.

    Args:
        tasks: The tasks as a batch.
        task: The index of the task of each state.
        states: The states, one a task or an index.
    """
    return jax.vmap(lambda task, state: task.terminal(state))(task_at(tasks, task), states)


def check_tasks(tasks: ContinuousTask) -> None:
    """Refuse discounts outside (0, 1] and numbers that are not finite.

    Args:
        tasks: The tasks as a batch.

    Raises:
        InputError: For any of these.
    """
    check_instance(tasks, ContinuousTask, "tasks")
    check_finite(tasks, field="tasks")
    for discount in np.ravel(np.asarray(tasks.discount)):
        check_discount(float(discount))
