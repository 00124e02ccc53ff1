"""The planners of other projects, run by a Python that has them; `planning.py` starts this and talks to it.

It receives `(function, *arguments)` and sends the result, or the text of an error. It imports nothing of this project.
"""

import importlib
import importlib.metadata
import importlib.util
import re
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

MODULES = {"quantecon": "quantecon.markov", "mdpsolver": "mdpsolver", "imitation": "imitation.algorithms.mce_irl"}
Arrays = dict[str, np.ndarray]
Call = Callable[[], np.ndarray]
held: dict[str, Any] = {"problem": {}, "planners": {}, "imports": 0}


def quantecon(problem: Arrays) -> Callable[[str, float, int], Call]:
    """`quantecon.markov.DiscreteDP`, state-action pairs with a sparse matrix."""
    from scipy.sparse import csr_matrix

    states, actions = problem["reward"].shape
    rows = problem["state"] * actions + problem["action"]
    moves = csr_matrix((problem["chance"], (rows, problem["after"])), shape=(states * actions, states))
    state, action = np.divmod(np.arange(states * actions), actions)
    discount, reward = float(problem["discount"]), problem["reward"].reshape(-1)
    program = importlib.import_module(MODULES["quantecon"]).DiscreteDP(reward, moves, discount, state, action)
    names = {"values": "value_iteration", "policies": "policy_iteration", "modified": "modified_policy_iteration"}
    return lambda algorithm, tolerance, _: (
        lambda: program.solve(method=names[algorithm], epsilon=tolerance, max_iter=1_000_000).v
    )


def mdpsolver(problem: Arrays) -> Callable[[str, float, int], Call]:
    """`mdpsolver.model`, transitions element by element; a new one for each solve, as a used one goes on."""
    columns = (problem[name].tolist() for name in ("state", "action", "after", "chance"))
    moves = [list(move) for move in zip(*columns, strict=True)]
    data = {"discount": float(problem["discount"]), "rewards": problem["reward"].tolist(), "tranMatElementwise": moves}

    def solver(algorithm: str, tolerance: float, _: int) -> Call:
        model = importlib.import_module(MODULES["mdpsolver"]).model()
        model.mdp(**data)
        kind, *more = algorithm.split()
        options = {"update": "gs" if "gs" in more else "standard", "parallel": "serial" not in more}
        options |= {"algorithm": {"values": "vi", "policies": "pi", "modified": "mpi"}[kind], "tolerance": tolerance}

        def call() -> np.ndarray:
            model.solve(**options)
            return model.getValueVector()

        return call

    return solver


def imitation(problem: Arrays) -> Callable[[str, float, int], Call]:
    """`imitation.algorithms.mce_irl.mce_partition_fh`: soft values at β = 1, a finite horizon, dense transitions.

    Rewards are multiplied by β, and values divided. Its tasks have no end, and every choice adds to the values, so an
    end is a state without a way out, with a reward that takes back what choosing there adds.
    """
    (states, actions), beta, discount = problem["reward"].shape, float(problem["beta"]), float(problem["discount"])
    moves = np.zeros((states, actions, states))
    np.add.at(moves, (problem["state"], problem["action"], problem["after"]), problem["chance"])
    reward = beta * problem["reward"].max(axis=1)
    reward[problem["terminal"]] = -np.log(actions)
    world = SimpleNamespace(state_dim=states, action_dim=actions, transition_matrix=moves, reward_matrix=reward)
    solve = importlib.import_module(MODULES["imitation"]).mce_partition_fh

    def solver(_: str, __: float, horizon: int) -> Call:
        world.horizon = horizon
        return lambda: solve(world, discount=discount)[0][0] / beta

    return solver


def versions() -> dict[str, str]:
    """Return the libraries that are installed, with their versions."""
    return {name: importlib.metadata.version(name) for name in MODULES if importlib.util.find_spec(name)}


def load(path: str) -> None:
    """Read a problem (arrays as `planning.Problem` has them)."""
    with np.load(path) as saved:
        held.update(problem={name: saved[name] for name in saved.files}, planners={})


def build(method: str) -> None:
    """Import the library of a method and hand it the problem, unless that is done."""
    library = method.partition(" ")[0]
    if library not in held["planners"]:
        importlib.import_module(MODULES[library])
        held["imports"] = _status("VmRSS")
        held["planners"][library] = globals()[library](held["problem"])


def solve(method: str, tolerance: float, horizon: int) -> tuple[float, list[float]]:
    """Return the seconds of the library's solving call alone, and the values."""
    library, _, algorithm = method.partition(" ")
    call = held["planners"][library](algorithm, tolerance, horizon)
    started = time.perf_counter()
    values = call()
    return time.perf_counter() - started, np.asarray(values, dtype=np.float64).tolist()


def memory() -> tuple[int, int]:
    """Return the largest resident set so far, and what was held after the library was imported."""
    return _status("VmHWM"), held["imports"]


def _status(key: str) -> int:
    path = Path("/proc/self/status")
    line = re.search(rf"^{key}:\s+(\d+) kB", path.read_text(), re.MULTILINE) if path.exists() else None
    return int(line.group(1)) * 1024 if line else 0


def main() -> None:
    """Answer requests until there are no more."""
    connection = Connection(int(sys.argv[1]))
    while True:
        try:
            function, *arguments = connection.recv()
        except EOFError:
            return
        try:
            connection.send((globals()[function](*arguments), None))
        except Exception as error:  # whatever a library raises
            connection.send((None, f"{type(error).__name__}: {error}"))


if __name__ == "__main__":
    main()
