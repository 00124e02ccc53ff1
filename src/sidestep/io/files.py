"""Reading a file in full, and writing one so that it appears whole or not at all."""

import json
import os
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
    # Not `tempfile`, whose files nobody else may read: this one gets the permissions that any new file gets.
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
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


def _plain(value: object) -> object:
    """A NumPy number or array as the Python one that JSON knows."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"expected plain values, found {type(value).__name__}")


def _reason(error: Exception) -> str:
    """What went wrong, in the system's words and without the path, which the error names already."""
    return (isinstance(error, OSError) and error.strerror) or str(error)
