"""Walks: the positions of agents, step by step, in metres, and their goals.

A table has one row per position, in columns

- `walk`: any label; rows of one walk may be between those of others,
- `step`: numbers that increase within a walk,
- `x`, `y`: metres in the map's frame,
- `t` (optional): seconds, never decreasing within a walk,
- `goal_x`, `goal_y` (optional): metres, the same in all rows of a walk; empty means the last position of the walk,
- `failed_x`, `failed_y` (optional): not empty only in rows that mark a failed move: the agent tried to step to this
  position, could not, and stayed at `x`, `y`,

and any other column is metadata. A Minari dataset, `minari:ID`, is such a table too, with one row per position
(`sidestep.io.minari.walks`). Rows are counted from 1, the first row below the header.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int, Integer, Real

from sidestep._arguments import to_floats, to_indices, to_integers
from sidestep._repr import short_repr
from sidestep.errors import check, check_instance, describe, to_list, to_path
from sidestep.io.minari.walks import read_positions, write_positions
from sidestep.io.tables import check_columns, check_rows, finite_column, number_column, read_table, write_table

_REQUIRED = ("walk", "step", "x", "y")
_OPTIONAL = ("goal_x", "goal_y", "failed_x", "failed_y")
_STORES = {"minari": (read_positions, write_positions)}
"""Stores other than files, by the prefix of their names: the functions that read and write them."""


@short_repr()
@dataclass(frozen=True, eq=False)
class Walks:
    """Walks, one after another; the rows of walk i are `offsets[i]` to `offsets[i + 1]`.

    Attributes:
        labels: The label of each walk, as in the table.
        offsets: The first row of each walk, and the number of rows.
        goals: X and y (metres) of the goal of each walk.
        positions: X and y (metres) in each row.
        failed_moves: X and y (metres) of the target of a failed move; NaN in all other rows.
        steps: The step of each row.
        rows: The data row (from 1) of each row in the table that it came from.
        metadata: The other columns, `t` among them, one row per position.
        source: The name of the file, for error messages.

    Example:
        >>> import pyarrow as pa
        >>> walks = walks_from_table(pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 1.5], "y": [0.5, 0.5]}))
        >>> [positions.tolist() for positions in walks]
        [[[0.5, 0.5], [1.5, 0.5]]]
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

    def __post_init__(self) -> None:
        labels, rows = len(to_list(self.labels, object, "labels", least=0)), len(self.rows)
        for name, shape in (("goals", (labels, 2)), ("positions", (rows, 2)), ("failed_moves", (rows, 2))):
            to_floats(getattr(self, name), name, shape)
        to_floats(self.steps, "steps", (rows,))
        to_integers(self.rows, "rows", ("rows",))
        to_integers(self.offsets, "offsets", (labels + 1,), least=0, most=rows)
        check_instance(self.metadata, pa.Table, "metadata")

    def __len__(self) -> int:
        """Return the number of walks."""
        return len(self.labels)

    def __iter__(self) -> Iterator[Float[np.ndarray, "_ 2"]]:
        """Iterate over the positions (metres) of each walk."""
        return iter(np.split(self.positions, self.offsets[1:-1]))

    def per_walk(self, column: str) -> list[object]:
        """Return the value of a metadata column for each walk.

        Args:
            column: The name of a column of metadata.

        Raises:
            InputError: If the column does not exist, has an empty cell, or has two values within a walk.
        """
        check(isinstance(column, str), f"expected the name of a column, found {describe(column)}", field="column")
        message = f"expected a column of metadata, found {column}"
        check(column not in _REQUIRED + _OPTIONAL, message, source=self.source, field=column)
        check_columns(self.metadata, (column,), self.source)
        values, first = self.metadata[column].to_pylist(), np.repeat(self.offsets[:-1], np.diff(self.offsets))
        valid = np.array([own is not None and own == values[index] for own, index in zip(values, first, strict=True)])
        message = "expected one value in all rows of a walk, found {!r}"
        check_rows(valid, message, self.source, column, self.rows, values)
        return [values[index] for index in self.offsets[:-1]]

    def select(self, index: Bool[np.ndarray, " walks"] | Integer[np.ndarray, " selected"] | Sequence[int]) -> "Walks":
        """Return the walks that a mask or an array of indices selects, in that order.

        Args:
            index: A mask over all walks, or indices of walks; negative ones count from the end.

        Raises:
            InputError: For a mask of another length, and indices of walks that do not exist.

        Example:
            >>> first_ten = walks.select(np.arange(10))  # doctest: +SKIP
        """
        indices = to_indices(index, len(self), "index", "walks")
        lengths = np.diff(self.offsets)[indices]
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        rows = np.arange(offsets[-1]) + np.repeat(self.offsets[indices] - offsets[:-1], lengths)
        by_row = {name: getattr(self, name)[rows] for name in ("positions", "failed_moves", "steps", "rows")}
        labels, goals = [self.labels[index] for index in indices], self.goals[indices]
        return replace(self, labels=labels, offsets=offsets, goals=goals, metadata=self.metadata.take(rows), **by_row)


def read_walks(path: str | Path) -> Walks:
    """Return the walks in a `.csv` or `.parquet` file, or in a local Minari dataset, `minari:ID`.

    The module describes the columns.

    Args:
        path: The file, or `minari:ID`.

    Raises:
        InputError: As `read_table` or `read_positions` do, and as `walks_from_table` does.

    Example:
        >>> walks = read_walks("walks.csv")  # doctest: +SKIP
    """
    read, _, name = _store(path)
    return walks_from_table(read(name), source=str(path))


def write_walks(path: str | Path, walks: Walks) -> None:
    """Write walks as `.csv`, `.parquet` or `minari:ID` atomically, walk by walk, for `read_walks`.

    Args:
        path: The file, or `minari:ID` with a new id.
        walks: The walks.

    Raises:
        InputError: As `write_table` or `write_positions` do.

    Example:
        >>> write_walks("walks.csv", walks)  # doctest: +SKIP
    """
    check_instance(walks, Walks, "walks")
    _, write, name = _store(path)
    write(name, table_from_walks(walks))


def walks_from_table(table: pa.Table | pa.RecordBatch, source: str = "walks") -> Walks:
    """Return the walks in a table in memory.

    Args:
        table: One row per position, in the columns of this module.
        source: The name of the table in errors.

    Raises:
        InputError: Naming row and column, for columns that are missing or lack their partner, an empty table, cells
            that are empty, not numbers or not finite, steps unsorted or repeated within a walk, times that decrease,
            goals that change within a walk, half-filled goals and failed moves, and walks of one point.

    Example:
        >>> import pyarrow as pa
        >>> walks = walks_from_table(pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 1.5], "y": [0.5, 0.5]}))
        >>> len(walks), walks.goals.tolist()
        (1, [[1.5, 0.5]])
    """
    check_instance(table, (pa.Table, pa.RecordBatch), "table")
    table = pa.Table.from_batches([table]) if isinstance(table, pa.RecordBatch) else table
    check_columns(table, _REQUIRED, source)
    check(len(table) > 0, "expected at least one walk, found a table without rows", source=source)
    encoded = _labels(table, source)
    row_walks = encoded.indices.to_numpy()
    order = np.argsort(row_walks, kind="stable")
    walk, rows = row_walks[order], order + 1
    offsets = np.searchsorted(walk, np.arange(len(encoded.dictionary) + 1))

    def check_pairs(valid: Bool[np.ndarray, " pairs"], field: str, message: str) -> None:
        """Raise `InputError` for the earliest data row that is not valid after the row before it in its walk."""
        message += ", but this row does not follow row {} so"
        check_rows(valid | (walk[1:] != walk[:-1]), message, source, field, rows[1:], rows[:-1])

    positions = np.stack([finite_column(table, name, source) for name in ("x", "y")], axis=1)[order]
    steps = _steps(table, source)[order]
    check_pairs(np.diff(steps) > 0, "step", "expected steps that increase within a walk")
    if "t" in table.column_names:
        times = finite_column(table, "t", source)[order]
        check_pairs(np.diff(times) >= 0, "t", "expected times that never decrease within a walk")
    labels = encoded.dictionary.to_pylist()
    message = "expected at least two positions, found one in walk {!r}"
    check_rows(np.diff(offsets) != 1, message, source, "walk", rows[offsets[:-1]], labels)
    goals = _pair(table, "goal", source)[order]
    for field, column in zip(("goal_x", "goal_y"), goals.T, strict=True):
        same = (column[1:] == column[:-1]) | (np.isnan(column[1:]) & np.isnan(column[:-1]))
        check_pairs(same, field, "expected the same goal in all rows of a walk")
    goals = goals[offsets[:-1]]
    goals = np.where(np.isnan(goals), positions[offsets[1:] - 1], goals)
    failed_moves = _pair(table, "failed", source)[order]
    metadata = table.drop_columns([name for name in table.column_names if name in _REQUIRED + _OPTIONAL]).take(order)
    return Walks(labels, offsets.astype(np.int64), goals, positions, failed_moves, steps, rows, metadata, source)


def table_from_walks(walks: Walks) -> pa.Table:
    """Return the table of walks, one row per position; with `failed_x` and `failed_y` only if a move failed.

    Args:
        walks: The walks.
    """
    walk = np.repeat(np.arange(len(walks)), np.diff(walks.offsets))
    columns = {"walk": pa.array(walks.labels).take(walk), "step": walks.steps}
    columns |= position_columns("", walks.positions) | position_columns("goal_", walks.goals[walk])
    if not np.isnan(walks.failed_moves).all():
        columns |= position_columns("failed_", walks.failed_moves)
    return pa.table(columns | {name: walks.metadata[name] for name in walks.metadata.column_names})


def position_columns(prefix: str, positions: Float[np.ndarray, "rows 2"]) -> dict[str, pa.Array]:
    """Return x and y of positions as columns of a table; a cell is empty where a position is NaN.

    Args:
        prefix: What the names of the columns have before x and y.
        positions: x and y (metres) in each row.
    """
    columns = zip("xy", positions.T, strict=True)
    return {f"{prefix}{axis}": pa.array(values, from_pandas=True) for axis, values in columns}


def _store(path: str | Path) -> tuple[Callable[[Any], pa.Table], Callable[[Any, pa.Table], None], str | Path]:
    """Return the functions that read and write walks in a place, and the name of the place for them."""
    store, _, name = to_path(path).as_posix().partition(":")
    return (*_STORES[store], name) if store in _STORES else (partial(read_table, labels=("walk",)), write_table, path)


def _labels(table: pa.Table, source: str) -> pa.DictionaryArray:
    """Return the label of the walk of each row, numbered in order of first appearance."""
    column = table["walk"].combine_chunks()
    if isinstance(column, pa.DictionaryArray):  # It may list labels in another order, or labels that no row has.
        column = column.dictionary_decode()
    missing = column.is_null(nan_is_null=True).to_numpy(zero_copy_only=False)
    check_rows(~missing, "expected the label of a walk", source, "walk")
    return column.dictionary_encode()


def _steps(table: pa.Table, source: str) -> Real[np.ndarray, " rows"]:
    """Return the steps as whole numbers where all are (nanoseconds do not fit a float), else as floats."""
    numbers = finite_column(table, "step", source)
    try:
        return table["step"].cast(pa.int64()).to_numpy()
    except pa.ArrowInvalid:
        return numbers


def _pair(table: pa.Table, name: str, source: str) -> Float[np.ndarray, "rows 2"]:
    """Return x and y of optional positions; in each row both are empty (NaN) or neither is."""
    first, second = f"{name}_x", f"{name}_y"
    if not {first, second} & set(table.column_names):
        return np.full((len(table), 2), np.nan)
    check_columns(table, (first, second), source)
    pair = np.stack([number_column(table, first, source), number_column(table, second, source)], axis=1)
    empty = np.isnan(pair)
    complete = empty[:, 0] == empty[:, 1]
    field = first if empty[np.argmin(complete), 0] else second
    check_rows(complete, f"expected {first} and {second}, or neither, in a row", source, field)
    return pair
