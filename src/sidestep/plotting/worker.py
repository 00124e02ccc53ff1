"""A process that draws one figure: it loads matplotlib, then reads what to draw from its standard input.

`sidestep.cli.drawing` starts it.
"""

import gc
import pickle
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from sidestep.errors import InputError


def main() -> None:
    """Draw one figure; write None or the `InputError` to standard output."""
    # the first process answers to a keyboard interrupt, and closes the standard input of this one
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.set_threshold(50_000)
    from matplotlib.backends import backend_agg  # noqa: F401

    from sidestep.plotting import maps  # noqa: F401

    try:
        figure = pickle.load(sys.stdin.buffer)
    except EOFError:
        return
    error = None
    try:
        save_figure(*figure)
    except InputError as problem:
        error = problem
    pickle.dump(error, sys.stdout.buffer)
    gc.freeze()  # the process ends without a search for garbage


def save_figure(module: str, name: str, path: Path, arguments: Sequence[Any]) -> None:
    """Draw a figure and save it as a PNG.

    Args:
        module: The name of a module of `sidestep.plotting`.
        name: The name of a function in it that returns a figure.
        path: The file.
        arguments: The arguments of that function.
    """
    from sidestep.plotting.maps import save

    save(getattr(import_module(f"sidestep.plotting.{module}"), name)(*arguments), path)


if __name__ == "__main__":
    main()
