"""Tables in files: CSV and Parquet as `pyarrow.Table`, with errors that name the row."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from jaxtyping import Bool, Float, Int
from pyarrow import parquet

from sidestep._files import read_whole, write_whole
from sidestep.errors import InputError, check, input_errors

_WHOLE_NUMBER = r"^-?(0|[1-9][0-9]{0,17})$"
_NUMBER = r"^-?(0|[1-9][0-9]{0,14})(\.[0-9]+)?([eE][+-]?[0-9]{1,3})?$"


def read_table(path: str | Path, labels: tuple[str, ...] = ()) -> pa.Table:
    """Return the table in a `.csv` or `.parquet` file; empty cells are null.

    Columns of a CSV become numbers only where that loses nothing: a column with a cell `003` stays text.

    Args:
        path: The file.
        labels: Columns that stay text unless all their cells are whole numbers.

    Raises:
        InputError: For another ending, a file that cannot be read or is empty, text that is not UTF-8, a row of another
            length than the header (with its row), and for column names that repeat.
    """
    table = _by_ending(path, lambda file: _read_csv(file, labels), _read_parquet)(Path(path))
    for name in table.column_names:
        check(table.column_names.count(name) == 1, "the column appears more than once", source=path, field=name)
    return table


def write_table(path: str | Path, table: pa.Table) -> None:
    """Write a table as `.csv` or `.parquet` atomically.

    Args:
        path: A name that ends in .csv or .parquet.
        table: The table.

    Raises:
        InputError: For another ending, and for a column that CSV cannot represent.
    """
    write = _by_ending(path, pyarrow.csv.write_csv, parquet.write_table)
    with input_errors("the table cannot be written", pa.ArrowException, source=path):
        write_whole(path, lambda file: write(table, file))


def check_rows(
    valid: Bool[np.ndarray, " rows"],
    message: str,
    source: object,
    field: str,
    rows: Int[np.ndarray, " rows"] | None = None,
    values: Sequence[object] | np.ndarray = (),
) -> None:
    """Raise `InputError` for the first row of a table that is not valid.

    Args:
        valid: Whether each row is valid.
        message: The message, with a place `{}` for each number in a row of `values`.
        source: The name of the table.
        field: The name of the column.
        rows: The numbers of the rows; by default 1, 2, …
        values: The contents of the rows, if the message names them.

    Raises:
        InputError: If a row is not valid.
    """
    if not valid.all():
        rows = np.arange(1, len(valid) + 1) if rows is None else rows
        index = int(np.argmin(np.where(valid, np.inf, rows)))
        content = values[index] if len(values) else ()
        text = message.format(*(content.tolist() if isinstance(content, np.ndarray) else [content]))
        raise InputError(text, source=source, row=int(rows[index]), field=field)


def check_columns(table: pa.Table, names: Sequence[str], source: str) -> None:
    """Raise `InputError` for columns that are not in a table.

    Args:
        table: The table.
        names: The columns that it must have.
        source: Its name, for the error.
    """
    missing = ", ".join(name for name in names if name not in table.column_names)
    check(not missing, f"the column is missing; found {', '.join(table.column_names)}", source=source, field=missing)


def number_column(table: pa.Table, name: str, source: str) -> Float[np.ndarray, " rows"]:
    """Return a column as numbers, NaN where a cell is empty.

    Args:
        table: The table.
        name: The name of the column.
        source: The name of the table, for errors.

    Raises:
        InputError: With the row, for infinity and for a cell that is not a number.
    """
    column = table[name]
    kinds = ("integer", "floating", "decimal", "string", "large_string", "null")
    is_number = any(getattr(pa.types, f"is_{kind}")(column.type) for kind in kinds)
    check(is_number, f"expected numbers, found {column.type}", source=source, field=name)
    try:
        # Not safe, because whole numbers beyond 2^53 may lose their last digits here.
        numbers = column.cast(pa.float64(), safe=False).to_numpy()
    except pa.ArrowInvalid:
        row, cell = next((row, cell) for row, cell in enumerate(column, start=1) if not _is_number(cell))
        raise InputError(f"expected a number, found {cell.as_py()!r}", source=source, row=row, field=name) from None
    check_rows(~np.isinf(numbers), "expected a finite number, found infinity", source, name)
    return numbers


def _is_number(cell: pa.Scalar) -> bool:
    try:
        cell.cast(pa.float64())
    except pa.ArrowInvalid:
        return False
    return True


def finite_column(table: pa.Table, name: str, source: str) -> Float[np.ndarray, " rows"]:
    """Return a column of numbers without empty cells.

    Args:
        table: The table.
        name: The name of the column.
        source: The name of the table, for errors.

    Raises:
        InputError: As `number_column` does, and, with the row, for an empty cell or NaN.
    """
    numbers = number_column(table, name, source)
    valid = ~np.isnan(numbers)
    missing = "NaN" if table[name][int(np.argmin(valid))].is_valid else "an empty cell"
    check_rows(valid, f"expected a finite number, found {missing}", source, name)
    return numbers


def _by_ending(path: str | Path, for_csv: Callable, for_parquet: Callable) -> Callable:
    functions = {".csv": for_csv, ".parquet": for_parquet}
    ending = Path(path).suffix.lower()
    message = f"expected a file name that ends in .csv or .parquet, found {Path(path).name!r}"
    check(ending in functions, message, source=path)
    return functions[ending]


def _read_csv(path: Path, labels: tuple[str, ...]) -> pa.Table:
    """Return the table in a CSV, read with every cell as text, and null where a cell is empty."""
    content = read_whole(path)
    ragged: list[pyarrow.csv.InvalidRow] = []

    def remember(row: pyarrow.csv.InvalidRow) -> str:
        ragged.append(row)
        return "skip"

    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = content[: error.start].count(b"\n")
        raise InputError("expected text in UTF-8", source=path, row=row or None) from error
    with input_errors("expected a table in CSV", pa.ArrowException, csv.Error, source=path):
        header = next(filter(None, csv.reader(io.StringIO(text))), [])
        one_thread = pyarrow.csv.ReadOptions(use_threads=False)  # Rows are numbered only by one thread.
        parse = pyarrow.csv.ParseOptions(newlines_in_values=True, invalid_row_handler=remember)
        types = {name: pa.string() for name in header}
        convert = pyarrow.csv.ConvertOptions(column_types=types, null_values=[""], strings_can_be_null=True)
        table = pyarrow.csv.read_csv(pa.BufferReader(content), one_thread, parse, convert)
    if ragged:
        first = ragged[0]
        message = f"expected {first.expected_columns} cells as in the header, found {first.actual_columns}"
        raise InputError(message, source=path, row=first.number - 1)
    columns = zip(table.column_names, table.columns, strict=True)
    return table.from_arrays([_typed(column, name not in labels) for name, column in columns], table.column_names)


def _read_parquet(path: Path) -> pa.Table:
    """Return the table in a Parquet file; unlike `read_table`, `ParquetFile` adds no columns for folder names."""
    with input_errors("expected a table in Parquet", pa.ArrowException, OSError, source=path):
        return parquet.ParquetFile(pa.BufferReader(read_whole(path))).read()


def _typed(column: pa.ChunkedArray, fractions: bool) -> pa.ChunkedArray:
    """Return a column of text as numbers if every cell that is not empty is one."""
    import pyarrow.compute as pc

    for pattern, kind in ((_WHOLE_NUMBER, pa.int64()), (_NUMBER, pa.float64()))[: 1 + fractions]:
        matches = pc.call_function("match_substring_regex", [column], pc.MatchSubstringOptions(pattern))
        if False not in matches.unique().to_pylist():
            return column.cast(kind)
    return column
