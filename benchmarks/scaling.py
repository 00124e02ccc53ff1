"""How the cost of a gradient grows with the map, in units of one shortest-path search on the same map.

    python benchmarks/scaling.py
    python benchmarks/scaling.py --sizes 256 1024 --backups boltzmann --tolerance 1e-8

On offices of 64² to 2048² cells with rooms and doors, every cell's P(blocked) unknown to the learner and by now about
.98 on walls and .02 elsewhere, ten walkers pursue one goal at a step cost of 1 (β = 5, γ = .9999). What is timed is the
value and gradient of the walkers' action log-likelihood with respect to all cells' parameters, as a fit computes it:

- **cold**: starting from nothing;
- **warm**: after a step of an optimiser, starting from what the solve before it left (values, order, adjoint). The step
  is along the gradient, its largest component `--step` long; with `--step-by-sign` every component is that long;
- **region**: the same, but that only the states are solved that mattered to the solve before (`GaussSeidel` alone
  leaves
  the others out), as a fit of a large map does where it tries a step that changes little;
- **Dijkstra**: `scipy.sparse.csgraph.dijkstra` from the goal over the expected cost of every move, the matrix given.

All of these take turns in one process and medians count. Peak memory is that of a process of its own that builds the
problem and takes a gradient of each kind: the largest resident set of the whole process, imports and compiler
included, and its excess over what was held after the imports.

The **exponent** is that of the power law through the times from 128² cells on, and the worst one between two sizes
in a row. Sizes are timed one after another, so on a machine that others use too the exponents of the units tell more:
they are by how much more than Dijkstra's a gradient's cost grows.

Records (`--json`): `name` (solver), `backup`, `cells`, `tasks`, `cold_seconds`, `warm_seconds`, `region_seconds`,
`dijkstra_seconds` (medians), `cold_units`, `warm_units`, `region_units` (medians over turns of the ratio to the same
turn's Dijkstra), `best_...` (the fastest turn), `cold_sweeps`, `warm_sweeps`, `region_sweeps`, `region` (the share of
the states that mattered), `region_error` (the largest difference between its gradient and the warm one, as a share of
the largest component; null if other states were seen to matter), `converged`, `tolerance`, `step` (its largest
component), `moves`, `turns`, `peak_bytes` (the whole process), `imports_bytes` (held after imports), `excess_bytes`
(what the peak exceeds that by), `gradient_bytes` (peak while the gradients are taken, compilation included, less what
was held before) and `building_bytes` (the peak before that). Beside them `exponents`: `name, backup, kind, fitted,
worst`.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse.csgraph import dijkstra

import measuring
from sidestep.errors import NotConverged
from sidestep.tabular.backups import BACKUPS, Behavior, Gradient
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import Choices, choice_log_likelihood, choices_of
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import Solution, SolveOptions
from sidestep.tabular.solvers.base import Solver, WarmStart
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task
from worlds import World, expected_costs, half_learned_office, load

SOLVERS = {"ordered": GaussSeidel, "jacobi": Jacobi}
FROM_CELLS = 128**2
"""From how many cells on the exponent is fitted: below, what a call costs whatever the map shows."""


class Problem(eqx.Module):
    """What to differentiate, and how it is solved."""

    model: TransitionModel
    demonstrations: Demonstrations
    choices: Choices
    behavior: Behavior
    solver: Solver
    gradient: Gradient = eqx.field(static=True, default="exact")

    def cold_start(self) -> WarmStart:
        """The start when nothing is known of any task."""
        start = self.solver.cold_start(self.model.graph.states, jnp.zeros(0).dtype)
        tasks = len(self.demonstrations.tasks.terminal)
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (tasks, *leaf.shape)), start)


class Step(NamedTuple):
    """A value and gradient, and how the solve went."""

    value: Float[Array, ""]
    gradient: Float[Array, "..."]
    start: WarmStart
    sweeps: Int[Array, " tasks"]
    converged: Bool[Array, ""]


KINDS = ("cold", "warm", "region")
"""The kinds of gradients that are timed."""


def problem_of(world: World, name: str, backup: str, arguments: argparse.Namespace) -> Problem:
    """The problem in a world."""
    demos = world.demonstrations(arguments.discount, arguments.step_cost)
    solver = SOLVERS[name](tolerance=arguments.tolerance)
    return Problem(world.model, demos, choices_of(demos), Behavior(BACKUPS[backup](), arguments.beta), solver)


@eqx.filter_jit
def take(
    problem: Problem, parameters: Float[Array, "..."], start: WarmStart, region: Bool[Array, "tasks states"]
) -> Step:
    """The action log-likelihood and its gradient, from a start; the new start holds the new adjoint.

    Only the states of the region need be solved.
    """

    def objective(parameters: Array, adjoint: Array) -> tuple[Array, tuple]:
        model, begun = problem.model.with_parameters(parameters), start._replace(adjoint=adjoint)

        def one(task: Task, choices: Choices, begun: WarmStart, region: Array) -> tuple[Array, Solution]:
            how = {"options": SolveOptions(problem.gradient, solver=problem.solver), "region": region}
            return choice_log_likelihood(model, task, choices, problem.behavior, begun, **how)

        values, found = jax.vmap(one)(problem.demonstrations.tasks, problem.choices, begun, region)
        return values.sum(), (found.start, found.sweeps, found.converged.all())

    differentiated = jax.value_and_grad(objective, argnums=(0, 1), has_aux=True)
    (value, (left, sweeps, converged)), (gradient, adjoint) = differentiated(parameters, start.adjoint)
    return Step(value, gradient, left._replace(adjoint=adjoint), sweeps, converged)


def stepped(parameters: Array, gradient: Array, arguments: argparse.Namespace) -> Array:
    """The parameters after a step uphill."""
    largest = jnp.abs(gradient).max()
    direction = jnp.sign(gradient) * (jnp.abs(gradient) > 1e-9 * largest) if arguments.step_by_sign else gradient
    return parameters + arguments.step * direction / (1 if arguments.step_by_sign else largest)


def of_all_kinds(problem: Problem, arguments: argparse.Namespace) -> Iterator[Step]:
    """A gradient of each of `KINDS`, each when it is asked for."""
    at = problem.model.parameters
    start = problem.cold_start()
    found = jax.block_until_ready(take(problem, at, start, start.region))
    start = found.start
    yield found
    at = jax.block_until_ready(stepped(at, found.gradient, arguments))
    # nothing is kept that a fit would not keep
    del found
    yield jax.block_until_ready(take(problem, at, start, jnp.ones_like(start.region)))
    yield jax.block_until_ready(take(problem, at, start, start.region))


# ---------------------------------------------------------------------------------------------------- measuring


def measure(
    world: World, saved: Path, backup: str, names: Sequence[str], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """The records of one map and backup, a record a solver; Dijkstra and all solvers take turns."""
    problems = {name: problem_of(world, name, backup, arguments) for name in names}
    steps = {name: list(of_all_kinds(problem, arguments)) for name, problem in problems.items()}
    moves = expected_costs(world.model)

    def search() -> float:
        return measuring.seconds_of(lambda: [dijkstra(moves, indices=int(goal)) for goal in world.goals])

    def cold(name: str) -> float:
        problem = problems[name]
        start = jax.block_until_ready(problem.cold_start())
        at, region = problem.model.parameters, jax.block_until_ready(start.region)
        return measuring.seconds_of(lambda: jax.block_until_ready(take(problem, at, start, region)))

    def warm(name: str, within: bool = False) -> float:
        problem, first = problems[name], steps[name][0]
        at = jax.block_until_ready(stepped(problem.model.parameters, first.gradient, arguments))
        region = jax.block_until_ready(first.start.region if within else jnp.ones_like(first.start.region))
        return measuring.seconds_of(lambda: jax.block_until_ready(take(problem, at, first.start, region)))

    calls = {"dijkstra": search}
    for name in names:
        calls |= {f"cold {name}": partial(cold, name), f"warm {name}": partial(warm, name)}
        calls[f"region {name}"] = partial(warm, name, within=True)
    taken = measuring.in_turns(calls, arguments.turns, arguments.budget)
    return [
        {
            "name": name,
            "backup": backup,
            "cells": world.size**2,
            "tasks": len(world.goals),
            **_times(taken, name),
            **_went(steps[name]),
            "tolerance": arguments.tolerance,
            "step": arguments.step,
            "moves": len(world.walks) - len(world.ends),
            **_memory(world.size, saved, name, backup, arguments),
        }
        for name in names
    ]


def _times(taken: Mapping[str, Sequence[float]], name: str) -> dict[str, Any]:
    """Medians, in seconds and in units of the search in the same turn."""
    searches = taken["dijkstra"]
    found: dict[str, Any] = {"dijkstra_seconds": measuring.median(searches), "best_dijkstra_seconds": min(searches)}
    for kind in KINDS:
        own = taken[f"{kind} {name}"]
        found[f"{kind}_seconds"] = measuring.median(own)
        found[f"best_{kind}_seconds"] = min(own)
        units = [mine / search for mine, search in zip(own, searches, strict=False)]
        found[f"{kind}_units"] = measuring.median(units)
        found["turns"] = len(own)
    return found


def _went(steps: Sequence[Step]) -> dict[str, Any]:
    """The sweeps of the values, and whether values and adjoints all converged; they must."""
    # an adjoint that did not converge leaves a gradient of NaN
    if not all(step.converged and jnp.isfinite(step.gradient).all() for step in steps[:2]) or not steps[2].converged:
        raise NotConverged("the values or the adjoint did not converge: try another tolerance or backup")
    cold, warm, region = steps
    # NaN if other states were seen to matter
    error = jnp.abs(region.gradient - warm.gradient).max() / jnp.abs(warm.gradient).max()
    return {
        **{f"{kind}_sweeps": int(step.sweeps.max()) for kind, step in zip(KINDS, steps, strict=True)},
        "region": float(cold.start.region.mean()),
        "region_error": float(error) if jnp.isfinite(error) else None,
        "converged": True,
    }


def _memory(size: int, saved: Path, name: str, backup: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """The memory of a process of its own."""
    nothing: dict[str, Any] = dict.fromkeys(("peak_bytes", "imports_bytes", "excess_bytes", "gradient_bytes"))
    if arguments.quick and size < max(arguments.sizes):
        return nothing
    told = {key: value for key, value in vars(arguments).items() if isinstance(value, (int, float))}
    asked = json.dumps({**told, "world": str(saved), "name": name, "backup": backup})
    return measuring.in_own_process(__file__, "--measure-memory", asked) or nothing


def measure_memory(asked: str, imports: int) -> None:
    """Takes a gradient of each kind in this process and prints what it needed."""
    given = json.loads(asked)
    arguments = argparse.Namespace(**given)
    problem = problem_of(load(Path(given["world"])), given["name"], given["backup"], arguments)
    jax.block_until_ready(problem)
    built, building = measuring.held_bytes(), measuring.peak_bytes()
    known = measuring.reset_peak()
    steps = of_all_kinds(problem, arguments)
    # a gradient that is not kept, as in a fit
    while next(steps, None) is not None:
        pass
    taking = measuring.peak_bytes()
    peak = max(building, taking)
    gradient = taking - built if known else None
    found = {"peak_bytes": peak, "imports_bytes": imports, "excess_bytes": peak - imports, "gradient_bytes": gradient}
    print(json.dumps({**found, "building_bytes": building}))


# ---------------------------------------------------------------------------------------------------- reporting


def exponents(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The exponent of seconds ∝ cells^exponent for each solver, backup and kind of start."""
    rows = []
    for name, backup in dict.fromkeys((record["name"], record["backup"]) for record in records):
        own = [r for r in records if (r["name"], r["backup"]) == (name, backup) and r["cells"] >= FROM_CELLS]
        seconds = [f"{kind}_seconds" for kind in (*KINDS, "dijkstra")]
        for kind in (*seconds, *(f"{kind}_units" for kind in KINDS)):
            if len(own) > 1:
                fitted, worst = power_law([r["cells"] for r in own], [r[kind] for r in own])
                rows.append({"name": name, "backup": backup, "kind": kind, "fitted": fitted, "worst": worst})
    return rows


def power_law(sizes: Sequence[float], times: Sequence[float]) -> tuple[float, float]:
    """The exponent fitted to times by sizes (both ascending by size), and the largest between two in a row."""
    x, y = np.log(sizes), np.log(times)
    return float(np.polyfit(x, y, 1)[0]), float((np.diff(y) / np.diff(x)).max())


def print_records(records: Sequence[Mapping[str, Any]], arguments: argparse.Namespace) -> None:
    """The tables."""
    columns = ("map", "solver", "backup", *(f"{kind} ms" for kind in (*KINDS, "Dijkstra")))
    columns += (*(f"{kind} units" for kind in KINDS), "sweeps", "matters", "peak MiB", "imports", "excess", "gradients")
    rows = [
        (
            f"{round(record['cells'] ** 0.5)}²",
            record["name"],
            record["backup"],
            *(measuring.milliseconds(record[f"{kind}_seconds"]) for kind in (*KINDS, "dijkstra")),
            *(measuring.number(record[f"{kind}_units"], ".2f") for kind in KINDS),
            ", ".join(str(record[f"{kind}_sweeps"]) for kind in KINDS),
            measuring.number(record["region"], ".2f"),
            *(measuring.mebibytes(record[f"{key}_bytes"]) for key in ("peak", "imports", "excess", "gradient")),
        )
        for record in records
    ]
    how = "every component" if arguments.step_by_sign else "largest component"
    title = (
        f"a value and gradient, {arguments.tasks} task(s), β={arguments.beta:g}, γ={arguments.discount:g}, "
        f"step cost {arguments.step_cost:g}, tolerance {arguments.tolerance:g}; warm after a step of "
        f"{arguments.step:g} ({how})"
    )
    measuring.print_table(title, columns, rows, left=("solver", "backup"))
    fits = [
        (
            row["name"],
            row["backup"],
            row["kind"].replace("_", " "),
            f"{row['fitted']:.3f}",
            f"{row['worst']:.3f}",
        )
        for row in exponents(records)
    ]
    if fits:
        columns = ("solver", "backup", "time", "exponent", "worst in a row")
        measuring.print_table(
            f"time ∝ cells^exponent, from {FROM_CELLS} cells on", columns, fits, left=("solver", "backup", "time")
        )


def _arguments() -> argparse.Namespace:
    parser = measuring.argument_parser(
        "The cost of a gradient by the size of the map.", "64² to 256², three turns, no memory below that"
    )
    add = parser.add_argument
    add("--sizes", type=int, nargs="+", default=[64, 128, 256, 512, 1024, 2048], metavar="N", help="N × N cells")
    add("--backups", nargs="+", choices=sorted(BACKUPS), default=["boltzmann", "logsumexp"])
    add("--solvers", nargs="+", choices=list(SOLVERS), default=list(SOLVERS))
    add("--jacobi-limit", type=int, default=128, metavar="N", help="largest N for sweeps over all states at once")
    add("--beta", type=float, default=5.0, help="how sharply walkers choose")
    add("--discount", type=float, default=0.9999)
    add("--step-cost", type=float, default=1.0)
    add("--tolerance", type=float, default=1e-7, help="relative change at which a solve stops")
    add("--step", type=float, default=0.1, help="the optimiser's step before the warm gradient, in logits")
    add("--step-by-sign", action="store_true", help="the same step for every cell, as Adam's first")
    add("--tasks", type=int, default=1, help="how many goals")
    add("--walks", type=int, default=10, help="how many walks to each goal")
    add("--turns", type=int, default=7, help="how often everything is timed")
    add("--budget", type=float, default=8.0, help="seconds after which a method takes no more than three turns")
    add("--seed", type=int, default=0, help="draws maps, walks and parameters")
    add("--measure-memory", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.sizes, arguments.turns, arguments.budget = [64, 128, 256], 3, 1.0
    if min(arguments.turns, arguments.tasks, arguments.walks) < 1:
        parser.error("--turns, --tasks and --walks: expected numbers above 0")
    return arguments


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes what the arguments ask for."""
    records = []
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        for size in sorted(arguments.sizes):
            world = half_learned_office(size, arguments.seed, arguments.walks, arguments.tasks)
            saved = Path(folder) / "world.npz"
            world.save(saved)
            names = [name for name in arguments.solvers if name != "jacobi" or size <= arguments.jacobi_limit]
            for backup in arguments.backups:
                records += measure(world, saved, backup, names, arguments)
                measuring.write_records(arguments, records, exponents=exponents(records))
                measuring.note(f"{size}² {backup}: {time.perf_counter() - started:.0f} s")
    print_records(records, arguments)


if __name__ == "__main__":
    imports_bytes = measuring.held_bytes()
    chosen = _arguments()
    if chosen.measure_memory:
        jax.config.update("jax_enable_x64", True)
        measure_memory(chosen.measure_memory, imports_bytes)
    else:
        sys.exit(measuring.main(run, chosen))
