"""The planners of other projects, run by a Python that has them; `planning_peers.py` starts this and talks to it.

Each line of standard input is a request in JSON, each line of standard output its answer:

- `{"do": "know", "methods": [...]}` names the methods whose libraries are there, with their versions;
- `{"do": "load", "problem": "problem.npz"}` reads a problem (arrays as `planning_peers.Problem` writes them);
- `{"do": "build", "method": ...}` imports the library and gives it the problem, unless that has been done;
- `{"do": "solve", "method": ..., "tolerance": ..., "horizon": ..., "into": "values.npy"}` solves it and writes the
  values; the answer's `seconds` are those of the library's solving call alone, neither reading nor building.
- `{"do": "memory"}` tells the largest resident set so far, and what was held after the library was imported.

It imports nothing of this project.
"""

import importlib
import importlib.metadata
import json
import os
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

MODULES = {"quantecon": "quantecon.markov", "mdpsolver": "mdpsolver", "imitation": "imitation.algorithms.mce_irl"}


class QuantEcon:
    """`quantecon.markov.DiscreteDP`, state-action pairs with a sparse matrix."""

    def __init__(self, given: dict[str, np.ndarray]):
        from scipy.sparse import csr_matrix

        states, actions = given["reward"].shape
        rows = given["state"] * actions + given["action"]
        moves = csr_matrix((given["chance"], (rows, given["after"])), shape=(states * actions, states))
        state, action = np.divmod(np.arange(states * actions), actions)
        self._problem = _library("quantecon").DiscreteDP(
            given["reward"].reshape(-1), moves, float(given["discount"]), state, action
        )

    def solver(self, algorithm: str, tolerance: float, horizon: int) -> Callable[[], np.ndarray]:
        """The call to be timed."""
        del horizon
        names = {"values": "value_iteration", "policies": "policy_iteration", "modified": "modified_policy_iteration"}
        method, most = names[algorithm], 1_000_000
        return lambda: self._problem.solve(method=method, epsilon=tolerance, max_iter=most).v


class MDPSolver:
    """`mdpsolver.model`, transitions element by element; new for each solve, as a used one goes on where it was."""

    def __init__(self, given: dict[str, np.ndarray]):
        columns = (given["state"].tolist(), given["action"].tolist(), given["after"].tolist(), given["chance"].tolist())
        moves = [list(move) for move in zip(*columns, strict=True)]
        rewards = given["reward"].tolist()
        self._given = {"discount": float(given["discount"]), "rewards": rewards, "tranMatElementwise": moves}

    def solver(self, algorithm: str, tolerance: float, horizon: int) -> Callable[[], np.ndarray]:
        """The call to be timed."""
        del horizon
        problem = _library("mdpsolver").model()
        problem.mdp(**self._given)
        kinds = {"values": "vi", "policies": "pi", "modified": "mpi"}
        kind, *more = algorithm.split()
        asked = {
            "algorithm": kinds[kind],
            "tolerance": tolerance,
            "update": "gs" if "gs" in more else "standard",
            "parallel": "serial" not in more,
        }

        def call() -> np.ndarray:
            problem.solve(**asked)
            return problem.getValueVector()

        return call


class Imitation:
    """`imitation.algorithms.mce_irl.mce_partition_fh`: soft values at β = 1, a finite horizon, dense transitions.

    Rewards are multiplied by β, and values divided. Its tasks have no end, and every choice adds to the values, so an
    end is a state without a way out whose reward takes back what choosing there adds.
    """

    def __init__(self, given: dict[str, np.ndarray]):
        states, actions = given["reward"].shape
        moves = np.zeros((states, actions, states))
        np.add.at(moves, (given["state"], given["action"], given["after"]), given["chance"])
        reward = float(given["beta"]) * given["reward"].max(axis=1)
        reward[given["terminal"]] = -np.log(actions)
        self._given, self._solve = given, _library("imitation").mce_partition_fh
        self._world = SimpleNamespace(
            state_dim=states, action_dim=actions, transition_matrix=moves, reward_matrix=reward, horizon=1
        )

    def solver(self, algorithm: str, tolerance: float, horizon: int) -> Callable[[], np.ndarray]:
        """The call to be timed."""
        del algorithm, tolerance
        self._world.horizon = horizon
        discount, beta = float(self._given["discount"]), float(self._given["beta"])
        return lambda: self._solve(self._world, discount=discount)[0][0] / beta


PLANNERS = {"quantecon": QuantEcon, "mdpsolver": MDPSolver, "imitation": Imitation}


class Worker:
    """Holds a problem, as each library wants it."""

    def __init__(self) -> None:
        self._given: dict[str, np.ndarray] = {}
        self._planners: dict[str, Any] = {}
        self._imports = 0

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request."""
        if request["do"] == "know":
            return self.know()
        if request["do"] == "load":
            with np.load(request["problem"]) as saved:
                self._given = {name: saved[name] for name in saved.files}
            self._planners = {}
            return {}
        if request["do"] == "build":
            self.build(request["method"])
            return {}
        if request["do"] == "solve":
            return self.solve(request)
        return {"peak_bytes": _status("VmHWM"), "imports_bytes": self._imports}

    def know(self) -> dict[str, Any]:
        """The libraries that are here, and their versions."""
        found = {}
        for name in MODULES:
            try:
                found[name] = importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                continue
        return found

    def build(self, method: str) -> None:
        """Gives the problem that was loaded to the library of a method."""
        library = method.partition(" ")[0]
        if library not in self._planners:
            _library(library)
            self._imports = _status("VmRSS")
            self._planners[library] = PLANNERS[library](self._given)

    def solve(self, request: dict[str, Any]) -> dict[str, Any]:
        """Solves the problem that was loaded."""
        library, _, algorithm = request["method"].partition(" ")
        self.build(request["method"])
        call = self._planners[library].solver(algorithm, request["tolerance"], request["horizon"])
        started = time.perf_counter()
        values = call()
        seconds = time.perf_counter() - started
        np.save(request["into"], np.asarray(values, dtype=np.float64))
        return {"seconds": seconds}


def _library(name: str) -> Any:
    """The module with a library's planner."""
    return importlib.import_module(MODULES[name])


def _status(key: str) -> int:
    """A size from the system's account of this process, in bytes; 0 if there is none."""
    path = Path("/proc/self/status")
    found = re.search(rf"^{key}:\s+(\d+) kB", path.read_text(), re.MULTILINE) if path.exists() else None
    return int(found.group(1)) * 1024 if found else 0


def main() -> None:
    """Answers until there are no more requests; what the libraries print goes to standard error."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    worker = Worker()
    for line in sys.stdin:
        try:
            found = worker.answer(json.loads(line))
        except Exception as error:  # whatever a library raises is told, not hidden
            found = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(found), file=answers, flush=True)


if __name__ == "__main__":
    main()
