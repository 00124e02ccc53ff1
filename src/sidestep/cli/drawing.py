"""Pictures by a second process, which loads matplotlib while the first one computes.

matplotlib takes nearly as long to load as JAX, and both can load at once on two cores. A process that has loaded
matplotlib already draws by itself, and so does the first one if the second fails.
"""

import os
import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from concurrent.futures import Future


@contextmanager
def prepared_drawing() -> Iterator[None]:
    """Start the process that draws, unless this one can draw without delay; stop it if nothing is drawn."""
    if "matplotlib" not in sys.modules:
        _worker()
    try:
        yield
    finally:
        if _worker.cache_info().currsize:
            with _worker() as unused:
                unused.kill()
            _worker.cache_clear()


def draw(name: str, path: Path, *arguments: Any, module: str = "maps") -> "Future[None]":
    """Begin to draw a figure and to save it as a PNG.

    Args:
        name: The name of a function that returns a figure.
        path: The file.
        *arguments: The arguments of that function.
        module: The name of its module in `sidestep.plotting`.

    Returns:
        The drawing: its `result()` waits for the picture, and raises `InputError` where the file system refuses.
    """
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(max_workers=1).submit(_draw, module, name, path.absolute(), arguments)


def _draw(*figure: Any) -> None:
    if "matplotlib" not in sys.modules:
        worker = _worker()
        _worker.cache_clear()
        answer, _ = worker.communicate(pickle.dumps(figure))
        if worker.returncode == 0:
            error = pickle.loads(answer)
            if error is not None:
                raise error
            return
    from sidestep.plotting.worker import save_figure

    save_figure(*figure)


@cache
def _worker() -> Popen[bytes]:
    # -P: the present folder may hold a file with the name of a module
    command = [sys.executable, "-P", "-m", "sidestep.plotting.worker"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return Popen(command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, env=environment)
