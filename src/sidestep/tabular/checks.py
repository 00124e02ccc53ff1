"""Checks that tasks, behavior and demonstrations are of a model's world; what JAX is tracing is not looked at."""

import jax
import numpy as np

from sidestep.errors import InputError, check, check_instance
from sidestep.tabular.arrays import is_traced
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.graph import Graph, check_states
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.tasks import Task


def check_model(model: TransitionModel) -> None:
    """Raise `InputError` unless something is a transition model without NaN, all successors of which are states.

    Args:
        model: The model.
    """
    check_instance(model, TransitionModel, "model")
    for leaf in jax.tree.leaves(model.parameters):
        if not is_traced(leaf):
            missing = np.isnan(np.asarray(leaf))
            places = np.argwhere(missing)[:1].tolist()
            check(not missing.any(), f"expected numbers as parameters, found nan at {places}", field="model")
    if isinstance(model.graph, Graph) and not is_traced(model.graph.successors):
        check_states(np.asarray(model.graph.successors), model.graph.states, "successors")


def check_persons(behavior: Behavior | BehaviorModel | None, tasks: int) -> None:
    """Raise `InputError` unless a behavior model has no persons, or the person of each task.

    Args:
        behavior: The behavior.
        tasks: The number of tasks.
    """
    if isinstance(behavior, BehaviorModel) and behavior.person is not None:
        own = len(behavior.person)
        message = f"expected the person of each of the {tasks} tasks (see split_by_person), found {own} persons"
        check(own == tasks, message, field="person")


def check_behavior(behavior: Behavior | BehaviorModel, world: Graph) -> None:
    """Raise `InputError` unless something is a behavior, or a behavior model of the world of a graph.

    Args:
        behavior: The behavior.
        world: The graph of a model.
    """
    check_instance(behavior, (Behavior, BehaviorModel), "behavior")
    if isinstance(behavior, BehaviorModel):
        shape = world.states, world.actions
        for field in ("features", "aimed_at"):
            own = getattr(behavior, field)
            axes = shape if own is None else own.shape[:2]
            fits = all(axis in (1, size) for axis, size in zip(axes, shape, strict=True))
            check(fits, f"expected {shape} states and actions, or 1 instead, found {axes}", field=field)


def check_task(task: Task, world: Graph, field: str = "task") -> None:
    """Raise `InputError` unless a task, or a stack of tasks, is of the world of a graph and has discounts in (0, 1].

    Args:
        task: One task or a stack.
        world: The graph of a model.
        field: The argument, for the error.
    """
    check_instance(task, Task, field)
    check_instance(world, Graph, "world")
    states = task.terminal.shape[-1]
    message = f"expected a task of the model's {world.states} states, found one of {states}"
    check(states == world.states, message, field=field)
    own: list[tuple[str, tuple[int, ...], tuple[int, ...]]] = [
        ("rewards", task.reward.shape[-2:], (world.states, world.actions))
    ]
    if task.outcome_reward is not None:
        own.append(("rewards of outcomes", task.outcome_reward.shape[-3:], world.successors.shape))
    for what, axes, expected in own:
        fits = all(axis in (1, size) for axis, size in zip(axes, expected, strict=True))
        check(fits, f"expected {what} of shape {expected}, or 1 instead of an axis, found {axes}", field=field)
    if not is_traced(task.discount):
        discounts = np.atleast_1d(np.asarray(task.discount))
        wrong = discounts[~((discounts > 0) & (discounts <= 1))][:1].tolist()
        check(not wrong, f"expected a discount above 0 and at most 1, found {wrong}", source=field, field="discount")


def check_demonstrations(demonstrations: Demonstrations, world: Graph) -> None:
    """Raise `InputError` unless demonstrations are of the world of a graph, in order, and of moves that can be made.

    Args:
        demonstrations: The moves and their tasks.
        world: The graph of a model.
    """
    check_instance(demonstrations, Demonstrations, "demonstrations")
    check_instance(demonstrations.tasks, Task, "demonstrations")
    check_task(demonstrations.tasks, world, "demonstrations")
    stacked = demonstrations.tasks.terminal.ndim == 2
    check(stacked, "expected a stack of tasks, found a single task", source="demonstrations", field="tasks")
    if is_traced(demonstrations, world):
        return
    _check_order(demonstrations)
    moves = (demonstrations.states, demonstrations.actions, demonstrations.next_states)
    states, actions, next_states = (np.asarray(part) for part in moves)
    for name, numbers, count in (("state", states, world.states), ("action", actions, world.actions)):
        _check_moves(demonstrations, (numbers < 0) | (numbers >= count), name, numbers, f"0…{count - 1}")
    _check_moves(demonstrations, (next_states < 0) | (next_states >= world.states), "state", next_states, "the world's")
    available = np.broadcast_to(np.asarray(world.available), (world.states, world.actions))
    if not available.all():
        _check_moves(
            demonstrations, ~available[states, actions], "action", actions, "one that is available in its state"
        )
    ended = np.asarray(demonstrations.tasks.terminal)[np.asarray(demonstrations.task), states]
    _check_moves(demonstrations, ended, "state", states, "that is not a terminal state of its task")


def _check_order(demonstrations: Demonstrations) -> None:
    """Raise `InputError` unless trajectories are numbered 0, 1, … in order and tasks, weights and persons are valid."""
    moves, count = len(demonstrations), len(demonstrations.tasks.terminal)
    trajectory = np.asarray(demonstrations.trajectory)
    step = np.diff(trajectory, prepend=0)
    _check_each(
        (step == 0) | ((step == 1) & (np.arange(moves) > 0)), trajectory, "the numbers 0, 1, … in order", "trajectory"
    )
    task, weights = np.asarray(demonstrations.task), np.asarray(demonstrations.weights)
    _check_each((task >= 0) & (task < count), task, f"a task in 0…{count - 1}", "task")
    _check_each((weights >= 0) & (weights < np.inf), weights, "a finite number, at least 0", "weights")
    if demonstrations.person is not None:
        shape = np.shape(demonstrations.person)
        message = f"expected a person for each of the {moves} moves, found shape {shape}"
        check(shape == (moves,), message, source="demonstrations", field="person")


def _check_each(valid: np.ndarray, numbers: np.ndarray, expected: str, field: str) -> None:
    """Raise `InputError` with the first number that is not valid."""
    if not valid.all():
        index = int(np.argmin(valid))
        message = f"expected {expected}, found {numbers[index]} in row {index} of the moves"
        raise InputError(message, source="demonstrations", field=field)


def _check_moves(demonstrations: Demonstrations, wrong: np.ndarray, name: str, numbers: np.ndarray, valid: str) -> None:
    """Raise `InputError` with the trajectory and the move of the first wrong number."""
    if not wrong.any():
        return
    index = int(np.argmax(wrong))
    trajectory = np.asarray(demonstrations.trajectory)
    move = index - int(np.searchsorted(trajectory, trajectory[index]))
    message = f"expected {name} {valid} in move {move}, found {numbers[index]} in state {demonstrations.states[index]}"
    raise InputError(message, source=f"trajectory {trajectory[index]}", field="demonstrations")
