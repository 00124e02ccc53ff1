"""Tasks in the metadata of a Minari dataset: one entry for each.

An entry has `discount`, `terminal` (a list of states), `reward` and `terminal_reward`, and `outcome_reward` for tasks
that pay by outcome: tables with axes of length 1 where allowed in `Task`.
"""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.errors import check, check_instance, input_errors
from sidestep.io.minari.datasets import Metadata
from sidestep.tabular.graph import Graph, grid_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import Task

_TABLES = "discount", "terminal_reward", "reward", "outcome_reward"


def entries_of(tasks: Task) -> list[dict[str, Any]]:
    """Return the entry of each task.

    Args:
        tasks: A stack, of NumPy arrays.
    """
    fields = {name: getattr(tasks, name) for name in _TABLES}
    columns: dict[str, list] = {
        name: np.asarray(table, np.float64).tolist() for name, table in fields.items() if table is not None
    }
    columns["terminal"] = [np.flatnonzero(terminal).tolist() for terminal in tasks.terminal]
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def task_of(entry: Any, world: Grid | Graph, source: str) -> Task:
    """Return the task of an entry; raise `InputError` for one that does not fit the world.

    Args:
        entry: Of the metadata.
        world: Gives the numbers of states, actions and outcomes.
        source: The entry, for the message.
    """
    states, actions = world_size(world)
    complete = isinstance(entry, Mapping) and {"discount", "terminal", "terminal_reward", "reward"} <= entry.keys()
    check(complete, "expected discount, terminal, terminal_reward and reward", source=source)
    discount = number_in(entry, "discount", source)
    message = f"expected a finite number above 0 and at most 1, found {discount}"
    check(0 < discount <= 1, message, source=source, field="discount")
    ends = np.asarray(entry["terminal"])
    valid = ends.ndim == 1 and (ends.dtype.kind == "i" or not len(ends)) and np.isin(ends, np.arange(states)).all()
    check(valid, f"expected a list of states in 0…{states - 1}", source=source, field="terminal")
    terminal = jnp.asarray(np.isin(np.arange(states), ends))
    reward = jnp.asarray(_table(entry, "reward", (states, actions), source))
    terminal_reward = jnp.asarray(_table(entry, "terminal_reward", (states,), source))
    of_outcomes = None
    if entry.get("outcome_reward") is not None:
        shape = graph_of(world).successors.shape
        of_outcomes = jnp.asarray(_table(entry, "outcome_reward", shape, source))
    return Task(reward, terminal_reward, terminal, jnp.asarray(discount, jnp.result_type(float)), of_outcomes)


def best_terminal_states(entry: Mapping[str, Any], world: Grid | Graph) -> list[int]:
    """Return the terminal states of a task that pay most on arrival; none if the task has no terminal state.

    Args:
        entry: Of the metadata.
        world: Says which outcomes lead to a state.
    """
    terminal = np.asarray(entry["terminal"], dtype=np.int64)
    final = np.asarray(entry["terminal_reward"])
    paid = final[terminal] if len(final) > 1 else np.repeat(final, len(terminal))
    if entry.get("outcome_reward") is not None:
        successors = np.asarray(graph_of(world).successors)
        rewards = np.broadcast_to(np.asarray(entry["outcome_reward"]), successors.shape)
        arriving = ~np.isin(np.arange(len(successors)), terminal)
        most = np.full(len(successors), -np.inf)
        np.maximum.at(most, successors[arriving], rewards[arriving])
        paid = most[terminal] + entry["discount"] * paid
    return terminal[paid == paid.max(initial=-np.inf)].tolist()


def number_in(metadata: Metadata, field: str, source: str) -> float:
    """Return a number in metadata; raise `InputError` where there is none.

    Args:
        metadata: Of an episode or a task.
        field: The key.
        source: The episode or the task, for the message.
    """
    value: Any = metadata.get(field)
    message = "neither the episode nor an argument has it: expected a number, or a task for all episodes"
    check(value is not None, message, source=source, field=field)
    is_number = np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"
    check(is_number, f"expected a number, found {value!r}", source=source, field=field)
    return float(value)


def whole_number_in(metadata: Metadata, field: str, source: str) -> int:
    """Return a whole number in metadata; raise `InputError` where there is none.

    Args:
        metadata: Of an episode or a task.
        field: The key.
        source: The episode or the task, for the message.
    """
    value = number_in(metadata, field, source)
    check(value.is_integer(), f"expected a whole number, found {value:g}", source=source, field=field)
    return int(value)


def world_size(world: Grid | Graph) -> tuple[int, int]:
    """Return the numbers of states and actions of a world.

    Args:
        world: A grid or a graph.
    """
    check_instance(world, (Grid, Graph), "world")
    return (world.size, len(world.steps)) if isinstance(world, Grid) else (world.states, world.actions)


def graph_of(world: Grid | Graph) -> Graph:
    """Return the graph of a world.

    Args:
        world: A grid or a graph.
    """
    return grid_graph(world) if isinstance(world, Grid) else world


def _table(entry: Mapping[str, Any], field: str, shape: tuple[int, ...], source: str) -> Float[np.ndarray, "..."]:
    """Return a table of finite numbers of a shape, of which any axis may have length 1."""
    with input_errors("expected a table of numbers", TypeError, ValueError, source=source, field=field):
        table = np.asarray(entry[field], dtype=np.float64)
    fits = table.ndim == len(shape) and all(np.isin(table.shape, 1) | (np.array(table.shape) == shape))
    message = f"expected finite numbers of shape {shape}, found shape {table.shape}"
    check(fits and np.isfinite(table).all(), message, source=source, field=field)
    return table
