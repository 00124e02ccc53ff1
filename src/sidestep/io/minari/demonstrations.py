"""Demonstrations in discrete worlds as Minari datasets, and datasets of discrete spaces as demonstrations.

Observations are states, and actions are numbered as in the model. The reward of a move (s, a, s′) is R(s, a), plus γ
times the terminal reward of s′ if s′ is terminal. The return Σ γ^t r_t of an episode is then that of the task, and the
rewards are on average those of the Gymnasium environment.

Complete tasks are in the metadata, so that a dataset suffices for learning. The metadata of the dataset have `tasks`,
one entry per task: `discount`, `terminal` (a list of states), and `reward` and `terminal_reward`, tables with axes of
length 1 where allowed in `Task`. The metadata of each episode have `goal` (the terminal state with the largest reward,
or a list of several), `discount`, and `task`, the number of its entry. In a dataset without `tasks`, the task of each
episode is to reach its `goal` at its `discount`, as in `reach`.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sidestep.errors import InputError, check, check_instance, describe, input_errors, to_number
from sidestep.io.minari.datasets import Episode, Metadata, read_dataset, require_minari, write_dataset
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import Task, reach

_NO_ENDS: Mapping[int, int] = {}


def write_demonstrations(
    dataset: str, demonstrations: Demonstrations[Task], world: Grid | Graph, *, ends: Mapping[int, int] = _NO_ENDS
) -> None:
    """Write demonstrations and their tasks as a local Minari dataset atomically.

    Args:
        dataset: A new id, such as `"office/walks-v0"`.
        demonstrations: In `world`.
        world: Gives the numbers of states and actions.
        ends: `Environment.ends` of a Gymnasium environment with separate states for ends of episodes; they are written
            as the environment's states.

    Raises:
        InputError: For an id that is malformed or exists already, demonstrations in another world, and for moves of a
            trajectory that do not start where the move before has ended.

    Example:
        >>> write_demonstrations("office/walks-v0", demonstrations, grid)  # doctest: +SKIP
    """
    require_minari(dataset)
    from gymnasium.spaces import Discrete

    states, actions = _world_size(world)
    check_instance(demonstrations, Demonstrations, "demonstrations")
    check_instance(demonstrations.tasks, Task, "demonstrations")
    _check_dataset(dataset, ends)
    moves = jax.tree.map(np.asarray, demonstrations)
    own_states, last_action = moves.tasks.terminal.shape[-1], moves.actions.max()
    message = f"expected demonstrations in a world of {states} states and {actions} actions"
    message += f", found {own_states} states and action {last_action}"
    check(own_states == states and last_action < actions, message, field="demonstrations")
    names = ("discount", "terminal_reward", "reward")
    columns = {name: getattr(moves.tasks, name).astype(np.float64).tolist() for name in names}
    columns["terminal"] = [np.flatnonzero(terminal).tolist() for terminal in moves.tasks.terminal]
    tasks = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    spaces = Discrete(states - len(ends)), Discrete(actions)
    write_dataset(dataset, spaces, list(_episodes(moves, tasks, actions, ends)), {"tasks": tasks})


def read_demonstrations(
    dataset: str | Path,
    world: Grid | Graph,
    *,
    task: Task | None = None,
    discount: float | None = None,
    step_cost: float | None = None,
    ends: Mapping[int, int] = _NO_ENDS,
) -> Demonstrations[Task]:
    """Return the demonstrations in a local Minari dataset with whole numbers as observations and actions.

    Args:
        dataset: Its id, or its path.
        world: Gives the numbers of states and actions.
        task: Of all episodes; by default the task in the metadata of each.
        discount: Of episodes that have a goal but no discount in their metadata.
        step_cost: Of episodes that have only goal and discount in their metadata, as in `reach`.
        ends: As in `write_demonstrations`.

    Raises:
        InputError: For a dataset that does not exist, is broken or empty, or has other spaces than the world, and,
            naming the episode and the field, for lengths that do not fit, states and actions outside the spaces, an
            episode that continues after a terminal state, and a task that is missing or not of this world.

    Example:
        >>> demonstrations = read_demonstrations("office/walks-v0", grid)  # doctest: +SKIP
    """
    states, actions = _world_size(world)
    _check_dataset(dataset, ends)
    check_instance(task, (Task, type(None)), "task")
    for value, field in ((discount, "discount"), (step_cost, "step_cost")):
        if value is not None:
            to_number(value, field, above=0)

    def check_spaces(*spaces: object) -> None:
        from gymnasium.spaces import Discrete

        counts = {"observation_space": states - len(ends), "action_space": actions}
        for space, (field, count) in zip(spaces, counts.items(), strict=True):
            fits = isinstance(space, Discrete) and space.n == count and space.start == 0
            check(fits, f"expected Discrete({count}), as the world has, found {space}", source=dataset, field=field)

    metadata, episodes = read_dataset(dataset, check_spaces)
    entries = metadata.get("tasks")
    if task is not None:
        message = f"expected one task of {states} states, found {task.terminal.shape}"
        check(task.terminal.shape == (states,), message, field="task")
        tasks, indices = [task], [0] * len(episodes)
    elif entries is not None:
        check(isinstance(entries, list) and entries, "expected a list of tasks", source=dataset, field="tasks")
        tasks = [_task(entry, world, f"{dataset}, task {index}") for index, entry in enumerate(entries)]
        indices = [_entry_of(episode, entries) for episode in episodes]
    else:
        tasks, indices = _tasks_of_goals(episodes, world, discount, step_cost)
    pairs = zip(episodes, indices, strict=True)
    trajectories = [_trajectory(episode, index, states - len(ends), actions, ends) for episode, index in pairs]
    try:
        return gather(trajectories, tasks)
    except InputError as error:
        raise error.of(dataset if error.row is None else episodes[error.row - 1].source) from error


def _episodes(
    moves: Demonstrations[Task], tasks: list[dict], actions: int, ends: Mapping[int, int]
) -> Iterator[Episode]:
    """Yield the episode of each trajectory; `moves` has NumPy's arrays, `tasks` describes each task."""
    origin = {own: state for state, own in ends.items()}
    rewards = _rewards(moves, actions)
    for row, own in enumerate(np.split(np.arange(len(moves)), moves.first_moves()[1:]), start=1):
        before, after, task = moves.states[own], moves.next_states[own], moves.task[own]
        connected = (after[:-1] == before[1:]).all() and (task == task[0]).all()
        message = "expected moves that each start where the one before ended, and one task"
        check(connected, message, source="trajectory", row=row)
        index, last = int(task[0]), int(after[-1])
        path = np.append(before, origin.get(last, last)).astype(np.int64)
        acted = moves.actions[own].astype(np.int64)
        metadata = {"task": index, "discount": tasks[index]["discount"]}
        goals = _best_terminal_states(tasks[index])
        metadata |= {"goal": goals[0] if len(goals) == 1 else goals} if goals else {}
        yield Episode(path, acted, rewards[own], last in tasks[index]["terminal"], {}, metadata)


def _rewards(moves: Demonstrations[Task], actions: int) -> Float[np.ndarray, " moves"]:
    """Return the reward of each move: R(s, a), plus γ times the terminal reward if the move ends the task."""
    tasks, task, after = moves.tasks, moves.task, moves.next_states
    reward = np.broadcast_to(tasks.reward, (*tasks.terminal.shape, actions))[task, moves.states, moves.actions]
    terminal_reward = np.broadcast_to(tasks.terminal_reward, tasks.terminal.shape)[task, after]
    return reward + tasks.discount[task].astype(np.float64) * tasks.terminal[task, after] * terminal_reward


def _trajectory(episode: Episode, task: int, states: int, actions: int, ends: Mapping[int, int]) -> Trajectory:
    path = _within(episode.observations, len(episode.rewards) + 1, states, episode.source, "observations")
    if episode.terminated:
        path[-1] = ends.get(int(path[-1]), int(path[-1]))
    return Trajectory(path, _within(episode.actions, len(episode.rewards), actions, episode.source, "actions"), task)


def _within(values: object, length: int, count: int, source: str, field: str) -> Int[np.ndarray, " length"]:
    """Return whole numbers in 0…count − 1, one for each move or observation."""
    numbers = np.asarray(values)
    message = f"expected {length} whole numbers, found {numbers.dtype} of shape {numbers.shape}"
    check(numbers.shape == (length,) and numbers.dtype.kind in "iu", message, source=source, field=field)
    step = int(np.argmax((numbers < 0) | (numbers >= count)))
    message = f"expected a whole number in 0…{count - 1}, found {numbers[step]} at step {step}"
    check(0 <= numbers[step] < count, message, source=source, field=field)
    return numbers.astype(np.int64)


def _best_terminal_states(entry: Mapping[str, Any]) -> list[int]:
    """Return the terminal states of a task with the largest reward; none if the task has no terminal state."""
    terminal = np.asarray(entry["terminal"], dtype=np.int64)
    final = np.asarray(entry["terminal_reward"])
    paid = final[terminal] if len(final) > 1 else np.repeat(final, len(terminal))
    return terminal[paid == paid.max(initial=-np.inf)].tolist()


def _tasks_of_goals(
    episodes: Sequence[Episode], world: Grid | Graph, discount: float | None, step_cost: float | None
) -> tuple[list[Task], list[int]]:
    """Return the tasks of reaching the goals of episodes, and the index of each episode's task."""
    towards: dict[tuple[int, float], Task] = {}
    keys = []
    for episode in episodes:
        metadata = {"discount": discount} | dict(episode.metadata)
        key = _whole(metadata, "goal", episode.source), _number(metadata, "discount", episode.source)
        keys.append(key)
        try:
            towards[key] = towards.get(key) or reach(world, key[0], discount=key[1], step_cost=step_cost)
        except InputError as error:
            raise error.of(episode.source) from error
    return list(towards.values()), [list(towards).index(key) for key in keys]


def _entry_of(episode: Episode, entries: Sequence[Mapping[str, Any]]) -> int:
    """Return the entry of an episode; goal and discount of its metadata, if any, must be those of the entry."""
    index = _whole(episode.metadata, "task", episode.source)
    message = f"expected a task in 0…{len(entries) - 1}, found {index}"
    check(0 <= index < len(entries), message, source=episode.source, field="task")
    entry = entries[index]
    for field, expected in (("goal", _best_terminal_states(entry)), ("discount", entry["discount"])):
        own = episode.metadata.get(field, expected)
        message = f"expected {expected} as in task {index}, found {own}"
        check(np.array_equal(np.atleast_1d(own), np.atleast_1d(expected)), message, source=episode.source, field=field)
    return index


def _number(metadata: Metadata, field: str, source: str) -> float:
    """Return a number in the metadata of an episode."""
    value: Any = metadata.get(field)
    message = "neither the episode nor an argument has it: expected a number, or a task for all episodes"
    check(value is not None, message, source=source, field=field)
    is_number = np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"
    check(is_number, f"expected a number, found {value!r}", source=source, field=field)
    return float(value)


def _whole(metadata: Metadata, field: str, source: str) -> int:
    """Return a whole number in the metadata of an episode."""
    value = _number(metadata, field, source)
    check(value.is_integer(), f"expected a whole number, found {value:g}", source=source, field=field)
    return int(value)


def _task(entry: Any, world: Grid | Graph, source: str) -> Task:
    """Return the task of an entry; raise `InputError` for one that does not fit the world."""
    states, actions = _world_size(world)
    complete = isinstance(entry, Mapping) and {"discount", "terminal", "terminal_reward", "reward"} <= entry.keys()
    check(complete, "expected discount, terminal, terminal_reward and reward", source=source)
    discount = _number(entry, "discount", source)
    message = f"expected a number above 0 and at most 1, found {discount}"
    check(0 < discount <= 1, message, source=source, field="discount")
    ends = np.asarray(entry["terminal"])
    valid = ends.ndim == 1 and (ends.dtype.kind == "i" or not len(ends)) and np.isin(ends, np.arange(states)).all()
    check(valid, f"expected a list of states in 0…{states - 1}", source=source, field="terminal")
    terminal = jnp.asarray(np.isin(np.arange(states), ends))
    reward = jnp.asarray(_table(entry, "reward", (states, actions), source))
    terminal_reward = jnp.asarray(_table(entry, "terminal_reward", (states,), source))
    return Task(reward, terminal_reward, terminal, jnp.asarray(discount, jnp.result_type(float)))


def _table(entry: Mapping[str, Any], field: str, shape: tuple[int, ...], source: str) -> Float[np.ndarray, "..."]:
    """Return a table of finite numbers of a shape, of which any axis may have length 1."""
    with input_errors("expected a table of numbers", TypeError, ValueError, source=source, field=field):
        table = np.asarray(entry[field], dtype=np.float64)
    fits = table.ndim == len(shape) and all(np.isin(table.shape, 1) | (np.array(table.shape) == shape))
    message = f"expected finite numbers of shape {shape}, found shape {table.shape}"
    check(fits and np.isfinite(table).all(), message, source=source, field=field)
    return table


def _check_dataset(dataset: object, ends: object) -> None:
    """Check the arguments of both functions that name the dataset and its terminal states."""
    message = f"expected the name of a dataset, found {describe(dataset)}"
    check(isinstance(dataset, str | Path), message, field="dataset")
    check_instance(ends, Mapping, "ends")


def _world_size(world: Grid | Graph) -> tuple[int, int]:
    """Return the numbers of states and actions of a world."""
    check_instance(world, (Grid, Graph), "world")
    return (world.size, len(world.steps)) if isinstance(world, Grid) else (world.states, world.actions)
