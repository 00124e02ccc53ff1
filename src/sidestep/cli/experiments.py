"""`sidestep demo`, `sidestep reproduce` and `sidestep experiment`: the demonstration and the experiments."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import typer

from sidestep.cli.options import Folder, Seed

Experiment = Literal["room", "pendulum", "representations", "motivation", "calibration"]
_EXPERIMENT_HELP = (
    "room: a wall that no walk touches; pendulum: gravity from actions alone; representations: three models of the "
    "room; motivation: costs of cells against a transition model, when the reward changes; calibration: ranks of true "
    "maps among sampled ones."
)


def demo(out: Folder = Path("sidestep-demo"), seed: Seed = 0) -> None:
    """Simulate agents in an office, learn its map from their walks alone, plan to new goals, and draw it all."""
    from sidestep.cli.display import print_lines, print_scores, working
    from sidestep.experiments.demo import demo

    with working("simulating, learning, planning") as notify:
        summary = demo(out, seed, notify)
    print_scores({"learned map": summary["scores"]})
    print_lines(f"pictures and numbers in {out}")


def reproduce(out: Folder = Path("sidestep-reproduce"), seed: Seed = 0) -> None:
    """Reproduce the paper's figures 1-4 as PNG, and the numbers behind them."""
    from sidestep.cli.display import ROW_SCORES, print_lines, print_scores, working
    from sidestep.experiments.reproduce import reproduce

    with working("starting") as notify:
        summary = reproduce(out, seed, notify)
    rows = {f"{name} {way}": scores for name, ways in summary["maps"].items() for way, scores in ways.items()}
    print_scores(rows, ROW_SCORES)
    print_lines(f"figures and numbers in {out}")


def experiment(
    name: Annotated[Experiment, typer.Argument(help=_EXPERIMENT_HELP)],
    out: Annotated[Path | None, typer.Option("--out", help="The folder to write to.", metavar="DIR")] = None,
    seed: Seed = 0,
    size: Annotated[
        list[str] | None,
        typer.Option(help="A size of the experiment, such as maps=20; repeat it for several.", metavar="NAME=NUMBER"),
    ] = None,
) -> None:
    """Run an experiment beyond the paper's figures: a picture and summary.json."""
    from sidestep.cli.display import print_lines, print_scores, working

    out = out or Path(f"sidestep-{name}")
    with working("starting") as notify:
        run = import_module(f"sidestep.experiments.{name}").run
        summary = run(out, seed, notify, config_of(run, size or ()))
    for key, value in summary.items():
        if isinstance(value, float | int | str) and key != "command":
            text = f"{value:.4g}" if isinstance(value, float) else value
            print_lines(f"{key.replace('_', ' ')}: {text}")
    if table := summary.get("table"):
        print_scores(table, [*next(iter(table.values()))])
    print_lines(f"picture and numbers in {out}")


def config_of(run: Callable[..., Any], sizes: Sequence[str]) -> Any:
    """Return the configuration of an experiment with other sizes, the whole numbers among its fields.

    Args:
        run: The experiment, with a parameter `config`.
        sizes: Each as NAME=NUMBER.

    Raises:
        BadParameter: For a size that the experiment does not have, and for what is no whole number.
    """
    record = get_args(get_type_hints(run)["config"])[0]
    names = [each.name for each in fields(record) if each.type is int]
    values = {}
    for text in sizes:
        name, _, number = text.partition("=")
        if name not in names or not number.isdecimal():
            expected = ", ".join(names)
            raise typer.BadParameter(
                f"expected one of {expected}, =, and a number, found {text!r}", param_hint="--size"
            )
        values[name] = int(number)
    return record(**values)
