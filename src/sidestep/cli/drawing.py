"""Pictures by a second process, which loads matplotlib while the first one computes.

matplotlib takes as long to load as JAX. In a process of its own it saves a quarter of the time of a short command
(`python -m benchmarks startup`). A process that has loaded matplotlib already draws by itself.
"""

import pickle
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any


def prepare_drawing() -> None:
    """Start the process that draws, unless this one can draw without delay."""
    if "matplotlib" not in sys.modules:
        _worker()


def draw(name: str, path: Path, *arguments: Any) -> None:
    """Draw a figure and save it as a PNG.

    Args:
        name: The name of a function in `sidestep.plotting.maps` that returns a figure.
        path: The file.
        *arguments: The arguments of that function.

    Raises:
        InputError: Where the file system refuses.
    """
    if "matplotlib" in sys.modules:
        from sidestep.plotting import maps

        maps.save(getattr(maps, name)(*arguments), path)
        return
    worker = _worker()
    _worker.cache_clear()
    answer, _ = worker.communicate(pickle.dumps((name, path, arguments)))
    error = pickle.loads(answer) if worker.returncode == 0 else RuntimeError(f"the picture {path} was not drawn")
    if error is not None:
        raise error


@cache
def _worker() -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "sidestep.plotting.worker"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
