"""Planning beside other projects' planners: the same problem, the same accuracy, answers compared.

    python -m venv peers && peers/bin/pip install quantecon mdpsolver imitation
    python benchmarks/planning_peers.py --peers-python peers/bin/python

None of the other projects is a dependency of this one: they run in a process of their own, by the Python that
`--peers-python` names. All take turns in one run.

- **Hard max** (best plan): `sidestep.plan` by either solver, against QuantEcon's `DiscreteDP` (sparse; value, policy
  and modified policy iteration) and mdpsolver (the same three; with `gs` its Gauss–Seidel updates).
- **Log-sum-exp** (soft values): `sidestep.solve`, to the fixed point and with a finite horizon, against `imitation`'s
  `mce_partition_fh`, which has a finite horizon and dense transitions, so maps are small. The horizon is one after
  which values differ from the fixed point by no more than `--accuracy`.

The maps are offices with P(blocked) about .98 on walls and .02 elsewhere, one goal, a step cost of 1, γ = .99. Each
method stops by a rule of its own; each gets the loosest tolerance, of powers of ten, with which its values come within
`--accuracy` of the exact ones, relative to each value. The exact ones are the sparse linear solve of the best policy,
whose Bellman residual is checked. Only a library's solving call is timed, not the making of its matrices; for this
project everything is, from the map's parameters to the plan.

Memory is the peak of a process of its own that builds and solves the problem once; for the largest map of each kind.

Records (`--json`): `name` (method), `project`, `backup`, `cells`, `tasks`, `cold_seconds` (median; all start from
nothing), `best_seconds`, `warm_seconds` (null), `dijkstra_seconds`, `ratio` (to the fastest of this project: above 1
means slower than ours), `difference` (largest, relative to each value), `tolerance`, `horizon`, `turns`, `peak_bytes`
(whole process), `imports_bytes` (held after imports), `excess_bytes`, `failed` (null, or why there is no time).
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.sparse.csgraph import dijkstra

import measuring
from peer_process import Peers
from planning_problem import Problem, difference, exact_hard, exact_soft, own_call
from sidestep.errors import InputError, SidestepError
from worlds import expected_costs, half_learned_office, load

HERE = Path(__file__).parent
PROJECTS = ("quantecon", "mdpsolver", "imitation")
HOW_TO = "python -m venv peers && peers/bin/pip install quantecon mdpsolver imitation"
TOLERANCES = tuple(10.0**-power for power in range(2, 14))
HARD_PEERS = (
    "quantecon policies",
    "quantecon modified",
    "quantecon values",
    "mdpsolver modified gs",
    "mdpsolver modified serial",
    "mdpsolver modified",
    "mdpsolver values",
    "mdpsolver policies",
)
SOFT_PEERS = ("imitation finite horizon",)
HARD_OURS = ("sidestep ordered", "sidestep jacobi")
SOFT_OURS = ("sidestep ordered", "sidestep jacobi", "sidestep finite horizon")
WITHOUT_TOLERANCE = ("quantecon policies", "imitation finite horizon", "sidestep finite horizon")


# ---------------------------------------------------------------------------------------------------- the methods


@dataclass
class Method:
    """How one method is run on a problem, and what came of it."""

    name: str
    solve: Callable[[float, int], tuple[float, np.ndarray]]  # tolerance and horizon to seconds and values
    tolerance: float | None = None
    horizon: int = 0
    difference: float | None = None
    failed: str | None = None

    def tune(self, exact: np.ndarray, accuracy: float, horizon: int, patience: float) -> None:
        """Finds the loosest tolerance with which the values are accurate; notes why there is none."""
        self.horizon = horizon
        spent = 0.0
        try:
            for tolerance in TOLERANCES:
                seconds, values = self.solve(tolerance, horizon)
                spent += seconds
                self.tolerance, self.difference = tolerance, difference(values, exact)
                if self.difference <= accuracy:
                    return
                if self.name in WITHOUT_TOLERANCE or spent > patience:
                    break
            self.failed = f"not within {accuracy:g}: {self.difference:.1e}"
        except SidestepError as error:
            self.failed = str(error)

    def seconds(self) -> float:
        """One timed solve."""
        return self.solve(self.tolerance or TOLERANCES[-1], self.horizon)[0]


def methods_for(problem: Problem, soft: bool, peers: Peers, known: Mapping[str, str]) -> list[Method]:
    """This project's methods and those of the others that are there."""

    def own(name: str, tolerance: float, horizon: int) -> tuple[float, np.ndarray]:
        call = own_call(problem, name, soft, tolerance, horizon)
        started = time.perf_counter()
        values = call()
        return time.perf_counter() - started, values

    ours, others = (SOFT_OURS, SOFT_PEERS) if soft else (HARD_OURS, HARD_PEERS)
    found = [Method(name, partial(own, name)) for name in ours]
    return found + [Method(name, partial(peers.solve, name)) for name in others if name.split()[0] in known]


# ---------------------------------------------------------------------------------------------------- measuring


def long_enough(problem: Problem, exact: np.ndarray, accuracy: float) -> int:
    """A horizon after which the values are as accurate as is asked."""
    horizon = 4 * problem.world.size
    while difference(own_call(problem, "sidestep finite horizon", True, 0, horizon)(), exact) > accuracy:
        horizon = int(1.25 * horizon)
    return horizon


def measure(
    problem: Problem, soft: bool, peers: Peers, known: Mapping[str, str], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """The records of one problem, a record a method."""
    exact = exact_soft(problem) if soft else exact_hard(problem)
    horizon = long_enough(problem, exact, arguments.accuracy) if soft else 0
    with tempfile.TemporaryDirectory() as folder:
        arrays, world = Path(folder) / "problem.npz", Path(folder) / "world.npz"
        np.savez(arrays, allow_pickle=False, **problem.arrays())
        problem.world.save(world)
        peers.load(arrays)
        methods = methods_for(problem, soft, peers, known)
        for method in methods:
            method.tune(exact, arguments.accuracy, horizon, arguments.patience)
        moves, goal = expected_costs(problem.model), int(problem.world.goals[0])
        calls = {"dijkstra": lambda: measuring.seconds_of(lambda: dijkstra(moves, indices=goal))}
        calls |= {method.name: method.seconds for method in methods if not method.failed}
        taken = measuring.in_turns(calls, arguments.turns, arguments.budget)
        memory = {
            method.name: _memory(method, problem.world.size, soft, arrays, world, arguments) for method in methods
        }
    ours = [np.median(taken[method.name]) for method in methods if _own(method) and method.name in taken]
    return [
        {
            "name": method.name,
            "project": method.name.split()[0],
            "version": known.get(method.name.split()[0]),
            "backup": "logsumexp" if soft else "max",
            "cells": problem.world.size**2,
            "tasks": 1,
            "cold_seconds": (median := measuring.median(taken.get(method.name))),
            "best_seconds": min(taken[method.name]) if method.name in taken else None,
            "warm_seconds": None,
            "dijkstra_seconds": measuring.median(taken["dijkstra"]),
            "ratio": median / min(ours) if median and ours else None,
            "difference": method.difference,
            "tolerance": None if method.name in WITHOUT_TOLERANCE else method.tolerance,
            "horizon": horizon if "finite" in method.name else None,
            "turns": len(taken.get(method.name, [])),
            **memory[method.name],
            "failed": method.failed,
        }
        for method in methods
    ]


def _own(method: Method) -> bool:
    return method.name.startswith("sidestep")


def _memory(
    method: Method, size: int, soft: bool, arrays: Path, world: Path, arguments: argparse.Namespace
) -> dict[str, Any]:
    """The memory of a process of its own."""
    nothing: dict[str, Any] = dict.fromkeys(("peak_bytes", "imports_bytes", "excess_bytes"))
    largest = max(arguments.soft_sizes if soft else arguments.sizes)
    if method.failed or arguments.no_memory or size < largest:
        return nothing
    asked = {"name": method.name, "tolerance": method.tolerance, "horizon": method.horizon, "soft": soft}
    if _own(method):
        asked |= {"world": str(world), "discount": arguments.discount, "beta": arguments.beta}
        return measuring.in_own_process(__file__, "--measure-memory", json.dumps(asked)) or nothing
    peers = Peers(arguments.peers_python, arguments.patience)
    try:
        peers.load(arrays)
        peers.solve(method.name, asked["tolerance"], asked["horizon"])
        found = peers.ask(do="memory")
    except SidestepError as error:
        measuring.complain(f"memory of {method.name} was not measured: {error}")
        return nothing
    finally:
        peers.close()
    return {**found, "excess_bytes": found["peak_bytes"] - found["imports_bytes"]}


def measure_memory(asked: str, imports: int) -> None:
    """Solves once in this process and prints what it needed."""
    given = json.loads(asked)
    problem = Problem(load(Path(given["world"])), given["discount"], given["beta"])
    own_call(problem, given["name"], given["soft"], given["tolerance"], given["horizon"])()
    peak = measuring.peak_bytes()
    print(json.dumps({"peak_bytes": peak, "imports_bytes": imports, "excess_bytes": peak - imports}))


# ---------------------------------------------------------------------------------------------------- reporting


def print_records(records: Sequence[Mapping[str, Any]], arguments: argparse.Namespace) -> None:
    """The table, and which of the others are faster."""
    columns = ("map", "backup", "method", "ms", "best ms", "ratio to ours", "Dijkstras", "difference", "peak MiB")
    rows = [
        (
            f"{round(record['cells'] ** 0.5)}²",
            record["backup"],
            record["name"],
            measuring.milliseconds(record["cold_seconds"]) if not record["failed"] else record["failed"],
            measuring.milliseconds(record["best_seconds"]),
            measuring.number(record["ratio"], ".2f"),
            measuring.number(_over(record["cold_seconds"], record["dijkstra_seconds"]), ".1f"),
            measuring.number(record["difference"], ".0e"),
            measuring.mebibytes(record["peak_bytes"]),
        )
        for record in records
    ]
    title = f"planning, β={arguments.beta:g} (soft), γ={arguments.discount:g}, within {arguments.accuracy:g} of exact"
    measuring.print_table(title, columns, rows, left=("backup", "method"))
    faster = [r for r in records if r["project"] != "sidestep" and r["ratio"] is not None and r["ratio"] < 1]
    for record in faster:
        size = round(record["cells"] ** 0.5)
        print(f"faster than ours: {record['name']} on {size}² ({record['backup']}), {record['ratio']:.2f} of our time")
    timed = [record for record in records if record["project"] != "sidestep" and not record["failed"]]
    print(f"{len(timed) - len(faster)} of {len(timed)} times of other planners were slower than ours on the same map")


def _over(seconds: float | None, unit: float | None) -> float | None:
    return seconds / unit if seconds and unit else None


def _arguments() -> argparse.Namespace:
    parser = measuring.argument_parser(
        "Planning beside other projects' planners.", "one small map of each kind, no memory"
    )
    add = parser.add_argument
    add("--peers-python", default="peers/bin/python", metavar="PATH", help=f"a Python that has the others: {HOW_TO}")
    add("--sizes", type=int, nargs="*", default=[32, 64, 128], metavar="N", help="N × N cells, hard max")
    add("--soft-sizes", type=int, nargs="*", default=[16, 24], metavar="N", help="N × N cells, log-sum-exp")
    add("--discount", type=float, default=0.99)
    add("--beta", type=float, default=5.0, help="how sharply soft walkers choose")
    add("--accuracy", type=float, default=1e-6, help="how far from the exact values every method may be")
    add("--turns", type=int, default=9, help="how often everything is timed")
    add("--budget", type=float, default=5.0, help="seconds after which a method takes no more than three turns")
    add("--patience", type=float, default=6.0, help="seconds after which a method is given up")
    add("--no-memory", action="store_true", help="leave out the processes that measure memory")
    add("--seed", type=int, default=0, help="draws maps and parameters")
    add("--measure-memory", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.sizes, arguments.soft_sizes = [32], [16]
        arguments.turns, arguments.budget, arguments.no_memory = 3, 1.0, True
    if not 0 < arguments.discount < 1:
        parser.error("--discount: expected a number above 0 and below 1, which the other planners need")
    return arguments


def found_peers(arguments: argparse.Namespace) -> tuple[Peers | None, dict[str, str]]:
    """The process of the others and their versions; None, and a word on how to make one, where some are missing."""
    try:
        peers = Peers(arguments.peers_python, arguments.patience)
        known = peers.ask(do="know")
        lacking = ", ".join(name for name in PROJECTS if name not in known)
    except (OSError, SidestepError):
        peers, known, lacking = None, {}, "there is no such Python"
    if peers and not lacking:
        return peers, known
    if peers:
        peers.close()
    print(f"{arguments.peers_python} is to have the other planners; missing: {lacking}. To make one:", file=sys.stderr)
    print(f"\n    {HOW_TO}\n\nand give it with --peers-python peers/bin/python", file=sys.stderr)
    return None, known


def run(arguments: argparse.Namespace) -> int:
    """Measures, prints and writes what the arguments ask for; 2 where there is no Python for the others."""
    peers, known = found_peers(arguments)
    if peers is None:
        return 2
    work = [(size, False) for size in arguments.sizes] + [(size, True) for size in arguments.soft_sizes]
    if not work:
        raise InputError("expected at least one size", source="--sizes, --soft-sizes")
    records = []
    for size, soft in work:
        problem = Problem(half_learned_office(size, arguments.seed), arguments.discount, arguments.beta)
        records += measure(problem, soft, peers, known, arguments)
        measuring.write_records(arguments, records, peers=known)
        measuring.note(f"{size}² {'log-sum-exp' if soft else 'hard max'} done")
    peers.close()
    print_records(records, arguments)
    return 0


if __name__ == "__main__":
    imports_bytes = measuring.held_bytes()
    chosen = _arguments()
    if chosen.measure_memory:
        jax.config.update("jax_enable_x64", True)
        measure_memory(chosen.measure_memory, imports_bytes)
    else:
        sys.exit(measuring.main(run, chosen))
