"""What a gradient costs: the adjoint by either solver, beside other ways to the same gradient.

    python -m benchmarks gradients --sizes 16 32 --backups logsumexp --gradient fixed_policy
    python -m benchmarks gradients --beta 10 --discount 0.95 --goal-pays

The problem is that of `scaling.py`, with one task. These methods compute the gradient of the walkers' action
log-likelihood with respect to all parameters, the values included:

- sidestep gauss_seidel, sidestep jacobi: the adjoint, as a fit computes it, cold and warm (see `scaling.py`);
- unrolled: JAX's reverse-mode differentiation through plain value iteration, which keeps every sweep in memory;
- dense implicit: values by Gauss–Seidel, and the adjoint from `jnp.linalg.solve` of the dense Jacobian;
- optimistix: `optimistix.fixed_point` of one plain backup with its default `ImplicitAdjoint`, which builds that
  Jacobian too; where optimistix is installed (`pip install optimistix`; it is not a dependency);
- forward: the paper's dynamic program (eq. 7 with eq. 8, or with eq. 9 for `--gradient fixed_policy`), iterated on an
  array of states × parameters, from values by Gauss–Seidel.

"values" is the value solve by Gauss–Seidel alone, "plain values" that by plain sweeps. With `--models cells table` each
map comes twice: as an obstacle grid (a parameter for each cell) and as a table (a parameter for every outcome of every
state and action) with the same probabilities, to show the effect of the number of parameters.

All stop at the same relative change; plain sweeps go on until the gradient is within `--accuracy` of the exact one (by
Gauss–Seidel at a tolerance of 1e-12, or as small as it gets). A method that needs more than `--memory` is not run; one
that takes longer than `--limit` is timed once and not run on larger maps. Memory is measured for the first backup.

Records: `name`, `model`, `backup`, `cells`, `parameters`, `tasks`, `cold_seconds`, `warm_seconds`, `dijkstra_seconds`
(medians), `best_seconds`, `ratio` (to `sidestep gauss_seidel`, cold, in the same turn: above 1 is slower), `difference`
(from the exact gradient, relative to its largest component), `sweeps`, `compiled_bytes` (by XLA), `compile_seconds`,
`turns`, the fields of `benchmarks.peak_memory`, `failed` (null, or why it was not run).
"""

import importlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from benchmarks import (
    MEMORY,
    Record,
    in_turns,
    median,
    median_ratio,
    note,
    option,
    peak_memory,
    place,
    print_faster,
    print_table,
    scaling,
    seconds_of,
)
from benchmarks.scaling import Problem, World, draw, take
from sidestep.errors import NotConverged
from sidestep.tabular.forward_gradients import forward_gradient
from sidestep.tabular.models import TabularModel
from sidestep.tabular.solve import SolveOptions, decision_process, solve
from sidestep.tabular.solvers.base import DecisionProcess, advantages, at_fixed_policy
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel

__all__ = ["Options", "draw", "measure", "show"]
EXACT = (1e-12, 1e-11, 1e-10)
"""Tolerances of the exact gradient: the first that is reached. The Boltzmann average may waver below 1e-10."""
MOST_SWEEPS = 5_000
Result = tuple[Array, Array]  # a gradient (or values), and the number of sweeps


@dataclass
class Options(scaling.GradientOptions):
    """The options of this benchmark."""

    backups: list[str] = option(["boltzmann", "logsumexp"], "names of backups", quick=["boltzmann"])
    tolerance: float = option(1e-8, "relative change at which iterations stop")
    turns: int = option(9, "how often each method is timed", quick=3)
    budget: float = option(4.0, "seconds after which a method takes no more than three turns", quick=1.0)
    sizes: list[int] = option([16, 32, 64, 128], "N × N cells (10 or more)", quick=[24])
    models: list[str] = option(["cells"], "what the parameters are", choices=("cells", "table"))
    gradient: str = option("exact", "which gradient", choices=("exact", "fixed_policy"))
    accuracy: float = option(1e-6, "how far the unrolled gradient may be from the exact one")
    limit: float = option(5.0, "seconds after which a method is timed only once")
    memory: float = option(4.0, "GiB above which a method is not run")
    forward_limit: int = option(2**21, "largest states × parameters for the forward program")
    memory_sizes: list[int] = option([64, 128], "N × N cells whose memory is measured", quick=[0], least=0)


# ---------------------------------------------------------------------------------------------------- the methods


def problem_of(world: World, model: str, backup: str, options: Options) -> Problem:
    """Return the problem in a world, in one parametrization."""
    problem = scaling.problem_of(world, backup, options)
    solving = SolveOptions(options.gradient, solver=problem.solving.solver)  # pyright: ignore[reportArgumentType]
    problem = eqx.tree_at(lambda p: p.solving, problem, solving)
    if model == "cells":
        return problem
    probabilities = world.model.probabilities()
    possible = probabilities > 0
    table = TabularModel(world.model.graph, jnp.log(jnp.where(possible, probabilities, 1)), possible)
    return eqx.tree_at(lambda p: p.model, problem, table)


def process_of(problem: Problem, parameters: Array) -> DecisionProcess:
    """Return the one task under the model at some parameters."""
    model, task = problem.model.with_parameters(parameters), jax.tree.map(lambda x: x[0], problem.demonstrations.tasks)
    return decision_process(model, model.probabilities(), task)


def one_backup(problem: Problem, parameters: Array, values: Array) -> Array:
    """Return F(V, θ), one plain backup, with the gradient that is asked for."""
    process, behavior = process_of(problem, parameters), problem.behavior
    q = process.action_values(values)
    if problem.solving.gradient == "exact":
        return process.with_terminal_rewards(behavior.backup.value(q, behavior.beta))
    return process.with_terminal_rewards(
        at_fixed_policy(behavior.backup, behavior.beta, q, process.available_actions())
    )


def log_likelihood(problem: Problem, parameters: Array, values: Array) -> Array:
    """Return the actions' log-likelihood from the values."""
    model, demos = problem.model.with_parameters(parameters), problem.demonstrations
    states, task = demos.states, jax.tree.map(lambda leaf: leaf[0], demos.tasks)
    after = values[model.graph.successors[states]]
    rest = task.reward, model.graph.available, task.discount
    q = advantages(values[states], after, model.probabilities()[states], *rest)
    return jnp.sum(jnp.take_along_axis(problem.behavior.log_policy(q), demos.actions[:, None], axis=-1))


def start_of(problem: Problem, parameters: Array) -> Array:
    """Return the values from which plain sweeps start: 0, but for the goal."""
    return process_of(problem, parameters).with_terminal_rewards(jnp.zeros(problem.model.graph.states))


def solved(problem: Problem, parameters: Array) -> Result:
    """Return the values by the problem's solver."""
    model, options = problem.model.with_parameters(parameters), SolveOptions(solver=problem.solving.solver)
    solution = solve(model, problem.demonstrations.tasks, problem.behavior, options=options)
    return jnp.where(solution.converged[0], solution.values[0], jnp.nan), solution.sweeps[0]


def adjoint(problem: Problem, parameters: Array) -> Result:
    """Return the gradient by the adjoint, from nothing."""
    start = problem.cold_start()
    step = take(problem, parameters, start, start.region)
    return jnp.where(step.converged, step.gradient, jnp.nan), step.sweeps[0]


def plain_values(problem: Problem, parameters: Array, sweeps: int) -> Result:
    """Return values by a number of plain sweeps."""

    def sweep(values: Array, _: None) -> tuple[Array, None]:
        return one_backup(problem, parameters, values), None

    return jax.lax.scan(sweep, start_of(problem, parameters), length=sweeps)[0], jnp.asarray(sweeps)


def unrolled(problem: Problem, parameters: Array, sweeps: int) -> Result:
    """Return the gradient through a number of plain sweeps."""
    objective = lambda x: log_likelihood(problem, x, plain_values(problem, x, sweeps)[0])  # noqa: E731
    return jax.grad(objective)(parameters), jnp.asarray(sweeps)


def dense(problem: Problem, parameters: Array) -> Result:
    """Return the gradient by a dense solve of the adjoint equation (I − ∂F/∂V)ᵀ λ = g."""
    values, sweeps = solved(problem, parameters)
    by_parameters, by_values = jax.grad(partial(log_likelihood, problem), argnums=(0, 1))(parameters, values)
    jacobian = jax.jacobian(partial(one_backup, problem, parameters))(values)
    multipliers = jnp.linalg.solve((jnp.eye(len(values)) - jacobian).T, by_values)
    vjp = jax.vjp(lambda x: one_backup(problem, x, values), parameters)[1]
    return by_parameters + vjp(multipliers)[0], sweeps


def by_optimistix(problem: Problem, parameters: Array) -> Result:
    """Return the gradient by optimistix's fixed point with its default adjoint."""
    optimistix, start = importlib.import_module("optimistix"), start_of(problem, parameters)
    tolerance = problem.solving.solver.tolerance_for(start.dtype)  # pyright: ignore[reportOptionalMemberAccess]
    solver = optimistix.FixedPointIteration(rtol=tolerance, atol=tolerance)

    def objective(parameters: Array) -> tuple[Array, Array]:
        backup = lambda values, x: one_backup(problem, x, values)  # noqa: E731
        point = optimistix.fixed_point(backup, solver, start, args=parameters, max_steps=MOST_SWEEPS, throw=False)
        return log_likelihood(problem, parameters, point.value), point.stats["num_steps"]

    return jax.grad(objective, has_aux=True)(parameters)


def forward(problem: Problem, parameters: Array) -> Result:
    """Return the gradient by the paper's dynamic program, and how often it was iterated."""
    model, task = problem.model.with_parameters(parameters), jax.tree.map(lambda x: x[0], problem.demonstrations.tasks)
    result = forward_gradient(model, task, problem.behavior, options=problem.solving, max_sweeps=MOST_SWEEPS)
    flat, unravel = ravel_pytree(parameters)
    gradient = jax.grad(lambda x, v: log_likelihood(problem, unravel(x), v), argnums=(0, 1))
    by_parameters, by_values = gradient(flat, result.solution.values)
    return unravel(by_parameters + by_values @ result.value_gradient), result.sweeps


METHODS: Mapping[str, Callable[..., Result]] = {
    "sidestep gauss_seidel": adjoint,
    "sidestep jacobi": adjoint,
    "values": solved,
    "plain values": plain_values,
    "unrolled": unrolled,
    "dense implicit": dense,
    "optimistix": by_optimistix,
    "forward": forward,
}
BY_SWEEPS, ONLY_VALUES = ("plain values", "unrolled"), ("values", "plain values")
OTHERS = ("unrolled", "dense implicit", "optimistix", "forward")


# ---------------------------------------------------------------------------------------------------- measuring


@dataclass
class Method:
    """A compiled method and its first result; `call` is None if it is not run."""

    name: str
    call: Callable[[], Result] | None = None
    warm: Callable[[], Any] | None = None
    compile_seconds: float = 0.0
    bytes: int = 0
    sweeps: int = 0
    difference: float | None = None
    failed: str | None = None
    seconds: float = 0.0


def with_solver(name: str, problem: Problem) -> Problem:
    """Return the problem with the solver of a method."""
    if name != "sidestep jacobi":
        return problem
    tolerance = problem.solving.solver.tolerance  # pyright: ignore[reportOptionalMemberAccess]
    return eqx.tree_at(lambda p: p.solving.solver, problem, scaling.SOLVERS["jacobi"](tolerance=tolerance))


def compiled(name: str, problem: Problem, exact: Array | None = None, limit: float = np.inf, sweeps: int = 0) -> Method:
    """Return a method, compiled and, if `exact` is known, run once and compared; not run above `limit` bytes.

    All arrays are inputs, so that the compiler computes nothing of them.
    """
    function = partial(METHODS[name], sweeps=sweeps) if name in BY_SWEEPS else METHODS[name]
    arrays, static = eqx.partition(with_solver(name, problem), eqx.is_array)
    started = time.perf_counter()
    whole = jax.jit(lambda arrays, parameters: function(eqx.combine(arrays, static), parameters))
    made = whole.lower(arrays, problem.model.parameters).compile()
    method = Method(name, compile_seconds=time.perf_counter() - started, sweeps=sweeps)
    memory = made.memory_analysis()
    assert memory is not None
    method.bytes = memory.temp_size_in_bytes + memory.output_size_in_bytes
    if method.bytes > limit:
        method.failed = f"needs {method.bytes / 2**30:.1f} GiB"
        return method
    method.call = lambda: jax.block_until_ready(made(arrays, problem.model.parameters))
    if exact is not None:
        started = time.perf_counter()
        gradient, count = method.call()
        method.seconds, method.sweeps = time.perf_counter() - started, int(count)
        if name not in ONLY_VALUES:
            difference = float(jnp.abs(gradient - exact).max() / jnp.abs(exact).max())
            method.difference = difference if np.isfinite(difference) else None
    return method


def by_plain_sweeps(problem: Problem, exact: Array, limit: float, options: Options) -> list[Method]:
    """Return plain values and their unrolled gradient, by about as few sweeps as make it accurate, if possible."""
    sweeps = round(4 * problem.model.graph.states**0.5)
    method = more = compiled("unrolled", problem, exact, limit, sweeps)
    while more.call is not None and sweeps < MOST_SWEEPS and method.seconds <= options.limit:
        if method.difference is not None and method.difference <= options.accuracy:
            break
        sweeps = min(MOST_SWEEPS, int(1.3 * sweeps) + 1)
        more = compiled("unrolled", problem, exact, limit, sweeps)
        method = more if more.call is not None else method
    return [compiled("plain values", problem, exact, limit, method.sweeps or sweeps), method]


def exact_gradient(problem: Problem) -> Array:
    """Return the gradient at a tolerance as small as is reached; raises `NotConverged` if none is."""
    cold = problem.cold_start()
    for tolerance in EXACT:
        solver = GaussSeidel(tolerance=tolerance, max_sweeps=1_000)
        strict = eqx.tree_at(lambda p: p.solving.solver, problem, solver)
        step = take(strict, problem.model.parameters, cold, cold.region)
        if bool(step.converged):
            return step.gradient
    raise NotConverged("the values or the adjoint did not converge: try a smaller β or another backup")


def warm_call(name: str, problem: Problem, options: Options) -> Callable[[], Any] | None:
    """Return a warm gradient: after a step, from what the solve before left; None if it does not converge."""
    problem = with_solver(name, problem)
    cold = problem.cold_start()
    first = take(problem, problem.model.parameters, cold, cold.region)
    at, start = jax.block_until_ready((scaling.stepped(problem.model.parameters, first.gradient, options), first.start))
    call = lambda: jax.block_until_ready(take(problem, at, start, cold.region))  # noqa: E731
    return call if bool(call().converged) else None


def methods_for(problem: Problem, slow: set[str], options: Options) -> Iterator[Method]:
    """Yield all methods for a problem, compiled, run once and compared, but for those in `slow`."""
    limit, exact = options.memory * 2**30, exact_gradient(problem)
    for name in ("sidestep gauss_seidel", "sidestep jacobi", "values"):
        method = compiled(name, problem, exact)
        method.warm = None if name == "values" else warm_call(name, problem, options)
        yield method
    yield from by_plain_sweeps(problem, exact, limit, options)
    states, count = problem.model.graph.states, int(np.size(problem.model.parameters))
    for name in ("dense implicit", "optimistix", "forward"):
        # a Jacobian of plain backups, or an array of states × parameters
        least = 8 * states * (count if name == "forward" else states)
        if name == "optimistix" and find_spec("optimistix") is None:
            yield Method(name, failed="not installed")
        elif name in slow:
            yield Method(name, bytes=least, failed=f"over {options.limit:g} s before")
        elif name == "forward" and states * count > options.forward_limit:
            yield Method(name, bytes=least, failed=f"{states * count:.0e} numbers")
        else:
            yield compiled(name, problem, exact, limit)


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each map, backup, parametrization and method."""
    slow: dict[tuple[str, str], set[str]] = {}
    for size in sorted(options.sizes):
        world = scaling.half_learned_office(size, options.seed)
        for backup in options.backups:
            for model in options.models:
                yield from _of_one_problem(world, model, backup, slow.setdefault((backup, model), set()), options)
                note(f"{size}² {backup} {model} done")


def _of_one_problem(world: World, model: str, backup: str, slow: set[str], options: Options) -> Iterator[Record]:
    """Yield the records of one problem; add to `slow` what takes too long."""
    problem = problem_of(world, model, backup, options)
    methods = list(methods_for(problem, slow, options))
    slow |= {method.name for method in methods if method.name in OTHERS and method.seconds > options.limit}
    calls = {method.name: method.call for method in methods if method.call and method.name not in slow}
    calls |= {f"warm {method.name}": method.warm for method in methods if method.warm}
    timed = {"dijkstra": world.dijkstra()} | {name: partial(seconds_of, call) for name, call in calls.items()}
    taken = in_turns(timed, options.turns, options.budget)
    taken |= {method.name: [method.seconds] for method in methods if method.call and method.name in slow}
    for method in methods:
        own = taken.get(method.name, [])
        memory: Record = dict.fromkeys(MEMORY)
        measured = backup == options.backups[0] and world.size in options.memory_sizes
        if method.call and method.seconds <= options.limit and measured:
            memory = peak_memory(one_gradient, world, model, backup, options, method.name, method.sweeps)
        yield {
            "name": method.name,
            "model": model,
            "backup": backup,
            "cells": world.size**2,
            "parameters": int(np.size(problem.model.parameters)),
            "tasks": 1,
            "cold_seconds": median(own),
            "warm_seconds": median(taken.get(f"warm {method.name}")),
            "dijkstra_seconds": median(taken["dijkstra"]),
            "best_seconds": min(own, default=None),
            "ratio": median_ratio(own, taken["sidestep gauss_seidel"]),
            "difference": method.difference,
            "sweeps": method.sweeps,
            "compiled_bytes": method.bytes,
            "compile_seconds": method.compile_seconds,
            "turns": len(own),
            **memory,
            "failed": method.failed,
        }


def one_gradient(world: World, model: str, backup: str, options: Options, name: str, sweeps: int) -> Callable:
    """Return a call that takes one gradient, for `peak_memory`."""
    method = compiled(name, problem_of(world, model, backup, options), sweeps=sweeps)
    assert method.call is not None
    return method.call


def show(records: Sequence[Record], options: Options) -> None:
    """Print the table, and which of the others are faster or disagree."""
    columns = {"cells": "cells", "θ": "parameters", "of": "model", "backup": "backup", "method": "name"}
    columns |= {"cold ms": "cold_seconds ms", "best ms": "best_seconds ms", "ratio": "ratio .2f"}
    columns |= {"warm ms": "warm_seconds ms", "sweeps": "sweeps", "difference": "difference .0e"}
    columns |= {"peak MiB": "peak_bytes MiB", "call MiB": "call_bytes MiB", "not run": "failed"}
    print_table(f"a gradient ({options.gradient}), {scaling.described(options)}", records, columns)
    for record in records:
        off = np.inf if record["difference"] is None else record["difference"]
        if record["name"] not in ONLY_VALUES and record["ratio"] is not None and off > options.accuracy:
            print(f"not within {options.accuracy:g}: {record['name']} ({place(record)}), {off:.1e}")
    print_faster([record for record in records if record["name"] in OTHERS])
