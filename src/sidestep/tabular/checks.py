"""Checks that tasks, behavior and demonstrations are of a model's world; what JAX is tracing is not looked at."""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from sidestep.errors import InputError, check
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.graph import Graph
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.tasks import Task


def is_traced(*trees: Any) -> bool:
    """Return whether JAX is tracing any array of some trees, so that its numbers are not known.

    Args:
        trees: Of arrays and other things.
    """
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def check_model(model: TransitionModel) -> None:
    """Raise `InputError` unless something is a transition model with finite parameters.

    Args:
        model: The model.
    """
    kind = type(model).__name__
    check(isinstance(model, TransitionModel), f"expected a TransitionModel, found {kind}", field="model")
    for leaf in jax.tree.leaves(model.parameters):
        if not is_traced(leaf):
            finite = np.isfinite(np.asarray(leaf))
            message = f"expected finite parameters, found {np.asarray(leaf)[~finite][:1]}"
            check(finite.all(), message, field="model")


def check_persons(behavior: Behavior | BehaviorModel, tasks: int) -> None:
    """Raise `InputError` unless a behavior model has no persons, or the person of each task.

    Args:
        behavior: The behavior.
        tasks: The number of tasks.
    """
    if isinstance(behavior, BehaviorModel) and behavior.person is not None:
        own = len(behavior.person)
        message = f"expected the person of each of the {tasks} tasks (see split_by_person), found {own} persons"
        check(own == tasks, message, field="person")


def check_behavior(behavior: Behavior | BehaviorModel, *, learned: bool = False) -> None:
    """Raise `InputError` unless something is a behavior.

    Args:
        behavior: The behavior.
        learned: Whether a `BehaviorModel` is one too.
    """
    kind, advice = type(behavior).__name__, ""
    if isinstance(behavior, BehaviorModel) and not learned:
        advice = "; a BehaviorModel has one of each person: `behavior_of(person)`"
    valid = isinstance(behavior, (Behavior, BehaviorModel) if learned else Behavior)
    check(valid, f"expected a Behavior, found {kind}{advice}", field="behavior")


def check_task(task: Task, world: Graph) -> None:
    """Raise `InputError` unless a task, or a stack of tasks, is of the world of a graph.

    Args:
        task: One task or a stack.
        world: The graph of a model.
    """
    check(isinstance(task, Task), f"expected a Task, found {type(task).__name__}", field="task")
    check(isinstance(world, Graph), f"expected the Graph of a model, found {type(world).__name__}", field="world")
    states = task.terminal.shape[-1]
    message = f"expected a task of the model's {world.states} states, found one of {states}"
    check(states == world.states, message, field="task")
    _check_axes("rewards", task.reward.shape[-2:], (world.states, world.actions))
    if task.outcome_reward is not None:
        _check_axes("rewards of outcomes", task.outcome_reward.shape[-3:], world.successors.shape)


def _check_axes(what: str, axes: tuple[int, ...], expected: tuple[int, ...]) -> None:
    fits = all(own in (1, size) for own, size in zip(axes, expected, strict=True))
    check(fits, f"expected {what} of shape {expected}, or 1 instead of an axis, found {axes}", field="task")


def check_demonstrations(demonstrations: Demonstrations, world: Graph) -> None:
    """Raise `InputError` unless demonstrations are of the world of a graph, and take available actions only.

    Args:
        demonstrations: The moves and their tasks.
        world: The graph of a model.
    """
    kind = type(demonstrations).__name__
    check(isinstance(demonstrations, Demonstrations), f"expected Demonstrations, found {kind}", field="demonstrations")
    discrete = isinstance(demonstrations.tasks, Task)
    message = f"expected tasks of a discrete world, found {type(demonstrations.tasks).__name__}"
    check(discrete, message, field="demonstrations")
    check_task(demonstrations.tasks, world)
    if is_traced(demonstrations, world):
        return
    moves = (demonstrations.states, demonstrations.actions, demonstrations.next_states)
    states, actions, next_states = (np.asarray(part) for part in moves)
    for name, numbers, count in (("state", states, world.states), ("action", actions, world.actions)):
        _check_moves(demonstrations, (numbers < 0) | (numbers >= count), name, numbers, f"0…{count - 1}")
    _check_moves(demonstrations, (next_states < 0) | (next_states >= world.states), "state", next_states, "the world's")
    available = np.broadcast_to(np.asarray(world.available), (world.states, world.actions))
    if not available.all():
        _check_moves(demonstrations, ~available[states, actions], "action", actions, "one that is available in its state")


def _check_moves(demonstrations: Demonstrations, wrong: np.ndarray, name: str, numbers: np.ndarray, valid: str) -> None:
    """Raise `InputError` with the trajectory and the move of the first wrong number."""
    if not wrong.any():
        return
    index = int(np.argmax(wrong))
    trajectory = np.asarray(demonstrations.trajectory)
    move = index - int(np.searchsorted(trajectory, trajectory[index]))
    message = f"expected {name} {valid} in move {move}, found {numbers[index]} in state {demonstrations.states[index]}"
    raise InputError(message, source=f"trajectory {trajectory[index]}", field="demonstrations")
