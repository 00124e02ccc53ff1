"""Checks that tasks, behavior and demonstrations are of a model's world; what JAX is tracing is not looked at."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from sidestep._arguments import to_mask
from sidestep.errors import InputError, check, check_instance
from sidestep.tabular.arrays import is_traced
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.distributions import check_distributions
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
    if not type(model).__module__.startswith("sidestep."):
        _check_probabilities(model)
    if isinstance(model.graph, Graph) and not is_traced(model.graph.successors):
        check_states(np.asarray(model.graph.successors), model.graph.states, "successors")
        to_mask(model.graph.available, "available")
        for name in ("available", "lengths"):
            _check_axes(
                getattr(model.graph, name).shape, model.graph.successors.shape[:2], f"a table `{name}`", "graph"
            )


def _check_probabilities(model: TransitionModel) -> None:
    """Raise `InputError` unless a model has a distribution over the outcomes of each available action.

    Args:
        model: Of a class that is not the library's, as those have distributions by design.
    """
    expected, shape = model.graph.successors.shape, jax.eval_shape(model.probabilities).shape
    check(shape == expected, f"expected probabilities of shape {expected}, found {shape}", field="model")
    if not is_traced(model):
        counts = np.broadcast_to(np.asarray(model.graph.available), shape[:2])
        check_distributions(np.asarray(model.probabilities()), ("state", "action"), counts=counts, field="model")


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
    """Raise `InputError` unless a task, or a stack of tasks, is of the world of a graph, and its numbers are valid.

    These are discounts in (0, 1] and finite rewards. Each state that is not terminal needs an available action.

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
    _check_axes(task.reward.shape[-2:], world.successors.shape[:2], "rewards", field)
    _check_rewards(task.reward, ("state", "action"), field, "reward")
    if task.outcome_reward is not None:
        _check_axes(task.outcome_reward.shape[-3:], world.successors.shape, "rewards of outcomes", field)
        _check_rewards(task.outcome_reward, ("state", "action", "outcome"), field, "outcome_reward")
    if not is_traced(task.terminal, task.terminal_reward):
        paid = np.where(np.asarray(task.terminal), np.asarray(task.terminal_reward), 0)
        _check_rewards(paid, ("state",), field, "terminal_reward")
    if not is_traced(task.terminal, world.available):
        _check_actions(np.asarray(task.terminal), np.asarray(world.available), field)
    if not is_traced(task.discount):
        discounts = np.atleast_1d(np.asarray(task.discount))
        wrong = discounts[~((discounts > 0) & (discounts <= 1))][:1].tolist()
        check(not wrong, f"expected a discount above 0 and at most 1, found {wrong}", source=field, field="discount")


def _check_axes(axes: tuple[int, ...], expected: tuple[int, ...], what: str, field: str) -> None:
    """Raise `InputError` unless each axis has the size expected, or 1."""
    fits = len(axes) == len(expected) and all(axis in (1, size) for axis, size in zip(axes, expected, strict=True))
    check(fits, f"expected {what} of shape {expected}, or 1 instead of an axis, found {axes}", field=field)


def _check_rewards(rewards: Any, names: tuple[str, ...], source: str, field: str) -> None:
    """Raise `InputError`, with the place, for a reward that is not finite; `names` are those of the last axes."""
    if is_traced(rewards):
        return
    numbers = np.asarray(rewards)
    for place in np.argwhere(~np.isfinite(numbers))[:1].tolist():
        named = zip(("task", *names)[-numbers.ndim :], place, numbers.shape, strict=True)
        where = ", ".join(f"{name} {index}" for name, index, size in named if size > 1)
        message = f"expected finite rewards, found {numbers[tuple(place)]}{f' in {where}' if where else ''}"
        raise InputError(message, source=source, field=field)


def _check_actions(
    terminal: Bool[np.ndarray, "*tasks states"], available: Bool[np.ndarray, "#states #actions"], field: str
) -> None:
    """Raise `InputError` for a state in which a task goes on and no action is available."""
    stuck = ~terminal & ~available.any(axis=1)
    for *_, state in np.argwhere(stuck)[:1].tolist():
        message = f"expected an available action in each state that is not terminal, found none in state {state}"
        raise InputError(message, source=field, field="available")


def check_policy(policy: Any, terminal: Any, world: Graph, moves: int) -> None:
    """Raise `InputError` unless a policy gives probabilities to the available actions of states that are not terminal.

    Args:
        policy: π(a | s); with an axis of moves before its own, for each move.
        terminal: Where no action is taken.
        world: The graph of a model.
        moves: The number of moves.
    """
    shape = world.states, world.actions
    fits = jnp.shape(policy) in (shape, (moves, *shape)) and jnp.shape(terminal) == shape[:1]
    message = f"expected a policy of shape {shape}, or one for each of {moves} moves, and terminal states of shape "
    message += f"{shape[:1]}, found "
    check(fits, f"{message}{jnp.shape(policy)} and {jnp.shape(terminal)}", field="policy, terminal")
    if is_traced(policy, terminal, world):
        return
    numbers, acts = np.asarray(policy), ~np.asarray(terminal, bool)
    names = ("state",) if numbers.ndim == 2 else ("move", "state")
    check_distributions(numbers, names, counts=acts, field="policy")
    wrong = (numbers > 0) & ~np.asarray(world.available) & acts[:, None]
    for *_, state, action in np.argwhere(wrong)[:1].tolist():
        message = f"expected available actions only, found action {action} in state {state} with a probability above 0"
        raise InputError(message, field="policy")


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
