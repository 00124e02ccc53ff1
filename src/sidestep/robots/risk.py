"""The risk of a path: whether it is open, and how far a robot goes that takes it, over maps from the posterior.

A cell's P(blocked) does not tell whether a path is open: where one of two gaps is closed, and nothing says which, each
is open with probability ½, but one of them is open for sure. Maps that are sampled together know this. A path is open
in a map if each of its moves is legal there, and

    P(open | start and goal are free) = (n + ½)/(N + 1),      n of N maps in which it is open.

The N maps are those of the posterior in which the start and the goal are free: the robot stands at the start, and it is
sent to a place where it can stand. Whether the goal is free is another question, which its P(blocked) answers. A path
that needs no unknown cell is open with probability 1.
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
    return np.asarray(~samples.reshape(len(samples), grid.size)[:, required_cells(grid, path)].any(axis=1))


def _with_free_ends(path: Int[np.ndarray, " steps"], samples: Maps) -> Bool[np.ndarray, "possible rows columns"]:
    """Return the maps in which the first and the last state of a path are free."""
    return samples[~samples.reshape(len(samples), -1)[:, path[[0, -1]]].any(axis=1)]


def open_probability(grid: Grid, path: Int[np.ndarray, " steps"], samples: Maps) -> float:
    """Return the probability that a path is open given that its start and goal are free, from maps of the posterior.

    Args:
        grid: The cells, what is known of them, and the moves.
        path: The states along the path, the start first.
        samples: Whether each cell is blocked, in each map.

    Returns:
        A probability; exactly 1 where all cells that the moves need are known to be free, and ½ where no map has a free
        start and goal.

    Example:
        >>> grid, one_of_two = Grid.unknown(1, 3), np.array([[[0, 1, 0]], [[0, 0, 0]]], dtype=bool)
        >>> open_probability(grid, np.array([0, 1, 2]), one_of_two)
        0.5
    """
    between = np.setdiff1d(required_cells(grid, path), path[[0, -1]])
    if (grid.known.reshape(-1)[between] == Cell.FREE).all():
        return 1.0
    possible = _with_free_ends(path, samples)
    return float((_is_open(grid, path, possible).sum() + 0.5) / (len(possible) + 1))


def independent_open_probability(
    grid: Grid, path: Int[np.ndarray, " steps"], blocked: Float[np.ndarray, "rows columns"]
) -> float:
    """Return the probability that a path is open given that its start and goal are free, if cells were independent.

    Args:
        grid: The cells and the moves.
        path: The states along the path, the start first.
        blocked: P(blocked) of each cell.

    Returns:
        The product of P(free) over the other cells that the moves need.
    """
    between = np.setdiff1d(required_cells(grid, path), path[[0, -1]])
    return float(np.prod(1 - blocked.reshape(-1)[between]))


def expected_length(grid: Grid, plan: GoalPlan, path: Int[np.ndarray, " steps"], samples: Maps) -> float | None:
    """Return the mean length that a robot executes in maps of the posterior with free ends, with bumps and detours.

    Where its path is open it goes along it; only in the other maps its moves are followed one by one.

    Args:
        grid: The cells and the moves.
        plan: The robot's plan to the goal.
        path: The states along the plan's path from the start to the goal.
        samples: Whether each cell is blocked, in each map; at most 40 of those in which the start and the goal are free
            are used, at equal distances.

    Returns:
        A length in cell sides, over the maps in which the robot arrives; None where it never does.
    """
    possible = _with_free_ends(path, samples)
    used = possible[:: max(1, -(-len(possible) // _EXECUTED))]
    is_open = _is_open(grid, path, used)
    # added up in the order of the moves, as the robot does
    lengths = np.full(len(used), sum(grid.lengths[_actions(grid, path)].tolist()))
    for index in np.flatnonzero(~is_open):
        known = np.where(used[index], Cell.OCCUPIED, Cell.FREE).astype(np.int64)
        truth = grid_environment(replace(grid, known=known))
        lengths[index] = plan.executed_lengths(truth, path[:1])[0]
    arriving = lengths[np.isfinite(lengths)]
    return float(arriving.mean()) if len(arriving) else None
