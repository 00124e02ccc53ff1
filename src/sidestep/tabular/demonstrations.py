"""Demonstrations: what people did, as flat arrays over all their moves, and the tasks that they pursued."""

from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from sidestep.errors import InputError
from sidestep.tabular.tasks import Task, stack_tasks

Tasks = TypeVar("Tasks", bound=eqx.Module)
"""What tasks are: arrays in discrete worlds (`Task`), functions in continuous ones (`ContinuousTask`)."""


class Trajectory(NamedTuple):
    """One walk: s₁, a₁, …, s_{τ+1}, and the index of its task.

    States are whole numbers in discrete worlds and vectors in continuous ones. An action is its index where there are
    finitely many, and a vector otherwise.
    """

    states: Shaped[np.ndarray, "moves+1 *state"]
    actions: Shaped[np.ndarray, "moves *action"]
    task: int


class Demonstrations(eqx.Module, Generic[Tasks]):
    """Moves (s, a, s′) of many trajectories on many tasks, one after another.

    - `states`, `actions`, `next_states`: the moves; whole numbers in discrete worlds, in continuous ones vectors.
    - `task`, `trajectory`: which task (index into `tasks`) and which trajectory each move belongs to.
    - `tasks`: all tasks, stacked.
    - `weight`: how much each move counts in the likelihood of discrete worlds; None where all count once.
    """

    states: Shaped[Array, "moves *state"]
    actions: Shaped[Array, "moves *action"]
    next_states: Shaped[Array, "moves *state"]
    task: Int[Array, " moves"]
    trajectory: Int[Array, " moves"]
    tasks: Tasks
    weight: Float[Array, " moves"] | None = None

    def __len__(self) -> int:
        """The number of moves."""
        return len(self.states)

    @property
    def trajectories(self) -> int:
        """The number of trajectories."""
        return int(self.trajectory[-1]) + 1

    @property
    def weights(self) -> Float[Array, " moves"]:
        """How much each move counts: its weight, or once."""
        return jnp.ones(len(self)) if self.weight is None else self.weight

    def with_only(self, trajectories: Bool[np.ndarray, " trajectories"]) -> "Demonstrations[Tasks]":
        """The same moves, of which only those of some trajectories count."""
        weight = np.asarray(trajectories, dtype=np.float64)[np.asarray(self.trajectory)]
        return eqx.tree_at(lambda demos: demos.weight, self, jnp.asarray(weight), is_leaf=lambda leaf: leaf is None)

    def first_moves(self) -> Int[np.ndarray, " trajectories"]:
        """The index of the first move of each trajectory."""
        return np.flatnonzero(np.diff(np.asarray(self.trajectory), prepend=-1))

    def paths(self) -> list[Shaped[np.ndarray, "_ *state"]]:
        """The states along each trajectory, the last one included."""
        cuts = self.first_moves()[1:]
        states, ends = np.asarray(self.states), np.asarray(self.next_states)
        pieces = zip(np.split(states, cuts), np.split(ends, cuts), strict=True)
        return [np.concatenate([piece, end[-1:]]) for piece, end in pieces]

    def visited_state_goals(self: "Demonstrations[Task]") -> Int[np.ndarray, "visits 2"]:
        """The different (state, goal) pairs of all that people passed, where they arrived or stopped included.

        The goal is the first terminal state of the task.
        """
        goals = np.asarray(self.tasks.terminal).argmax(axis=-1)[np.asarray(self.task)]
        passed = np.concatenate([np.asarray(self.states), np.asarray(self.next_states)])
        return np.unique(np.stack([passed, np.tile(goals, 2)], axis=1), axis=0)


def split_by_person(
    demonstrations: Demonstrations[Task], person: Int[np.ndarray, " trajectories"]
) -> tuple[Demonstrations[Task], Int[np.ndarray, " tasks"]]:
    """The same moves with a task of its own for every person who pursues it, and whose each task is.

    - `person`: whose each trajectory is, 0…persons − 1.
    """
    whose = np.asarray(person)[np.asarray(demonstrations.trajectory)]
    kinds, task = np.unique(np.stack([np.asarray(demonstrations.task), whose], axis=1), axis=0, return_inverse=True)
    tasks = jax.tree.map(lambda leaf: leaf[kinds[:, 0]], demonstrations.tasks)
    own = eqx.tree_at(lambda demos: (demos.task, demos.tasks), demonstrations, (flat_moves([task]), tasks))
    return own, kinds[:, 1]


def gather(trajectories: Sequence[Trajectory], tasks: Sequence[Task]) -> Demonstrations[Task]:
    """Demonstrations from trajectories in any discrete world.

    Raises `InputError` for an empty trajectory, lengths that do not fit, a task that is not there, or a trajectory
    that goes on after a terminal state of its task.
    """
    stacked = stack_tasks(tasks)
    terminal = np.asarray(stacked.terminal)
    for index, (states, actions, task) in enumerate(trajectories, start=1):
        if len(actions) == 0 or len(states) != len(actions) + 1:
            raise InputError(
                f"expected moves and one state more, found {len(actions)} and {len(states)}",
                source="trajectory",
                row=index,
            )
        if not 0 <= task < len(tasks):
            raise InputError(f"expected a task in 0…{len(tasks) - 1}, found {task}", source="trajectory", row=index)
        if min(states) < 0 or max(states) >= terminal.shape[1] or min(actions) < 0:
            raise InputError(f"expected states in 0…{terminal.shape[1] - 1}", source="trajectory", row=index)
        if terminal[task, states[:-1]].any():
            raise InputError("goes on after a terminal state of its task", source="trajectory", row=index)
    lengths = [len(trajectory.actions) for trajectory in trajectories]
    if not lengths:
        raise InputError("expected at least one trajectory", field="trajectories")
    return Demonstrations(
        states=flat_moves([trajectory.states[:-1] for trajectory in trajectories]),
        actions=flat_moves([trajectory.actions for trajectory in trajectories]),
        next_states=flat_moves([trajectory.states[1:] for trajectory in trajectories]),
        task=jnp.asarray(np.repeat([trajectory.task for trajectory in trajectories], lengths), dtype=jnp.int32),
        trajectory=jnp.asarray(np.repeat(np.arange(len(lengths)), lengths), dtype=jnp.int32),
        tasks=stacked,
    )


def flat_moves(parts: Sequence[np.ndarray]) -> Int[Array, " moves"]:
    """Pieces of a flat array, one after another."""
    return jnp.asarray(np.concatenate(parts), dtype=jnp.int32)


def pad_to_power_of_two(demonstrations: Demonstrations[Task]) -> Demonstrations[Task]:
    """The same moves and tasks, and after them the first ones again, up to powers of two; see `next_power_of_two`.

    Of results for every move, those from `len(demonstrations)` on are to be thrown away. Trajectories mean nothing any
    more, and weights count twice.
    """
    moves, tasks = len(demonstrations), len(demonstrations.tasks.terminal)

    def filled(leaf: Array, count: int) -> Array:
        array = np.asarray(leaf)
        return jnp.asarray(np.concatenate([array, np.repeat(array[:1], next_power_of_two(count) - count, axis=0)]))

    own = eqx.tree_at(lambda demos: demos.tasks, demonstrations, None)
    filled_tasks = jax.tree.map(lambda leaf: filled(leaf, tasks), demonstrations.tasks)
    filled_moves = jax.tree.map(lambda leaf: filled(leaf, moves), own)
    return eqx.tree_at(lambda demos: demos.tasks, filled_moves, filled_tasks, is_leaf=lambda leaf: leaf is None)


def next_power_of_two(count: int) -> int:
    """The next power of two, so that one compiled function serves data of many sizes."""
    return 2 ** int(np.ceil(np.log2(count)))
