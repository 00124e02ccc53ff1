"""The files that an experiment writes: a picture and a summary."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sidestep._files import write_json
from sidestep.plotting.maps import save

Notify = Callable[[str], None]
"""A function that shows a line of progress."""

Summary = dict[str, Any]
"""The content of a summary, as JSON has it."""


def quiet(_: str) -> None:
    """Show no progress."""


def write_results(folder: Path, name: str, seed: int, started: float, figure: Figure, results: Summary) -> Summary:
    """Write the picture `NAME.png` and `summary.json` of an experiment.

    Args:
        folder: The folder to write to.
        name: The name of the experiment.
        seed: The seed of everything random.
        started: When the experiment began, by `time.monotonic`.
        figure: The picture.
        results: The other entries of the summary.

    Returns:
        The content of `summary.json`.
    """
    seconds = round(time.monotonic() - started, 1)
    summary = {"command": f"experiment {name}", "seed": seed, **results, "seconds": seconds}
    save(figure, folder / f"{name}.png")
    write_json(folder / "summary.json", summary)
    return summary
