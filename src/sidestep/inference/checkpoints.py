"""Checkpoints: the state of a fit in one file, from which it can be resumed.

The first line is JSON: a fingerprint of the problem, and the history. Then come the arrays of the state, and optional
arrays: these depend on the batches and devices, and a fit that is resumed on others does without them.
"""

import hashlib
import io
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import equinox as eqx
import jax
import numpy as np

from sidestep._files import read_whole, write_whole
from sidestep._typing import Tree
from sidestep.errors import InputError, check, check_instance, input_errors, to_number, to_path

History = Sequence[Sequence[int | float]]


def fingerprint(problem: Tree) -> str:
    """Return a digest of everything in a pytree: structure, static settings, numbers, types and shapes.

    Args:
        problem: Arrays and settings.
    """
    leaves, structure = jax.tree.flatten(problem)
    digest = hashlib.sha256(str(structure).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes() if array.dtype != object else str(leaf).encode())
    return digest.hexdigest()


def _shapes(arrays: Tree) -> list[str]:
    return [f"{leaf.dtype}{leaf.shape}" for leaf in jax.tree.leaves(arrays)]


class Checkpoint(NamedTuple):
    """The file of a fit's checkpoint, and how often it is saved.

    Attributes:
        path: The file.
        min_interval: The least time between two saves, in seconds.
        max_fraction: The largest fraction of the time that saving may take, in (0, 1].

    Example:
        >>> Checkpoint("fit.checkpoint", min_interval=60.0).max_fraction
        0.1
    """

    path: str | Path
    min_interval: float = 5.0
    max_fraction: float = 0.1


class Saver:
    """Keeps a checkpoint up to date while a fit runs; without one it does nothing.

    Args:
        checkpoint: A file, a `Checkpoint`, or None.
        key: The fingerprint of the problem.
    """

    def __init__(self, checkpoint: str | Path | Checkpoint | None, key: str):
        check_instance(checkpoint, (str, Path, Checkpoint, type(None)), "checkpoint")
        self.checkpoint: Checkpoint | None = None
        if checkpoint is not None:
            own = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
            interval = to_number(own.min_interval, "min_interval", least=0)
            fraction = to_number(own.max_fraction, "max_fraction", above=0, most=1)
            self.checkpoint = Checkpoint(to_path(own.path, "checkpoint"), interval, fraction)
        self.key, self.next = key, 0.0

    def load(self, like: Tree, optional: Tree = ()) -> tuple[Tree, History, Tree]:
        """Read the checkpoint.

        Args:
            like: Arrays of the structure, types and shapes of the state.
            optional: Likewise, of the arrays that a resumed fit can do without.

        Returns:
            The state, the history, and the optional arrays: `optional` itself if those of the file have other shapes,
            and the arguments if there is no file yet.

        Raises:
            InputError: Without a checkpoint, for a file that is not one, or one of a fit of other data or with other
                settings.
        """
        if self.checkpoint is None:
            raise InputError("expected a checkpoint to resume from", field="resume")
        path = Path(self.checkpoint.path)
        if not path.exists():
            return like, [], optional
        file = io.BytesIO(read_whole(path))
        with input_errors("not a checkpoint", ValueError, TypeError, KeyError, source=path):
            header = json.loads(file.readline())
            saved_key, history = header["fit"], header["history"]
        message = "belongs to a fit of other data or with other settings; start without resuming to replace it"
        check(saved_key == self.key, message, source=path)
        # what is not an array raises errors of many kinds
        with input_errors("not a checkpoint: the arrays cannot be read", Exception, source=path):
            if header.get("optional") != _shapes(optional):
                return eqx.tree_deserialise_leaves(file, like), history, optional
            state, optional = eqx.tree_deserialise_leaves(file, (like, optional))
            return state, history, optional

    def save(self, state: Tree, history: History, optional: Tree = ()) -> None:
        """Write the checkpoint as a whole, unless the last save is too recent.

        Args:
            state: The arrays from which the fit is resumed.
            history: A row of numbers per iteration.
            optional: Arrays that a resumed fit can do without.
        """

        def write(file: BinaryIO) -> None:
            header = {"fit": self.key, "history": list(history), "optional": _shapes(optional)}
            file.write(json.dumps(header).encode() + b"\n")
            eqx.tree_serialise_leaves(file, (state, optional))

        if self.checkpoint is None or time.monotonic() < self.next:
            return
        started = time.monotonic()
        write_whole(Path(self.checkpoint.path), write)
        pause = (time.monotonic() - started) * (1 / self.checkpoint.max_fraction - 1)
        self.next = time.monotonic() + max(self.checkpoint.min_interval, pause)
