"""What a gradient costs: the adjoint, beside unrolled differentiation and the paper's forward dynamic programme.

    python benchmarks/gradients.py
    python benchmarks/gradients.py --sizes 16 32 --backup logsumexp --gradient fixed_policy

On office maps with walls at random and one task, five things are timed:

- **values**: one solve;
- **adjoint**: the log-likelihood of some walkers' actions and its gradient with respect to all parameters, as `fit`
  computes it, its value solve included;
- **plain values**: plain value iteration, without the local elimination of self-loops, which therefore needs many more
  sweeps: as many as bring its gradient within 1e-8 of the adjoint's, up to a limit (a difference above that is shown);
- **unrolled**: JAX's reverse-mode differentiation through those plain sweeps, which keeps every sweep in memory;
- **forward**: the paper's dynamic programme (eq. 7 with eq. 8, or with eq. 9 for `--gradient fixed_policy`), iterated
  to the same tolerance as the values on an array of states × parameters, from values that are given. It is left out
  where that array would be too large.

Each map is given twice, as an obstacle grid (a parameter a cell) and as a table (a parameter for every outcome of every
state and action) with the same probabilities, to show what the number of parameters does.

Times are medians of warm calls after compilation, and the best (of means over 10 ms, where a call is shorter). The
methods take turns, so that noise on the machine hits all alike, and slow ones take fewer turns. The ratio is the median
over turns of adjoint to values. Memory is what XLA sets aside for a call besides its inputs (`memory_analysis`:
temporaries and outputs): exact, and the same on every run, where the resident set also holds the compiler. A method
that needs more than `--memory` is not run; its memory is still shown.
"""

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from rich import box
from rich.console import Console
from rich.table import Table

from sidestep.demonstrations import Demonstrations, gather
from sidestep.domains.offices import connected_cells, office, places
from sidestep.errors import NotConverged, SidestepError
from sidestep.io.files import write_json
from sidestep.simulation import simulate
from sidestep.tabular.backups import BACKUPS, Behavior, Gradient
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import action_log_likelihood
from sidestep.tabular.models import ObstacleGrid, TabularModel, TransitionModel, true_model
from sidestep.tabular.solve import solve
from sidestep.tabular.solvers.process import DecisionProcess
from sidestep.tasks import Task, reach

WALKERS = 20
AGREEMENT = 1e-8
MOST_SWEEPS = 50_000
SHORTEST = 0.01
Parameters = Float[Array, "..."]


class Problem(eqx.Module):
    """Demonstrations of one task, and a model to differentiate their likelihood at."""

    model: TransitionModel
    demonstrations: Demonstrations
    behavior: Behavior
    gradient: Gradient = eqx.field(static=True)

    @property
    def task(self) -> Task:
        """The one task."""
        return jax.tree.map(lambda leaf: leaf[0], self.demonstrations.tasks)

    def process(self, parameters: Parameters) -> DecisionProcess:
        """The task under the model at some parameters."""
        model, task = self.model.with_parameters(parameters), self.task
        probabilities = model.probabilities()
        return DecisionProcess(
            model.graph.successors, probabilities, task.reward, task.final_reward, task.terminal, task.discount
        )


@dataclass
class Method:
    """A compiled way to compute something, and what it took; `call` is None if it was not to be run."""

    call: Callable[[Parameters], Any] | None
    compile_seconds: float
    bytes: int
    sweeps: int = 0
    difference: float | None = None
    seconds: list[float] | None = None


# ---------------------------------------------------------------------------------------------------- the methods


def values(problem: Problem, parameters: Parameters) -> tuple[Array, Array]:
    """One value solve (of a stack of one task, as in the likelihood), and its number of sweeps; −1 if it failed."""
    found = solve(problem.model.with_parameters(parameters), problem.demonstrations.tasks, problem.behavior)
    return found.values[0], jnp.where(found.converged, found.sweeps, -1)[0]


def likelihood_gradient(problem: Problem, parameters: Parameters, horizon: int | None = None) -> tuple[Array, Array]:
    """The actions' log-likelihood and its gradient: by the adjoint, or through `horizon` plain sweeps unrolled."""

    def objective(parameters: Parameters) -> Array:
        model = problem.model.with_parameters(parameters)
        demos, people = problem.demonstrations, problem.behavior
        return action_log_likelihood(model, demos, people, horizon=horizon, gradient=problem.gradient)

    return jax.value_and_grad(objective)(parameters)


def plain_values(problem: Problem, parameters: Parameters, sweeps: int) -> Array:
    """Values by so many plain sweeps."""
    return solve(problem.model.with_parameters(parameters), problem.task, problem.behavior, horizon=sweeps).values


def forward_gradient(problem: Problem, parameters: Parameters, solved: Array) -> tuple[Array, Array]:
    """The gradient by the paper's dynamic programme, and how many times it was iterated.

    With `solved` the values V, iterates dV/dθ = ∂F/∂θ + Σ_a w(a) γ Σ_k P(·, a, k) dV/dθ(succ(·, a, k)), the weights
    w being π(1 + β(Q − V)) (eq. 8) or π (eq. 9); dQ/dθ (eq. 7) is put in.
    """
    process, backup, beta = problem.process(parameters), problem.behavior.backup, problem.behavior.beta
    q = process.action_values(solved)
    weights = backup.weights(q, beta) if problem.gradient == "exact" else backup.fixed_policy_weights(q, beta)
    weights = jnp.where(process.terminal[:, None], 0, weights)
    flat, unravel = ravel_pytree(parameters)

    def direct(direction: Array) -> Array:
        """The change of one backup with θ, V held."""
        change = jax.jvp(lambda x: problem.process(unravel(x)).action_values(solved), (flat,), (direction,))[1]
        return jnp.sum(weights * change, axis=-1)

    own = jax.lax.map(lambda index: direct(jnp.zeros_like(flat).at[index].set(1)), jnp.arange(len(flat))).T
    leads = process.discount * weights[..., None] * process.probabilities

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        return (state[1] > 1e-10) & (state[2] < MOST_SWEEPS)

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        old, _, count = state
        new = own
        for action, outcome in np.ndindex(*leads.shape[1:]):
            new = new + leads[:, action, outcome, None] * old[process.successors[:, action, outcome]]
        return new, jnp.abs(new - old).max() / jnp.abs(new).max(), count + 1

    slopes, _, count = jax.lax.while_loop(unfinished, sweep, (own, jnp.asarray(jnp.inf), jnp.asarray(1)))

    def chosen(x: Array, v: Array) -> Array:
        demos = problem.demonstrations
        log_policy = problem.behavior.log_policy(problem.process(unravel(x)).action_values(v))
        return jnp.sum(log_policy[demos.states, demos.actions])

    by_parameters, by_values = jax.grad(chosen, argnums=(0, 1))(flat, solved)
    return unravel(by_parameters + by_values @ slopes), count


def plain_sweeps(problem: Problem, parameters: Parameters) -> Array:
    """How many plain sweeps it takes until values change by no more than 1e-11, relative to the largest."""
    process, people = problem.process(parameters), problem.behavior

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        return (state[1] > 1e-11) & (state[2] < MOST_SWEEPS)

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        old, _, count = state
        new = process.end(people.backup.value(process.action_values(old), people.beta))
        return new, jnp.abs(new - old).max() / jnp.abs(new).max(), count + 1

    start = process.end(jnp.zeros(process.terminal.shape, process.probabilities.dtype))
    return jax.lax.while_loop(unfinished, sweep, (start, jnp.asarray(jnp.inf), jnp.asarray(0)))[2]


# ---------------------------------------------------------------------------------------------------- the problems


def problems(size: int, arguments: argparse.Namespace) -> dict[str, Problem]:
    """An office of size × size cells as an obstacle grid and as a table, with optimal walkers to one goal."""
    truth = office(size, size, arguments.seed)
    random = np.random.default_rng(arguments.seed)
    goal = int(places(truth, 1, arguments.seed)[0])
    starts = random.choice(np.setdiff1d(connected_cells(truth), [goal]), WALKERS)
    pursued = reach(truth, goal, discount=arguments.discount, step_cost=arguments.step_cost)
    shortest = reach(truth, goal, discount=1.0, step_cost=1.0)
    walks = simulate(jax.random.key(arguments.seed), true_model(truth), [shortest], [starts])
    demos = gather(walks, [pursued])
    people = Behavior(BACKUPS[arguments.backup](), arguments.beta)
    grid = obstacle_grid(truth, random)
    models: dict[str, TransitionModel] = {"cells": grid, "table": table_of(grid)}
    return {name: Problem(model, demos, people, arguments.gradient) for name, model in models.items()}


def obstacle_grid(truth: Grid, random: np.random.Generator) -> ObstacleGrid:
    """A half-learned map: P(blocked) about .95 on obstacles and .05 on free cells."""
    wall = truth.known.reshape(-1) == Cell.OCCUPIED
    return ObstacleGrid(truth.forget(), np.where(wall, 3.0, -3.0) + random.normal(size=truth.size))


def table_of(model: TransitionModel) -> TabularModel:
    """The same probabilities, with a logit for every outcome of every state and action."""
    probabilities = model.probabilities()
    possible = probabilities > 0
    return TabularModel(model.graph, jnp.log(jnp.where(possible, probabilities, 1)), possible)


# ---------------------------------------------------------------------------------------------------- measuring


def compiled(function: Callable[..., Any], problem: Problem, *given: Array, limit: float = np.inf) -> Method:
    """A function of a problem, its parameters and what else is given, compiled; not to be run above `limit` bytes.

    All arrays are inputs, so that nothing of them is computed while compiling.
    """
    arrays, static = eqx.partition(problem, eqx.is_array)

    def of_arrays(arrays: Problem, parameters: Parameters, given: tuple[Array, ...]) -> Any:
        return function(eqx.combine(arrays, static), parameters, *given)

    started = time.perf_counter()
    made = jax.jit(of_arrays).lower(arrays, problem.model.parameters, given).compile()
    seconds = time.perf_counter() - started
    memory = made.memory_analysis()
    assert memory is not None
    needed = memory.temp_size_in_bytes + memory.output_size_in_bytes
    call = None if needed > limit else lambda parameters: jax.block_until_ready(made(arrays, parameters, given))
    return Method(call, seconds, needed)


def unrolled(problem: Problem, expected: Array, start: int, limit: float) -> tuple[Method, Method]:
    """Plain values and their unrolled gradient, by as many sweeps (`start` or more) as agree with `expected`."""
    parameters, sweeps = problem.model.parameters, start
    while True:
        method = compiled(partial(likelihood_gradient, horizon=sweeps), problem, limit=limit)
        method.sweeps = sweeps
        if method.call is None:
            break
        method.difference = difference(method.call(parameters)[1], expected)
        if method.difference <= AGREEMENT or sweeps >= MOST_SWEEPS:
            break
        sweeps = min(MOST_SWEEPS, int(1.3 * sweeps) + 1)
    plain = compiled(partial(plain_values, sweeps=sweeps), problem, limit=limit)
    plain.sweeps = sweeps
    return plain, method


def difference(found: Array, expected: Array) -> float:
    """The largest difference, relative to the largest component."""
    return float(jnp.abs(found - expected).max() / jnp.abs(expected).max())


def methods_for(problem: Problem, arguments: argparse.Namespace) -> dict[str, Method]:
    """All methods for a problem, compiled, run once and compared; raises `NotConverged` if values are not found."""
    parameters, limit = problem.model.parameters, arguments.memory * 2**30
    by_values = compiled(values, problem)
    by_adjoint = compiled(likelihood_gradient, problem)
    assert by_values.call is not None
    assert by_adjoint.call is not None
    solved, sweeps = by_values.call(parameters)
    expected = by_adjoint.call(parameters)[1]
    if sweeps < 0 or not jnp.isfinite(expected).all():
        raise NotConverged("the values or the adjoint did not converge: try a smaller β or another backup")
    by_values.sweeps, by_adjoint.difference = int(sweeps), 0.0
    counting = compiled(plain_sweeps, problem)
    assert counting.call is not None
    plain, by_unrolling = unrolled(problem, expected, int(counting.call(parameters)), limit)
    found = {"values": by_values, "adjoint": by_adjoint, "plain values": plain, "unrolled": by_unrolling}
    if solved.size * expected.size <= arguments.forward_limit:
        forward = found["forward"] = compiled(forward_gradient, problem, solved, limit=limit)
        if forward.call is not None:
            gradient, count = forward.call(parameters)
            forward.sweeps, forward.difference = int(count), difference(gradient, expected)
    return found


def time_in_turns(methods: Mapping[str, Method], parameters: Parameters, turns: int, budget: float) -> None:
    """Fills in the seconds of every method, the methods taking turns; each takes at least three, if any.

    A method that has used up `budget` seconds takes no more turns.
    """
    for method in methods.values():
        method.seconds = []
    for _ in range(turns):
        for method in methods.values():
            assert method.seconds is not None
            if method.call is None or (len(method.seconds) >= 3 and sum(method.seconds) > budget):
                continue
            method.seconds.append(_seconds(method.call, parameters))


def _seconds(call: Callable[[Parameters], Any], parameters: Parameters) -> float:
    """How long a call takes, the mean of as many as fill `SHORTEST` seconds."""
    calls, started = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - started) < SHORTEST:
        call(parameters)
        calls += 1
    return elapsed / calls


def measure(size: int, name: str, problem: Problem, arguments: argparse.Namespace) -> dict[str, Any]:
    """The record of one map in one parametrisation."""
    methods = methods_for(problem, arguments)
    time_in_turns(methods, problem.model.parameters, arguments.turns, arguments.budget)
    turns = zip(methods["adjoint"].seconds or [], methods["values"].seconds or [], strict=False)
    return {
        "size": size,
        "states": problem.model.graph.states,
        "model": name,
        "parameters": int(np.size(problem.model.parameters)),
        "moves": len(problem.demonstrations),
        "ratio": float(np.median([adjoint / value for adjoint, value in turns])),
        "best_ratio": min(methods["adjoint"].seconds or []) / min(methods["values"].seconds or []),
        "methods": {
            key: {
                "seconds": float(np.median(method.seconds)) if method.seconds else None,
                "best_seconds": min(method.seconds) if method.seconds else None,
                "turns": len(method.seconds or []),
                "bytes": method.bytes,
                "compile_seconds": method.compile_seconds,
                "sweeps": method.sweeps,
                "difference": method.difference,
            }
            for key, method in methods.items()
        },
    }


# ---------------------------------------------------------------------------------------------------- reporting


def print_record(table: Table, record: Mapping[str, Any]) -> None:
    """Adds a record to the table, a line a method."""
    for index, (name, method) in enumerate(record["methods"].items()):
        case = (f"{record['size']}²", record["model"], str(record["parameters"])) if index == 0 else ("", "", "")
        disagreement = method["difference"]
        table.add_row(
            *case,
            name,
            *("–" if method[key] is None else f"{1e3 * method[key]:.4g}" for key in ("seconds", "best_seconds")),
            f"{record['ratio']:.2f}" if name == "adjoint" else "",
            str(method["sweeps"] or "–") if name != "adjoint" else "",
            f"{method['bytes'] / 2**20:.2f}",
            f"{disagreement:.0e}" if disagreement else "",
            end_section=index == len(record["methods"]) - 1,
        )


def print_records(records: Sequence[Mapping[str, Any]], title: str) -> None:
    """The table, and the worst ratio and disagreement in it."""
    table = Table(title=title, box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("map", "model", "θ", "method", "ms", "best", "ratio", "sweeps", "MiB", "diff."):
        table.add_column(name, justify="left" if name in ("model", "method") else "right", no_wrap=True)
    for record in records:
        print_record(table, record)
    differences = [
        method["difference"] for record in records for method in record["methods"].values() if method["difference"]
    ]
    console = Console(width=None if sys.stdout.isatty() else 100)
    console.print(table)
    worst, best = (max(record[key] for record in records) for key in ("ratio", "best_ratio"))
    console.print(f"A gradient by the adjoint took at most {worst:.2f} times a value solve ({best:.2f} by best times).")
    if differences:
        console.print(f"The methods' gradients differ by at most {max(differences):.1e} of the largest component.")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="The cost of a gradient, three ways.")
    add = parser.add_argument
    add("--sizes", type=int, nargs="+", default=[16, 32, 64, 128], metavar="N", help="maps of N × N cells (10 or more)")
    add("--backup", choices=sorted(BACKUPS), default="boltzmann", help="how walkers value states")
    add("--gradient", choices=("exact", "fixed_policy"), default="exact")
    add("--beta", type=float, default=10.0, help="how sharply walkers choose")
    add("--discount", type=float, default=0.95)
    add("--step-cost", type=float, help="a cost for every move; without it the goal pays 1")
    add("--turns", type=int, default=40, help="how often each method is timed")
    add("--budget", type=float, default=10.0, help="seconds after which a method takes no more than three turns")
    add("--memory", type=float, default=4.0, help="GiB above which a method is not run")
    add("--forward-limit", type=int, default=2**21, help="largest states × parameters for the forward programme")
    add("--seed", type=int, default=0, help="draws maps, walkers and parameters")
    add("--json", type=Path, metavar="FILE", help="write the records")
    add("--quick", action="store_true", help="16² and 32² only, ten turns, a smaller forward programme")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.sizes, arguments.turns, arguments.budget, arguments.forward_limit = [16, 32], 10, 1.0, 2**19
    if arguments.turns < 1:
        parser.error("--turns: expected a number above 0")
    return arguments


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes what the arguments ask for."""
    records = []
    errors = Console(stderr=True)
    for size in arguments.sizes:
        for name, problem in problems(size, arguments).items():
            with errors.status(f"{size}² as {name}"):
                records.append(measure(size, name, problem, arguments))
    reward = "goal 1" if arguments.step_cost is None else f"step cost {arguments.step_cost:g}"
    title = f"{arguments.backup}, {arguments.gradient}, β={arguments.beta:g}, γ={arguments.discount:g}, {reward}"
    print_records(records, title)
    if arguments.json:
        settings = {key: value for key, value in vars(arguments).items() if key != "json"}
        write_json(arguments.json, {"settings": settings, "device": str(jax.devices()[0]), "records": records})


def main() -> int:
    """Runs the script; the exit code is 1 for settings that cannot be used and values that do not converge."""
    jax.config.update("jax_enable_x64", True)
    try:
        run(_arguments())
    except SidestepError as error:
        Console(stderr=True).print(f"error: {error}", markup=False, soft_wrap=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
