"""Simulated agents in a known world: demonstrations to learn from where no real ones are at hand."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from sidestep.errors import InputError
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Trajectory, next_power_of_two
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.planning import plan, roll_out
from sidestep.tabular.tasks import Task

_CHUNK = 128
"""The number of moves that are rolled out before looking at which agents have arrived."""


def simulate(
    key: PRNGKeyArray,
    world: TransitionModel,
    tasks: Sequence[Task],
    starts: Sequence[Int[np.ndarray, " _"]],
    behavior: Behavior | None = None,
    max_moves: int | None = None,
) -> list[Trajectory]:
    """Return trajectories of agents that know a world and pursue tasks in it.

    An agent acts until its task ends. For a task without an end, use `plan` and then `roll_out`.

    Args:
        key: Of the random choices.
        world: The transition model that the agents plan with and that their moves follow.
        tasks: The tasks that are pursued.
        starts: For each task the states that its agents start in, one agent an entry.
        behavior: The agents'; None for the optimal policy, with ties broken at random.
        max_moves: The number of moves after which an agent gives up; by default twice the number of states, and at
            least 1000.

    Returns:
        The trajectories, those of the first task first.

    Raises:
        InputError: For an agent that has not arrived after `max_moves`.
        ImproperTask: For a task that has no values.
        NotConverged: If the values of a task do not converge.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> [walk] = simulate(jax.random.key(0), true_model(grid), [reach(grid, 2)], [np.array([0])])
        >>> walk.states.tolist()
        [0, 1, 2]
    """
    max_moves = max_moves or max(1000, 2 * world.graph.states)
    trajectories = []
    for index, (task, own) in enumerate(zip(tasks, starts, strict=True)):
        made, agents = plan(world, task, behavior), len(own)
        terminal = np.asarray(made.terminal)
        # with copies of agents up to a power of two, so that one compiled function serves many numbers of agents
        states = np.resize(own, next_power_of_two(max(agents, 1)))[:, None]
        actions = np.zeros((len(states), 0), dtype=np.int64)
        while not (arrived := terminal[states[:agents, -1]]).all() and actions.shape[1] < max_moves:
            key, chunk_key = jax.random.split(key)
            moves = min(_CHUNK, max_moves - actions.shape[1])
            rolled = roll_out(chunk_key, world, made.policy, made.terminal, to_jax(states[:, -1], np.int32), moves)
            states = np.concatenate([states, np.asarray(rolled.states)[:, 1:]], axis=1)
            actions = np.concatenate([actions, np.asarray(rolled.actions)], axis=1)
        if not arrived.all():
            raise InputError(
                f"an agent from state {int(own[np.argmin(arrived)])} had not arrived after {max_moves} moves: "
                "expected a goal in reach, a larger β, a step cost with discount 1 for long ways, or more moves",
                source=f"task {index}",
            )
        for own_states, own_actions in zip(states[:agents], actions[:agents], strict=True):
            taken = int((own_actions >= 0).sum())
            trajectories.append(Trajectory(own_states[: taken + 1], own_actions[:taken], index))
    return trajectories
