"""Walks as Minari datasets, in the form of point mazes, and datasets of positions as tables of walks.

Observations are a `Dict` with `achieved_goal`, the positions, and `desired_goal`, the constant goal. Or they are a
`Box`, the positions; the goal is then that in the metadata of the episode (`goal`), or else the last position. The
first two numbers of positions and goals are x and y in metres, and others are left out. The label of a walk is `walk`
in the metadata, by default Minari's number of the episode. `infos` with one number or text for every position become
columns of the same name, with the meaning that they have in `sidestep.io.walks`: `step` (by default 0, 1, …), `t`,
`failed_x`, `failed_y`, or metadata.

Walks are written in this form. An action is the intended displacement from a position, in metres; the reward of the
last action is 1 if it reaches the goal, and all other rewards are 0.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Shaped

from sidestep.errors import check, input_errors
from sidestep.io.minari.datasets import Episode, read_dataset, require_minari, write_dataset
from sidestep.io.tables import check_rows

_OWN = ("walk", "x", "y", "goal_x", "goal_y")
"""Columns that are not from `infos`."""
_FAILED = ("failed_x", "failed_y")


def read_positions(dataset: str) -> pa.Table:
    """Return the walks of a local Minari dataset, by its id or its path, as a table for `sidestep.io.walks`.

    Args:
        dataset: Its id or its path.

    Raises:
        InputError: For a dataset that does not exist, is broken or empty, has no positions in its observations, or has
            two walks with one label, and, naming the episode and the field, for positions and goals that are not finite
            or of another shape, and for goals that change.
    """
    _, episodes = read_dataset(dataset, lambda observation_space, _: _check_space(observation_space, dataset))
    tables = [_table(episode, label) for episode, label in zip(episodes, _labels(episodes, dataset), strict=True)]
    message = "expected infos of the same kind in all episodes"
    with input_errors(message, pa.ArrowException, source=dataset, field="infos"):
        return pa.concat_tables(tables, promote_options="permissive")


def write_positions(dataset: str, table: pa.Table) -> None:
    """Write a table of walks from `table_from_walks` as a local Minari dataset atomically.

    Args:
        dataset: A new id with a version, such as `office/walks-v0`.
        table: One row per position.

    Raises:
        InputError: For an id that is malformed or exists already, a table without rows, and a column that is neither
            numbers nor text, or has empty cells.
    """
    require_minari(dataset)
    check(len(table) > 0, "expected at least one walk, found none", source=dataset)
    from gymnasium.spaces import Box, Dict

    plane = Box(-np.inf, np.inf, (2,), np.float64)
    observation_space = Dict({"observation": plane, "achieved_goal": plane, "desired_goal": plane})
    write_dataset(dataset, (observation_space, plane), list(_episodes(table, dataset)), metadata={})


def _episodes(table: pa.Table, dataset: str) -> Iterator[Episode]:
    """Yield the episode of each walk."""
    infos = {name: _info(table[name], name, dataset) for name in table.column_names if name not in _OWN}
    positions = np.stack([table["x"], table["y"]], axis=1)
    goals = np.stack([table["goal_x"], table["goal_y"]], axis=1)
    failed = np.stack([infos.get(name, np.full(len(table), np.nan)) for name in _FAILED], axis=1)
    targets = np.where(np.isnan(failed), positions, failed)
    labels = table["walk"].to_pylist()
    starts = [row for row in range(1, len(labels)) if labels[row] != labels[row - 1]]
    for rows in np.split(np.arange(len(labels)), starts):
        path, goal = positions[rows], goals[rows[0]]
        arrived = bool((path[-1] == goal).all())
        rewards = np.append(np.zeros(len(rows) - 2), float(arrived))
        observations = {"observation": path, "achieved_goal": path, "desired_goal": goals[rows]}
        metadata = {"walk": labels[rows[0]], "goal": goal.tolist()}
        own = {name: values[rows] for name, values in infos.items()}
        yield Episode(observations, targets[rows[1:]] - path[:-1], rewards, arrived, own, metadata)


def _info(column: pa.ChunkedArray, name: str, dataset: str) -> Shaped[np.ndarray, " rows"]:
    """Return a column as an array for `infos`."""
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    is_number = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
    valid = is_number or pa.types.is_string(kind) or pa.types.is_large_string(kind)
    check(valid, f"expected numbers or text, found {kind}; leave the column out", source=dataset, field=name)
    message = "a Minari dataset has no empty cells; fill it, or leave the column out"
    # these two are empty, then NaN, except where a move failed
    check_rows(column.is_valid().to_numpy() | (name in _FAILED), message, dataset, name)
    return column.to_numpy()


def _check_space(space: Any, dataset: str) -> None:
    """Raise `InputError` for observations without positions."""
    from gymnasium.spaces import Box

    places = _places(getattr(space, "spaces", space))
    message = f"expected achieved_goal among the observations, found {space}"
    check("achieved_goal" in places, message, source=dataset, field="observation_space")
    for name, each in places.items():
        fits = isinstance(each, Box) and len(each.shape) == 1 and each.shape[0] >= 2
        check(fits, f"expected a Box of at least two numbers x, y, found {each}", source=dataset, field=name)


def _places(observations: Any) -> dict[str, Any]:
    """Return the positions in observations, or in their space, and then the goals, if any."""
    if not isinstance(observations, Mapping):
        return {"achieved_goal": observations}
    return {name: observations[name] for name in ("achieved_goal", "desired_goal") if name in observations}


def _labels(episodes: Sequence[Episode], dataset: str) -> list[Any]:
    """Return the label of each walk, or, unless all episodes have one, Minari's numbers of the episodes."""
    # `tolist` makes Python's own numbers and text of NumPy's
    labels = [np.asarray(episode.metadata.get("walk")).tolist() for episode in episodes]
    if None in labels:
        return list(range(len(labels)))
    twice = [label for label, count in Counter(labels).items() if count > 1]
    check(not twice, f"expected different walks, found {twice} more than once", source=dataset, field="walk")
    return labels


def _table(episode: Episode, label: object) -> pa.Table:
    """Return the table of one walk, one row per position."""
    rows = len(episode.rewards) + 1
    seen = _places(episode.observations).items()
    places = {name: _plane(values, rows, episode.source, name) for name, values in seen}
    positions, goals = places["achieved_goal"], places.get("desired_goal")
    columns = {"walk": pa.array([label] * rows), "step": np.arange(rows), "x": positions[:, 0], "y": positions[:, 1]}
    if goals is None and episode.metadata.get("goal") is not None:
        goals = _plane([episode.metadata["goal"]], 1, episode.source, "goal")
    if goals is not None:
        changed = (goals != goals[0]).any(axis=1)
        message = f"expected one goal, found another at step {int(np.argmax(changed))}"
        check(not changed.any(), message, source=episode.source, field="desired_goal")
        columns |= {"goal_x": np.full(rows, goals[0, 0]), "goal_y": np.full(rows, goals[0, 1])}
    return pa.table(columns | _columns(episode.infos, rows))


def _plane(values: Any, rows: int, source: str, field: str) -> Float[np.ndarray, "rows 2"]:
    """Return x and y, the first two numbers of each row."""
    with input_errors("expected numbers", TypeError, ValueError, source=source, field=field):
        array = np.asarray(values, dtype=np.float64)
    message = f"expected x and y in each of {rows} rows, found shape {array.shape}"
    check(array.ndim == 2 and len(array) == rows and array.shape[1] >= 2, message, source=source, field=field)
    step = int(np.argmin(np.isfinite(array[:, :2]).all(axis=1)))
    message = f"expected finite numbers, found {array[step, :2].tolist()} at step {step}"
    check(np.isfinite(array[step, :2]).all(), message, source=source, field=field)
    return array[:, :2]


def _columns(infos: Mapping[str, Any], rows: int) -> dict[str, pa.Array]:
    """Return the infos with one number or text for every position; text is stored as bytes."""
    columns = {}
    for name, values in infos.items():
        fits = name not in _OWN and isinstance(values, np.ndarray) and values.shape == (rows,)
        if fits and values.dtype.kind in "biuf":
            columns[name] = pa.array(values)
        elif fits and all(isinstance(each, str | bytes) for each in values):
            columns[name] = pa.array(values).cast(pa.string())
    return columns
