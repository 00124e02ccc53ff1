"""What the command line shows: progress, notes and errors on standard error, results on standard output."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import floor, log10
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from sidestep.inference.coordinate_ascent import AscentProgress
    from sidestep.inference.maximize import Progress as FitProgress
    from sidestep.inference.sampler import SweepProgress

    FitCallback = Callable[[FitProgress | AscentProgress | SweepProgress], None]

_HEADINGS = {
    "auc": "AUC",
    "average_precision": "average\nprecision",
    "auc_relevant": "relevant\nAUC",
    "average_precision_relevant": "relevant\nprecision",
    "calibration_error": "calibration\nerror",
    "brier_score": "Brier\nscore",
    "log_loss": "log loss\n(nats)",
    "mean_obstacle": "mean on\nobstacles",
    "mean_free": "mean on\nfree cells",
    "max_probability": "highest",
    "legal_fraction": "legal\npaths",
    "excess_length": "excess\nlength\n(cells)",
    "regret": "regret\n(cells)",
    "arriving_fraction": "arrive",
    "heldout_log_likelihood": "held-out\nnats a move",
    "largest_difference": "largest\ndifference",
    "band_excess": "beyond\nthe band",
    "outside_90": "outside\ncentral 90 %",
}
_RANKING = "auc", "average_precision", "auc_relevant"
_CALIBRATION = "calibration_error", "brier_score", "log_loss"
_OTHERS = "recall", "mean_obstacle", "mean_free", "max_probability", "legal_fraction", "excess_length", "regret"
_MAP_SCORES = *_RANKING, *_CALIBRATION, *_OTHERS
ROW_SCORES = *_RANKING, *_OTHERS
"""Those that fit in a row."""


def print_lines(*lines: str) -> None:
    """Print lines of results.

    Args:
        *lines: The lines, without markup.
    """
    for line in lines:
        print(line)


def with_error(estimate: float, error: float | None) -> str:
    """Return an estimate with its standard error, to the first digit of the error, or two where that is a 1.

    Args:
        estimate: The number.
        error: Its standard error; None where it is unknown.
    """
    if not error:
        return f"{estimate:.3g}"
    rounded = float(f"{error:.1e}")
    exponent = floor(log10(rounded))
    digits = max(0, (1 if rounded < 2 * 10**exponent else 0) - exponent)
    return f"{estimate:.{digits}f} ± {error:.{digits}f}"


def print_notes(*lines: str) -> None:
    """Print notes, warnings or errors.

    Args:
        *lines: The lines, without markup.
    """
    for line in lines:
        print(line, file=sys.stderr)  # a progress bar on the terminal makes room for it


@contextmanager
def working(text: str) -> Iterator[Callable[[str], None]]:
    """Show a spinner on a terminal; the result changes its text.

    Args:
        text: The first text.

    Returns:
        A context manager with a function that shows another text.
    """
    from rich.console import Console

    with Console(stderr=True, highlight=False).status(text) as status:
        yield status.update


def _bar(*before_remaining: str, left: str) -> "Progress":
    from rich import console, progress

    done = "{task.description}", progress.BarColumn(), progress.MofNCompleteColumn(), progress.TimeElapsedColumn()
    errors = console.Console(stderr=True, highlight=False)
    columns = *done, *before_remaining, progress.TimeRemainingColumn(), left
    return progress.Progress(*columns, console=errors, transient=True, speed_estimate_period=600)


@contextmanager
def fit_progress(iterations: int) -> "Iterator[FitCallback]":
    """Show a progress bar on a terminal for a fit of at most `iterations`; the results report to it.

    When a fit converges cannot be known. So the time is the longest that is left, at the pace of the last ten minutes.

    Args:
        iterations: The most iterations of the fit.

    Returns:
        A context manager with a function that reports the progress of the fit.
    """
    with _bar("at most", left="left; {task.fields[state]}") as bar:
        task = bar.add_task("learning", total=iterations, state="compiling")

        def report(progress: "FitProgress | AscentProgress | SweepProgress") -> None:
            bar.update(task, completed=progress.iteration, total=progress.total, state=progress.description)

        yield report


@contextmanager
def stage_progress() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar on a terminal for each stage, with the time that is left of it.

    The size of a later stage is known when it begins, so there is no time for the whole.

    Returns:
        A context manager with a function that reports a stage, the steps that are done, and their number.
    """
    with _bar(left="left") as bar:
        tasks: "dict[str, TaskID]" = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done)

        yield report


def print_scores(rows: Mapping[str, Mapping[str, Any]], columns: Sequence[str] = _MAP_SCORES) -> None:
    """Print a table of scores with a row for each name, or one of a single name with a row for each score.

    Args:
        rows: The numbers of each row by key; a dash stands for None.
        columns: The keys of the columns; by default those of `evaluate`.
    """
    from rich.console import Console
    from rich.table import Table

    names, headings = [*rows], [_HEADINGS.get(key, key) for key in columns]
    numbers = [[scores.get(key) for key in columns] for scores in rows.values()]
    if len(rows) == 1:  # all scores in a row do not fit into a narrow terminal
        names, headings, numbers = [each.replace("\n", " ") for each in headings], names, zip(*numbers, strict=True)
    table = Table("", *headings)
    for name, cells in zip(names, numbers, strict=True):
        table.add_row(name, *("–" if number is None else f"{number:.3f}" for number in cells))
    Console(highlight=False, width=None if sys.stdout.isatty() else 140).print(table)
