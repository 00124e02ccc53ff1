"""Demonstrations in continuous worlds: the same record as in discrete ones, with vectors for states."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from sidestep.continuous.policies import FinitePolicy, GaussianPolicy, Policy
from sidestep.continuous.tasks import ContinuousTask, check_tasks, ended_at, stack
from sidestep.errors import InputError
from sidestep.tabular.demonstrations import Demonstrations, Trajectory


def gather(trajectories: Sequence[Trajectory], tasks: Sequence[ContinuousTask]) -> Demonstrations:
    """Demonstrations from trajectories in a continuous world.

    Raises `InputError` for an empty one, lengths or shapes that do not fit, numbers that are not finite, a task that is
    not there, and a trajectory that goes on after its task has ended.
    """
    stacked = stack(tasks)
    check_tasks(stacked)
    if not trajectories:
        raise InputError("expected at least one trajectory", field="trajectories")
    shape, action = np.shape(trajectories[0].states)[1:], np.shape(trajectories[0].actions)[1:]
    for index, (states, actions, task) in enumerate(trajectories, start=1):
        if len(actions) == 0 or len(states) != len(actions) + 1 or np.shape(states)[1:] != shape:
            raise InputError(
                f"expected moves and one state of shape {shape} more, found {len(actions)} and {np.shape(states)}",
                source="trajectory",
                row=index,
            )
        if np.shape(actions)[1:] != action:
            raise InputError(
                f"expected actions of shape {action}, found {np.shape(actions)[1:]}",
                source="trajectory",
                row=index,
                field="actions",
            )
        for field, numbers in (("states", states), ("actions", actions)):
            if not np.isfinite(numbers).all():
                raise InputError("expected finite numbers", source="trajectory", row=index, field=field)
        if not 0 <= task < len(tasks):
            raise InputError(f"expected a task in 0…{len(tasks) - 1}, found {task}", source="trajectory", row=index)
    lengths = [len(each.actions) for each in trajectories]
    gathered = Demonstrations(
        states=jnp.asarray(np.concatenate([each.states[:-1] for each in trajectories])),
        actions=jnp.asarray(np.concatenate([each.actions for each in trajectories])),
        next_states=jnp.asarray(np.concatenate([each.states[1:] for each in trajectories])),
        task=jnp.asarray(np.repeat([each.task for each in trajectories], lengths), dtype=jnp.int32),
        trajectory=jnp.asarray(np.repeat(np.arange(len(lengths)), lengths), dtype=jnp.int32),
        tasks=stacked,
    )
    ended = ended_at(stacked, gathered.task, gathered.states)
    if ended.any():
        row = int(gathered.trajectory[int(ended.argmax())]) + 1
        raise InputError("goes on after a terminal state of its task", source="trajectory", row=row)
    return gathered


def check_choices(demonstrations: Demonstrations, policy: Policy) -> None:
    """Raises `InputError` for actions that are none of the policy's."""
    chosen = np.asarray(demonstrations.actions)
    if not isinstance(policy, FinitePolicy):
        if not np.issubdtype(chosen.dtype, np.floating):
            raise InputError("expected vectors, as the policy's actions are", field="actions")
        if isinstance(policy, GaussianPolicy) and chosen.shape[1:] != policy.log_spread.shape:
            raise InputError(
                f"expected vectors of {len(policy.log_spread)}, found shape {chosen.shape[1:]}", field="actions"
            )
        return
    most = len(policy.actions) - 1
    wrong = np.ones(len(chosen), bool)
    if chosen.ndim == 1 and np.issubdtype(chosen.dtype, np.integer):
        wrong = (chosen < 0) | (chosen > most)
    if wrong.any():
        move = int(wrong.argmax())
        raise InputError(
            f"expected the index of an action, 0…{most}, found {chosen[move]}",
            source=f"trajectory {int(demonstrations.trajectory[move]) + 1}",
            field="actions",
        )
