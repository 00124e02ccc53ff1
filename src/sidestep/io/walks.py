"""Walks: where people were, step by step, in metres, and where they wanted to go.

A table holds one row a position, in columns

- `walk`: any label; rows of one walk may lie between those of others,
- `step`: numbers that increase within a walk,
- `x`, `y`: metres in the map's frame,
- `t` (optional): seconds, never decreasing within a walk,
- `goal_x`, `goal_y` (optional): metres, the same in all rows of a walk; empty means the walk's last
  position,
- `failed_x`, `failed_y` (optional): filled only in rows that mark a failed move: the person tried to step
  to this position, could not, and stayed at `x`, `y`,

and any other column is metadata, carried along. A Minari dataset, `minari:ID`, is such a table too, whose rows
are all its positions (`sidestep.io.minari.walks`). Rows are counted as people count them: the first under the
header is 1.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int, Integer, Real

from sidestep.errors import InputError
from sidestep.io.minari.walks import read_positions, write_positions
from sidestep.io.tables import check_columns, finite_column, number_column, read_table, write_table

_REQUIRED = ("walk", "step", "x", "y")
_OPTIONAL = ("goal_x", "goal_y", "failed_x", "failed_y")
_STORES = {"minari": (read_positions, write_positions)}
"""Where else than in files walks are kept, by what stands before the colon: how they are read and written."""


@dataclass(frozen=True, eq=False)
class Walks:
    """Walks one after another; the rows of walk i are `offsets[i]` to `offsets[i + 1]`.

    - `labels`: the label of each walk, as in the table.
    - `goals`: where each walk wants to go, in metres.
    - `positions`: in metres.
    - `failed_moves`: where a move that failed should have led, in metres; NaN in rows that are ordinary
      positions.
    - `steps`, `rows`: step and data row (from 1) of each position in the table it came from.
    - `metadata`: the other columns, `t` among them, one row a position.
    - `source`: the file, for error messages.
    """

    labels: list[object]
    offsets: Int[np.ndarray, " boundaries"]
    goals: Float[np.ndarray, "walks 2"]
    positions: Float[np.ndarray, "rows 2"]
    failed_moves: Float[np.ndarray, "rows 2"]
    steps: Real[np.ndarray, " rows"]
    rows: Int[np.ndarray, " rows"]
    metadata: pa.Table
    source: str

    def __len__(self) -> int:
        """The number of walks."""
        return len(self.labels)

    def __iter__(self) -> Iterator[Float[np.ndarray, "_ 2"]]:
        """The positions (metres) of each walk in turn."""
        return iter(np.split(self.positions, self.offsets[1:-1]))

    def of_each(self, column: str) -> list[object]:
        """What a column of the metadata says of each walk.

        Raises `InputError` where there is no such column, nothing in it, or not the same in all rows of a walk.
        """
        if column in _REQUIRED + _OPTIONAL:
            raise InputError("expected a column that says something else of walks", source=self.source, field=column)
        check_columns(self.metadata, (column,), self.source)
        said = self.metadata[column].to_pylist()
        for row, first in enumerate(np.repeat(self.offsets[:-1], np.diff(self.offsets)).tolist()):
            if said[row] is None or said[row] != said[first]:
                expected = "expected the same in all rows of a walk and nowhere nothing"
                raise InputError(
                    f"{expected}, found {said[row]!r}", source=self.source, row=int(self.rows[row]), field=column
                )
        return [said[first] for first in self.offsets[:-1].tolist()]

    def select(self, chosen: Bool[np.ndarray, " walks"] | Integer[np.ndarray, " chosen"]) -> "Walks":
        """The walks that a mask or an array of indices chooses, in that order.

        >>> first_ten = walks.select(np.arange(10))  # doctest: +SKIP
        """
        indices = np.flatnonzero(chosen) if chosen.dtype == bool else np.arange(len(self))[chosen]
        lengths = np.diff(self.offsets)[indices]
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        rows = np.arange(offsets[-1]) + np.repeat(self.offsets[indices] - offsets[:-1], lengths)
        return replace(
            self,
            labels=[self.labels[index] for index in indices],
            offsets=offsets,
            goals=self.goals[indices],
            positions=self.positions[rows],
            failed_moves=self.failed_moves[rows],
            steps=self.steps[rows],
            rows=self.rows[rows],
            metadata=self.metadata.take(rows),
        )


def read_walks(path: str | Path) -> Walks:
    """The walks in a `.csv` or `.parquet` file, or in a local Minari dataset, `minari:ID`.

    See the module for the columns, `walks_of_table` and `read_positions` for the errors.

    >>> walks = read_walks("walks.csv")  # doctest: +SKIP
    """
    read, _, name = _kept(path)
    return walks_of_table(read(name), source=str(path))


def write_walks(path: str | Path, walks: Walks) -> None:
    """Write walks as `.csv`, `.parquet` or `minari:ID`, whole or not at all, walk by walk, for `read_walks`."""
    _, write, name = _kept(path)
    write(name, table_of_walks(walks))


def walks_of_table(table: pa.Table, source: str = "walks") -> Walks:
    """The walks in a table in memory, which `source` names in errors.

    Raises `InputError`, naming row and column, for columns that are missing or come without their partner,
    an empty table, cells that are empty, not numbers or not finite, steps unsorted or repeated within a
    walk, times that decrease, goals that change within a walk, half-filled goals and failed moves, and
    walks of one point.

    >>> walks = walks_of_table(pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 1.5], "y": [0.5, 0.5]}))
    >>> len(walks), walks.goals.tolist()
    (1, [[1.5, 0.5]])
    """
    _check_columns(table, source)
    encoded = _labels(table, source)
    walk_of_row = encoded.indices.to_numpy()
    order = np.argsort(walk_of_row, kind="stable")
    walk, rows = walk_of_row[order], order + 1
    offsets = np.searchsorted(walk, np.arange(len(encoded.dictionary) + 1))
    positions = np.stack([finite_column(table, "x", source), finite_column(table, "y", source)], axis=1)[order]
    steps = _steps(table, source)[order]
    _refuse(np.diff(steps) <= 0, walk, rows, source, "step", "expected steps that increase within a walk")
    if "t" in table.column_names:
        times = finite_column(table, "t", source)[order]
        _refuse(np.diff(times) < 0, walk, rows, source, "t", "expected times that never decrease within a walk")
    if (np.diff(offsets) == 1).any():
        index = int(np.argmax(np.diff(offsets) == 1))
        message = f"expected at least two positions, found one in walk {encoded.dictionary[index].as_py()!r}"
        raise InputError(message, source=source, row=int(rows[offsets[index]]), field="walk")
    return Walks(
        labels=encoded.dictionary.to_pylist(),
        offsets=offsets.astype(np.int64),
        goals=_goals(_pair(table, "goal_x", "goal_y", source)[order], positions, walk, offsets, rows, source),
        positions=positions,
        failed_moves=_pair(table, "failed_x", "failed_y", source)[order],
        steps=steps,
        rows=rows,
        metadata=table.drop_columns([name for name in table.column_names if name in _REQUIRED + _OPTIONAL]).take(order),
        source=source,
    )


def table_of_walks(walks: Walks) -> pa.Table:
    """The table of walks, one row a position; `failed_x` and `failed_y` only where a move failed."""
    lengths = np.diff(walks.offsets)
    goals = np.repeat(walks.goals, lengths, axis=0)
    columns = {
        "walk": pa.array(walks.labels).take(np.repeat(np.arange(len(walks)), lengths)),
        "step": walks.steps,
        "x": walks.positions[:, 0],
        "y": walks.positions[:, 1],
        "goal_x": goals[:, 0],
        "goal_y": goals[:, 1],
    }
    if not np.isnan(walks.failed_moves).all():
        for name, values in zip(("failed_x", "failed_y"), walks.failed_moves.T, strict=True):
            columns[name] = pa.array(values, from_pandas=True)
    return pa.table(columns | {name: walks.metadata[name] for name in walks.metadata.column_names})


def _kept(path: str | Path) -> tuple[Callable[[Any], pa.Table], Callable[[Any, pa.Table], None], str | Path]:
    """How walks are read and written there, and under which name."""
    store, _, name = PurePath(path).as_posix().partition(":")
    return (*_STORES[store], name) if store in _STORES else (partial(read_table, labels=("walk",)), write_table, path)


def _check_columns(table: pa.Table, source: str) -> None:
    """Refuse tables without rows or without a column they need."""
    check_columns(table, _REQUIRED, source)
    names = table.column_names
    for first, second in (("goal_x", "goal_y"), ("failed_x", "failed_y")):
        if (first in names) != (second in names):
            absent = second if first in names else first
            raise InputError(f"expected {first} and {second}, or neither", source=source, field=absent)
    if len(table) == 0:
        raise InputError("expected at least one walk, found a table without rows", source=source)


def _labels(table: pa.Table, source: str) -> pa.DictionaryArray:
    """The label of each row's walk, numbered in order of first appearance."""
    column = table["walk"].combine_chunks()
    if isinstance(column, pa.DictionaryArray):  # It may list labels in another order, or labels that no row has.
        column = column.dictionary_decode()
    missing = column.is_null(nan_is_null=True).to_numpy(zero_copy_only=False)
    if missing.any():
        raise InputError("expected the label of a walk", source=source, row=int(np.argmax(missing)) + 1, field="walk")
    return column.dictionary_encode()


def _steps(table: pa.Table, source: str) -> Real[np.ndarray, " rows"]:
    """The steps, whole numbers where all are (nanoseconds would not fit a float), else as they are."""
    numbers = finite_column(table, "step", source)
    try:
        return table["step"].cast(pa.int64()).to_numpy()
    except pa.ArrowInvalid:
        return numbers


def _pair(table: pa.Table, first: str, second: str, source: str) -> Float[np.ndarray, "rows 2"]:
    """Two optional columns of numbers, both filled or both empty (NaN) in each row."""
    if first not in table.column_names:
        return np.full((len(table), 2), np.nan)
    pair = np.stack([number_column(table, first, source), number_column(table, second, source)], axis=1)
    empty = np.isnan(pair)
    half = empty[:, 0] != empty[:, 1]
    if half.any():
        index = int(np.argmax(half))
        field = first if empty[index, 0] else second
        message = f"expected {first} and {second}, or neither, in a row"
        raise InputError(message, source=source, row=index + 1, field=field)
    return pair


def _goals(
    given: Float[np.ndarray, "rows 2"],
    positions: Float[np.ndarray, "rows 2"],
    walk: Int[np.ndarray, " rows"],
    offsets: Int[np.ndarray, " boundaries"],
    rows: Int[np.ndarray, " rows"],
    source: str,
) -> Float[np.ndarray, "walks 2"]:
    """The goal of each walk: the one its rows give, or where it ends."""
    for axis, field in enumerate(("goal_x", "goal_y")):
        column = given[:, axis]
        same = (column[1:] == column[:-1]) | (np.isnan(column[1:]) & np.isnan(column[:-1]))
        _refuse(~same, walk, rows, source, field, "expected the same goal in all rows of a walk")
    goals = given[offsets[:-1]]
    return np.where(np.isnan(goals), positions[offsets[1:] - 1], goals)


def _refuse(
    bad: Bool[np.ndarray, " pairs"],
    walk: Int[np.ndarray, " rows"],
    rows: Int[np.ndarray, " rows"],
    source: str,
    field: str,
    message: str,
) -> None:
    """Refuse the earliest data row that stands in a bad relation to the row before it in its walk."""
    later = np.flatnonzero(bad & (walk[1:] == walk[:-1])) + 1
    if later.size:
        index = later[np.argmin(rows[later])]
        message = f"{message}, but this row does not follow row {rows[index - 1]} so"
        raise InputError(message, source=source, row=int(rows[index]), field=field)
