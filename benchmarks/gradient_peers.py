"""What a gradient costs: the adjoint by either solver, beside other ways to the same gradient.

    python benchmarks/gradient_peers.py
    python benchmarks/gradient_peers.py --sizes 16 32 --backups logsumexp --gradient fixed_policy
    python benchmarks/gradient_peers.py --beta 10 --discount 0.95 --goal-pays
    python benchmarks/gradient_peers.py --discount 0.99

On offices whose walls are nearly certain (`worlds.py`) and one task, these compute the gradient of ten walkers' action
log-likelihood with respect to all parameters, their values included:

- **sidestep ordered**, **sidestep jacobi**: the adjoint, as a fit computes it; cold from nothing, warm after a step of
  an optimiser from what the solve before left (see `scaling.py`);
- **unrolled**: JAX's reverse-mode differentiation through plain value iteration, which keeps every sweep in memory;
- **dense implicit**: the values of `sidestep ordered`, and the adjoint from `jnp.linalg.solve` of the dense Jacobian;
- **optimistix**: `optimistix.fixed_point` of one plain backup with its default `ImplicitAdjoint`, which builds that
  Jacobian too; where optimistix is installed (`pip install optimistix`; it is not a dependency);
- **forward**: the paper's dynamic programme (eq. 7 with eq. 8, or with eq. 9 for `--gradient fixed_policy`), iterated
  on an array of states × parameters, from values by `sidestep ordered`.

and **values** is the value solve of `sidestep ordered` alone, **plain values** that by plain sweeps.

With `--models cells table` each map is given twice, as an obstacle grid (a parameter a cell) and as a table (a
parameter for every outcome of every state and action) with the same probabilities, to show what the number of
parameters does.

All get the same tolerance, the relative change at which their iterations stop; plain sweeps go on until the gradient is
within `--accuracy` of the exact one (by `sidestep ordered` at a tolerance of 1e-12, or as small as it gets). All
differences are shown, those of this project too. A method that would need more than `--memory` is not run, and the
table says so; one that takes longer than `--patience` is timed once and not tried on larger maps. Memory is measured
for the first backup, on maps of `--memory-sizes`.

Records (`--json`): `name`, `model`, `backup`, `cells`, `parameters`, `tasks`, `cold_seconds`, `warm_seconds` (null
where there is no warm start), `dijkstra_seconds` (medians), `best_seconds`, `ratio` (to `sidestep ordered`, cold, in
the same turn: above 1 means slower than ours), `difference` (from the exact gradient, relative to its largest
component), `sweeps` (of the values, or of plain iterations), `compiled_bytes` (what XLA sets aside), `compile_seconds`,
`turns`, `peak_bytes`, `imports_bytes`, `excess_bytes` (of a process of its own, compiler included), `call_bytes` (the
peak of one call there beyond what was held when it began), `failed` (null, or why it was not run).
"""

import argparse
import importlib
import importlib.util
import json
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.sparse.csgraph import dijkstra

import measuring
from gradient_methods import MOST_SWEEPS, ONLY_VALUES, OTHERS, Found, method_function, problem_of
from scaling import Problem, stepped, take
from sidestep.errors import NotConverged
from sidestep.tabular.backups import BACKUPS
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from worlds import World, expected_costs, half_learned_office, load

EXACT = (1e-12, 1e-11, 1e-10)
"""Tolerances of what counts as exact: the first that is reached. The Boltzmann average may waver below 1e-10."""


# ---------------------------------------------------------------------------------------------------- measuring


@dataclass
class Method:
    """A compiled way to compute something, and what it took; `call` is None if it is not to be run."""

    name: str
    call: Callable[[], Found] | None = None
    warm: Callable[[], Any] | None = None
    compile_seconds: float = 0.0
    bytes: int = 0
    sweeps: int = 0
    difference: float | None = None
    failed: str | None = None
    first_seconds: float = 0.0


def compiled(name: str, problem: Problem, limit: float = np.inf, sweeps: int = 0) -> Method:
    """A method on a problem, compiled; not to be run above `limit` bytes.

    All arrays are inputs, so that nothing of them is computed while compiling.
    """
    function, problem = method_function(name, problem, sweeps)
    arrays, static = eqx.partition(problem, eqx.is_array)
    started = time.perf_counter()
    whole = jax.jit(lambda arrays, parameters: function(eqx.combine(arrays, static), parameters))
    made = whole.lower(arrays, problem.model.parameters).compile()
    seconds = time.perf_counter() - started
    memory = made.memory_analysis()
    assert memory is not None
    needed = memory.temp_size_in_bytes + memory.output_size_in_bytes
    if needed > limit:
        return Method(name, None, None, seconds, needed, failed=f"needs {needed / 2**30:.1f} GiB")
    call = partial(lambda given: jax.block_until_ready(made(given, problem.model.parameters)), arrays)
    return Method(name, call, None, seconds, needed, sweeps)


def checked(method: Method, exact: Array) -> Method:
    """Runs a method once, for its sweeps and how far its gradient is from the exact one."""
    if method.call is not None:
        started = time.perf_counter()
        found, sweeps = method.call()
        method.first_seconds = time.perf_counter() - started
        method.sweeps = int(sweeps)
        if method.name not in ONLY_VALUES:
            method.difference = difference(found, exact)
    return method


def enough_sweeps(problem: Problem, exact: Array, limit: float, arguments: argparse.Namespace) -> tuple[Method, Method]:
    """Plain values and their unrolled gradient, by about as few sweeps as make it accurate, or as many as may be."""
    sweeps = round(4 * problem.model.graph.states**0.5)
    method = checked(compiled("unrolled", problem, limit, sweeps), exact)
    while method.call is not None and sweeps < MOST_SWEEPS and method.first_seconds <= arguments.patience:
        if method.difference is not None and method.difference <= arguments.accuracy:
            break
        sweeps = min(MOST_SWEEPS, int(1.3 * sweeps) + 1)
        more = checked(compiled("unrolled", problem, limit, sweeps), exact)
        if more.call is None:
            break
        method = more
    return checked(compiled("plain values", problem, limit, method.sweeps or sweeps), exact), method


def difference(found: Array, expected: Array) -> float | None:
    """The largest difference, relative to the largest component; None for what is not finite."""
    value = float(jnp.abs(found - expected).max() / jnp.abs(expected).max())
    return value if np.isfinite(value) else None


def exact_gradient(problem: Problem) -> Array:
    """The gradient by `sidestep ordered` at a tolerance as small as is reached; raises `NotConverged` if none is."""
    for tolerance in EXACT:
        solver = GaussSeidel(tolerance=tolerance, max_sweeps=1_000)
        strict = eqx.tree_at(lambda p: p.solver, problem, solver)
        cold = problem.cold_start()
        found = take(strict, problem.model.parameters, cold, cold.region)
        if bool(found.converged):
            return found.gradient
    raise NotConverged("the values or the adjoint did not converge: try a smaller β or another backup")


def methods_for(problem: Problem, slow: Collection[str], arguments: argparse.Namespace) -> list[Method]:
    """All methods for a problem, compiled, run once and compared; raises `NotConverged` if values are not found.

    Those in `slow`, which took too long on a smaller map, are left out.
    """
    limit = arguments.memory * 2**30
    exact = exact_gradient(problem)
    names = ["sidestep ordered", "sidestep jacobi", "values"]
    found = [with_warm(checked(compiled(name, problem), exact), problem, arguments) for name in names]
    found += enough_sweeps(problem, exact, limit, arguments)
    states, count = problem.model.graph.states, int(np.size(problem.model.parameters))
    for name in ("dense implicit", "optimistix", "forward"):
        # a Jacobian of plain backups, or an array of states × parameters
        least = 8 * states * (count if name == "forward" else states)
        if name == "optimistix" and importlib.util.find_spec("optimistix") is None:
            found.append(Method(name, failed="not installed"))
        elif name in slow:
            found.append(Method(name, bytes=least, failed=f"over {arguments.patience:g} s before"))
        elif name == "forward" and states * count > arguments.forward_limit:
            found.append(Method(name, bytes=least, failed=f"{states * count:.0e} numbers"))
        else:
            found.append(checked(compiled(name, problem, limit), exact))
    return found


def with_warm(method: Method, problem: Problem, arguments: argparse.Namespace) -> Method:
    """A method of this project with its warm start: after a step, from what the solve before left."""
    if method.name in ONLY_VALUES:
        return method
    problem = method_function(method.name, problem, 0)[1]
    cold = problem.cold_start()
    first = take(problem, problem.model.parameters, cold, cold.region)
    at = stepped(problem.model.parameters, first.gradient, arguments)
    at, start = jax.block_until_ready((at, first.start))
    if bool(take(problem, at, start, cold.region).converged):
        method.warm = lambda: jax.block_until_ready(take(problem, at, start, cold.region))
    return method


def measure(
    world: World, saved: Path, model: str, backup: str, slow: set[str], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """The records of one map in one parametrisation, a record a method; adds to `slow` what takes too long."""
    problem = problem_of(world, model, backup, arguments)
    methods = methods_for(problem, slow, arguments)
    slow |= {method.name for method in methods if method.name in OTHERS and method.first_seconds > arguments.patience}
    moves, goal = expected_costs(world.model), int(world.goals[0])
    calls: dict[str, Callable[[], float]] = {
        "dijkstra": lambda: measuring.seconds_of(lambda: dijkstra(moves, indices=goal))
    }
    for method in methods:
        for name, call in ((method.name, method.call), (f"warm {method.name}", method.warm)):
            if call is not None and method.name not in slow:
                calls[name] = partial(measuring.seconds_of, call)
    taken = measuring.in_turns(calls, arguments.turns, arguments.budget)
    taken |= {method.name: [method.first_seconds] for method in methods if method.call and method.name in slow}
    ours = taken["sidestep ordered"]
    return [
        {
            "name": method.name,
            "model": model,
            "backup": backup,
            "cells": world.size**2,
            "parameters": int(np.size(problem.model.parameters)),
            "tasks": 1,
            "cold_seconds": measuring.median(own := taken.get(method.name)),
            "warm_seconds": measuring.median(taken.get(f"warm {method.name}")),
            "dijkstra_seconds": measuring.median(taken["dijkstra"]),
            "best_seconds": min(own) if own else None,
            "ratio": measuring.median([mine / our for mine, our in zip(own or [], ours, strict=False)]),
            "difference": method.difference,
            "sweeps": method.sweeps,
            "compiled_bytes": method.bytes,
            "compile_seconds": method.compile_seconds,
            "turns": len(own or []),
            **_memory(method, world.size, saved, model, backup, arguments),
            "failed": method.failed,
        }
        for method in methods
    ]


def _memory(
    method: Method, size: int, saved: Path, model: str, backup: str, arguments: argparse.Namespace
) -> dict[str, Any]:
    """The memory of a process of its own, for the first backup and the sizes that it is asked for."""
    nothing: dict[str, Any] = dict.fromkeys(("peak_bytes", "imports_bytes", "excess_bytes", "call_bytes"))
    if (
        method.call is None
        or method.first_seconds > arguments.patience
        or backup != arguments.backups[0]
        or size not in arguments.memory_sizes
    ):
        return nothing
    told = {key: value for key, value in vars(arguments).items() if isinstance(value, (int, float, str))}
    asked = {**told, "world": str(saved), "name": method.name, "model": model, "backup": backup}
    return (
        measuring.in_own_process(__file__, "--measure-memory", json.dumps({**asked, "sweeps": method.sweeps}))
        or nothing
    )


def measure_memory(asked: str, imports: int) -> None:
    """Takes one gradient in this process and prints what it needed."""
    given = json.loads(asked)
    problem = problem_of(load(Path(given["world"])), given["model"], given["backup"], argparse.Namespace(**given))
    method = compiled(given["name"], problem, sweeps=given["sweeps"])
    assert method.call is not None
    before, peak = measuring.held_bytes(), measuring.peak_bytes()
    known = measuring.reset_peak()
    method.call()
    calling = measuring.peak_bytes()
    peak = max(peak, calling)
    found = {"peak_bytes": peak, "imports_bytes": imports, "excess_bytes": peak - imports}
    print(json.dumps({**found, "call_bytes": calling - before if known else None}))


# ---------------------------------------------------------------------------------------------------- reporting


def print_records(records: Sequence[Mapping[str, Any]], arguments: argparse.Namespace) -> None:
    """The table, and which of the others are faster or disagree."""
    columns = ("map", "θ", "backup", "method", "cold ms", "best ms", "ratio to ours", "warm ms")
    columns += ("sweeps", "difference", "peak MiB", "call MiB")
    rows = [
        (
            f"{round(record['cells'] ** 0.5)}²",
            f"{record['parameters']} {record['model']}",
            record["backup"],
            record["name"],
            record["failed"] or measuring.milliseconds(record["cold_seconds"]),
            measuring.milliseconds(record["best_seconds"]),
            measuring.number(record["ratio"], ".2f"),
            measuring.milliseconds(record["warm_seconds"]),
            str(record["sweeps"] or "–"),
            measuring.number(record["difference"], ".0e"),
            measuring.mebibytes(record["peak_bytes"]),
            measuring.mebibytes(record["call_bytes"]),
        )
        for record in records
    ]
    reward = "goal pays 1" if arguments.goal_pays else f"step cost {arguments.step_cost:g}"
    title = f"a gradient ({arguments.gradient}), β={arguments.beta:g}, γ={arguments.discount:g}, {reward}, "
    measuring.print_table(title + f"tolerance {arguments.tolerance:g}", columns, rows, left=("backup", "method"))
    others = [record for record in records if record["name"] in OTHERS]
    for record in records:
        where = f"{record['name']} ({round(record['cells'] ** 0.5)}², {record['backup']}, {record['model']})"
        if record in others and record["ratio"] is not None and record["ratio"] < 1:
            print(f"faster than ours: {where}, {record['ratio']:.2f} of our time")
        off = np.inf if record["difference"] is None else record["difference"]
        if record["name"] not in ONLY_VALUES and record["ratio"] is not None and off > arguments.accuracy:
            print(f"not within {arguments.accuracy:g}: {where}, {off:.1e}")
    timed = [record for record in others if record["ratio"] is not None]
    slower = sum(record["ratio"] >= 1 for record in timed)
    print(f"{slower} of {len(timed)} other gradients were slower than ours on the same map")


def _arguments() -> argparse.Namespace:
    parser = measuring.argument_parser(
        "The cost of a gradient, by many ways to it.", "24² only, the Boltzmann average, three turns, no memory"
    )
    add = parser.add_argument
    add("--sizes", type=int, nargs="+", default=[16, 32, 64, 128], metavar="N", help="N × N cells (10 or more)")
    add("--backups", nargs="+", choices=sorted(BACKUPS), default=["boltzmann", "logsumexp"])
    add("--models", nargs="+", choices=("cells", "table"), default=["cells"], help="what the parameters are")
    add("--gradient", choices=("exact", "fixed_policy"), default="exact")
    add("--beta", type=float, default=5.0, help="how sharply walkers choose")
    add("--discount", type=float, default=0.9999)
    add("--step-cost", type=float, default=1.0, help="a cost for every move")
    add("--goal-pays", action="store_true", help="no cost for moves; the goal pays 1")
    add("--tolerance", type=float, default=1e-8, help="relative change at which iterations stop")
    add("--accuracy", type=float, default=1e-6, help="how far the unrolled gradient may be from the exact one")
    add("--step", type=float, default=0.1, help="the optimiser's step before a warm gradient, in logits")
    add("--step-by-sign", action="store_true", help="the same step for every parameter, as Adam's first")
    add("--turns", type=int, default=9, help="how often each method is timed")
    add("--budget", type=float, default=4.0, help="seconds after which a method takes no more than three turns")
    add(
        "--patience",
        type=float,
        default=5.0,
        help="seconds after which a method is timed but once",
    )
    add("--memory", type=float, default=4.0, help="GiB above which a method is not run")
    add("--forward-limit", type=int, default=2**21, help="largest states × parameters for the forward programme")
    add("--memory-sizes", type=int, nargs="*", default=[64, 128], metavar="N", help="maps to measure the memory of")
    add("--seed", type=int, default=0, help="draws maps, walks and parameters")
    add("--measure-memory", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.sizes, arguments.models, arguments.backups = [24], ["cells"], ["boltzmann"]
        arguments.turns, arguments.budget, arguments.memory_sizes = 3, 1.0, []
    if arguments.turns < 1:
        parser.error("--turns: expected a number above 0")
    return arguments


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes what the arguments ask for."""
    records = []
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "world.npz"
        slow: dict[tuple[str, str], set[str]] = {}
        for size in sorted(arguments.sizes):
            world = half_learned_office(size, arguments.seed)
            world.save(saved)
            for backup in arguments.backups:
                for model in arguments.models:
                    records += measure(world, saved, model, backup, slow.setdefault((backup, model), set()), arguments)
                    measuring.write_records(arguments, records)
                    measuring.note(f"{size}² {backup} {model} done")
    print_records(records, arguments)


if __name__ == "__main__":
    imports_bytes = measuring.held_bytes()
    options = _arguments()
    if options.measure_memory:
        jax.config.update("jax_enable_x64", True)
        measure_memory(options.measure_memory, imports_bytes)
    else:
        sys.exit(measuring.main(run, options))
