"""The problems that `planning_peers.py` gives to all planners, their exact answers, and this project's own calls."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.linalg import spsolve

from sidestep.errors import NotConverged
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.base import Solver
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task
from worlds import World


@dataclass(frozen=True)
class Problem:
    """A world and one task in it, as this project and as others want it."""

    world: World
    discount: float
    beta: float

    @cached_property
    def model(self) -> ObstacleGrid:
        """The half-learned model."""
        return self.world.model

    @cached_property
    def task(self) -> Task:
        """Reaching the goal at a step cost of 1."""
        return self.world.tasks(self.discount, 1.0)[0]

    def arrays(self) -> dict[str, np.ndarray]:
        """Transitions (state, action, after, chance), no two alike; the goal leads to itself and costs nothing."""
        model, goal = self.model, int(self.world.goals[0])
        successors, chances = np.array(model.graph.successors), np.array(model.probabilities())
        states, actions, outcomes = successors.shape
        successors[goal] = goal
        rows = np.repeat(np.arange(states * actions), outcomes)
        moves = coo_array((chances.reshape(-1), (rows, successors.reshape(-1))), shape=(states * actions, states))
        moves.sum_duplicates()
        pairs, after = moves.coords
        reward = np.full((states, actions), -1.0)
        reward[goal] = 0
        return {
            "state": pairs // actions,
            "action": pairs % actions,
            "after": after,
            "chance": moves.data,
            "reward": reward,
            "terminal": np.arange(states) == goal,
            "discount": np.asarray(self.discount),
            "beta": np.asarray(self.beta),
        }


@eqx.filter_jit
def soft_values(
    model: ObstacleGrid, task: Task, behavior: Behavior, solver: Solver | None, horizon: int | None
) -> tuple[Array, Array]:
    """Soft values and whether they converged."""
    found = solve(model, task, behavior, options=SolveOptions(solver=solver, horizon=horizon))
    return found.values, found.converged


def own_call(problem: Problem, name: str, soft: bool, tolerance: float, horizon: int) -> Callable[[], np.ndarray]:
    """This project's call by its name; raises `NotConverged` if it fails."""
    model, task = problem.model, problem.task
    solvers = {"sidestep ordered": GaussSeidel(tolerance=tolerance), "sidestep jacobi": Jacobi(tolerance=tolerance)}
    solver = solvers.get(name)
    if not soft:
        return lambda: np.asarray(
            jax.block_until_ready(plan(model, task, options=SolveOptions(solver=solver))).solution.values
        )

    def call() -> np.ndarray:
        people = Behavior(LogSumExp(), problem.beta)
        values, converged = soft_values(model, task, people, solver, horizon if solver is None else None)
        if not bool(converged):
            raise NotConverged("soft values did not converge")
        return np.asarray(values)

    return call


def exact_hard(problem: Problem) -> Float[np.ndarray, " states"]:
    """The values of the best policy by a linear solve; raises `NotConverged` unless no action is better."""
    given = problem.arrays()
    states, actions = given["reward"].shape
    pairs = given["state"] * actions + given["action"]
    moves = csr_array((given["chance"], (pairs, given["after"])), shape=(states * actions, states))
    policy = np.asarray(plan(problem.model, problem.task).policy).argmax(axis=1)
    for _ in range(20):
        chosen = np.arange(states) * actions + policy
        system = (eye_array(states) - problem.discount * moves[chosen]).tocsc()
        values = np.asarray(spsolve(system, given["reward"].reshape(-1)[chosen]))
        q = given["reward"] + problem.discount * (moves @ values).reshape(states, actions)
        if np.abs(q.max(axis=1) - values).max() <= 1e-9 * (1 - problem.discount) * np.abs(values).max():
            return values
        policy = q.argmax(axis=1)
    raise NotConverged("the exact values were not found")


def exact_soft(problem: Problem) -> Float[np.ndarray, " states"]:
    """The soft values, iterated by plain backups in NumPy from those of the solver until rounding."""
    given = problem.arrays()
    states, actions = given["reward"].shape
    pairs = given["state"] * actions + given["action"]
    moves = csr_array((given["chance"], (pairs, given["after"])), shape=(states * actions, states))
    values = own_call(problem, "sidestep ordered", True, 1e-12, 0)()
    for _ in range(100_000):
        q = problem.beta * (given["reward"] + problem.discount * (moves @ values).reshape(states, actions))
        best = q.max(axis=1)
        new = (best + np.log(np.exp(q - best[:, None]).sum(axis=1))) / problem.beta
        new[given["terminal"]] = 0
        change, values = np.abs(new - values).max(), new
        if change <= 1e-10 * (1 - problem.discount) * np.abs(values).max():
            return values
    raise NotConverged("the exact soft values were not found")


def difference(found: np.ndarray, exact: np.ndarray) -> float:
    """The largest difference, relative to each value (to 1, where that is smaller, such as at the goal)."""
    return float(np.max(np.abs(found - exact) / np.maximum(np.abs(exact), 1.0)))
