"""Small maps, and tasks as the Gauss–Seidel sweeps read them: with their states numbered in an order."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, TransitionModel
from sidestep.tabular.solvers.bounds import MoveCosts
from sidestep.tabular.solvers.native import HostProcess, inverse_permutation
from sidestep.tabular.solvers.ordering import NumberedProcess, number_process, order_by_distance
from sidestep.tabular.tasks import Task

_ZERO: Any = np.float64(0)
NO_COSTS = MoveCosts(_ZERO, _ZERO)
"""Moves without a cost bound no error below that of the discount."""


def some_map(rows: int = 20, columns: int = 21, seed: int = 0) -> ObstacleGrid:
    """A map of mostly free cells; 420 states."""
    grid = Grid.unknown(rows, columns)
    return ObstacleGrid(grid, jnp.asarray(np.random.default_rng(seed).normal(-1.5, 1.5, grid.size)))


def host_process(model: TransitionModel, task: Task) -> HostProcess:
    """A task under a model, as NumPy arrays."""
    arrays = (model.graph.successors, model.probabilities(), task.reward, task.terminal_reward, task.terminal)
    arrays = (*arrays, model.graph.available)
    return HostProcess(*map(np.asarray, arrays), discount=np.float64(task.discount))


def order_of(model: TransitionModel, task: Task) -> Int[np.ndarray, " states"]:
    """The states by their distance from where a task ends."""
    return order_by_distance(host_process(model, task))


def numbered_process(model: TransitionModel, task: Task, order: Int[np.ndarray, " states"]) -> NumberedProcess:
    """A task under a model as the sweeps read it, its states numbered in an order."""
    position = inverse_permutation(order)
    assert position is not None
    return number_process(host_process(model, task), order, position, np.ones(len(order), bool))[0]
