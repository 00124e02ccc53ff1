"""Where each action can lead.

A graph lists, for every state s and action a, the states that may follow: `successors[s, a, k]`, k = 0…K−1 the
*outcomes*. A transition model gives each outcome its probability; the graph itself holds none. Outcomes may repeat a
state (their probabilities add up) and an outcome may be the state itself.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import csr_array

from sidestep.errors import InputError
from sidestep.tabular.grid import Cell, Grid


class Graph(eqx.Module):
    """The possible outcomes of each action, and how long each action is.

    - `successors`: the state that outcome k of action a in state s leads to, in 0…states−1.
    - `lengths`: how long each action is, for tasks that charge by length; a cell side on grids. Either axis may be 1.
    """

    successors: Int[Array, "states actions outcomes"]
    lengths: Float[Array, "#states #actions"]

    @property
    def states(self) -> int:
        """The number of states."""
        return self.successors.shape[0]

    @property
    def actions(self) -> int:
        """The number of actions."""
        return self.successors.shape[1]


def graph(successors: Int[np.ndarray, "states actions outcomes"]) -> Graph:
    """A graph from a table of successors, every action of length 1.

    Raises `InputError` for an empty table or a successor that is not a state.

    >>> graph(np.array([[[0], [1]], [[1], [0]]])).states
    2
    """
    if successors.size == 0:
        raise InputError("expected at least one state, action and outcome", field="successors")
    if successors.min() < 0 or successors.max() >= len(successors):
        raise InputError(f"expected states 0…{len(successors) - 1}", field="successors")
    return Graph(jnp.asarray(successors, dtype=jnp.int32), jnp.ones((1, 1)))


def grid_graph(grid: Grid) -> Graph:
    """The graph of a grid: outcome 0 is the cell moved into, outcome 1 staying put; moves off the map stay put.

    A diagonal is √2 long, other moves 1 (in cell sides).
    """
    entered = moves_into(grid)[:, :, 0]
    staying = np.broadcast_to(np.arange(grid.size)[:, None], entered.shape)
    target = np.where(entered == grid.size, staying, entered)
    return Graph(jnp.asarray(np.stack([target, staying], -1), dtype=jnp.int32), jnp.asarray(grid.lengths[None]))


def straight_moves(grid: Grid) -> Int[np.ndarray, "cells 4"]:
    """The cell that each straight move leads to; off the map one stays."""
    return np.asarray(grid_graph(grid).successors[:, :4, 0])


def moves_into(grid: Grid) -> Int[np.ndarray, "states actions 3"]:
    """The cells that must be free for each move to succeed: the one moved into, then the two beside a diagonal.

    A diagonal does not cut corners, so both cells beside it must be free. Where there is no such cell the entry is
    `grid.size`, one past the last state; off the map, the first entry is.
    """
    rows, columns = grid.shape
    row, column = np.divmod(np.arange(grid.size), columns)
    change = grid.steps
    straight = (change == 0).any(axis=1)

    def cell(row_change: np.ndarray, column_change: np.ndarray) -> np.ndarray:
        r, c = row[:, None] + row_change, column[:, None] + column_change
        inside = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
        return np.where(inside, r * columns + c, grid.size)

    zero = np.zeros(len(change), dtype=np.int64)
    entered = cell(change[:, 0], change[:, 1])
    beside = [cell(change[:, 0], zero), cell(zero, change[:, 1])]
    return np.stack([entered, *(np.where(straight, grid.size, side) for side in beside)], axis=-1)


def walkable_graph(truth: Grid) -> csr_array:
    """The legal moves between free cells of a map, as a sparse matrix of lengths in cell sides (1 or √2).

    Entry (s, s′) is the length of the move from state s to s′. Diagonals do not cut corners, and a cell that
    the map does not know counts as not walkable. The matrix is symmetric.

    >>> walkable_graph(Grid(np.array([[0, 0, 1]]))).toarray()[0].tolist()
    [0.0, 1.0, 0.0]
    """
    needed = moves_into(truth)
    legal = clear_moves(truth, needed) & free_cells(truth)[:, None]
    state, action = np.nonzero(legal)
    lengths = truth.lengths[action]
    return csr_array((lengths, (state, needed[state, action, 0])), shape=(truth.size, truth.size))


def free_cells(truth: Grid) -> Bool[np.ndarray, " states"]:
    """Return which cells a map knows to be free."""
    return truth.known.reshape(-1) == Cell.FREE


def clear_moves(truth: Grid, needed: Int[np.ndarray, "states actions cells"]) -> Bool[np.ndarray, "states actions"]:
    """Whether a move stays on the map and all cells that it needs are free."""
    return clear_cells(truth)[needed].all(axis=-1) & (needed[..., 0] < truth.size)


def clear_cells(truth: Grid) -> Bool[np.ndarray, " cells"]:
    """Which cells are free, and true one past the last: the entry of `moves_into` for "no such cell"."""
    return np.append(free_cells(truth), True)
