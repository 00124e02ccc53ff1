"""Walkers in a known world: demonstrations to learn from when there are no people at hand."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.planning import plan, roll_out
from sidestep.tabular.tasks import Task

_TOGETHER = 128
"""How many moves are rolled out between looks at who has arrived."""


def simulate(
    key: PRNGKeyArray,
    world: TransitionModel,
    tasks: Sequence[Task],
    starts: Sequence[Int[np.ndarray, " _"]],
    behavior: Behavior | None = None,
    moves: int | None = None,
) -> list[Trajectory]:
    """Trajectories of walkers who know a world and pursue tasks in it.

    - `tasks`, `starts`: for each task, the states that its walkers start from (repeat a state for several walkers).
    - `behavior`: how they act; by default optimally, with ties broken at random.
    - `moves`: after how many moves a walker gives up; by default twice as many as there are states, and at least 1000.

    Raises `InputError` for a walker who does not arrive in time.
    """
    most = moves or max(1000, 2 * world.graph.states)
    trajectories = []
    for index, (task, own) in enumerate(zip(tasks, starts, strict=True)):
        made = plan(world, task, behavior)
        states, actions = np.asarray(own)[:, None], np.zeros((len(own), 0), dtype=np.int64)
        while not (arrived := np.asarray(made.terminal)[states[:, -1]]).all() and actions.shape[1] < most:
            key, walking = jax.random.split(key)
            together = min(_TOGETHER, most - actions.shape[1])
            walked = roll_out(walking, world, made.policy, made.terminal, jnp.asarray(states[:, -1]), together)
            states = np.concatenate([states, np.asarray(walked.states)[:, 1:]], axis=1)
            actions = np.concatenate([actions, np.asarray(walked.actions)], axis=1)
        if not arrived.all():
            raise InputError(
                f"a walker from state {int(own[np.argmin(arrived)])} had not arrived after {most} moves: "
                "expected a goal in reach, a larger β, or more moves",
                source=f"task {index}",
            )
        for own_states, own_actions in zip(states, actions, strict=True):
            taken = int((own_actions >= 0).sum())
            trajectories.append(Trajectory(own_states[: taken + 1], own_actions[:taken], index))
    return trajectories
