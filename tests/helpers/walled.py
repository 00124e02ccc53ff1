"""A small world for the tests of fits: a wall, and paths around it.

. . # . .
. . # . .
. . # . .        Paths lead from side to side; none touches the wall.
. . # . .
. . . . .
"""

import jax.numpy as jnp
import numpy as np

from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.tasks import reach

WALL = np.zeros((5, 5), dtype=bool)
WALL[:4, 2] = True
BLANK = Grid.unknown(5, 5)
TRUTH = Grid(np.where(WALL, int(Cell.OCCUPIED), int(Cell.FREE)))
GOALS = (4, 14, 0)
PATHS = (
    (0, 0, "DDDDRRRRUUUU"),
    (0, 0, "RDDDDRRRUUUU"),
    (0, 0, "DDDRDRRRUUUU"),
    (1, 10, "DDRRRRUU"),
    (1, 5, "RDDDRRRUU"),
    (2, 4, "DDDDLLLLUUUU"),
    (2, 4, "LDDDDLLLUUUU"),
)
"""The index of the goal, the start state, and the moves: up, down, left, right."""
REPEATS = 4


def follow(start: int, moves: str, grid: Grid = BLANK) -> tuple[np.ndarray, np.ndarray]:
    """Return the states and actions of moves that all succeed."""
    actions = np.array(["UDLR".index(move) for move in moves])
    changes = grid.steps[actions] @ np.array([grid.shape[1], 1])
    return start + np.append(0, np.cumsum(changes)), actions


def walks(grid: Grid = BLANK, discount: float = 0.95, step_cost: float | None = None) -> Demonstrations:
    """Return the demonstrations; the other arguments are those of `reach`."""
    trajectories = [Trajectory(*follow(start, moves), task) for task, start, moves in PATHS for _ in range(REPEATS)]
    return gather(trajectories, [reach(grid, goal, discount=discount, step_cost=step_cost) for goal in GOALS])


def objective(model, demonstrations, behavior, parameters, mean=-2.0, variance=2.0, **settings):
    """Return log L(θ) − Σ (θ − b)²/(2σ²), the objective of a fit with a normal prior."""
    likelihood = log_likelihood(model.with_parameters(parameters), demonstrations, behavior, **settings)
    return likelihood.total - jnp.sum((parameters - mean) ** 2 / (2 * variance))
