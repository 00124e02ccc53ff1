"""A process that draws one figure: it loads matplotlib, then reads what to draw from its standard input.

`sidestep.cli.drawing` starts it.
"""

import gc
import pickle
import signal
import sys

from sidestep.errors import InputError


def main() -> None:
    """Draw one figure of `sidestep.plotting.maps`; write None or the `InputError` to standard output."""
    # the first process answers to a keyboard interrupt, and closes the standard input of this one
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.set_threshold(50_000)
    from matplotlib.backends import backend_agg  # noqa: F401

    from sidestep.plotting import maps

    try:
        name, path, arguments = pickle.load(sys.stdin.buffer)
    except EOFError:
        return
    error = None
    try:
        maps.save(getattr(maps, name)(*arguments), path)
    except InputError as problem:
        error = problem
    pickle.dump(error, sys.stdout.buffer)
    gc.freeze()  # the process ends without a search for garbage


if __name__ == "__main__":
    main()
