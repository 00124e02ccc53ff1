"""Run a benchmark: `python -m benchmarks NAME [options]`, from the repository's root."""

import argparse
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import MISSING, asdict, fields
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

from benchmarks import Record, note
from sidestep._files import read_json, write_json
from sidestep.errors import SidestepError

BENCHMARKS = {
    "startup": "whole processes of the command line, in units of one that imports JAX",
    "scaling": "the cost of a gradient against the size of the map",
    "gradients": "a gradient by the adjoint, beside other ways to it",
    "planning": "plans and soft values, beside other planners",
    "fits": "large maps end to end: hide walls, simulate walks, learn, score",
    "intervals": "how often 95 % intervals of β, a lapse and three logits cover the truth",
    "rollouts": "roll-outs of continuous worlds: speed, and the noise of gradient estimators",
    "wind": "wind in the plane learned by roll-outs from actions, beside its exact posterior",
    "enumeration": "the sampler and the mean field against the exact posterior of small worlds",
    "people": "walls learned from real walks in the twelve Tartarus mazes",
    "baselines": "all methods of `sidestep compare`: walls, held-out actions, robots with new goals",
    "domains": "simulated offices, apartments and blocks, all of them learned: how well, and how well calibrated",
    "risk": "whether plans with risk mean what they say: P(path is open) beside true offices",
    "shapes": "the shape of maps: weights of a binary Markov random field, fitted to true maps",
    "towns": "one-way streets from taxi trips in Shanghai, buildings from drives in MAGELLAN's towns",
    "mutants": "how many small mutations of the source code the tests notice",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark and return the exit code: 0, 1 for data or settings that cannot be used, 2 for wrong usage."""
    names = "\n".join(f"  {name:<10} {text}" for name, text in BENCHMARKS.items())
    raw = argparse.RawDescriptionHelpFormatter
    first = argparse.ArgumentParser(
        prog="python -m benchmarks", description=f"benchmarks:\n{names}", formatter_class=raw
    )
    first.add_argument("name", choices=BENCHMARKS, metavar="NAME", help="a benchmark; NAME --help tells its options")
    first.add_argument("options", nargs=argparse.REMAINDER)
    chosen = first.parse_args(arguments)
    module = import_module(f"benchmarks.{chosen.name}")
    parser = argparse.ArgumentParser(f"{first.prog} {chosen.name}", description=module.__doc__, formatter_class=raw)
    for key, keywords in _arguments(module):
        parser.add_argument(key, **keywords)
    if parser.parse_args(chosen.options).quick:
        quick = {each.name: each.metadata["quick"] for each in fields(module.Options)}
        parser.set_defaults(**{name: value for name, value in quick.items() if value is not None})
    try:
        return run(module, parser.parse_args(chosen.options), parser)
    except SidestepError as error:
        note(f"error: {error}")
        return 1


def run(module: Any, parsed: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Measure (or read records), print, draw and write what is asked for."""
    values = vars(parsed)
    for each in fields(module.Options):
        numbers = values[each.name] if isinstance(values[each.name], list) else [values[each.name]]
        if any(type(number) is int and number < each.metadata["least"] for number in numbers):
            parser.error(f"--{each.name.replace('_', '-')}: expected at least {each.metadata['least']}")
    options = module.Options(**{each.name: values[each.name] for each in fields(module.Options)})
    records: list[Record] = []
    if parsed.records:
        records = read_json(parsed.records)["records"]
    else:
        import jax

        jax.config.update("jax_enable_x64", True)
        for record in module.measure(options):
            records.append(record)
            if parsed.json:
                settings = {key: _plain(value) for key, value in asdict(options).items()}
                write_json(parsed.json, {"settings": settings, "machine": _machine(), "records": records})
    module.show(records, options)
    if parsed.picture:
        module.draw(records, options).savefig(parsed.picture, dpi=120)
    return 0


def _arguments(module: Any) -> list[tuple[str, dict[str, Any]]]:
    """Return the options that all benchmarks have, and those of a module's `Options`."""
    arguments: list[tuple[str, dict[str, Any]]] = [
        ("--json", {"type": Path, "metavar": "FILE", "help": "write the records"}),
        ("--from", {"type": Path, "metavar": "FILE", "dest": "records", "help": "show records that --json wrote"}),
        ("--quick", {"action": "store_true", "help": "a small part only, in about a minute"}),
    ]
    about = "draw a picture" if hasattr(module, "draw") else argparse.SUPPRESS
    arguments.append(("--picture", {"type": Path, "metavar": "FILE", "help": about}))
    hints = get_type_hints(module.Options)
    for each in fields(module.Options):
        assert each.default_factory is not MISSING
        default, hint = each.default_factory(), hints[each.name]
        kind = next((kind for kind in get_args(hint) if kind is not NoneType), hint)
        about = f"{each.metadata['help']} (default: {_plain(default)})"
        keywords: dict[str, Any] = {"help": about, "default": default, "action": "store_true"}
        if hint is not bool:
            choices, many = each.metadata["choices"], isinstance(default, list)
            keywords |= {"action": "store", "type": kind, "choices": choices, "nargs": "*" if many else None}
            keywords |= {} if choices else {"metavar": kind.__name__.upper()}
        arguments.append((f"--{each.name.replace('_', '-')}", keywords))
    return arguments


def _machine() -> Record:
    import jax
    import numpy as np

    device, cores = jax.devices()[0].device_kind, os.cpu_count()
    versions = {"python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__}
    return {"device": device, "processor": platform.machine(), "cores": cores, **versions}


def _plain(setting: Any) -> Any:
    """Return a setting as JSON has it: paths as text, in lists too."""
    if isinstance(setting, Path):
        return str(setting)
    return [_plain(each) for each in setting] if isinstance(setting, list) else setting


if __name__ == "__main__":
    sys.exit(main())
