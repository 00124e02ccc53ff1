"""Tables of walks: what is read, what is refused and where, and that walks come back as they were written."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.drawn import assert_same_walks, walk_tables
from sidestep.errors import InputError
from sidestep.io.walks import read_walks, walks_from_table, write_walks

GOOD = """walk,step,x,y,t,goal_x,goal_y,subject,trial
b,0,0.5,0.5,0.0,3.5,0.5,003,5
a,0,0.5,1.5,0.0,,,001,6
b,1,1.5,0.5,0.5,3.5,0.5,003,5
a,4,1.5,1.5,2.0,,,001,6
a,7,2.5,1.5,2.0,,,001,6
"""


def read_text(folder, text, name="walks.csv"):
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_walks(folder / name)


def test_read_walks_groups_rows_in_order_of_appearance(tmp_path):
    walks = read_text(tmp_path, GOOD)
    assert (len(walks), walks.labels) == (2, ["b", "a"])
    assert walks.offsets.tolist() == [0, 2, 5]
    assert walks.rows.tolist() == [1, 3, 2, 4, 5]
    assert walks.steps.tolist() == [0, 1, 0, 4, 7]
    assert [positions.tolist() for positions in walks] == [
        [[0.5, 0.5], [1.5, 0.5]],
        [[0.5, 1.5], [1.5, 1.5], [2.5, 1.5]],
    ]
    assert walks.goals.tolist() == [[3.5, 0.5], [2.5, 1.5]]
    assert np.isnan(walks.failed_moves).all()
    assert walks.source == str(tmp_path / "walks.csv")


def test_read_walks_keeps_metadata(tmp_path):
    metadata = read_text(tmp_path, GOOD).metadata
    assert metadata.column_names == ["t", "subject", "trial"]
    assert metadata["subject"].to_pylist() == ["003", "003", "001", "001", "001"]
    assert metadata["trial"].to_pylist() == [5, 5, 6, 6, 6]
    assert metadata["t"].to_pylist() == [0.0, 0.5, 0.0, 2.0, 2.0]


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ("1,2", [1, 2]),
        ("1.5,2", [1.5, 2.0]),
        ("1,", [1, None]),
        ("01,2", ["01", "2"]),
        ("NA,2", ["NA", "2"]),
        ("9999999999999999999,2", ["9999999999999999999", "2"]),
        ("nan,2", ["nan", "2"]),
    ],
)
def test_read_walks_makes_numbers_where_nothing_is_lost(tmp_path, cells, expected):
    first, second = cells.split(",")
    walks = read_text(tmp_path, f"walk,step,x,y,note\n0,0,0,0,{first}\n0,1,1,0,{second}\n")
    assert walks.metadata["note"].to_pylist() == expected


def test_read_walks_keeps_labels_that_differ_as_text(tmp_path):
    text = "walk,step,x,y\n1.10,0,0,0\n1.1,0,0,0\n1.10,1,1,0\n1.1,1,1,0\n"
    assert read_text(tmp_path, text).labels == ["1.10", "1.1"]


def test_read_walks_accepts_byte_order_marks_and_blank_lines(tmp_path):
    text = b'\xef\xbb\xbfwalk,step,x,y,note\r\n0,0,0,0,"two\nlines"\r\n\r\n0,1,1.5,0,b\r\n'
    walks = read_text(tmp_path, text)
    assert walks.positions.tolist() == [[0, 0], [1.5, 0]]
    assert walks.metadata["note"].to_pylist() == ["two\nlines", "b"]


def test_read_walks_reads_failed_moves(tmp_path):
    text = "walk,step,x,y,failed_x,failed_y\n0,0,0.5,0.5,,\n0,1,0.5,0.5,1.5,0.5\n0,2,0.5,1.5,nan,nan\n"
    failed = read_text(tmp_path, text).failed_moves
    np.testing.assert_array_equal(failed, [[np.nan, np.nan], [1.5, 0.5], [np.nan, np.nan]])


def test_walks_from_table_keeps_nanosecond_steps():
    start = 2**62
    table = pa.table({"walk": [0, 0], "step": [start, start + 1], "x": [0, 1], "y": [0, 0]})
    assert walks_from_table(table).steps.tolist() == [start, start + 1]


def test_walks_from_table_keeps_row_order_in_large_tables():
    walk = np.random.default_rng(0).integers(0, 3, 10_000)
    zeros = np.zeros(len(walk))
    walks = walks_from_table(pa.table({"walk": walk, "step": np.arange(len(walk)), "x": zeros, "y": zeros}))
    for index, label in enumerate(walks.labels):
        rows = walks.rows[walks.offsets[index] : walks.offsets[index + 1]]
        np.testing.assert_array_equal(rows, np.flatnonzero(walk == label) + 1)


@pytest.mark.parametrize("labels", ["abba", "abab"])
def test_walks_from_table_names_the_first_bad_row(labels):
    table = pa.table({"walk": list(labels), "step": [0, 0, 0, 0], "x": [0.0] * 4, "y": [0.0] * 4})
    with pytest.raises(InputError, match="row 3, field 'step'"):
        walks_from_table(table)


@pytest.mark.parametrize("label", [None, float("nan")])
def test_walks_from_table_without_a_label_raises(label):
    table = pa.table({"walk": [0.5, label], "step": [0, 1], "x": [0.0, 1.0], "y": [0.0, 0.0]})
    with pytest.raises(InputError, match="row 2, field 'walk': expected the label of a walk"):
        walks_from_table(table)


def test_walks_from_table_ignores_unused_dictionary_labels():
    labels = pa.DictionaryArray.from_arrays(pa.array([2, 1, 2, 1]), pa.array(["unused", "a", "b"]))
    table = pa.table({"walk": labels, "step": [0, 0, 1, 1], "x": [0.0, 1, 2, 3], "y": [0.0, 0, 0, 0]})
    walks = walks_from_table(table)
    assert walks.labels == ["b", "a"]
    assert walks.positions[:, 0].tolist() == [0, 2, 1, 3]


@pytest.mark.parametrize("chosen", [np.array([False, True]), np.array([1]), np.array([-1])])
def test_select_keeps_fields_aligned(tmp_path, chosen):
    walks = read_text(tmp_path, GOOD).select(chosen)
    assert (walks.labels, walks.offsets.tolist(), walks.goals.tolist()) == (["a"], [0, 3], [[2.5, 1.5]])
    assert walks.positions[:, 0].tolist() == [0.5, 1.5, 2.5]
    assert (walks.rows.tolist(), walks.steps.tolist()) == ([2, 4, 5], [0, 4, 7])
    assert walks.metadata["subject"].to_pylist() == ["001"] * 3
    assert walks.failed_moves.shape == (3, 2)


def test_select_reorders_walks(tmp_path):
    walks = read_text(tmp_path, GOOD)
    assert walks.select(np.array([1, 0])).rows.tolist() == [2, 4, 5, 1, 3]
    assert len(walks.select(np.array([False, False]))) == 0


def changed(line, column, value):
    """`GOOD` with one cell changed; line 1 is the first data row."""
    lines = [row.split(",") for row in GOOD.splitlines()]
    lines[line][lines[0].index(column)] = value
    return "\n".join(",".join(row) for row in lines)


NO_NUMBERS = {"abc": "'abc'", "-inf": "infinity", "": "an empty cell", "nan": "NaN"}


@pytest.mark.parametrize("column", ["x", "y", "step", "t"])
@pytest.mark.parametrize("value", NO_NUMBERS)
def test_read_walks_names_a_cell_that_is_no_number(tmp_path, column, value):
    message = rf"walks\.csv, row 3, field '{column}': expected a .*found {NO_NUMBERS[value]}"
    with pytest.raises(InputError, match=message):
        read_text(tmp_path, changed(3, column, value))


@pytest.mark.parametrize(
    ("line", "column", "value", "message"),
    [
        (5, "step", "4", "row 5, field 'step': expected steps that increase .* row 4"),
        (4, "step", "-1", "row 4, field 'step': expected steps that increase .* row 2"),
        (3, "t", "-0.5", "row 3, field 't': expected times that never decrease .* row 1"),
        (3, "goal_x", "abc", "row 3, field 'goal_x': expected a .*found 'abc'"),
        (3, "goal_x", "-inf", "row 3, field 'goal_x': expected a .*found infinity"),
        (3, "goal_x", "3.25", "row 3, field 'goal_x': expected the same goal"),
        (3, "goal_y", "0.25", "row 3, field 'goal_y': expected the same goal"),
        (3, "goal_y", "", "row 3, field 'goal_y': expected goal_x and goal_y, or neither"),
        (4, "goal_x", "1", "row 4, field 'goal_y': expected goal_x and goal_y, or neither"),
        (2, "walk", "", "row 2, field 'walk': expected the label"),
        (2, "walk", "c", "row 2, field 'walk': expected at least two positions, found one in walk 'c'"),
    ],
)
def test_read_walks_names_bad_rows(tmp_path, line, column, value, message):
    with pytest.raises(InputError, match=rf"walks\.csv, {message}"):
        read_text(tmp_path, changed(line, column, value))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("\n\n", "the file is empty"),
        ("walk,step,x,y\n", "expected at least one walk, found a table without rows"),
        ("walk,step,x\n0,0,0\n", "field 'y': the column is missing; found walk, step, x"),
        ("walk;step;x;y\n0;0;0;0\n", "field 'walk, step, x, y': the column is missing"),
        ("walk,step,x,y,x\n0,0,0,0,0\n", "field 'x': the column appears more than once"),
        ("walk,step,x,y,goal_x\n0,0,0,0,0\n0,1,0,0,0\n", "field 'goal_y': the column is missing"),
        ("walk,step,x,y,failed_y\n0,0,0,0,0\n0,1,0,0,0\n", "field 'failed_x': the column is missing"),
        ("walk,step,x,y\n0,0,0,0\n\n0,1,1\n", "row 2: expected 4 cells as in the header, found 3"),
        ("walk,step,x,y\n0,0,0,0\n0,1,1,1,1\n", "row 2: expected 4 cells as in the header, found 5"),
        (b"walk,step,x,y\n0,0,0,0\n\xff,1,1,1\n", "row 2: expected text in UTF-8"),
        (b"\xff\xfewalk", "expected text in UTF-8"),
        (b"\xef\xbb\xbf", "expected a table in CSV"),
        ('"walk,step\n' + "0,0,0,0\n" * 20_000, "expected a table in CSV"),
        (
            "walk,step,x,y,failed_x,failed_y\n0,0,0,0,,\n0,1,0,0,1,\n",
            "row 2, field 'failed_y': expected failed_x and failed_y, or neither",
        ),
    ],
)
def test_read_walks_names_bad_tables(tmp_path, text, message):
    with pytest.raises(InputError, match=rf"walks\.csv(,|:) {message}"):
        read_text(tmp_path, text)


def test_read_walks_of_a_bad_parquet_file_raises(tmp_path):
    write_walks(tmp_path / "whole.parquet", read_text(tmp_path, GOOD))
    whole = (tmp_path / "whole.parquet").read_bytes()
    for content in (b"not parquet at all", b"PAR1 broken PAR1", whole[: len(whole) // 2]):
        with pytest.raises(InputError, match=r"walks\.parquet: expected a table in Parquet"):
            read_text(tmp_path, content, "walks.parquet")


@pytest.mark.parametrize("name", ["walks.txt", "walks", "walks.csv.gz"])
def test_walks_with_another_ending_raise(tmp_path, name):
    with pytest.raises(InputError, match=r"expected a file name that ends in \.csv or \.parquet"):
        read_text(tmp_path, GOOD, name)
    with pytest.raises(InputError, match=r"expected a file name that ends in \.csv or \.parquet"):
        write_walks(tmp_path / name, read_text(tmp_path, GOOD))


def test_read_walks_of_missing_files_and_folders_raises(tmp_path):
    (tmp_path / "folder.csv").mkdir()
    for name in ("absent.csv", "folder.csv", "absent.parquet"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read"):
            read_walks(tmp_path / name)


@pytest.mark.parametrize("column", [pa.array([True, False]), pa.array([[0], [1]]), pa.array([0, 1], pa.timestamp("s"))])
def test_walks_from_table_of_other_types_raises(column):
    table = pa.table({"walk": [0, 0], "step": [0, 1], "x": column, "y": [0, 0]})
    with pytest.raises(InputError, match="field 'x': expected numbers, found"):
        walks_from_table(table)


def test_read_walks_ignores_partition_names_in_the_path(tmp_path):
    (tmp_path / "site=3").mkdir()
    write_walks(tmp_path / "site=3" / "walks.parquet", read_text(tmp_path, GOOD))
    assert "site" not in read_walks(tmp_path / "site=3" / "walks.parquet").metadata.column_names


def test_write_walks_of_lists_to_csv_raises_and_leaves_nothing(tmp_path):
    table = pa.table({"walk": [0, 0], "step": [0, 1], "x": [0, 1], "y": [0, 0], "tags": [["a"], []]})
    with pytest.raises(InputError, match=r"walks\.csv: the table cannot be written"):
        write_walks(tmp_path / "walks.csv", walks_from_table(table))
    assert not list(tmp_path.iterdir())
    write_walks(tmp_path / "walks.parquet", walks_from_table(table))
    assert read_walks(tmp_path / "walks.parquet").metadata["tags"].to_pylist() == [["a"], []]


@given(walk_tables(), st.sampled_from(["csv", "parquet"]))
def test_write_walks_is_read_back(tmp_path_factory, table, ending):
    walks, path = walks_from_table(table), tmp_path_factory.mktemp("walks") / f"walks.{ending}"
    write_walks(path, walks)
    assert_same_walks(read_walks(path), walks)
