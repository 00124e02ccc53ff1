"""Planning beside other projects' planners: the same problem, the same accuracy, answers compared.

    python -m venv peers && peers/bin/pip install quantecon mdpsolver imitation
    python -m benchmarks planning --peers-python peers/bin/python

The other projects are no dependencies of this one: they run in a process of their own (`peers.py`), by the Python that
`--peers-python` names. All take turns in one run.

- Hard max (best plan): `sidestep.plan` by either solver, beside QuantEcon's `DiscreteDP` (sparse; value, policy and
  modified policy iteration) and mdpsolver (the same three; with `gs` its Gauss–Seidel updates).
- Log-sum-exp (soft values): `sidestep.solve`, to the fixed point and with a finite horizon, beside `imitation`'s
  `mce_partition_fh`, which has a finite horizon and dense transitions, so maps are small. The horizon is one after
  which values differ from the fixed point by no more than `--accuracy`.

The maps are those of `scaling.py`, with one goal, a step cost of 1, γ = .99. Each method stops by a rule of its own; it
gets the loosest tolerance, of powers of ten, with which its values come within `--accuracy` of the exact ones, relative
to each value. The exact ones are the sparse linear solve of the best policy; its Bellman residual is checked. Of a
library only its solving call is timed, without the making of its matrices; of this project all, from the map's
parameters to the plan. Memory is that of a process that solves the problem once; for the largest map of each kind.

Records: `name` (method), `project`, `version`, `backup`, `cells`, `tasks`, `cold_seconds` (median), `best_seconds`,
`warm_seconds` (null), `dijkstra_seconds`, `ratio` (to the fastest of this project: above 1 is slower), `difference`
(largest, relative to each value), `tolerance`, `horizon`, `turns`, the first three fields of `benchmarks.peak_memory`,
`failed` (null, or why there is no time).
"""

import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.linalg import spsolve

from benchmarks import MEMORY, Record, in_turns, median, note, option, peak_memory, print_faster, print_table, warn
from benchmarks.scaling import SOLVERS, World, draw, half_learned_office
from sidestep.errors import InputError, NotConverged, SidestepError
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.tasks import Task

__all__ = ["Options", "draw", "measure", "show"]
HOW_TO = "to make one: python -m venv peers && peers/bin/pip install quantecon mdpsolver imitation"
TOLERANCES = tuple(10.0**-power for power in range(2, 14))
QUANTECON = [f"quantecon {kind}" for kind in ("policies", "modified", "values")]
MDPSOLVER = [f"mdpsolver {kind}" for kind in ("modified gs", "modified serial", "modified", "values", "policies")]
OURS = [f"sidestep {name}" for name in SOLVERS]
HARD, SOFT = OURS + QUANTECON + MDPSOLVER, [*OURS, "sidestep finite horizon", "imitation finite horizon"]
WITHOUT_TOLERANCE = ("quantecon policies", "imitation finite horizon", "sidestep finite horizon")
BUILDING = 300.0
"""Seconds that a library may take to be imported and to build its matrices, which are not timed."""


@dataclass
class Options:
    """The options of this benchmark."""

    peers_python: str = option("peers/bin/python", "a Python that has the others")
    sizes: list[int] = option([32, 64, 128], "N × N cells, hard max", quick=[32])
    soft_sizes: list[int] = option([16, 24], "N × N cells, log-sum-exp", quick=[16])
    discount: float = option(0.99, "γ, above 0 and below 1, as the others need it")
    beta: float = option(5.0, "inverse temperature of soft walkers")
    accuracy: float = option(1e-6, "how far from the exact values every method may be")
    turns: int = option(9, "how often everything is timed", quick=3)
    budget: float = option(5.0, "seconds after which a method takes no more than three turns", quick=1.0)
    limit: float = option(6.0, "seconds after which a method is given up")
    no_memory: bool = option(False, "leave out the processes that measure memory", quick=True)
    seed: int = option(0, "draws maps and parameters", least=0)


# ---------------------------------------------------------------------------------------------------- the problem


@dataclass(frozen=True)
class Problem:
    """A world and one task in it, for this project and for others."""

    world: World
    discount: float
    beta: float

    @cached_property
    def task(self) -> Task:
        """Reaching the goal at a step cost of 1."""
        return self.world.tasks(self.discount, 1.0)[0]

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """Transitions (state, action, after, chance), no two alike; the goal leads to itself and costs nothing."""
        model, goal = self.world.model, int(self.world.goals[0])
        successors, chances = np.array(model.graph.successors), np.array(model.probabilities())
        states, actions, outcomes = successors.shape
        successors[goal] = goal
        rows = np.repeat(np.arange(states * actions), outcomes)
        moves = coo_array((chances.reshape(-1), (rows, successors.reshape(-1))), shape=(states * actions, states))
        moves.sum_duplicates()
        pairs, after = moves.coords
        reward = np.full((states, actions), -1.0)
        reward[goal] = 0
        terminal, numbers = np.arange(states) == goal, {"discount": self.discount, "beta": self.beta}
        moved = {"state": pairs // actions, "action": pairs % actions, "after": after, "chance": moves.data}
        return {**moved, "reward": reward, "terminal": terminal} | {k: np.asarray(v) for k, v in numbers.items()}

    def backup(self, values: np.ndarray) -> np.ndarray:
        """Return Q(s, a)."""
        return self.arrays["reward"] + self.discount * (self.moves @ values).reshape(self.arrays["reward"].shape)

    @cached_property
    def moves(self) -> csr_array:
        """The transitions, a row for each state and action."""
        (states, actions), inputs = self.arrays["reward"].shape, self.arrays
        rows = inputs["state"] * actions + inputs["action"]
        return csr_array((inputs["chance"], (rows, inputs["after"])), shape=(states * actions, states))

    def exact_hard(self) -> np.ndarray:
        """Return the values of the best policy by a linear solve; raises `NotConverged` unless no action is better."""
        states, actions = self.arrays["reward"].shape
        policy = np.asarray(plan(self.world.model, self.task).policy).argmax(axis=1)
        for _ in range(20):
            chosen = np.arange(states) * actions + policy
            system = (eye_array(states) - self.discount * self.moves[chosen]).tocsc()
            values = np.asarray(spsolve(system, self.arrays["reward"].reshape(-1)[chosen]))
            q = self.backup(values)
            if np.abs(q.max(axis=1) - values).max() <= 1e-9 * (1 - self.discount) * np.abs(values).max():
                return values
            policy = q.argmax(axis=1)
        raise NotConverged("the exact values were not reached")

    def exact_soft(self) -> np.ndarray:
        """Return the soft values, iterated by plain backups in NumPy from those of the solver until rounding."""
        values = own_call(self, OURS[0], True, 1e-12, 0)()
        for _ in range(100_000):
            new = np.logaddexp.reduce(self.beta * self.backup(values), axis=1) / self.beta
            new[self.arrays["terminal"]] = 0
            change, values = np.abs(new - values).max(), new
            if change <= 1e-10 * (1 - self.discount) * np.abs(values).max():
                return values
        raise NotConverged("the exact soft values were not reached")


@eqx.filter_jit
def soft_values(model: ObstacleGrid, task: Task, behavior: Behavior, options: SolveOptions) -> tuple[Array, Array]:
    """Return soft values, and whether they converged."""
    solution = solve(model, task, behavior, options=options)
    return solution.values, solution.converged


def own_call(problem: Problem, name: str, soft: bool, tolerance: float, horizon: int) -> Callable[[], np.ndarray]:
    """Return this project's call by its name; the call raises `NotConverged` if it fails."""
    model, task, kind = problem.world.model, problem.task, SOLVERS.get(name.removeprefix("sidestep "))
    options = SolveOptions(solver=kind(tolerance=tolerance)) if kind else SolveOptions(horizon=horizon)
    if not soft:
        return lambda: np.asarray(jax.block_until_ready(plan(model, task, options=options)).solution.values)

    def call() -> np.ndarray:
        values, converged = soft_values(model, task, Behavior(LogSumExp(), problem.beta), options)
        if not bool(converged):
            raise NotConverged("soft values did not converge")
        return np.asarray(values)

    return call


def difference(values: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest difference, relative to each value (to 1, where that is smaller, such as at the goal)."""
    return float(np.max(np.abs(values - exact) / np.maximum(np.abs(exact), 1.0)))


# ---------------------------------------------------------------------------------------------------- the others


class Peers:
    """The process of the other planners; one that takes longer than `limit` seconds to answer is replaced."""

    def __init__(self, python: str, limit: float):
        self._python, self._limit, self._problem = python, limit, ""
        self._begin()

    def _begin(self) -> None:
        ours, theirs = socket.socketpair()
        # threads that spin while they wait would slow themselves down on a machine that is shared
        variables = {**os.environ, "OMP_WAIT_POLICY": "passive"}
        command = [self._python, str(Path(__file__).with_name("peers.py")), str(theirs.fileno())]
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(command, env=variables, pass_fds=[theirs.fileno()], **quiet)
        theirs.close()
        self._connection = Connection(ours.detach())

    def ask(self, function: str, *arguments: object, limit: float | None = None) -> Any:
        """Return the result of a function of `peers.py`; raises `SidestepError` if it fails or takes too long."""
        limit = limit or self._limit
        try:
            self._connection.send((function, *arguments))
            answered = self._connection.poll(limit)
            result, error = self._connection.recv() if answered else (None, f"over {limit:g} s")
        except (OSError, EOFError):
            answered, result, error = False, None, "the process of the others ended"
        if not answered:
            self.close()
            self._begin()
            if self._problem:
                self.load(self._problem)
        if error:
            raise SidestepError(error)
        return result

    def load(self, problem: str) -> None:
        """Have a problem read."""
        self._problem = problem
        self.ask("load", problem, limit=BUILDING)

    def solve(self, method: str, tolerance: float, horizon: int) -> tuple[float, np.ndarray]:
        """Return the seconds of a solve, and its values."""
        self.ask("build", method, limit=BUILDING)
        seconds, values = self.ask("solve", method, tolerance, horizon)
        return seconds, np.asarray(values)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._connection.close()


# ---------------------------------------------------------------------------------------------------- measuring


@dataclass
class Method:
    """How one method is run on a problem, and its result; `solve` maps tolerance and horizon to seconds and values."""

    name: str
    solve: Callable[[float, int], tuple[float, np.ndarray]]
    tolerance: float = TOLERANCES[-1]
    difference: float | None = None
    failed: str | None = None

    def tune(self, exact: np.ndarray, horizon: int, options: Options) -> None:
        """Set the loosest tolerance with which the values are accurate, or note why there is none."""
        spent = 0.0
        try:
            for self.tolerance in TOLERANCES:
                seconds, values = self.solve(self.tolerance, horizon)
                spent, self.difference = spent + seconds, difference(values, exact)
                if self.difference <= options.accuracy:
                    return
                if self.name in WITHOUT_TOLERANCE or spent > options.limit:
                    break
            self.failed = f"not within {options.accuracy:g}: {self.difference:.1e}"
        except SidestepError as error:
            self.failed = str(error)


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each map and method."""
    if not 0 < options.discount < 1:
        raise InputError("expected a number above 0 and below 1", source="--discount")
    try:
        peers = Peers(options.peers_python, options.limit)
        known = peers.ask("versions", limit=BUILDING)
    except OSError as error:
        raise InputError(f"cannot be run: {error.strerror}; {HOW_TO}", source=options.peers_python) from error
    if lacking := [name for name in ("quantecon", "mdpsolver", "imitation") if name not in known]:
        warn(f"{options.peers_python} lacks {', '.join(lacking)}; {HOW_TO}")
    for size, soft in [(size, False) for size in options.sizes] + [(size, True) for size in options.soft_sizes]:
        problem = Problem(half_learned_office(size, options.seed), options.discount, options.beta)
        yield from _of_one_problem(problem, soft, peers, known, options)
        note(f"{size}² {'log-sum-exp' if soft else 'hard max'} done")
    peers.close()


def _of_one_problem(
    problem: Problem, soft: bool, peers: Peers, known: Mapping[str, str], options: Options
) -> Iterator[Record]:
    exact, horizon = (problem.exact_soft(), 4 * problem.world.size) if soft else (problem.exact_hard(), 0)

    def own(name: str, tolerance: float, horizon: int) -> tuple[float, np.ndarray]:
        call = own_call(problem, name, soft, tolerance, horizon)
        started = time.perf_counter()
        values = call()
        return time.perf_counter() - started, values

    while soft and difference(own("sidestep finite horizon", 0, horizon)[1], exact) > options.accuracy:
        horizon = int(1.25 * horizon)
    with tempfile.TemporaryDirectory() as folder:
        arrays = str(Path(folder) / "problem.npz")
        np.savez(arrays, allow_pickle=False, **problem.arrays)
        peers.load(arrays)
        names = SOFT if soft else HARD
        methods = [Method(name, partial(own, name)) for name in names if name.startswith("sidestep")]
        methods += [Method(name, partial(peers.solve, name)) for name in names if name.split()[0] in known]
        for method in methods:
            method.tune(exact, horizon, options)
        calls = {"dijkstra": problem.world.dijkstra()}
        calls |= {m.name: lambda m=m: m.solve(m.tolerance, horizon)[0] for m in methods if not m.failed}
        taken = in_turns(calls, options.turns, options.budget)
        measured = not options.no_memory and problem.world.size == max(options.soft_sizes if soft else options.sizes)
        measured = [method for method in methods if measured and not method.failed]
        memory = {method.name: _memory(method, problem, soft, horizon, arrays, options) for method in measured}
    fastest = min((np.median(taken[name]) for name in taken if name.startswith("sidestep")), default=np.nan)
    for method in methods:
        seconds, project = taken.get(method.name, []), method.name.split()[0]
        yield {
            "name": method.name,
            "project": project,
            "version": known.get(project),
            "backup": "logsumexp" if soft else "max",
            "cells": problem.world.size**2,
            "tasks": 1,
            "cold_seconds": median(seconds),
            "best_seconds": min(seconds, default=None),
            "warm_seconds": None,
            "dijkstra_seconds": median(taken["dijkstra"]),
            "ratio": float(np.median(seconds) / fastest) if seconds else None,
            "difference": method.difference,
            "tolerance": None if method.name in WITHOUT_TOLERANCE else method.tolerance,
            "horizon": horizon if "finite" in method.name else None,
            "turns": len(seconds),
            **memory.get(method.name, dict.fromkeys(MEMORY[:3])),
            "failed": method.failed,
        }


def _memory(method: Method, problem: Problem, soft: bool, horizon: int, arrays: str, options: Options) -> Record:
    """Return the memory of a process of its own."""
    if method.name.startswith("sidestep"):
        measured = peak_memory(own_call, problem, method.name, soft, method.tolerance, horizon)
        return {key: measured[key] for key in MEMORY[:3]}
    peers = Peers(options.peers_python, options.limit)
    try:
        peers.load(arrays)
        peers.solve(method.name, method.tolerance, horizon)
        peak, imports = peers.ask("memory")
    except SidestepError as error:
        warn(f"the memory of {method.name} was not measured: {error}")
        return dict.fromkeys(MEMORY[:3])
    finally:
        peers.close()
    return dict(zip(MEMORY, (peak, imports, peak - imports), strict=False))


def show(records: Sequence[Record], options: Options) -> None:
    """Print the table, and which of the others are faster."""
    columns = {"cells": "cells", "backup": "backup", "method": "name", "ms": "cold_seconds ms"}
    columns |= {"best ms": "best_seconds ms", "ratio": "ratio .2f", "Dijkstra ms": "dijkstra_seconds ms"}
    columns |= {"difference": "difference .0e", "peak MiB": "peak_bytes MiB", "failed": "failed"}
    title = f"planning, β={options.beta:g} (soft), γ={options.discount:g}, within {options.accuracy:g} of exact"
    print_table(title, records, columns)
    print_faster([record for record in records if record["project"] != "sidestep"])
