"""Checkpoints: where a fit stood, in one file, so that it can go on from there.

The first line is JSON (what was being fitted, and the history so far), the rest the arrays that the optimiser carries,
and those that it can do without: they depend on how the tasks are batched and spread over devices, and a fit that is
resumed on others goes on without them.
"""

import hashlib
import io
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from sidestep._files import read_whole, write_whole
from sidestep.errors import InputError


def fingerprint(problem: PyTree) -> str:
    """A digest of everything in a pytree: structure, static settings, numbers and shapes."""
    leaves, structure = jax.tree.flatten(problem)
    digest = hashlib.sha256(str(structure).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes() if array.dtype != object else str(leaf).encode())
    return digest.hexdigest()


def save_checkpoint(
    path: Path, key: str, carried: PyTree, history: Sequence[Sequence[int | float]], kept: PyTree = ()
) -> None:
    """Writes a checkpoint, whole or not at all; `kept` are arrays that a resumed fit can do without."""

    def write(file: BinaryIO) -> None:
        header = {"fit": key, "history": list(history), "kept": _shapes(kept)}
        file.write(json.dumps(header).encode() + b"\n")
        eqx.tree_serialise_leaves(file, (carried, kept))

    write_whole(path, write)


def load_checkpoint(
    path: Path, key: str, like: PyTree, kept: PyTree = ()
) -> tuple[PyTree, list[list[int | float]], PyTree]:
    """What the optimiser carried, in the structure of `like`, the history, and what was kept.

    That is `kept` itself where the file has arrays of other shapes.

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
        if header.get("kept") != _shapes(kept):
            return eqx.tree_deserialise_leaves(file, like), history, kept
        carried, kept = eqx.tree_deserialise_leaves(file, (like, kept))
        return carried, history, kept
    except Exception as error:  # what is not an array raises errors of many kinds
        raise InputError("not a checkpoint: the arrays cannot be read", source=path) from error


def _shapes(arrays: PyTree) -> list[str]:
    return [f"{leaf.dtype}{leaf.shape}" for leaf in jax.tree.leaves(arrays)]


class Saver:
    """Keeps a checkpoint file up to date while something runs; without a path it keeps nothing.

    Saving takes no more than a tenth of the time, and happens every few seconds at most.
    """

    def __init__(self, path: str | Path | None, key: str):
        self.path, self.key = None if path is None else Path(path), key
        self.next = 0.0

    def load(self, like: PyTree, kept: PyTree = ()) -> tuple[PyTree, list[list[int | float]], PyTree]:
        """What was carried, the history and what was kept; `like` and `kept` themselves if there is no file yet.

        Raises `InputError` without a path, and for a file that `load_checkpoint` refuses.
        """
        if self.path is None:
            raise InputError("expected a checkpoint to resume from", field="resume")
        return load_checkpoint(self.path, self.key, like, kept) if self.path.exists() else (like, [], kept)

    def save(self, carried: PyTree, history: Sequence[Sequence[int | float]], kept: PyTree = ()) -> None:
        """Saves, if it is time to."""
        if self.path is not None and time.monotonic() >= self.next:
            started = time.monotonic()
            save_checkpoint(self.path, self.key, carried, history, kept)
            took = time.monotonic() - started
            self.next = started + took + self.pause(took)

    def pause(self, took: float) -> float:
        """How many seconds to wait after a save that took so many."""
        return max(5.0, 9 * took)
