"""How the cost of a gradient grows with the map, in units of one shortest-path search on the same map.

    python -m benchmarks scaling --sizes 256 1024 --backups boltzmann --tolerance 1e-8

The map is an office of 64² to 2048² cells. The learner does not know any cell: by now P(blocked) is about .98 on walls
and .02 elsewhere (logits ±3.9, with noise of .3), as after a fit to many walks. Ten walkers pursue one goal at a step
cost of 1 (β = 5, γ = .9999). What is timed is the value and gradient of their action log-likelihood with respect to the
parameters of all cells, as a fit computes it:

- cold: from nothing;
- warm: after a step of an optimizer, from what the solve before left (values, order, adjoint). The step is along the
  gradient, its largest component `--step` long; with `--step-by-sign` every component is that long;
- region: the same, restricted to the states that mattered to the solve before (Gauss–Seidel only), as a fit of a
  large map does where it tries a step that changes little;
- Dijkstra: `scipy.sparse.csgraph.dijkstra` from the goal over the expected cost of every move, matrix not counted.

Memory is that of a process of its own that takes a gradient of each kind. The exponent is that of the power law through
the times from 128² cells on, and the largest between two sizes in a row.

Records: `name` (solver), `backup`, `cells`, `tasks`, `moves`, `tolerance`, `step`, `turns`; for each kind and Dijkstra
`..._seconds` (median), `best_..._seconds`, `..._units` (median ratio to Dijkstra in the same turn), `..._sweeps`;
`region` (fraction of states that mattered), `region_error` (largest difference between its gradient and the warm one,
relative to the largest component; null if other states mattered by then), and the fields of `benchmarks.peak_memory`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from benchmarks import MEMORY, Record, groups, in_turns, median, median_ratio, note, option, peak_memory, print_table
from benchmarks import seconds_of as seconds
from sidestep.errors import NotConverged
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import Choices, choice_log_likelihood, choices_of
from sidestep.tabular.models import ObstacleGrid, TransitionModel
from sidestep.tabular.solve import Solution, SolveOptions
from sidestep.tabular.solvers.base import WarmStart
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task, reach
from sidestep.worlds.offices import connected_cells, office

SOLVERS = {"gauss_seidel": GaussSeidel, "jacobi": Jacobi}
KINDS = ("cold", "warm", "region")
FROM_CELLS = 128**2
"""From how many cells on the exponent is fitted; below, the overhead of a call counts."""
SURE, NOISE = 3.9, 0.3
MARKERS = "os^Dv<>PX*hpd8"


@dataclass
class GradientOptions:
    """The options of what is differentiated."""

    backups: list[str] = option(["boltzmann", "logsumexp"], "names of backups", choices=sorted(BACKUPS))
    beta: float = option(5.0, "inverse temperature of the walkers")
    discount: float = option(0.9999, "γ")
    step_cost: float = option(1.0, "a cost for every move")
    goal_pays: bool = option(False, "no cost for moves; the goal pays 1")
    tolerance: float = option(1e-7, "relative change at which a solve stops")
    step: float = option(0.1, "the optimizer's step before the warm gradient, in logits")
    step_by_sign: bool = option(False, "the same step for every parameter, as Adam's first")
    turns: int = option(7, "how often everything is timed", quick=3)
    budget: float = option(8.0, "seconds after which a method takes no more than three turns", quick=1.0)
    seed: int = option(0, "draws maps, walks and parameters", least=0)


@dataclass
class Options(GradientOptions):
    """The options of this benchmark."""

    sizes: list[int] = option([64, 128, 256, 512, 1024, 2048], "N × N cells", quick=[64, 128, 256])
    solvers: list[str] = option(list(SOLVERS), "names of solvers", choices=SOLVERS)
    jacobi_limit: int = option(128, "largest N for Jacobi's sweeps over all states")
    tasks: int = option(1, "how many goals")
    walks: int = option(10, "walks to each goal")
    memory_from: int = option(0, "smallest N whose memory is measured", quick=256, least=0)


# ---------------------------------------------------------------------------------------------------- the problem


class World(NamedTuple):
    """An office of size × size cells: logits of P(blocked), a goal (state) for each task, the states of each walk."""

    size: int
    logits: np.ndarray
    goals: np.ndarray
    walks: list[tuple[int, np.ndarray]]  # each with its task

    @property
    def model(self) -> ObstacleGrid:
        """The half-learned model."""
        return ObstacleGrid(Grid.unknown(self.size, self.size), self.logits)

    def tasks(self, discount: float, step_cost: float | None) -> list[Task]:
        """Return the tasks of reaching each goal."""
        return [reach(self.model.blank, int(goal), discount=discount, step_cost=step_cost) for goal in self.goals]

    def demonstrations(self, discount: float, step_cost: float | None) -> Demonstrations:
        """Return the walks with their tasks."""
        steps = {tuple(step): action for action, step in enumerate(self.model.blank.steps.tolist())}
        trajectories = []
        for task, states in self.walks:
            changes = np.diff(np.stack(np.divmod(states, self.size), axis=-1), axis=0)
            trajectories.append(
                Trajectory(states, np.array([steps[tuple(change)] for change in changes.tolist()]), task)
            )
        return gather(trajectories, self.tasks(discount, step_cost))

    def dijkstra(self) -> Callable[[], float]:
        """Return a call that times the searches from the goals, over moves backwards at their expected costs 1/P."""
        successors = np.asarray(self.model.graph.successors)[:, :, 0]
        moves = successors != np.arange(len(successors))[:, None]
        first = np.concatenate([[0], np.cumsum(moves.sum(axis=1))]).astype(np.int32)
        costs = 1 / np.asarray(self.model.probabilities())[:, :, 0][moves]
        backwards = csr_array((costs, successors[moves], first), shape=(len(successors),) * 2).T.tocsr()
        return lambda: seconds(lambda: [dijkstra(backwards, indices=int(goal)) for goal in self.goals])


def half_learned_office(size: int, seed: int, walks: int = 10, goals: int = 1) -> World:
    """Return an office with `walks` shortest walks to each of some goals, from free cells at random."""
    truth = office(size, size, seed)
    random = np.random.default_rng(seed)
    wall = truth.known.reshape(-1) == Cell.OCCUPIED
    logits = np.where(wall, SURE, -SURE) + NOISE * random.normal(size=truth.size)
    graph, free = walkable_graph(truth), connected_cells(truth)
    ends, walked = random.choice(free, goals, replace=False), []
    for task, goal in enumerate(ends.tolist()):
        before = dijkstra(graph, indices=goal, return_predecessors=True)[1]
        for start in random.choice(np.setdiff1d(free, [goal]), walks).tolist():
            states = [start]
            while states[-1] != goal:
                states.append(int(before[states[-1]]))
            walked.append((task, np.asarray(states)))
    return World(size, logits, ends, walked)


class Problem(eqx.Module):
    """What is differentiated, and how it is solved."""

    model: TransitionModel
    demonstrations: Demonstrations
    choices: Choices
    behavior: Behavior
    solving: SolveOptions

    def cold_start(self) -> WarmStart:
        """Return the start from which nothing is known of any task."""
        assert self.solving.solver is not None
        start = self.solving.solver.cold_start(self.model.graph.states, jnp.zeros(0).dtype)
        tasks = len(self.demonstrations.tasks.terminal)
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (tasks, *leaf.shape)), start)


def problem_of(world: World, backup: str, options: GradientOptions, solver: str = "gauss_seidel") -> Problem:
    """Return the problem in a world."""
    demos = world.demonstrations(options.discount, None if options.goal_pays else options.step_cost)
    solving = SolveOptions(solver=SOLVERS[solver](tolerance=options.tolerance))
    return Problem(world.model, demos, choices_of(demos), Behavior(BACKUPS[backup](), options.beta), solving)


class Step(NamedTuple):
    """A value and gradient, and how the solve went."""

    value: Array
    gradient: Array
    start: WarmStart
    sweeps: Array
    converged: Array


@eqx.filter_jit
def take(problem: Problem, parameters: Array, start: WarmStart, region: Array) -> Step:
    """Return the action log-likelihood and its gradient; of each task, only the states of the region are solved."""

    def objective(parameters: Array, adjoint: Array) -> tuple[Array, tuple]:
        model, begun = problem.model.with_parameters(parameters), start._replace(adjoint=adjoint)

        def one(task: Task, choices: Choices, begun: WarmStart, region: Array) -> tuple[Array, Solution]:
            keywords = {"options": problem.solving, "region": region}
            return choice_log_likelihood(model, task, choices, problem.behavior, begun, **keywords)

        values, solution = jax.vmap(one)(problem.demonstrations.tasks, problem.choices, begun, region)
        return values.sum(), (solution.start, solution.sweeps, solution.converged.all())

    differentiated = jax.value_and_grad(objective, argnums=(0, 1), has_aux=True)
    (value, (left, sweeps, converged)), (gradient, adjoint) = differentiated(parameters, start.adjoint)
    return Step(value, gradient, left._replace(adjoint=adjoint), sweeps, converged)


def stepped(parameters: Array, gradient: Array, options: GradientOptions) -> Array:
    """Return the parameters after a step along the gradient."""
    largest = jnp.abs(gradient).max()
    if options.step_by_sign:
        return parameters + options.step * jnp.sign(gradient) * (jnp.abs(gradient) > 1e-9 * largest)
    return parameters + options.step * gradient / largest


def of_all_kinds(problem: Problem, options: GradientOptions) -> Iterator[Step]:
    """Yield a gradient of each of `KINDS`."""
    at, start = problem.model.parameters, problem.cold_start()
    step = jax.block_until_ready(take(problem, at, start, start.region))
    start = step.start
    yield step
    at = jax.block_until_ready(stepped(at, step.gradient, options))
    del step  # a fit does not keep it either
    yield jax.block_until_ready(take(problem, at, start, jnp.ones_like(start.region)))
    yield jax.block_until_ready(take(problem, at, start, start.region))


# ---------------------------------------------------------------------------------------------------- measuring


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each map, backup and solver."""
    for size in sorted(options.sizes):
        world = half_learned_office(size, options.seed, options.walks, options.tasks)
        names = [name for name in options.solvers if name != "jacobi" or size <= options.jacobi_limit]
        for backup in options.backups:
            yield from _of_one_map(world, backup, names, options)
            note(f"{size}² {backup} done")


def _of_one_map(world: World, backup: str, names: Sequence[str], options: Options) -> Iterator[Record]:
    problems = {name: problem_of(world, backup, options, name) for name in names}
    steps = {name: list(of_all_kinds(problem, options)) for name, problem in problems.items()}

    def timed(name: str, kind: str) -> float:
        problem, first = problems[name], steps[name][0]
        at, start = problem.model.parameters, problem.cold_start()
        region = start.region
        if kind != "cold":
            at, start = stepped(at, first.gradient, options), first.start
            region = start.region if kind == "region" else jnp.ones_like(start.region)
        at, start, region = jax.block_until_ready((at, start, region))
        return seconds(lambda: jax.block_until_ready(take(problem, at, start, region)))

    calls = {"dijkstra": world.dijkstra()}
    calls |= {f"{kind} {name}": partial(timed, name, kind) for name in names for kind in KINDS}
    taken = in_turns(calls, options.turns, options.budget)
    for name in names:
        record = {"name": name, "backup": backup, "cells": world.size**2, "tasks": len(world.goals)}
        for kind in (*KINDS, "dijkstra"):
            own = taken[kind if kind == "dijkstra" else f"{kind} {name}"]
            record |= {f"{kind}_seconds": median(own), f"best_{kind}_seconds": min(own), "turns": len(own)}
            record[f"{kind}_units"] = median_ratio(own, taken["dijkstra"])
        moves = sum(len(states) - 1 for _, states in world.walks)
        record |= {"tolerance": options.tolerance, "step": options.step, "moves": moves}
        memory: Record = dict.fromkeys(MEMORY)
        if world.size >= options.memory_from:
            memory = peak_memory(gradients_of_all_kinds, world, backup, options, name)
        yield {**record, **_solved(steps[name]), **memory}


def _solved(steps: Sequence[Step]) -> Record:
    """Return the sweeps of the values; raises `NotConverged` unless values and adjoints all converged."""
    # an adjoint that did not converge leaves a gradient of NaN
    if not all(step.converged and jnp.isfinite(step.gradient).all() for step in steps[:2]) or not steps[2].converged:
        raise NotConverged("the values or the adjoint did not converge: try another tolerance or backup")
    cold, warm, region = steps
    error = jnp.abs(region.gradient - warm.gradient).max() / jnp.abs(warm.gradient).max()
    return {
        **{f"{kind}_sweeps": int(step.sweeps.max()) for kind, step in zip(KINDS, steps, strict=True)},
        "region": float(cold.start.region.mean()),
        "region_error": float(error) if jnp.isfinite(error) else None,
    }


def gradients_of_all_kinds(world: World, backup: str, options: Options, solver: str) -> Callable[[], object]:
    """Return a call that takes a gradient of each kind and keeps none, for `peak_memory`."""
    problem = jax.block_until_ready(problem_of(world, backup, options, solver))
    return lambda: [None for _ in of_all_kinds(problem, options)]


# ---------------------------------------------------------------------------------------------------- reporting


def show(records: Sequence[Record], options: Options) -> None:
    """Print the times, and the exponents of their growth."""
    columns = {"cells": "cells", "solver": "name", "backup": "backup"}
    columns |= {f"{kind} ms": f"{kind}_seconds ms" for kind in (*KINDS, "dijkstra")}
    columns |= {f"{kind} units": f"{kind}_units .2f" for kind in KINDS} | {"sweeps": "cold_sweeps"}
    columns |= {"mattered": "region .2f", "peak MiB": "peak_bytes MiB", "imports": "imports_bytes MiB"}
    columns |= {"excess": "excess_bytes MiB", "gradients": "call_bytes MiB"}
    step = f"{options.step:g} ({'every' if options.step_by_sign else 'largest'} component)"
    print_table(f"a value and gradient, {described(options)}; warm after a step of {step}", records, columns)
    columns = {"solver": "name", "backup": "backup", "time": "kind"}
    columns |= {"exponent": "fitted .3f", "largest in a row": "largest .3f"}
    print_table(f"time ∝ cells^exponent, from {FROM_CELLS} cells on", list(exponents(records)), columns)


def described(options: GradientOptions) -> str:
    """Return the settings of the problem, for a title."""
    reward = "goal pays 1" if options.goal_pays else f"step cost {options.step_cost:g}"
    return f"β={options.beta:g}, γ={options.discount:g}, {reward}, tolerance {options.tolerance:g}"


def exponents(records: Sequence[Record]) -> Iterator[Record]:
    """Yield the exponent of time ∝ cells^exponent for each solver, backup, kind of start and unit of time."""
    for label, own in groups([record for record in records if record["cells"] >= FROM_CELLS], "name", "backup"):
        for kind in [*(f"{kind}_seconds" for kind in (*KINDS, "dijkstra")), *(f"{kind}_units" for kind in KINDS)]:
            if len(own) > 1:
                fitted, largest = power_law([r["cells"] for r in own], [r[kind] for r in own])
                yield {**label, "kind": kind.replace("_", " "), "fitted": fitted, "largest": largest}


def power_law(sizes: Sequence[float], times: Sequence[float]) -> tuple[float, float]:
    """Return the exponent fitted to times by sizes (both ascending by size), and the largest between two in a row."""
    x, y = np.log(sizes), np.log(times)
    return float(np.polyfit(x, y, 1)[0]), float((np.diff(y) / np.diff(x)).max())


def draw(records: Sequence[Record], options: object = None) -> Figure:
    """Return a picture of times (a panel for each backup) and peak memory against cells, a line for each method.

    Lines are solid for cold times, dashed for warm ones, and dotted for one shortest-path search on the same map.
    """
    del options
    backups, names = (list(dict.fromkeys(record[key] for record in records)) for key in ("backup", "name"))
    picture = Figure(figsize=(4.2 * (len(backups) + 1), 5), layout="constrained")
    panels = picture.subplots(1, len(backups) + 1)

    def line(axes, own: Sequence[Record], key: str, factor: float = 1.0, **style: Any) -> None:
        points = [(record["cells"], factor * record[key]) for record in own if record.get(key) is not None]
        if points:
            axes.plot(*np.transpose(sorted(points)), **style)

    for label, own in groups(records, "name", "backup"):
        number, axes = names.index(label["name"]), panels[backups.index(label["backup"])]
        style: dict[str, Any] = {"color": f"C{number}", "marker": MARKERS[number % len(MARKERS)]}
        line(axes, own, "cold_seconds", label=label["name"], **style)
        line(axes, own, "warm_seconds", linestyle="--", markerfacecolor="white", **style)
        line(panels[-1], own, "peak_bytes", 2**-20, **style)
    for backup, axes in zip(backups, panels, strict=False):
        first = next(own for label, own in groups(records, "name", "backup") if label["backup"] == backup)
        line(axes, first, "dijkstra_seconds", color="black", linestyle=":", label="one shortest-path search")
        axes.set(xscale="log", yscale="log", xlabel="cells", ylabel="seconds (dashed: after a step)", title=backup)
    panels[-1].set(xscale="log", ylim=(0, None), xlabel="cells", ylabel="peak memory of the process (MiB)")
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
    handles = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    picture.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize="small")
    return picture
