"""What the command line shows: progress while it works, tables when it has; errors and progress on standard error."""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from sidestep.inference.maximize import Progress as FitProgress

console = Console(highlight=False, width=None if sys.stdout.isatty() else 140)
errors = Console(stderr=True, highlight=False)


@contextmanager
def working(text: str) -> Iterator[Callable[[str], None]]:
    """A spinner on a terminal, with a text that can be changed."""
    with errors.status(text) as status:
        yield status.update


@contextmanager
def fitting(iterations: int) -> Iterator[tuple[Callable[[FitProgress], None], Callable[[str], None]]]:
    """A progress bar on a terminal for a fit of at most `iterations`, how long these would take, and what comes before.

    When a fit converges cannot be known; so the time is the longest that is left, at the pace of the last ten minutes.
    """
    columns = (
        TextColumn("learning"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("at most"),
        TimeRemainingColumn(),
        TextColumn("left; {task.fields[state]}"),
    )
    with Progress(*columns, console=errors, transient=True, speed_estimate_period=600) as bar:
        task = bar.add_task("learning", total=iterations, state="compiling")

        def report(progress: FitProgress) -> None:
            state = f"objective {progress.objective:.3f}, largest gradient {progress.gradient:.2g}"
            bar.update(task, completed=progress.iteration, state=state)

        yield report, lambda text: bar.update(task, state=text)


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar on a terminal for each stage of a work, with the time that is left of it.

    How much a later stage has to do is known when it begins; so no time is told for the whole.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(*columns, console=errors, transient=True, speed_estimate_period=600) as bar:
        begun: dict[str, TaskID] = {}

        def report(stage: str, done: int, of: int) -> None:
            if stage not in begun:
                begun[stage] = bar.add_task(stage, total=of)
            bar.update(begun[stage], completed=done)

        yield report


def print_scores(rows: Mapping[str, Mapping[str, Any]]) -> None:
    """The scores of learned maps by name, those of `evaluate`, as a table."""
    columns = {
        "auc": "AUC",
        "average_precision": "average\nprecision",
        "auc_relevant": "AUC of those\nthat matter",
        "recall": "recall",
        "mean_obstacle": "mean on\nobstacles",
        "mean_free": "mean on\nfree cells",
        "max_probability": "highest",
        "legal_fraction": "legal\npaths",
        "excess_length": "excess\nlength",
        "regret": "regret",
    }
    print_table(rows, columns)


def print_table(rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]) -> None:
    """A table of a row for each name; `columns` are the numbers' keys and headings, and what is missing is a dash."""
    table = Table("", *columns.values())
    for name, scores in rows.items():
        cells = (scores.get(key) for key in columns)
        table.add_row(name, *("–" if number is None else f"{number:.3f}" for number in cells))
    console.print(table)
