"""Reading a file in full, and writing a file or a folder so that it appears whole or not at all."""

import io
import json
import os
import shutil
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sidestep.errors import InputError


def read_whole(path: str | Path) -> bytes:
    """The bytes of a file; raises `InputError` for one that is missing, a folder, unreadable or empty."""
    try:
        content = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read: {_reason(error)}", source=path) from error
    if not content.strip():
        raise InputError("the file is empty", source=path)
    return content


def write_whole(path: str | Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file that appears whole or not at all.

    `write` is called with an open binary file beside `path`, which takes the name `path` once `write` has
    returned; if anything fails before that, what stood at `path` stands there still. The folder is created.
    Raises `InputError` where the file system refuses, and passes on what `write` raises.

    >>> write_whole("out/note.txt", lambda file: file.write(b"done"))  # doctest: +SKIP
    """
    path = Path(path)
    partial = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        with suppress(OSError):  # The first error is the one to tell of.
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise InputError(f"cannot be written: {_reason(error)}", source=path) from error
        raise


def write_whole_folder(path: str | Path, fill: Callable[[Path], object]) -> None:
    """Write a folder that appears whole or not at all.

    `fill` is called with an empty folder beside `path`, which takes the name `path` once `fill` has returned; if
    anything fails before that, it is removed. Raises `InputError` for a folder that is there already, or where the file
    system refuses, and passes on what `fill` raises.
    """
    path = Path(path)
    partial = _beside(path)
    try:
        if path.exists():
            raise InputError("is there already: expected a name that is free", source=path)
        partial.mkdir(parents=True)
        fill(partial)
        os.rename(partial, path)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError):
            raise InputError(f"cannot be written: {_reason(error)}", source=path) from error
        raise


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` as JSON, indented, in its own order, whole or not at all; NumPy numbers and arrays are
    welcome.

    JSON has no NaN and no infinity: pass None for what has no value. Raises `InputError` for either, and
    for data that JSON cannot hold.
    """
    try:
        text = json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False, default=_plain)
    except (TypeError, ValueError) as error:
        raise InputError(f"cannot be written as JSON: {error}", source=path) from error
    write_whole(path, lambda file: file.write(text.encode() + b"\n"))


def read_json(path: str | Path) -> Any:
    """What a JSON file holds; raises `InputError` for a file that is missing or not JSON."""
    try:
        return json.loads(read_whole(path))
    except ValueError as error:
        raise InputError(f"expected JSON: {error}", source=path) from error


def write_array(path: str | Path, array: np.ndarray) -> None:
    """Write an array of numbers as a `.npy` file, whole or not at all."""
    write_whole(path, lambda file: np.save(file, array, allow_pickle=False))


def read_array(path: str | Path, kinds: str) -> np.ndarray:
    """The array in a `.npy` file; `kinds` are those of its dtype ("f" floats, "iu" whole numbers).

    Raises `InputError` for a file that holds no such array.
    """
    content = read_whole(path)
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # what is not an array raises errors of many kinds
        raise InputError(f"expected a NumPy array: {error}", source=path) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
        raise InputError("expected a NumPy array of numbers", source=path)
    return array


def _beside(path: Path) -> Path:
    """A hidden name beside a path, for what is not whole yet."""
    # Not `tempfile`, whose files nobody else may read: this one gets the permissions that any new file gets.
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")


def _plain(value: object) -> object:
    """A NumPy number or array as the Python one that JSON knows."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"expected plain values, found {type(value).__name__}")


def _reason(error: Exception) -> str:
    """What went wrong, in the system's words and without the path, which the error names already."""
    return (isinstance(error, OSError) and error.strerror) or str(error)
