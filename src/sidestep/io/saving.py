"""Results in files: fits, posteriors and every other record of the library, without pickle.

A file is a zip archive with the member `description.json`, the tree of the result, and one `.npy` member for each
array. Records are named by their public names, and only classes and functions on a fixed list are made when a file is
read, by setting fields: no code of a file runs. What is not on the list, as a model of one's own or a network with
one's own activation, is described too, and is made with the help of a template.

`VERSION` grows with every change of the format. A file of another version, or with other fields than a record has now,
is refused.
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sidestep._files import read_whole, write_whole
from sidestep._version import __version__
from sidestep.errors import InputError, check, input_errors
from sidestep.io.result_trees import describe, rebuild

FORMAT, VERSION = "sidestep result", 1
"""What a description begins with."""

_DESCRIPTION = "description.json"


def save(path: str | Path, result: Any) -> None:
    """Write a fit, a posterior, draws or any other record of the library to a file that appears complete or not.

    Args:
        path: The file; one that exists is replaced.
        result: A record (`Fit`, `Laplace`, `Draws`, `BarrierPosterior`, a model, demonstrations, …), or a tuple, list
            or dictionary of records.

    Raises:
        InputError: For arrays of other things than numbers and texts, with the field for sets, bytes, complex numbers,
            paths and other objects that are no records, and for texts that UTF-8 cannot hold; for a result that holds
            itself; and if the file system refuses.

    Example:
        >>> import sidestep as ss
        >>> save("grid.result", ss.Grid.unknown(rows=2, columns=3))
        >>> load("grid.result").shape
        (2, 3)
    """
    with input_errors("expected a result that does not hold itself", RecursionError, source="save"):
        tree, arrays = describe(result)
        description = {"format": FORMAT, "version": VERSION, "library": __version__, "result": tree}
        text = json.dumps(description, ensure_ascii=False, allow_nan=False).encode()

    def write(file: BinaryIO) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(_DESCRIPTION, text)
            for number, array in enumerate(arrays):
                content = io.BytesIO()
                np.save(content, array, allow_pickle=False)
                archive.writestr(_member(number), content.getvalue())

    write_whole(path, write)


def load(path: str | Path, *, template: Any = None) -> Any:
    """Return what `save` has written, to the last bit.

    Args:
        path: The file.
        template: A result of the same structure, as a fit of the same model to other data: classes and functions that
            are not the library's are taken from the same place in it.

    Returns:
        The result.

    Raises:
        InputError: For a file that is missing, damaged, of another kind or version, or has 64-bit numbers where JAX has
            32-bit ones; and for classes and functions that are neither the library's nor the template's.

    Example:
        >>> import sidestep as ss
        >>> save("task.result", ss.reach(ss.Grid.unknown(rows=1, columns=3), 2))
        >>> load("task.result").terminal.tolist()
        [False, False, True]
    """
    content = read_whole(path)
    with input_errors("expected a result that `save` has written", Exception, source=path):  # errors of many kinds
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            description = json.loads(archive.read(_DESCRIPTION))
            count = len(archive.namelist()) - 1
            arrays = [np.load(io.BytesIO(archive.read(_member(at))), allow_pickle=False) for at in range(count)]
        kind, version = description["format"], description["version"]
    check(kind == FORMAT, f"expected a {FORMAT}, found {kind!r}", source=path)
    message = f"expected version {VERSION} of the format, found {version} (by sidestep {description.get('library')})"
    check(version == VERSION, message, source=path)
    try:
        kinds = KeyError, IndexError, TypeError, ValueError, RecursionError
        with input_errors("the description is damaged", *kinds, source=path):
            return rebuild(description["result"], arrays, template)
    except InputError as error:
        raise InputError(error.message, source=path, field=error.field) from error


def _member(number: int) -> str:
    return f"arrays/{number}.npy"
