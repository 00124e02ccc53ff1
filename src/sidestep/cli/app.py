"""The command line: its commands, their preparation, and their errors."""

import gc
import os
import sys
import traceback
from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import Annotated, Any

import typer

from sidestep.cli import experiments
from sidestep.cli.compare import compare
from sidestep.cli.evaluate import evaluate
from sidestep.cli.learn import learn
from sidestep.cli.options import present_spelling
from sidestep.cli.plan import plan
from sidestep.cli.simulate import simulate
from sidestep.errors import SidestepError

app = typer.Typer(
    help="Learn obstacles that no walk touched from walks of people that know them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
_EXAMPLES: dict[Callable[..., None], str] = {
    experiments.demo: "sidestep demo --out demo",
    learn: "sidestep learn walks.csv --map office.yaml --out learned",
    plan: "sidestep plan learned --start 3.5,1.5 --goal 5.5,7.5",
    evaluate: "sidestep evaluate learned --true-map truth.yaml",
    compare: "sidestep compare walks.csv --map office.yaml --true-map truth.yaml --out compared",
    simulate: "sidestep simulate truth.yaml --out walks.csv --walks 200 --goals 6",
    experiments.reproduce: "sidestep reproduce --out figures",
    experiments.experiment: "sidestep experiment room --out room",
}
_DRAWING = (learn, plan, evaluate)
"""The commands that draw a single picture."""
_INTERRUPTED = 130
"""The exit code that typer gives a keyboard interrupt."""


def _prepared(command: Callable[..., None]) -> Callable[..., None]:
    """Let the process compute in 64 bits and keep compiled code before a command runs, and from then on."""

    @wraps(command)
    def run(**values: Any) -> None:
        from sidestep.cli.drawing import prepared_drawing

        with prepared_drawing() if command in _DRAWING else nullcontext():
            import jax

            from sidestep._cache import keep_compiled_code

            jax.config.update("jax_enable_x64", True)
            keep_compiled_code()
            command(**values)

    return run


for _command, _example in _EXAMPLES.items():
    app.command(name=_command.__name__, epilog=f"Example: {_example}")(_prepared(_command))


def _print_version(wanted: bool) -> bool:
    if wanted:
        from sidestep._version import __version__

        typer.echo(__version__)
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    del version


def run_process() -> int:
    """Run the command line as a process of its own; return its exit code.

    A search for garbage visits all that the imported libraries hold, and finds nothing there. So there are fewer
    searches, and none at the end (`gc.freeze`). `python -m benchmarks startup` shows the time of whole processes.
    """
    gc.set_threshold(50_000)
    code = main()
    gc.freeze()
    return code


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: The arguments; by default those of the process.

    Returns:
        The exit code: 0, 1 for an error, 2 for wrong usage.
    """
    arguments = present_spelling(sys.argv[1:] if arguments is None else arguments)
    try:
        app(args=arguments, prog_name="sidestep", standalone_mode=True)
        return 0
    except SystemExit as stop:
        if stop.code != _INTERRUPTED:
            return stop.code if isinstance(stop.code, int) else 1
        message = "interrupted (`learn` and `compare` continue with --resume where there is a checkpoint)"
    except SidestepError as error:
        message = f"error: {error}"
    except Exception as error:
        # a defect of the program: one line, and the details on request
        if os.environ.get("SIDESTEP_DEBUG"):
            traceback.print_exc()
        cause = f"{type(error).__name__}: {error}"
        message = f"error: sidestep failed ({cause}); set SIDESTEP_DEBUG=1 for details to report"
    from sidestep.cli.display import print_notes

    print_notes(message)
    return 1
