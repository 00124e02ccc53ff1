"""Demonstrations as tables: one row for each move, in any library that has the Arrow PyCapsule interface.

pandas, polars, pyarrow, DuckDB and others hand their tables over by `__arrow_c_stream__`, so none of them is needed. A
table has a row for each move: its walk, state and action. The next state is that of the row below, unless there is a
column for it. The last row of a walk without such a column has no action: it holds the final state.
"""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int, Shaped

from sidestep.errors import InputError, check, check_instance, describe, input_errors, to_list
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.demonstrations import Demonstrations, flat_moves
from sidestep.tabular.tasks import Task, stack_tasks

_NONE = -1
"""The number of an empty cell."""
_ANEW = "give `walk` several columns where the walks of each person are numbered anew"
"""What may be wrong where rows of several walks seem to be of one."""


class Labels(NamedTuple):
    """Names of what arrays number: the first label is that of number 0.

    Attributes:
        states, actions, tasks, persons: Texts or whole numbers, each once; empty where numbers have no names.

    Example:
        >>> Labels(states=("home", "road", "work")).states[2]
        'work'
    """

    states: Sequence[Hashable] = ()
    actions: Sequence[Hashable] = ()
    tasks: Sequence[Hashable] = ()
    persons: Sequence[Hashable] = ()


class Columns(NamedTuple):
    """The names of a table's columns; None for those that it does not have.

    Attributes:
        state, action, next_state, step, task, subject, weight, truncated: As the arguments of
            `Demonstrations.from_table`.
        walk: The columns that tell walks apart; empty for a single walk.
    """

    state: str = "state"
    action: str = "action"
    next_state: str | None = None
    walk: tuple[str, ...] = ()
    step: str | None = None
    task: str | None = None
    subject: str | None = None
    weight: str | None = None
    truncated: str | None = None


def read_moves(table: Any, tasks: Task | Sequence[Task], columns: Columns, labels: Labels) -> Demonstrations[Task]:
    """Return the demonstrations in a table; `Demonstrations.from_table` describes the arguments and the errors.

    Args:
        table: The table.
        tasks: The tasks.
        columns: The names of its columns.
        labels: The names of states, actions, tasks and persons.
    """
    labels = _checked(labels)
    rows = _Rows(_as_arrow(table), columns)
    stacked = _stacked(tasks)
    states = stacked.terminal.shape[-1]
    walk = _walks(rows)
    person = rows.numbers("subject", labels.persons) if columns.subject else None
    if person is not None:
        _check_persons(rows, walk, person)
    order = _order(rows, walk)
    state = rows.numbers("state", labels.states, states)
    action = rows.numbers("action", labels.actions, empty=True)
    task = rows.numbers("task", labels.tasks, len(stacked.terminal)) if columns.task else np.zeros(len(rows), np.int64)
    check(columns.task or len(stacked.terminal) == 1, "several tasks: expected a column with the task", field="task")
    weight = rows.weights() if columns.weight else np.ones(len(rows))
    truncated = rows.booleans("truncated") if columns.truncated else np.zeros(len(rows), bool)
    after = rows.numbers("next_state", labels.states, states, empty=True) if columns.next_state else None
    number = rows.number[order]
    walk, state, action, task = (each[order] for each in (walk, state, action, task))
    weight, truncated = weight[order], truncated[order]
    after = np.full(len(state), _NONE) if after is None else after[order]
    last = np.append(walk[1:] != walk[:-1], True)
    if columns.step:
        _check_steps(rows, order, last | (after != _NONE))
    next_state = _next_states(rows, number, last, state, action, after)
    moves = action != _NONE
    _check_walks(rows, number, walk, task, "task")
    _check_walks(rows, number, walk, truncated.astype(np.int64), "truncated")
    ended = moves & np.asarray(stacked.terminal)[task, state]
    rows.check(~ended, number, "the walk goes on after a terminal state of its task", "state")
    return Demonstrations(
        *(flat_moves([each[moves]]) for each in (state, action, next_state, task, walk)),
        tasks=stacked,
        weights=to_jax(weight[moves]),
        person=None if person is None else flat_moves([person[order][moves]]),
        truncated=to_jax(truncated[moves]),
    )


def write_moves(demonstrations: Demonstrations[Task], labels: Labels) -> pa.Table:
    """Return demonstrations as a table; `Demonstrations.to_table` describes it.

    Args:
        demonstrations: The moves.
        labels: The names of states, actions, tasks and persons.
    """
    labels, walk = _checked(labels), np.asarray(demonstrations.trajectory)
    step = np.arange(len(walk)) - demonstrations.first_moves()[walk]
    names = labels.states, labels.actions, labels.states, labels.tasks
    fields = "state", "action", "next_state", "task"
    arrays = (demonstrations.states, demonstrations.actions, demonstrations.next_states, demonstrations.task)
    columns: dict[str, Any] = {"walk": walk, "step": step}
    for field, array, labeled in zip(fields, arrays, names, strict=True):
        columns[field] = _labeled(np.asarray(array), labeled, field)
    if demonstrations.person is not None:
        columns["subject"] = _labeled(np.asarray(demonstrations.person), labels.persons, "subject")
    columns["weight"] = np.asarray(demonstrations.weights)
    columns["truncated"] = np.asarray(demonstrations.truncated)
    with input_errors("expected names of one type", pa.ArrowException, source="labels"):
        return pa.table({name: pa.array(values) for name, values in columns.items()})


class _Rows:
    """The rows of a table, with errors that name row and column."""

    def __init__(self, table: pa.Table, columns: Columns):
        self.table, self.columns = table, columns
        self.number = np.arange(1, len(table) + 1)
        names = [*columns.walk, *(name for name in columns if isinstance(name, str))]
        for name in names:
            expected = f"expected one of {', '.join(table.column_names)}"
            count = table.column_names.count(name)
            check(count == 1, f"the table has {count} such columns: {expected}", source="table", field=name)
        check(len(table), "expected at least one row", source="table")

    def __len__(self) -> int:
        return len(self.table)

    def check(
        self, valid: Bool[np.ndarray, " rows"], number: Int[np.ndarray, " rows"], message: str, kind: str
    ) -> None:
        """Raise `InputError` for the first row of the table that is not valid; `kind` is a field of `Columns`."""
        if not valid.all():
            raise InputError(message, source="table", row=int(number[~valid].min()), field=self.name(kind))

    def name(self, kind: str) -> str:
        return ", ".join(self.columns.walk) if kind == "walk" else getattr(self.columns, kind) or kind

    def column(self, kind: str) -> pa.Array:
        """Return the column of a kind, as `read` does."""
        return self.read(self.name(kind))

    def read(self, name: str) -> pa.Array:
        """Return a column in one piece, with NaN as an empty cell, and categories as what they stand for."""
        column = self.table[name].combine_chunks()
        if pa.types.is_dictionary(column.type) or pa.types.is_string_view(column.type):
            column = pa.array(column.to_pylist())  # Arrow has few functions for texts of polars
        if pa.types.is_floating(column.type):
            column = pa.array(column.to_numpy(zero_copy_only=False), from_pandas=True)
        return column

    def numbers(
        self, kind: str, labels: Sequence[Hashable], count: int | None = None, empty: bool = False
    ) -> Int[np.ndarray, " rows"]:
        """Return a column of whole numbers, or of labels as their numbers; −1 where a cell is empty, if it may be."""
        column = self.column(kind)
        missing = np.asarray(column.is_null())
        if not empty:
            self.check(~missing, self.number, "expected a value, found an empty cell", kind)
        numbers = self._places(column, labels, kind) if len(labels) else self._whole(column, kind)
        span = "0 and above" if count is None else f"0…{count - 1}"
        for row in np.flatnonzero(~missing & ((numbers < 0) | (numbers >= (np.inf if count is None else count))))[:1]:
            expected, name = f"a whole number in {span}", ""
            if len(labels):
                expected, name = f"a label of one of {span}", f"{describe(labels[int(numbers[row])])}, label "
            message = f"expected {expected}, found {name}{numbers[row]}"
            raise InputError(message, source="table", row=int(row) + 1, field=self.name(kind))
        return np.where(missing, _NONE, numbers)

    def _places(self, column: pa.Array, labels: Sequence[Hashable], kind: str) -> Int[np.ndarray, " rows"]:
        """Return the place of each cell among labels."""
        nested = pa.types.is_nested(column.type)
        message = f"expected texts or whole numbers, found {column.type}"
        check(not nested, message, source="table", field=self.name(kind))
        known = {label: place for place, label in enumerate(labels)}
        check(len(known) == len(labels), "expected labels that appear once", source="labels", field=kind)
        places = {None: _NONE, **known}
        for row, cell in enumerate(column.to_pylist(), start=1):
            if cell not in places:
                message = f"expected one of the labels {_some(labels)}, found {cell!r}"
                raise InputError(message, source="table", row=row, field=self.name(kind))
        return np.array([places[cell] for cell in column.to_pylist()], np.int64)

    def _whole(self, column: pa.Array, kind: str) -> Int[np.ndarray, " rows"]:
        """Return a column of whole numbers, 0 where a cell is empty."""
        of_type = pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_null(column.type)
        message = f"expected whole numbers (or labels=Labels(…) that name them), found {column.type}"
        check(of_type, message, source="table", field=self.name(kind))
        filled = np.asarray(pc.fill_null(column, 0) if not pa.types.is_null(column.type) else np.zeros(len(self)))
        whole = _is_whole(filled) & (np.abs(filled) < 2.0**31)
        for row in np.flatnonzero(~whole)[:1]:
            message = f"expected a whole number, found {filled[row]}"
            raise InputError(message, source="table", row=int(row) + 1, field=self.name(kind))
        return filled.astype(np.int64)

    def booleans(self, kind: str) -> Bool[np.ndarray, " rows"]:
        """Return a column of booleans."""
        column = self.column(kind)
        of_type = pa.types.is_boolean(column.type)
        check(of_type, f"expected booleans, found {column.type}", source="table", field=self.name(kind))
        self.check(~np.asarray(column.is_null()), self.number, "expected a value, found an empty cell", kind)
        return column.to_numpy(zero_copy_only=False).astype(bool)

    def weights(self) -> Float[np.ndarray, " rows"]:
        """Return the weights of moves, 0 where a cell is empty and there is no action."""
        with input_errors("expected numbers", pa.ArrowException, source="table", field=self.name("weight")):
            weights = np.asarray(self.column("weight").cast(pa.float64()).fill_null(np.nan))
        unused = np.isnan(weights) & np.asarray(self.column("action").is_null())
        weights = np.where(unused, 0.0, weights)
        valid = np.isfinite(weights) & (weights >= 0)
        self.check(valid, self.number, "expected a finite number, at least 0", "weight")
        return weights


def _as_arrow(table: Any) -> pa.Table:
    """Return any table as Arrow's."""
    if not hasattr(table, "__arrow_c_stream__") and hasattr(table, "__dataframe__"):
        from pyarrow.interchange import from_dataframe

        return from_dataframe(table)
    message = "expected a table of pandas, polars, pyarrow or another library with Arrow's PyCapsule interface"
    with input_errors(message, Exception, source="table"):  # other libraries raise errors of many kinds
        return pa.table(table)


def _checked(labels: Labels) -> Labels:
    """Return labels as lists; raise `InputError` for other classes, and for a label that no cell can hold."""
    check_instance(labels, Labels, "labels")
    fields = {name: to_list(own, object, f"labels.{name}", 0) for name, own in labels._asdict().items()}
    for name, own in fields.items():
        for place, label in enumerate(own):
            message = f"expected a text or a whole number, found {describe(label)}"
            single = isinstance(label, Hashable) and not isinstance(label, tuple)
            check(single, message, field=f"labels.{name}[{place}]")
    return Labels(**fields)


def _is_whole(numbers: Shaped[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    return np.isfinite(numbers) & (numbers == np.round(numbers))


def _stacked(tasks: Task | Sequence[Task]) -> Task:
    if isinstance(tasks, Task):
        return tasks if tasks.terminal.ndim == 2 else stack_tasks([tasks])
    return stack_tasks(tasks)


def _walks(rows: _Rows) -> Int[np.ndarray, " rows"]:
    """Return the walk of each row, numbered as they appear."""
    walk = np.zeros(len(rows), np.int64)
    for name in rows.columns.walk:
        column = rows.read(name)
        rows.check(~np.asarray(column.is_null()), rows.number, "expected a value, found an empty cell", "walk")
        own = np.asarray(column.dictionary_encode().indices).astype(np.int64)
        _, first, both = np.unique(np.stack([walk, own]), axis=1, return_index=True, return_inverse=True)
        walk = np.argsort(np.argsort(first))[both.ravel()]
    return walk


def _check_persons(rows: _Rows, walk: Int[np.ndarray, " rows"], person: Int[np.ndarray, " rows"]) -> None:
    """Raise `InputError` unless each walk has one person, with the columns by which walks of several are told apart."""
    first = np.unique(walk, return_index=True)[1]
    columns = [rows.name("subject"), *rows.columns.walk]
    message = f"the walk has rows of several persons: expected walk={columns} where each person's walks begin anew"
    rows.check(person == person[first][walk], rows.number, message, "subject")


def _order(rows: _Rows, walk: Int[np.ndarray, " rows"]) -> Int[np.ndarray, " rows"]:
    """Return the rows walk by walk, in the order of steps."""
    if not rows.columns.step:
        return np.argsort(walk, kind="stable")
    column = rows.column("step")
    kinds = ("integer", "floating", "temporal", "decimal")
    ordered = any(getattr(pa.types, f"is_{kind}")(column.type) for kind in kinds)
    check(ordered, f"expected numbers or times, found {column.type}", source="table", field=rows.name("step"))
    rows.check(~np.asarray(column.is_null()), rows.number, "expected a value, found an empty cell", "step")
    rank = np.unique(column.to_numpy(zero_copy_only=False), return_inverse=True)[1]
    order = np.lexsort((rank, walk))
    repeated = (np.diff(walk[order], prepend=-1) == 0) & (np.diff(rank[order], prepend=-1) == 0)
    rows.check(~repeated, rows.number[order], f"the walk has another row with the same step ({_ANEW})", "step")
    return order


def _check_steps(rows: _Rows, order: Int[np.ndarray, " rows"], known: Bool[np.ndarray, " rows"]) -> None:
    """Raise `InputError` where steps are whole numbers, one is left out and the next state is not known without it.

    Whole numbers may be stored as floats or decimals, as pandas does beside an empty cell; times are no numbers.
    """
    column = rows.column("step")
    step = np.asarray(column)[order]
    if not pa.types.is_temporal(column.type) and _is_whole(step.astype(np.float64)).all():
        follows = np.append(step[1:] == step[:-1] + 1, True)
        message = "expected the next step in the walk's next row, found a gap (give `next_state`)"
        rows.check(known | follows, rows.number[order], message, "step")


def _next_states(
    rows: _Rows,
    number: Int[np.ndarray, " rows"],
    last: Bool[np.ndarray, " rows"],
    state: Int[np.ndarray, " rows"],
    action: Int[np.ndarray, " rows"],
    after: Int[np.ndarray, " rows"],
) -> Int[np.ndarray, " rows"]:
    """Return the state after each move; −1 in rows with a final state."""
    final = action == _NONE
    below = np.append(state[1:], _NONE)
    message = f"expected an action: only the last row of a walk may be without one ({_ANEW})"
    rows.check(last | ~final, number, message, "action")
    first = np.append(True, last[:-1])
    rows.check(~(first & final), number, "expected at least one move in a walk, found a final state only", "action")
    rows.check(~(final & (after != _NONE)), number, "a row with a next state needs an action", "action")
    message = "the last row of a walk needs a next state, or no action where it holds the final state"
    rows.check(~last | final | (after != _NONE), number, message, "next_state" if rows.columns.next_state else "action")
    differs = ~last & (after != _NONE) & (after != below)
    message = "expected the state of the walk's next row"
    rows.check(~differs, number, message, "next_state")
    return np.where(last, after, below)


def _check_walks(
    rows: _Rows,
    number: Int[np.ndarray, " rows"],
    walk: Int[np.ndarray, " rows"],
    values: Int[np.ndarray, " rows"],
    kind: str,
) -> None:
    """Raise `InputError` unless a value is the same in all rows of a walk."""
    changes = (np.diff(walk, prepend=-1) == 0) & (np.diff(values, prepend=_NONE) != 0)
    rows.check(~changes, number, "expected the same value in all rows of a walk", kind)


def _labeled(numbers: Int[np.ndarray, " moves"], labels: Sequence[Hashable], field: str) -> Shaped[np.ndarray, "_"]:
    """Return the labels of numbers, or the numbers where there are no labels."""
    if not len(labels):
        return numbers
    check(numbers.max() < len(labels), f"expected {numbers.max() + 1} labels, found {len(labels)}", field=field)
    named = np.empty(len(labels), object)
    named[:] = labels
    return named[numbers]


def _some(labels: Sequence[Hashable]) -> str:
    shown = ", ".join(map(repr, labels[:5]))
    return shown if len(labels) <= 5 else f"{shown}, …"
