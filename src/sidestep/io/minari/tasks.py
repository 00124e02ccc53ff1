"""Complete tasks in the metadata of a Minari dataset, so that it suffices for learning.

The metadata of the dataset have `tasks`, one entry per task: `discount`, `terminal` (a list of states), and `reward`
and `terminal_reward`, tables with axes of length 1 where allowed in `Task`. The metadata of each episode have `goal`
(the terminal state with the largest reward, or a list of several), `discount`, and `task`, the number of its entry. In
a dataset without `tasks`, the task of each episode is to reach its `goal` at its `discount`, as in `reach`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.errors import InputError, check
from sidestep.io.minari.datasets import Dataset, Episode
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import Task, check_discount, reach


def describe_tasks(tasks: Task) -> list[dict[str, Any]]:
    """Return stacked tasks as plain values, one entry per task."""
    return [
        {
            "discount": float(tasks.discount[index]),
            "terminal": np.flatnonzero(tasks.terminal[index]).tolist(),
            "terminal_reward": np.asarray(tasks.terminal_reward[index], dtype=np.float64).tolist(),
            "reward": np.asarray(tasks.reward[index], dtype=np.float64).tolist(),
        }
        for index in range(len(tasks.discount))
    ]


def best_terminal_states(entry: Mapping[str, Any]) -> list[int]:
    """Return the terminal states of a task with the largest reward; none if the task has no terminal state."""
    terminal = np.asarray(entry["terminal"], dtype=np.int64)
    final = np.asarray(entry["terminal_reward"])
    paid = final[terminal] if len(final) > 1 else np.repeat(final, len(terminal))
    return terminal[paid == paid.max(initial=-np.inf)].tolist()


def tasks_of_episodes(
    dataset: Dataset, source: object, world: Grid | Graph, discount: float | None, step_cost: float | None
) -> tuple[list[Task], list[int]]:
    """Return the tasks of a dataset, and the index of each episode's task.

    Args:
        dataset: the dataset.
        source: its name, for error messages.
        world: gives the numbers of states and actions.
        discount: of tasks with only a goal in their metadata.
        step_cost: of tasks with only goal and discount in their metadata.

    Raises:
        InputError: naming the episode and the field, if metadata have no task or one that does not fit the world.
    """
    entries = dataset.metadata.get("tasks")
    if entries is None:
        return _towards_goals(dataset.episodes, world, discount, step_cost)
    check(isinstance(entries, list) and entries, "expected a list of tasks", source=source, field="tasks")
    tasks = [_task(entry, world, f"{source}, task {index}") for index, entry in enumerate(entries)]
    return tasks, [_entry_of(episode, entries) for episode in dataset.episodes]


def _towards_goals(
    episodes: Sequence[Episode], world: Grid | Graph, discount: float | None, step_cost: float | None
) -> tuple[list[Task], list[int]]:
    """Return one task for each different goal and discount of episodes, and the index of each episode's task."""
    number: dict[tuple[int, float], int] = {}
    tasks, indices = [], []
    for episode in episodes:
        metadata = {"discount": discount} | dict(episode.metadata)
        goal, own_discount = _whole(metadata, "goal", episode.source), _number(metadata, "discount", episode.source)
        if (goal, own_discount) not in number:
            number[goal, own_discount] = len(tasks)
            try:
                tasks.append(reach(world, goal, discount=own_discount, step_cost=step_cost))
            except InputError as error:
                raise error.of(episode.source) from error
        indices.append(number[goal, own_discount])
    return tasks, indices


def _entry_of(episode: Episode, entries: Sequence[Mapping[str, Any]]) -> int:
    """Return the entry of an episode; goal and discount of its metadata, if any, must be those of the entry."""
    index = _whole(episode.metadata, "task", episode.source)
    message = f"expected a task in 0…{len(entries) - 1}, found {index}"
    check(0 <= index < len(entries), message, source=episode.source, field="task")
    entry = entries[index]
    for field, expected in (("goal", best_terminal_states(entry)), ("discount", entry["discount"])):
        own = episode.metadata.get(field, expected)
        message = f"expected {expected} as in task {index}, found {own}"
        check(np.array_equal(np.atleast_1d(own), np.atleast_1d(expected)), message, source=episode.source, field=field)
    return index


def _number(metadata: Mapping[str, Any], field: str, source: str) -> float:
    """Return a number in the metadata of an episode."""
    value = metadata.get(field)
    if value is None:
        message = "neither the episode nor an argument has it: expected a number, or a task for all episodes"
        raise InputError(message, source=source, field=field)
    is_number = np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"
    check(is_number, f"expected a number, found {value!r}", source=source, field=field)
    return float(value)


def _whole(metadata: Mapping[str, Any], field: str, source: str) -> int:
    """Return a whole number in the metadata of an episode."""
    value = _number(metadata, field, source)
    check(value.is_integer(), f"expected a whole number, found {value:g}", source=source, field=field)
    return int(value)


def _task(entry: Any, world: Grid | Graph, source: str) -> Task:
    """Return the task of an entry; raise `InputError` for one that does not fit the world."""
    states, actions = world_size(world)
    keys = {"discount", "terminal", "terminal_reward", "reward"}
    complete = isinstance(entry, Mapping) and keys <= entry.keys()
    check(complete, "expected discount, terminal, terminal_reward and reward", source=source)
    discount = _number(entry, "discount", source)
    try:
        check_discount(discount)
    except InputError as error:
        raise error.of(source) from error
    ends = np.asarray(entry["terminal"])
    if ends.ndim != 1 or (len(ends) and (ends.dtype.kind != "i" or ends.min() < 0 or ends.max() >= states)):
        raise InputError(f"expected a list of states in 0…{states - 1}", source=source, field="terminal")
    terminal = jnp.asarray(np.isin(np.arange(states), ends))
    reward = jnp.asarray(_table(entry, "reward", (states, actions), source))
    terminal_reward = jnp.asarray(_table(entry, "terminal_reward", (states,), source))
    return Task(reward, terminal_reward, terminal, jnp.asarray(discount, jnp.result_type(float)))


def _table(entry: Mapping[str, Any], field: str, shape: tuple[int, ...], source: str) -> Float[np.ndarray, "..."]:
    """Return a table of finite numbers of a shape, of which any axis may have length 1."""
    try:
        table = np.asarray(entry[field], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("expected a table of numbers", source=source, field=field) from error
    fits = table.ndim == len(shape) and all(np.isin(table.shape, 1) | (np.array(table.shape) == shape))
    message = f"expected finite numbers of shape {shape}, found shape {table.shape}"
    check(fits and np.isfinite(table).all(), message, source=source, field=field)
    return table


def world_size(world: Grid | Graph) -> tuple[int, int]:
    """Return the numbers of states and actions of a world."""
    return (world.size, len(world.steps)) if isinstance(world, Grid) else (world.states, world.actions)
