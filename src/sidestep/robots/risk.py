"""The risk of a path: whether it is open, and how far a robot goes that takes it, over maps from the posterior.

A cell's P(blocked) does not tell whether a path is open: where one of two gaps is closed, and nothing says which, each
is open with probability ½, but one of them is open for sure. Maps that are sampled together know this. A path is open
in a map if each of its moves is legal there, and

    P(open) = (n + ½)/(N + 1),      n of N maps in which it is open.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.errors import check
from sidestep.robots.planners import GoalPlan, grid_environment
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid

Maps = Bool[np.ndarray, "samples rows columns"]
_EXECUTED = 40
"""The most maps in which a robot is sent along a path."""


def required_cells(grid: Grid, path: Int[np.ndarray, " steps"]) -> Int[np.ndarray, " cells"]:
    """Return the cells that have to be free for a path: those entered, and those beside its diagonals.

    Args:
        grid: The cells and the moves.
        path: The states along the path, the start first.

    Raises:
        InputError: For a path with a step that is no move.

    Example:
        >>> required_cells(Grid.unknown(2, 2, connectivity=8), np.array([0, 3])).tolist()
        [1, 2, 3]
    """
    cells = moves_into(grid)[path[:-1], _actions(grid, path)]
    return np.unique(cells[cells < grid.size])


def _actions(grid: Grid, path: Int[np.ndarray, " steps"]) -> Int[np.ndarray, " moves"]:
    """Return the actions along a path."""
    leads = moves_into(grid)[path[:-1], :, 0] == path[1:, None]
    check(leads.any(axis=1).all(), "expected single moves", field="path")
    return leads.argmax(axis=1)


def _is_open(grid: Grid, path: Int[np.ndarray, " steps"], samples: Maps) -> Bool[np.ndarray, " samples"]:
    """Return whether a path is open in each map."""
    return np.asarray(~samples.reshape(len(samples), -1)[:, required_cells(grid, path)].any(axis=1))


def open_probability(grid: Grid, path: Int[np.ndarray, " steps"], samples: Maps) -> float:
    """Return the probability that a path is open, from maps of the posterior.

    Args:
        grid: The cells and the moves.
        path: The states along the path, the start first.
        samples: Whether each cell is blocked, in each map.

    Example:
        >>> grid, one_of_two = Grid.unknown(1, 3), np.array([[[0, 1, 0]], [[0, 0, 0]]], dtype=bool)
        >>> open_probability(grid, np.array([0, 1, 2]), one_of_two)
        0.5
    """
    return float((_is_open(grid, path, samples).sum() + 0.5) / (len(samples) + 1))


def independent_open_probability(
    grid: Grid, path: Int[np.ndarray, " steps"], blocked: Float[np.ndarray, "rows columns"]
) -> float:
    """Return the probability that a path is open if cells were independent: the product of their P(free).

    Args:
        grid: The cells and the moves.
        path: The states along the path, the start first.
        blocked: P(blocked) of each cell.
    """
    return float(np.prod(1 - blocked.reshape(-1)[required_cells(grid, path)]))


def expected_length(grid: Grid, plan: GoalPlan, path: Int[np.ndarray, " steps"], samples: Maps) -> float | None:
    """Return the mean length that a robot executes in maps of the posterior, with bumps and detours.

    Where its path is open it goes along it; only in the other maps its moves are followed one by one.

    Args:
        grid: The cells and the moves.
        plan: The robot's plan to the goal.
        path: The states along the plan's path from the start to the goal.
        samples: Whether each cell is blocked, in each map; at most 40, at equal distances, are used.

    Returns:
        A length in cell sides, over the maps in which the robot arrives; None where it never does.
    """
    used = samples[:: -(-len(samples) // _EXECUTED)]
    is_open = _is_open(grid, path, used)
    # added up in the order of the moves, as the robot does
    lengths = np.full(len(used), sum(grid.lengths[_actions(grid, path)].tolist()))
    for index in np.flatnonzero(~is_open):
        known = np.where(used[index], Cell.OCCUPIED, Cell.FREE).astype(np.int64)
        truth = grid_environment(replace(grid, known=known))
        lengths[index] = plan.executed_lengths(truth, path[:1])[0]
    arriving = lengths[np.isfinite(lengths)]
    return float(arriving.mean()) if len(arriving) else None
