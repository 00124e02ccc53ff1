"""Output files appear whole or not at all."""

import json

import numpy as np
import pytest

from sidestep._files import read_whole, write_array, write_json, write_whole, write_whole_folder
from sidestep.errors import InputError


def test_write_whole_creates_the_folder(tmp_path):
    write_whole(tmp_path / "new" / "note.txt", lambda file: file.write(b"done"))
    assert (tmp_path / "new" / "note.txt").read_bytes() == b"done"
    assert [entry.name for entry in (tmp_path / "new").iterdir()] == ["note.txt"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_write_whole_that_fails_keeps_the_old_file(tmp_path, failure):
    path = tmp_path / "note.txt"
    path.write_bytes(b"old")

    def fail(file):
        file.write(b"half")
        raise failure

    with pytest.raises(failure):
        write_whole(path, fail)
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["note.txt"]


def test_write_whole_onto_a_folder_or_below_a_file_raises(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    (tmp_path / "taken").mkdir()
    for name in ("taken", "file/note.txt"):
        with pytest.raises(InputError, match=f"{name}: cannot be written"):
            write_whole(tmp_path / name, lambda file: file.write(b"done"))
    assert {entry.name for entry in tmp_path.iterdir()} == {"file", "taken"}


def test_write_whole_folder_appears_when_full(tmp_path):
    def fill(folder):
        assert not (tmp_path / "new").exists()
        (folder / "note.txt").write_bytes(b"done")

    write_whole_folder(tmp_path / "new", fill)
    assert (tmp_path / "new" / "note.txt").read_bytes() == b"done"
    with pytest.raises(InputError, match="new: exists already: expected a new name"):
        write_whole_folder(tmp_path / "new", fill)
    assert [entry.name for entry in tmp_path.iterdir()] == ["new"]


@pytest.mark.parametrize(("failure", "expected"), [(KeyboardInterrupt, KeyboardInterrupt), (OSError, InputError)])
def test_write_whole_folder_that_fails_leaves_nothing(tmp_path, failure, expected):
    def fail(folder):
        (folder / "note.txt").write_bytes(b"half")
        raise failure

    with pytest.raises(expected):
        write_whole_folder(tmp_path / "new", fail)
    assert not list(tmp_path.iterdir())


def test_write_json_keeps_order_and_converts_numpy(tmp_path):
    data = {"z": np.float32(0.5), "a": np.int64(3), "list": np.arange(2), "none": None, "is": np.bool_(True)}
    write_json(tmp_path / "summary.json", data)
    read = json.loads((tmp_path / "summary.json").read_text())
    assert list(read.items()) == [("z", 0.5), ("a", 3), ("list", [0, 1]), ("none", None), ("is", True)]


@pytest.mark.parametrize("value", [float("nan"), np.float32("inf"), object()])
def test_write_json_of_unrepresentable_data_raises(tmp_path, value):
    with pytest.raises(InputError, match=r"summary\.json: cannot be written as JSON"):
        write_json(tmp_path / "summary.json", {"loss": value})
    assert not list(tmp_path.iterdir())


def test_write_array_is_read_back(tmp_path):
    write_array(tmp_path / "blocked.npy", np.array([[0.25, 1.0]]))
    np.testing.assert_array_equal(np.load(tmp_path / "blocked.npy"), [[0.25, 1.0]])


def test_read_whole_of_unreadable_files_raises(tmp_path):
    (tmp_path / "empty").write_bytes(b" \n")
    for name, message in (("absent", "No such file"), (".", "Is a directory"), ("empty", "is empty"), ("\0", "null")):
        with pytest.raises(InputError, match=message):
            read_whole(tmp_path / name)
