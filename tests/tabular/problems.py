"""Small problems for the tabular tests, and the mathematics written out once more, plain and dense.

Nothing here uses the library's formulas: transitions are dense arrays T[s, a, s′], and values come from plain value
iteration, V ← B(R + γ T V), without any of the solver's care for self-loops.
"""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep.tabular.backups import Backup, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, TabularModel, TransitionModel
from sidestep.tabular.solve import solve
from sidestep.tasks import Task

BACKUPS: dict[str, Backup] = {
    "hard max": HardMax(),
    "Boltzmann": BoltzmannAverage(),
    "log-sum-exp": LogSumExp(),
    "mellowmax": Mellowmax(),
}
DISCOUNTS = (0.9, 0.95, 1.0)
STEPS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1))

solve_jit = eqx.filter_jit(solve)


NAMES = list(BACKUPS)


def plain_policy(q, beta):
    """π ∝ exp βQ."""
    odds = jnp.exp(beta * (q - jax.lax.stop_gradient(q.max(axis=-1, keepdims=True))))
    return odds / odds.sum(axis=-1, keepdims=True)


def plain_backup(name, q, beta):
    """V = B(Q), from the table in DESIGN section 1; `name` may be a traced index into `NAMES`."""
    best = jax.lax.stop_gradient(q.max(axis=-1))
    total = jnp.exp(beta * (q - best[..., None])).sum(axis=-1)
    values = {
        "hard max": q.max(axis=-1),
        "Boltzmann": (plain_policy(q, beta) * q).sum(axis=-1),
        "log-sum-exp": best + jnp.log(total) / beta,
        "mellowmax": best + jnp.log(total / q.shape[-1]) / beta,
    }
    return values[name] if isinstance(name, str) else jnp.stack([values[each] for each in NAMES])[name]


def plain_values(name, transitions, task: Task, beta, sweeps, at_most: int = 900):
    """(V, Q) by value iteration from nothing, differentiable through every one of `sweeps` (which may be traced)."""

    def q_of(values):
        return task.reward + task.discount * jnp.einsum("sat,t->sa", transitions, values)

    def ended(values):
        return jnp.where(task.terminal, task.final_reward, values)

    def sweep(values, index):
        swept = ended(plain_backup(name, q_of(values), beta))
        return jnp.where(index < sweeps, swept, values), None

    values, _ = jax.lax.scan(sweep, ended(jnp.zeros(len(transitions))), jnp.arange(at_most))
    return values, q_of(values)


def dense_obstacles(theta, rows: int, columns: int, connectivity: int):
    """T[s, a, s′] of the obstacle grid: a move needs its target free and, if diagonal, both cells beside it."""
    cells = list(product(range(rows), range(columns)))
    needed = np.zeros((len(cells), connectivity, len(cells)), dtype=bool)
    target = np.zeros_like(needed)
    for s, (r, c) in enumerate(cells):
        for a, (down, right) in enumerate(STEPS[:connectivity]):
            corners = {(r + down, c + right), (r + down, c), (r, c + right)} - {(r, c)}
            inside = (r + down, c + right) in cells
            target[s, a, cells.index((r + down, c + right)) if inside else s] = True
            for cell in corners if inside else ():
                needed[s, a, cells.index(cell)] = True
    free = 1 / (1 + jnp.exp(jnp.asarray(theta)))
    success = jnp.where(needed, free, 1.0).prod(axis=-1)[..., None]
    return success * target + (1 - success) * np.eye(len(cells))[:, None, :]


def dense_tabular(logits, successors):
    """T[s, a, s′] of a tabular model, outcomes that lead to the same state added up."""
    odds = jnp.exp(logits)
    probabilities = odds / odds.sum(axis=-1, keepdims=True)
    return jnp.einsum("sak,sakt->sat", probabilities, np.eye(len(successors))[successors])


class Problem(NamedTuple):
    """A model at a generic point, and its transitions as a dense function of its parameters."""

    model: TransitionModel
    dense: Callable
    goal: int

    @property
    def states(self) -> int:
        return self.model.graph.states

    @property
    def actions(self) -> int:
        return self.model.graph.actions


def obstacle_problem(connectivity, rows=3, columns=4, seed=0) -> Problem:
    theta = np.random.default_rng(seed).normal(-1, 1.5, rows * columns)
    model = ObstacleGrid(Grid.unknown(rows, columns, connectivity), jnp.asarray(theta))
    return Problem(model, lambda theta: dense_obstacles(theta, rows, columns, connectivity), goal=1)


def random_problem(states=7, actions=3, outcomes=4, seed=0) -> Problem:
    """A tabular model in which outcomes repeat and stay, and every state can reach the goal, state 0."""
    rng = np.random.default_rng(seed)
    successors = rng.integers(0, states, (states, actions, outcomes))
    successors[:, 0, 0] = np.maximum(np.arange(states) - 1, 0)
    successors[:, 1, 0] = np.arange(states)
    successors[:, 2, 1] = successors[:, 2, 2]
    logits = jnp.asarray(rng.normal(size=successors.shape))
    model = TabularModel(graph(successors), logits)
    return Problem(model, lambda logits: dense_tabular(logits, successors), goal=0)


PROBLEMS: dict[str, Problem] = {
    "4-connected": obstacle_problem(4),
    "8-connected": obstacle_problem(8),
    "tabular": random_problem(),
}


def generic_task(problem: Problem, discount: float, seed: int = 0) -> Task:
    """A task without ties: below discount 1 mostly the goal pays, at 1 every action costs about 1."""
    rng = np.random.default_rng(seed)
    reward = rng.uniform(-0.3, 0.3, (problem.states, problem.actions))
    reward = reward - 1 if discount == 1 else reward / 5
    final = rng.normal(1, 0.1, problem.states)
    terminal = np.arange(problem.states) == problem.goal
    return Task(jnp.asarray(reward), jnp.asarray(final), jnp.asarray(terminal), jnp.asarray(discount))


def relative_error(found, expected) -> float:
    """|found − expected| over |expected|, as vectors; no expected gradient here is zero."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert np.linalg.norm(expected) > 0
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
