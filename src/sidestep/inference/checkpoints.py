"""Checkpoints: where a fit stood, in one file, so that it can go on from there.

The first line is JSON (what was being fitted, and the history so far), the rest the arrays that the optimiser carries.
"""

import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from sidestep.errors import InputError
from sidestep.io.files import read_whole, write_whole


def fingerprint(problem: PyTree) -> str:
    """A digest of everything in a pytree: structure, static settings, numbers and shapes."""
    leaves, structure = jax.tree.flatten(problem)
    digest = hashlib.sha256(str(structure).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes() if array.dtype != object else str(leaf).encode())
    return digest.hexdigest()


def save_checkpoint(path: Path, key: str, carried: PyTree, history: Sequence[Sequence[int | float]]) -> None:
    """Writes a checkpoint, whole or not at all."""

    def write(file: BinaryIO) -> None:
        file.write(json.dumps({"fit": key, "history": list(history)}).encode() + b"\n")
        eqx.tree_serialise_leaves(file, carried)

    write_whole(path, write)


def load_checkpoint(path: Path, key: str, like: PyTree) -> tuple[PyTree, list[list[int | float]]]:
    """What the optimiser carried, in the structure of `like`, and the history.

    Raises `InputError` for a file that is no checkpoint, or one of a fit of other data or with other settings.
    """
    file = io.BytesIO(read_whole(path))
    try:
        header = json.loads(file.readline())
        key_found, history = header["fit"], header["history"]
    except (ValueError, TypeError, KeyError) as error:
        raise InputError("not a checkpoint", source=path) from error
    if key_found != key:
        raise InputError(
            "belongs to a fit of other data or with other settings; start without resuming to replace it",
            source=path,
        )
    try:
        return eqx.tree_deserialise_leaves(file, like), history
    except Exception as error:  # what is not an array raises errors of many kinds
        raise InputError("not a checkpoint: the arrays cannot be read", source=path) from error
