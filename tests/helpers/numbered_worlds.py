"""Small maps, and tasks as the ordered sweeps read them: with their states numbered in an order."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, TransitionModel
from sidestep.tabular.solvers.given import Given, positions, sizes
from sidestep.tabular.solvers.numbering import Numbered, numbered, numbering_for
from sidestep.tabular.solvers.ordering import order_by_distance
from sidestep.tabular.tasks import Task


def some_map(rows: int = 20, columns: int = 21, seed: int = 0) -> ObstacleGrid:
    """A map of mostly free cells; 420 states."""
    grid = Grid.unknown(rows, columns)
    return ObstacleGrid(grid, jnp.asarray(np.random.default_rng(seed).normal(-1.5, 1.5, grid.size)))


def order_of(model: TransitionModel, wanted: Task) -> Int[np.ndarray, " states"]:
    """The states by their distance from where a task ends."""
    successors, probabilities = np.asarray(model.graph.successors), np.asarray(model.probabilities())
    reward, terminal = np.asarray(wanted.reward), np.asarray(wanted.terminal)
    return order_by_distance(successors, probabilities, reward, terminal, float(wanted.discount))


def numbered_world(model: TransitionModel, wanted: Task, order: Int[np.ndarray, " states"]) -> Numbered:
    """A task under a model as the sweeps read it, its states numbered in an order."""
    successors, probabilities = np.asarray(model.graph.successors), np.asarray(model.probabilities())
    task = (np.asarray(each) for each in (wanted.reward, wanted.terminal_reward, wanted.terminal))
    given = Given(successors, probabilities, *task, discount=np.float64(wanted.discount))
    position = positions(order)
    assert position is not None
    return numbered(numbering_for(*sizes(given)), given, order, position)
