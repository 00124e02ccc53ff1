"""Demonstrations in continuous worlds: the record of the discrete ones, with vectors for states."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from sidestep.continuous.policies import FinitePolicy, GaussianPolicy, Policy
from sidestep.continuous.tasks import ContinuousTask, batch_tasks, check_tasks, has_ended
from sidestep.errors import InputError, check
from sidestep.tabular.demonstrations import Demonstrations, Trajectory


def gather_trajectories(trajectories: Sequence[Trajectory], tasks: Sequence[ContinuousTask]) -> Demonstrations:
    """Return the demonstrations of trajectories in a continuous world.

    Args:
        trajectories: states of shape (moves + 1, …), actions of shape (moves, …), and the index of a task.
        tasks: all of one kind.

    Raises:
        InputError: no or an empty trajectory, lengths or shapes that do not fit, numbers that are not finite, a task
            that does not exist, or a trajectory that goes on after its task has ended.

    Example:
        >>> from sidestep.continuous.tasks import reach_region
        >>> walk = Trajectory(np.array([[0.0], [0.5], [1.0]]), np.array([1, 1]), task=0)
        >>> len(gather_trajectories([walk], [reach_region((1.0,), 0.1)]))
        2
    """
    batched = batch_tasks(tasks)
    check_tasks(batched)
    check(trajectories, "expected at least one trajectory", field="trajectories")
    for row, trajectory in enumerate(trajectories, start=1):
        _check_trajectory(trajectory, trajectories[0], len(tasks), row)
    states, actions, task = zip(*trajectories, strict=True)
    lengths = [len(each) for each in actions]
    demonstrations = Demonstrations(
        states=jnp.asarray(np.concatenate([each[:-1] for each in states])),
        actions=jnp.asarray(np.concatenate(actions)),
        next_states=jnp.asarray(np.concatenate([each[1:] for each in states])),
        task=jnp.asarray(np.repeat(task, lengths), dtype=jnp.int32),
        trajectory=jnp.asarray(np.repeat(np.arange(len(lengths)), lengths), dtype=jnp.int32),
        tasks=batched,
    )
    ended = has_ended(batched, demonstrations.task, demonstrations.states)
    row = int(demonstrations.trajectory[int(ended.argmax())]) + 1
    check(not ended.any(), "goes on after a terminal state of its task", source="trajectory", row=row)
    return demonstrations


def _check_trajectory(trajectory: Trajectory, first: Trajectory, tasks: int, row: int) -> None:
    """Refuse a trajectory that is inconsistent, or has other shapes than the first."""
    states, actions, task = trajectory
    shape, action = np.shape(first.states)[1:], np.shape(first.actions)[1:]
    message, field = "", None
    if len(actions) == 0 or len(states) != len(actions) + 1 or np.shape(states)[1:] != shape:
        message = f"expected moves and one state of shape {shape} more, found {len(actions)} and {np.shape(states)}"
    elif np.shape(actions)[1:] != action:
        message, field = f"expected actions of shape {action}, found {np.shape(actions)[1:]}", "actions"
    elif not (np.isfinite(states).all() and np.isfinite(actions).all()):
        message, field = "expected finite numbers", "actions" if np.isfinite(states).all() else "states"
    elif not 0 <= task < tasks:
        message = f"expected a task in 0…{tasks - 1}, found {task}"
    check(not message, message, source="trajectory", row=row, field=field)


def check_choices(demonstrations: Demonstrations, policy: Policy) -> None:
    """Refuse actions that do not belong to the policy's."""
    choices = np.asarray(demonstrations.actions)
    if isinstance(policy, FinitePolicy):
        last = len(policy.actions) - 1
        is_index = choices.ndim == 1 and np.issubdtype(choices.dtype, np.integer)
        wrong = (choices < 0) | (choices > last) if is_index else np.ones(len(choices), bool)
        if wrong.any():
            move = int(wrong.argmax())
            source = f"trajectory {int(demonstrations.trajectory[move]) + 1}"
            message = f"expected the index of an action, 0…{last}, found {choices[move]}"
            raise InputError(message, source=source, field="actions")
    elif not np.issubdtype(choices.dtype, np.floating):
        raise InputError("expected vectors, as the policy's actions are", field="actions")
    elif isinstance(policy, GaussianPolicy) and choices.shape[1:] != policy.log_spread.shape:
        expected = f"expected vectors of {len(policy.log_spread)}, found shape {choices.shape[1:]}"
        raise InputError(expected, field="actions")
