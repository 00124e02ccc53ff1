"""Tables in files: CSV and Parquet as `pyarrow.Table`, with errors that name the row."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet
from jaxtyping import Float

from sidestep._files import read_whole, write_whole
from sidestep.errors import InputError

_WHOLE_NUMBER = r"^-?(0|[1-9][0-9]{0,17})$"
_NUMBER = r"^-?(0|[1-9][0-9]{0,14})(\.[0-9]+)?([eE][+-]?[0-9]{1,3})?$"


def read_table(path: str | Path, labels: tuple[str, ...] = ()) -> pa.Table:
    """A table from a `.csv` or `.parquet` file.

    Columns of a CSV become numbers only where that loses nothing: a column with a `003` in it stays text,
    and so do columns named in `labels` unless all their cells are whole numbers. Empty cells are null.
    Raises `InputError` for another ending, a file that cannot be read or is empty, text that is not UTF-8,
    a row of another length than the header (with its row), and for column names that repeat.
    """
    read = _by_ending(path, {".csv": _read_csv, ".parquet": _read_parquet})
    table = read(Path(path))
    for name in table.column_names:
        if table.column_names.count(name) > 1:
            raise InputError("the column appears more than once", source=path, field=name)
    if Path(path).suffix.lower() != ".csv":
        return table
    columns = {name: _typed(table[name], fractions=name not in labels) for name in table.column_names}
    return pa.table(columns)


def write_table(path: str | Path, table: pa.Table) -> None:
    """Write a table as `.csv` or `.parquet`, whole or not at all.

    Raises `InputError` for another ending, and for a column that CSV cannot hold.
    """
    write = _by_ending(path, {".csv": pyarrow.csv.write_csv, ".parquet": pyarrow.parquet.write_table})
    try:
        write_whole(path, lambda file: write(table, file))
    except pa.ArrowException as error:
        raise InputError(f"the table cannot be written: {error}", source=path) from error


def check_columns(table: pa.Table, names: Sequence[str], source: str) -> None:
    """Raises `InputError` for the first of these columns that a table does not have."""
    for name in names:
        if name not in table.column_names:
            raise InputError(f"the column is missing; found {', '.join(table.column_names)}", source=source, field=name)


def number_column(table: pa.Table, name: str, source: str) -> Float[np.ndarray, " rows"]:
    """A column as numbers, NaN where a cell is empty; `InputError`, with the row, for infinity and no number."""
    column = table[name]
    kinds = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_string)
    if not any(is_kind(column.type) for is_kind in (*kinds, pa.types.is_large_string, pa.types.is_null)):
        raise InputError(f"expected numbers, found {column.type}", source=source, field=name)
    try:
        # Not safe, because whole numbers beyond 2^53 may lose their last digits here.
        numbers = column.cast(pa.float64(), safe=False).to_numpy()
    except pa.ArrowInvalid:
        row, cell = next((row, cell) for row, cell in enumerate(column, start=1) if not _is_number(cell))
        raise InputError(f"expected a number, found {cell.as_py()!r}", source=source, row=row, field=name) from None
    infinite = np.isinf(numbers)
    if infinite.any():
        row = int(np.argmax(infinite)) + 1
        raise InputError("expected a finite number, found infinity", source=source, row=row, field=name)
    return numbers


def _is_number(cell: pa.Scalar) -> bool:
    """Whether a cell can be read as a number."""
    try:
        cell.cast(pa.float64())
    except pa.ArrowInvalid:
        return False
    return True


def finite_column(table: pa.Table, name: str, source: str) -> Float[np.ndarray, " rows"]:
    """A column of numbers that may not be empty anywhere; `InputError` as for `number_column`."""
    numbers = number_column(table, name, source)
    missing = np.isnan(numbers)
    if missing.any():
        row = int(np.argmax(missing)) + 1
        found = "an empty cell" if not table[name][row - 1].is_valid else "NaN"
        raise InputError(f"expected a finite number, found {found}", source=source, row=row, field=name)
    return numbers


def _by_ending(path: str | Path, choices: dict[str, Callable]) -> Callable:
    """The function for the ending of `path`."""
    ending = Path(path).suffix.lower()
    if ending not in choices:
        raise InputError("expected a file whose name ends in .csv or .parquet", source=path)
    return choices[ending]


def _read_csv(path: Path) -> pa.Table:
    """A CSV with every cell as text, nulls where a cell is empty."""
    content = read_whole(path)
    text = _decoded(content, path)
    ragged: list[pyarrow.csv.InvalidRow] = []

    def remember(row: pyarrow.csv.InvalidRow) -> str:
        ragged.append(row)
        return "skip"

    try:
        header = next(filter(None, csv.reader(io.StringIO(text))), [])
        table = pyarrow.csv.read_csv(
            pa.BufferReader(content),
            # Rows are numbered only by one thread.
            read_options=pyarrow.csv.ReadOptions(use_threads=False),
            parse_options=pyarrow.csv.ParseOptions(newlines_in_values=True, invalid_row_handler=remember),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types={name: pa.string() for name in header},
                null_values=[""],
                strings_can_be_null=True,
            ),
        )
    except (pa.ArrowException, csv.Error) as error:
        raise InputError(f"expected a table in CSV: {error}", source=path) from error
    if ragged:
        found, expected = ragged[0].actual_columns, ragged[0].expected_columns
        raise InputError(
            f"expected {expected} cells as in the header, found {found}",
            source=path,
            row=ragged[0].number - 1,
        )
    return table


def _decoded(content: bytes, path: Path) -> str:
    """The text of a file, without a byte order mark."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = content[: error.start].count(b"\n")
        raise InputError("expected text in UTF-8", source=path, row=row or None) from error


def _read_parquet(path: Path) -> pa.Table:
    """A Parquet file as it is; unlike `read_table`, `ParquetFile` makes no columns of folder names."""
    try:
        return pyarrow.parquet.ParquetFile(pa.BufferReader(read_whole(path))).read()
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"expected a table in Parquet: {error}", source=path) from error


def _typed(column: pa.ChunkedArray, fractions: bool) -> pa.ChunkedArray:
    """A column of text as numbers where every cell is one."""
    if _all_match(column, _WHOLE_NUMBER):
        return column.cast(pa.int64())
    return column.cast(pa.float64()) if fractions and _all_match(column, _NUMBER) else column


def _all_match(column: pa.ChunkedArray, pattern: str) -> bool:
    """Whether every cell that is not empty matches a regular expression."""
    matches = pc.call_function("match_substring_regex", [column], pc.MatchSubstringOptions(pattern))
    return False not in matches.unique().to_pylist()
