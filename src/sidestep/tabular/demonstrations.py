"""Demonstrations: the moves of agents as flat arrays, one trajectory after another, and the tasks that they pursued."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Generic, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from typing_extensions import TypeVar

from sidestep._arguments import to_integers, to_mask, to_states
from sidestep._repr import short_repr
from sidestep.errors import InputError, check, check_instance, describe, to_count, to_list
from sidestep.tabular.arrays import is_traced, to_jax
from sidestep.tabular.tasks import Task, stack_tasks

if TYPE_CHECKING:
    import pyarrow

    from sidestep.tabular.demonstration_tables import Labels

Tasks = TypeVar("Tasks", bound=eqx.Module, default=Any)
"""The type of the tasks: arrays in discrete worlds (`Task`), functions in continuous ones (`ContinuousTask`)."""

_MIN_MOVES, _MIN_TASKS = 64, 8
"""Demonstrations with fewer moves or tasks are padded to these, so that one compiled function serves them all."""


class Trajectory(NamedTuple):
    """The states and actions of one agent: s₁, a₁, …, s_{τ+1}.

    Attributes:
        states: s₁ … s_{τ+1}; integers in discrete worlds, vectors in continuous ones.
        actions: a₁ … a_τ; indices where there are finitely many actions, vectors otherwise.
        task: The index of the task that the agent pursued.
        truncated: Whether the agent was stopped by a limit of moves, before its task ended.

    Example:
        >>> Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0).task
        0
    """

    states: Shaped[np.ndarray, "moves+1 *state"]
    actions: Shaped[np.ndarray, "moves *action"]
    task: int
    truncated: bool = False


@short_repr("trajectories", "states", "actions", "tasks", "weights", "person")
class Demonstrations(eqx.Module, Generic[Tasks]):
    """The moves (s, a, s′) of many trajectories on many tasks, one after another; made by `gather`.

    Attributes:
        states: The state before each move; integers in discrete worlds, vectors in continuous ones.
        actions: The action of each move.
        next_states: The state after each move.
        task: The index (into `tasks`) of the task of each move.
        trajectory: The index of the trajectory of each move; 0, 1, … in order.
        tasks: All tasks, stacked.
        weights: How much each move counts in the likelihood; 1 by default.
        person: The person of each move; None where persons are not told apart.
        truncated: Whether the trajectory of each move was stopped by a limit of moves (see `Trajectory`); by default
            none was.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.tasks import reach
        >>> walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)
        >>> gather([walk, walk], [reach(Grid.unknown(rows=1, columns=3), 2)]).trajectories
        2
    """

    states: Shaped[Array, "moves *state"]
    actions: Shaped[Array, "moves *action"]
    next_states: Shaped[Array, "moves *state"]
    task: Int[Array, " moves"]
    trajectory: Int[Array, " moves"]
    tasks: Tasks
    weights: Float[Array, " moves"] = eqx.field(default=None)
    person: Int[Array, " moves"] | None = None
    truncated: Bool[Array, " moves"] = eqx.field(default=None)

    def __post_init__(self) -> None:
        if self.weights is None:
            self.weights = to_jax(np.ones(len(self.states)))
        if self.truncated is None:
            self.truncated = to_jax(np.zeros(len(self.states), bool))

    def __check_init__(self) -> None:
        moves = getattr(self.states, "shape", ())[:1]
        names = ["states", "actions", "next_states", "task", "trajectory", "weights", "truncated"]
        for name in names if self.person is None else [*names, "person"]:
            value = getattr(self, name)
            fits = isinstance(value, jax.Array | np.ndarray) and value.shape[:1] == moves != ()
            check(fits, f"expected an array with a row for each move, found {describe(value)}", field=name)

    def __len__(self) -> int:
        """Return the number of moves."""
        return len(self.states)

    @property
    def trajectories(self) -> int:
        """Return the number of trajectories."""
        return int(np.asarray(self.trajectory)[-1]) + 1

    def with_only(self, trajectories: Bool[np.ndarray, " trajectories"] | Sequence[bool]) -> "Demonstrations[Tasks]":
        """Return the same moves, with weight 0 for those of trajectories that are not chosen.

        Args:
            trajectories: Whether each trajectory counts.

        Returns:
            Demonstrations of the same length, so that no function is compiled anew; the weights of the chosen
            trajectories are as before.

        Raises:
            InputError: For anything but a boolean for each trajectory.
        """
        mask = to_mask(trajectories, "trajectories", (self.trajectories,))
        weights = np.where(np.asarray(mask)[np.asarray(self.trajectory)], np.asarray(self.weights), 0.0)
        return eqx.tree_at(lambda demonstrations: demonstrations.weights, self, to_jax(weights))

    @classmethod
    def from_table(
        cls,
        table: Any,
        tasks: Task | Sequence[Task],
        *,
        state: str = "state",
        action: str = "action",
        next_state: str | None = None,
        walk: str | Sequence[str] | None = "walk",
        step: str | None = None,
        task: str | None = None,
        subject: str | None = None,
        weight: str | None = None,
        truncated: str | None = None,
        labels: "Labels | None" = None,
    ) -> "Demonstrations[Task]":
        """Return the demonstrations in a table of pandas, polars, pyarrow or another library that speaks Arrow.

        A row is a move. Without a column of next states, the next state is that of the walk's next row, and the last
        row of a walk holds its final state, without an action.

        Args:
            table: Anything with Arrow's PyCapsule interface (`__arrow_c_stream__`) or the DataFrame interchange
                protocol.
            tasks: The tasks that the column `task` counts through; a single one needs no such column.
            state: The column with the state before each move; states, actions, tasks and persons are whole numbers from
                0, or labels.
            action: The column with the action.
            next_state: The column with the state after each move; an empty cell is the state of the next row.
            walk: The column that tells walks apart, by numbers or texts; a list of columns where one is not enough, as
                where each person's walks begin anew (`["subject", "walk"]`); None for a single walk. Walks are numbered
                as they appear.
            step: The column by which the rows of a walk are ordered; by default they are in order. Where the next state
                is that of the next row, whole numbers (also those stored as floats) must be followed by the next one.
            task: The column with the task of each walk.
            subject: The column with the person of each walk.
            weight: The column with how much each move counts.
            truncated: The column with whether each walk was stopped by a limit of moves.
            labels: The names of states, actions, tasks and persons, where cells hold names.

        Returns:
            The moves of all walks, one after another, with their tasks.

        Raises:
            InputError: With row and column, for a column that is missing or of another kind, an empty cell, a state,
                action or task that does not exist, a label that is not known or beyond the world's states or the
                tasks, moves that do not follow each other, a step that is left out, a walk without a move or that goes
                on after a terminal state, and two tasks or persons in one walk, or one that is truncated in some of its
                rows only.

        Example:
            >>> from sidestep.tabular.grid import Grid
            >>> from sidestep.tabular.tasks import reach
            >>> table = {"walk": ["a", "a", "a"], "state": [0, 1, 2], "action": [3, 3, None]}
            >>> shown = Demonstrations.from_table(table, reach(Grid.unknown(rows=1, columns=3), 2))
            >>> shown.next_states.tolist()
            [1, 2]
        """
        from sidestep.tabular.demonstration_tables import Columns, Labels, read_moves

        of_walk = [] if walk is None else [walk] if isinstance(walk, str) else to_list(walk, str, "walk")
        columns = Columns(state, action, next_state, tuple(of_walk), step, task, subject, weight, truncated)
        for field, name in columns._asdict().items():
            optional = () if field in ("state", "action") else (type(None),)
            check_instance(name, (tuple if field == "walk" else str, *optional), field)
        return read_moves(table, tasks, columns, Labels() if labels is None else labels)

    def to_table(self: "Demonstrations[Task]", labels: "Labels | None" = None) -> "pyarrow.Table":
        """Return the moves as a `pyarrow.Table`, which `to_pandas()` and `polars.from_arrow` convert.

        Args:
            labels: Names of states, actions, tasks and persons; without them these are numbers.

        Returns:
            A row for each move, with the columns `walk`, `step`, `state`, `action`, `next_state`, `task`, `subject`
            where there are persons, `weight` and `truncated`.

        Raises:
            InputError: Where there are too few labels, and for labels that are no `Labels`.

        Example:
            >>> from sidestep.tabular.grid import Grid
            >>> from sidestep.tabular.tasks import reach
            >>> walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)
            >>> shown = gather([walk, walk], [reach(Grid.unknown(rows=1, columns=3), 2)])
            >>> shown.to_table()["next_state"].to_pylist()
            [1, 2, 1, 2]
        """
        from sidestep.tabular.demonstration_tables import Labels, write_moves

        return write_moves(self, Labels() if labels is None else labels)

    def __getitem__(self, chosen: Any) -> "Demonstrations[Tasks]":
        """Return some trajectories, numbered anew; all tasks stay, so that their numbers do.

        Args:
            chosen: A slice, indices (which may repeat), or whether each trajectory is chosen.

        Raises:
            InputError: For no trajectory, and for one that does not exist.
        """
        from sidestep.tabular.selection import choose

        return choose(self, chosen)

    __iter__ = None
    """Not defined: `len` counts moves, and indices count trajectories."""

    @property
    def persons(self) -> Int[np.ndarray, " trajectories"] | None:
        """Return the person of each trajectory; None where persons are not told apart."""
        return None if self.person is None else np.asarray(self.person)[self.first_moves()]

    def first_moves(self) -> Int[np.ndarray, " trajectories"]:
        """Return the index of the first move of each trajectory."""
        return np.flatnonzero(np.diff(np.asarray(self.trajectory), prepend=-1))

    def paths(self) -> list[Shaped[np.ndarray, "_ *state"]]:
        """Return the states along each trajectory, the last one included."""
        cuts = self.first_moves()[1:]
        states, ends = np.asarray(self.states), np.asarray(self.next_states)
        pieces = zip(np.split(states, cuts), np.split(ends, cuts), strict=True)
        return [np.concatenate([piece, end[-1:]]) for piece, end in pieces]

    def visited_state_goals(self: "Demonstrations[Task]") -> Int[np.ndarray, "visits 2"]:
        """Return the distinct (state, goal) pairs of all visited states, final states included.

        The goal is the first terminal state of the task.
        """
        goals = np.asarray(self.tasks.terminal).argmax(axis=-1)[np.asarray(self.task)]
        visited = np.concatenate([np.asarray(self.states), np.asarray(self.next_states)])
        return np.unique(np.stack([visited, np.tile(goals, 2)], axis=1), axis=0)


def split_by_person(
    demonstrations: Demonstrations[Task], person: Int[np.ndarray, " trajectories"] | Sequence[int]
) -> tuple[Demonstrations[Task], Int[np.ndarray, " tasks"]]:
    """Return the same moves with a separate task for every person that pursues it, and the person of each task.

    Args:
        demonstrations: The moves of all persons.
        person: The person of each trajectory, 0…persons − 1.

    Returns:
        The demonstrations with the split tasks, and the index of the person of each task.

    Raises:
        InputError: For a person that is not a whole number, and where there is not one for each trajectory.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.tasks import reach
        >>> walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)
        >>> shown = gather([walk, walk], [reach(Grid.unknown(rows=1, columns=3), 2)])
        >>> split_by_person(shown, np.array([0, 1]))[1].tolist()  # the goal of both is now two tasks
        [0, 1]
    """
    check_instance(demonstrations, Demonstrations, "demonstrations")
    persons = to_integers(person, "person", (demonstrations.trajectories,), least=0)
    of_moves = np.asarray(persons)[np.asarray(demonstrations.trajectory)]
    pairs, task = np.unique(np.stack([np.asarray(demonstrations.task), of_moves], axis=1), axis=0, return_inverse=True)
    tasks = jax.tree.map(lambda leaf: to_jax(np.asarray(leaf)[pairs[:, 0]]), demonstrations.tasks)
    split = eqx.tree_at(lambda each: (each.task, each.tasks), demonstrations, (flat_moves([task]), tasks))
    return split, pairs[:, 1]


def gather(trajectories: Sequence[Trajectory], tasks: Sequence[Task]) -> Demonstrations[Task]:
    """Return demonstrations from trajectories in any discrete world.

    Args:
        trajectories: At least one, each with at least one move.
        tasks: The tasks that `Trajectory.task` counts through.

    Returns:
        The moves of all trajectories, one after another, with their tasks.

    Raises:
        InputError: For no or an empty trajectory, lengths that do not fit, a task or state that does not exist, or a
            trajectory that continues after a terminal state of its task.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.tasks import reach
        >>> walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)
        >>> len(gather([walk], [reach(Grid.unknown(rows=1, columns=3), 2)]))
        2
    """
    stacked = stack_tasks(to_list(tasks, Task, "tasks"))
    walks = to_list(trajectories, Trajectory, "trajectories")
    return flatten(to_trajectories(walks, np.asarray(stacked.terminal)), stacked)


def to_trajectories(
    trajectories: Sequence[Trajectory], terminal: Bool[np.ndarray, "tasks states"], actions: int | None = None
) -> list[Trajectory]:
    """Return trajectories as arrays of integers; each must fit its task.

    Args:
        trajectories: The trajectories.
        terminal: The terminal states of each task.
        actions: The number of actions of the world, None where it is not known.

    Raises:
        InputError: As `gather` does, with the row of the trajectory, the first of which is 1.
    """

    def checked(trajectory: Trajectory) -> Trajectory:
        path, acted, task, truncated = trajectory
        own = to_count(task, "task", 0, len(terminal) - 1)
        check_instance(truncated, (bool, np.bool_), "truncated")
        states = to_states(path, terminal.shape[1], "states")
        last = None if actions is None else actions - 1
        taken = to_integers(acted, "actions", ("moves",), least=0, most=last, what="actions")
        if not 0 < len(taken) == len(states) - 1:
            raise InputError(f"expected moves and one state more, found {len(taken)} and {len(states)}")
        message = "expected a trajectory that ends in the first terminal state, found one that goes on"
        check(not terminal[own, states[:-1]].any(), f"{message} after a terminal state of its task", field="states")
        return Trajectory(states, taken, own, truncated)

    results = []
    for row, trajectory in enumerate(trajectories, start=1):
        try:
            results.append(checked(trajectory))
        except InputError as error:
            raise InputError(error.message, source="trajectory", row=row, field=error.field) from None
    return results


def flatten(trajectories: Sequence[Trajectory], tasks: Task) -> Demonstrations[Task]:
    """Return the moves of trajectories, one after another, without checks.

    Args:
        trajectories: At least one, each with at least one move.
        tasks: The tasks that `Trajectory.task` counts through, stacked.
    """
    paths, actions, task, truncated = zip(*trajectories, strict=True)
    lengths = [len(taken) for taken in actions]
    states, next_states = flat_moves([path[:-1] for path in paths]), flat_moves([path[1:] for path in paths])
    of_moves, number = (flat_moves([np.repeat(each, lengths)]) for each in (task, np.arange(len(lengths))))
    stopped = to_jax(np.repeat(np.array(truncated, bool), lengths))
    return Demonstrations(states, flat_moves(actions), next_states, of_moves, number, tasks, truncated=stopped)


def trajectory_weights(
    trajectory: Int[np.ndarray, " moves"], weights: Float[np.ndarray, " moves"]
) -> Float[np.ndarray, " trajectories"]:
    """Return how much each trajectory counts: Σ w² / Σ w over its moves; 0 without a move that counts.

    That is w where each of its moves has the weight w or 0: as if moves of weight 0 were not there.

    Args:
        trajectory: The trajectory of each move.
        weights: How much each move counts, at least 0.
    """
    squares, sums = np.bincount(trajectory, weights**2), np.bincount(trajectory, weights)
    return np.divide(squares, sums, out=np.zeros_like(sums), where=sums > 0)


def flat_moves(parts: Sequence[np.ndarray]) -> Int[Array, " moves"]:
    """Return pieces of a flat array of integers, one after another.

    Args:
        parts: One-dimensional arrays.
    """
    return to_jax(np.concatenate(parts), np.int32)


def pad_to_power_of_two(demonstrations: Demonstrations[Task]) -> Demonstrations[Task]:
    """Return the same moves and tasks, padded to powers of two so that one compiled function serves many lengths.

    The padding of the moves repeats the first one with weight 0. That of the tasks ends in every state, so that there
    is nothing to solve. Of results for every move, those from `len(demonstrations)` on are to be dropped.
    Demonstrations that JAX is tracing are returned unchanged: their length is already fixed.

    Args:
        demonstrations: Moves and tasks of a discrete world.
    """
    if is_traced(demonstrations):
        return demonstrations

    def padded(tree: Any, count: int, least: int) -> tuple[Any, Bool[np.ndarray, " padded"]]:
        """Return the first row again in each row of padding, and which rows are padding."""
        rows = np.arange(next_power_of_two(max(count, least)))
        return jax.tree.map(lambda leaf: np.asarray(leaf)[np.where(rows < count, rows, 0)], tree), rows >= count

    tasks, is_padding = padded(demonstrations.tasks, len(demonstrations.tasks.terminal), _MIN_TASKS)
    tasks = eqx.tree_at(lambda task: task.terminal, tasks, tasks.terminal | is_padding[:, None])
    moves = eqx.tree_at(lambda each: each.tasks, demonstrations, None)
    moves, is_padding = padded(moves, len(demonstrations), _MIN_MOVES)
    changes = tasks, np.where(is_padding, 0, moves.weights)
    whole = eqx.tree_at(lambda each: (each.tasks, each.weights), moves, changes, is_leaf=lambda leaf: leaf is None)
    return jax.tree.map(to_jax, whole)


def next_power_of_two(count: int) -> int:
    """Return the smallest power of two that is at least `count`.

    Args:
        count: At least 1.
    """
    return 1 << (count - 1).bit_length()
