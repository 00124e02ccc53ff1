"""Reading a whole file, and writing a file or a folder atomically: it appears complete or not."""

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

from sidestep.errors import InputError, input_errors, to_path


def read_whole(path: str | Path) -> bytes:
    """Return the bytes of a file; raise `InputError` for one that is missing, a folder, unreadable or empty."""
    path = to_path(path)
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read: {_reason(error)}", source=path) from error
    if not content.strip():
        raise InputError("the file is empty", source=path)
    return content


def write_whole(path: str | Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file that appears complete or not.

    A temporary file beside `path` gets the name `path` after `write` has returned; after an error, an old file
    at `path` is unchanged. The folder is created.

    Args:
        path: the file.
        write: writes to the open binary file that it is called with; its errors are passed on.

    Raises:
        InputError: if the file system refuses.
    """
    path = to_path(path)
    partial = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        with suppress(OSError):  # the first error is the one to report
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise InputError(f"cannot be written: {_reason(error)}", source=path) from error
        raise


def write_whole_folder(path: str | Path, fill: Callable[[Path], object]) -> None:
    """Write a folder that appears complete or not.

    A temporary folder beside `path` gets the name `path` after `fill` has returned; after an error it is removed.

    Args:
        path: the folder.
        fill: writes into the empty folder that it is called with; its errors are passed on.

    Raises:
        InputError: for a folder that exists already, or if the file system refuses.
    """
    path = to_path(path)
    partial = _beside(path)
    try:
        if path.exists():
            raise InputError("exists already: expected a new name", source=path)
        partial.mkdir(parents=True)
        fill(partial)
        os.rename(partial, path)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError):
            raise InputError(f"cannot be written: {_reason(error)}", source=path) from error
        raise


def write_json(path: str | Path, data: Any) -> None:
    """Write data, which may contain NumPy numbers and arrays, as indented JSON atomically.

    Raises:
        InputError: for NaN, infinity and other data that JSON cannot represent; None is a missing value.
    """
    with input_errors("cannot be written as JSON", TypeError, ValueError, source=path):
        text = json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False, default=_plain)
    write_whole(path, lambda file: file.write(text.encode() + b"\n"))


def read_json(path: str | Path) -> Any:
    """Return the data in a JSON file; raise `InputError` for a file that is missing or not JSON."""
    content = read_whole(path)
    with input_errors("expected JSON", ValueError, source=path):
        return json.loads(content)


def write_array(path: str | Path, array: np.ndarray) -> None:
    """Write an array of numbers as a `.npy` file atomically."""
    write_whole(path, lambda file: np.save(file, array, allow_pickle=False))


def write_arrays(path: str | Path, **arrays: np.ndarray) -> None:
    """Write arrays of numbers by name as a compressed `.npz` file atomically."""
    write_whole(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays))


def read_array(path: str | Path, kinds: str, name: str | None = None) -> np.ndarray:
    """Return the array in a `.npy` file, or one of those in a `.npz` file.

    Args:
        path: the file.
        kinds: the accepted kinds of its dtype ("f" floats, "iu" whole numbers, "b" truth values).
        name: the name of the array in a `.npz` file.

    Raises:
        InputError: for a file without such an array.
    """
    content = read_whole(path)
    with input_errors("expected a NumPy array", Exception, source=path):  # NumPy raises errors of many kinds
        array = np.load(io.BytesIO(content), allow_pickle=False)
        array = array if name is None else array[name]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
        raise InputError("expected a NumPy array of numbers", source=path, field=name)
    return array


def _beside(path: Path) -> Path:
    """Return a hidden temporary name beside a path."""
    # Files of `tempfile` are readable by their owner only; this one gets the permissions of any new file.
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")


def _plain(value: object) -> object:
    """Convert a NumPy number or array for JSON."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"expected plain values, found {type(value).__name__}")


def _reason(error: Exception) -> str:
    """Return the system's message without the path, which `InputError` has already."""
    return (isinstance(error, OSError) and error.strerror) or str(error)
