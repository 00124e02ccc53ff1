"""Tasks in the metadata of a Minari dataset, whole, so that a dataset is enough to learn from.

The dataset's metadata hold `tasks`, one entry a task: `discount`, `terminal` (a list of states), and `reward` and
`terminal_reward`, tables whose axes may have length 1 as in `Task`. Each episode's metadata hold `goal` (the terminal
state that pays most; several are a list), `discount`, and `task`, the number of its entry. Where a dataset has no
`tasks`, each episode pursues its `goal` at its `discount`, as `reach` has it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.errors import InputError
from sidestep.io.minari.datasets import Dataset, Episode
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import Task, check_discount, reach


def described(tasks: Task) -> list[dict[str, Any]]:
    """Stacked tasks as plain values, one entry a task."""
    return [
        {
            "discount": float(tasks.discount[index]),
            "terminal": np.flatnonzero(tasks.terminal[index]).tolist(),
            "terminal_reward": np.asarray(tasks.terminal_reward[index], dtype=np.float64).tolist(),
            "reward": np.asarray(tasks.reward[index], dtype=np.float64).tolist(),
        }
        for index in range(len(tasks.discount))
    ]


def goals(entry: Mapping[str, Any]) -> list[int]:
    """The terminal states of a task that pay most; none if nothing ends it."""
    terminal = np.asarray(entry["terminal"], dtype=np.int64)
    final = np.asarray(entry["terminal_reward"])
    paid = final[terminal] if len(final) > 1 else np.repeat(final, len(terminal))
    return terminal[paid == paid.max(initial=-np.inf)].tolist()


def pursued(
    dataset: Dataset, source: object, world: Grid | Graph, discount: float | None, step_cost: float | None
) -> tuple[list[Task], list[int]]:
    """The tasks of a dataset, and which of them each episode pursues.

    - `source`: the dataset, for error messages. `discount`, `step_cost`: of tasks that metadata tell by their goal.

    Raises `InputError`, naming the episode and the field, where metadata lack a task or tell one that does not fit the
    world.
    """
    entries = dataset.metadata.get("tasks")
    if entries is None:
        return _towards_goals(dataset.episodes, world, discount, step_cost)
    if not isinstance(entries, list) or not entries:
        raise InputError("expected a list of tasks", source=source, field="tasks")
    tasks = [_task(entry, world, f"{source}, task {index}") for index, entry in enumerate(entries)]
    return tasks, [_entry_of(episode, entries) for episode in dataset.episodes]


def _towards_goals(
    episodes: Sequence[Episode], world: Grid | Graph, discount: float | None, step_cost: float | None
) -> tuple[list[Task], list[int]]:
    """One task for each different goal and discount that episodes tell."""
    number: dict[tuple[int, float], int] = {}
    tasks, own = [], []
    for episode in episodes:
        known = {"discount": discount} | dict(episode.metadata)
        wanted = _whole(known, "goal", episode.source), _number(known, "discount", episode.source)
        if wanted not in number:
            number[wanted] = len(tasks)
            try:
                tasks.append(reach(world, wanted[0], discount=wanted[1], step_cost=step_cost))
            except InputError as error:
                raise error.of(episode.source) from error
        own.append(number[wanted])
    return tasks, own


def _entry_of(episode: Episode, entries: Sequence[Mapping[str, Any]]) -> int:
    """Which entry an episode pursues; its goal and discount, where it tells them, must be that entry's."""
    index = _whole(episode.metadata, "task", episode.source)
    if not 0 <= index < len(entries):
        message = f"expected a task in 0…{len(entries) - 1}, found {index}"
        raise InputError(message, source=episode.source, field="task")
    entry = entries[index]
    for field, expected in (("goal", goals(entry)), ("discount", entry["discount"])):
        found = episode.metadata.get(field, expected)
        if not np.array_equal(np.atleast_1d(found), np.atleast_1d(expected)):
            message = f"expected {expected} as in task {index}, found {found}"
            raise InputError(message, source=episode.source, field=field)
    return index


def _number(metadata: Mapping[str, Any], field: str, source: str) -> float:
    """A number that an episode's metadata tell."""
    found = metadata.get(field)
    if found is None:
        message = "the episode does not tell it, and nor did an argument: expected a number, or a task for all episodes"
        raise InputError(message, source=source, field=field)
    if np.ndim(found) or np.asarray(found).dtype.kind not in "iuf":
        raise InputError(f"expected a number, found {found!r}", source=source, field=field)
    return float(found)


def _whole(metadata: Mapping[str, Any], field: str, source: str) -> int:
    """A whole number that an episode's metadata tell."""
    found = _number(metadata, field, source)
    if not found.is_integer():
        raise InputError(f"expected a whole number, found {found:g}", source=source, field=field)
    return int(found)


def _task(entry: Any, world: Grid | Graph, source: str) -> Task:
    """The task that an entry describes; raises `InputError` for one that does not fit the world."""
    states, actions = size_of(world)
    if not isinstance(entry, Mapping) or not {"discount", "terminal", "terminal_reward", "reward"} <= entry.keys():
        raise InputError("expected discount, terminal, final_reward and reward", source=source)
    discount = _number(entry, "discount", source)
    try:
        check_discount(discount)
    except InputError as error:
        raise error.of(source) from error
    ends = np.asarray(entry["terminal"])
    if ends.ndim != 1 or (len(ends) and (ends.dtype.kind != "i" or ends.min() < 0 or ends.max() >= states)):
        raise InputError(f"expected a list of states in 0…{states - 1}", source=source, field="terminal")
    terminal = jnp.asarray(np.isin(np.arange(states), ends))
    reward = _table(entry, "reward", (states, actions), source)
    final = _table(entry, "terminal_reward", (states,), source)
    return Task(jnp.asarray(reward), jnp.asarray(final), terminal, jnp.asarray(discount, jnp.result_type(float)))


def _table(entry: Mapping[str, Any], field: str, shape: tuple[int, ...], source: str) -> Float[np.ndarray, "..."]:
    """A table of finite numbers with that shape; any axis may have length 1."""
    try:
        table = np.asarray(entry[field], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("expected a table of numbers", source=source, field=field) from error
    fits = table.ndim == len(shape) and all(
        length in (1, full) for length, full in zip(table.shape, shape, strict=True)
    )
    if not fits or not np.isfinite(table).all():
        message = f"expected finite numbers of shape {shape}, found shape {table.shape}"
        raise InputError(message, source=source, field=field)
    return table


def size_of(world: Grid | Graph) -> tuple[int, int]:
    """How many states and actions a world has."""
    return (world.size, len(world.steps)) if isinstance(world, Grid) else (world.states, world.actions)
