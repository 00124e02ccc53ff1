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

from sidestep.tabular.backups import Backup, Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import (
    FIXED,
    IMPOSSIBLE,
    FeaturedGrid,
    ObstacleGrid,
    SlipperyGrid,
    TabularModel,
    TiedModel,
    TransitionModel,
    road_network,
    walled_grid,
)
from sidestep.tabular.solve import Solution, SolveOptions, solve
from sidestep.tabular.solvers.base import Solver
from sidestep.tabular.tasks import Task

BACKUPS: dict[str, Backup] = {
    "hard max": HardMax(),
    "Boltzmann": BoltzmannAverage(),
    "log-sum-exp": LogSumExp(),
    "mellowmax": Mellowmax(),
}
DISCOUNTS = (0.9, 1.0)
STEPS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1))

solve_jit = eqx.filter_jit(solve)


def solve_with(solver: Solver, model: TransitionModel, task: Task, behavior: Behavior, **others) -> Solution:
    """The solution by a solver."""
    return solve(model, task, behavior, options=SolveOptions(solver=solver), **others)


NAMES = list(BACKUPS)
EVERYTHING = jnp.ones((1, 1), bool)  # all actions are available


def plain_policy(q, beta, available=EVERYTHING):
    """π ∝ exp βQ over the available actions."""
    odds = plain_odds(q, beta, available)
    return odds / odds.sum(axis=-1, keepdims=True)


def plain_odds(q, beta, available=EVERYTHING):
    """The odds exp β(Q − max Q) of the available actions, 0 for the others."""
    best = jax.lax.stop_gradient(jnp.where(available, q, -jnp.inf).max(axis=-1, keepdims=True))
    return jnp.where(available, jnp.exp(beta * jnp.where(available, q - best, 0)), 0)


def plain_backup(name, q, beta, available=EVERYTHING):
    """V = B(Q), from the table in DESIGN section 1; `name` may be a traced index into `NAMES`."""
    count = jnp.broadcast_to(available, q.shape).sum(axis=-1)
    masked = jnp.where(available, q, -jnp.inf)
    best = jax.lax.stop_gradient(masked.max(axis=-1))
    total = plain_odds(q, beta, available).sum(axis=-1)
    values = {
        # not `max`, which has no gradient where a compiler rounds its argument twice and none equals the best
        "hard max": jnp.take_along_axis(q, masked.argmax(axis=-1)[..., None], axis=-1)[..., 0],
        "Boltzmann": (plain_policy(q, beta, available) * q).sum(axis=-1),
        "log-sum-exp": best + jnp.log(total) / beta,
        "mellowmax": best + jnp.log(total / count) / beta,
    }
    return values[name] if isinstance(name, str) else jnp.stack([values[each] for each in NAMES])[name]


def plain_values(name, transitions, task: Task, beta, sweeps: int, available=EVERYTHING):
    """(V, Q) of acting `sweeps` times, by value iteration from 0, differentiable through every sweep."""

    def q_of(values):
        return task.reward + task.discount * jnp.einsum("sat,t->sa", transitions, values)

    def ended(values):
        return jnp.where(task.terminal, task.terminal_reward, values)

    def sweep(values, _):
        return ended(plain_backup(name, q_of(values), beta, available)), None

    after, _ = jax.lax.scan(sweep, ended(jnp.zeros(len(transitions))), length=sweeps - 1)
    q = q_of(after)
    return ended(plain_backup(name, q, beta, available)), q


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


def dense(model: TransitionModel):
    """T[s, a, s′] of a model."""
    states = np.eye(model.graph.states)[np.asarray(model.graph.successors)]
    return jnp.einsum("sak,sakt->sat", model.probabilities(), states)


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

    @property
    def available(self):
        return self.model.graph.available


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


def tied_problem() -> Problem:
    """The random table, its outcomes tied by seven logits; some cannot happen, and some are not learned."""
    rng = np.random.default_rng(4)
    successors = np.asarray(random_problem().model.graph.successors)
    index = rng.integers(IMPOSSIBLE, 7, successors.shape)
    index[..., 0] = np.maximum(index[..., 0], FIXED)

    def dense(theta):
        odds = jnp.where(index >= 0, jnp.exp(theta[np.maximum(index, 0)]), np.where(index == FIXED, 1.0, 0.0))
        return jnp.einsum("sak,sakt->sat", odds / odds.sum(-1, keepdims=True), np.eye(len(successors))[successors])

    return Problem(TiedModel(graph(successors), index, jnp.asarray(rng.normal(size=7))), dense, goal=0)


def walled_problem(rows=3, columns=3) -> Problem:
    """A grid with walls between cells: first those that one crosses to the right, then those downwards."""
    theta = np.random.default_rng(5).normal(-1, 1.5, rows * (columns - 1) + (rows - 1) * columns)
    model = walled_grid(Grid.unknown(rows, columns), jnp.asarray(theta))

    def wall(cell, other):
        (r, c), right = min(cell, other), cell[1] != other[1]
        return r * (columns - 1) + c if right else rows * (columns - 1) + r * columns + c

    def dense(theta):
        transitions = jnp.zeros((rows * columns, 4, rows * columns))
        for r, c in product(range(rows), range(columns)):
            for a, (down, right) in enumerate(STEPS[:4]):
                target, here = (r + down, c + right), r * columns + c
                if not (0 <= target[0] < rows and 0 <= target[1] < columns):
                    transitions = transitions.at[here, a, here].set(1.0)
                    continue
                shut = 1 / (1 + jnp.exp(-theta[wall((r, c), target)]))
                transitions = transitions.at[here, a, here].set(shut)
                transitions = transitions.at[here, a, target[0] * columns + target[1]].set(1 - shut)
        return transitions

    return Problem(model, dense, goal=1)


TURNS = np.array([[0, 1], [1, 2], [2, 0], [1, 3], [3, 0], [4, 3], [3, 4], [4, 1]])


def road_problem(by_turn) -> Problem:
    """Five links and eight turns between them; links, or turns, may be closed."""
    theta = np.random.default_rng(6).normal(-1, 1.5, len(TURNS) if by_turn else 5)
    model = road_network(TURNS, np.arange(1.0, 6.0), jnp.asarray(theta), by_turn=by_turn)

    def dense(theta):
        transitions, taken = jnp.zeros((5, 2, 5)), [0] * 5
        for number, (begin, onto) in enumerate(TURNS):
            shut = 1 / (1 + jnp.exp(-theta[number if by_turn else onto]))
            transitions = transitions.at[begin, taken[begin], begin].set(shut)
            transitions = transitions.at[begin, taken[begin], onto].set(1 - shut)
            taken[begin] += 1
        for link, count in enumerate(taken):
            for action in range(count, 2):
                transitions = transitions.at[link, action, link].set(1.0)
        return transitions

    return Problem(model, dense, goal=0)


def featured_problem() -> Problem:
    """An obstacle grid whose logits are a network's, of three features a cell."""
    features = jnp.asarray(np.random.default_rng(7).normal(size=(12, 3)))
    network = eqx.nn.MLP(3, "scalar", 4, 1, jnp.tanh, key=jax.random.key(0))
    model = FeaturedGrid(Grid.unknown(3, 4), features, network)

    def dense(parameters):
        first, last = parameters.layers
        hidden = jnp.tanh(features @ first.weight.T + first.bias)
        return dense_obstacles((hidden @ last.weight.T)[:, 0] + last.bias[0], 3, 4, 4)

    return Problem(model, dense, goal=1)


SIDES = ((2, 3), (2, 3), (0, 1), (0, 1), (5, 6), (4, 7), (4, 7), (5, 6))
"""The two moves at a right angle to each."""


def slippery_problem(rows=3, columns=4) -> Problem:
    """A grid with two terrains, on which moves slip as often as each has it, and one row where they do not.

    A move is a mixture of moves of the obstacle grid: ahead, and to either side.
    """
    theta = np.random.default_rng(8).normal(-1, 1.5, rows * columns + 2)
    terrain = np.arange(rows * columns).reshape(rows, columns) % 2
    terrain[1] = -1
    model = SlipperyGrid(Grid.unknown(rows, columns, 8), theta[:-2], theta[-2:], terrain)

    def dense(theta):
        straight = dense_obstacles(theta[: rows * columns], rows, columns, 8)
        aside = sum(straight[:, [sides[k] for sides in SIDES]] for k in (0, 1)) / 2
        odds = jnp.where(terrain.ravel() < 0, 0.0, jnp.exp(theta[rows * columns :])[terrain.ravel()])
        slip = (odds / (1 + odds))[:, None, None]
        return (1 - slip) * straight + slip * aside

    return Problem(model, dense, goal=1)


FAMILIES: dict[str, Problem] = {
    "tied": tied_problem(),
    "walls between cells": walled_problem(),
    "links": road_problem(by_turn=False),
    "turns": road_problem(by_turn=True),
    "features": featured_problem(),
    "slips": slippery_problem(),
}
"""Models that are checked for their own gradients, not for every solver."""


def generic_task(problem: Problem, discount: float, seed: int = 0) -> Task:
    """A task without ties: below discount 1 mostly the goal pays, at 1 every action costs about 1."""
    rng = np.random.default_rng(seed)
    reward = rng.uniform(-0.3, 0.3, (problem.states, problem.actions))
    reward = reward - 1 if discount == 1 else reward / 5
    final = rng.normal(1, 0.1, problem.states)
    terminal = np.arange(problem.states) == problem.goal
    return Task(jnp.asarray(reward), jnp.asarray(final), jnp.asarray(terminal), jnp.asarray(discount))


def relative_error(result, expected) -> float:
    """|result − expected| over |expected|, as vectors; no expected gradient here is zero."""
    result, expected = np.asarray(result), np.asarray(expected)
    assert np.linalg.norm(expected) > 0
    return float(np.linalg.norm(result - expected) / np.linalg.norm(expected))
