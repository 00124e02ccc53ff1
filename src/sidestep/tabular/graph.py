"""Where each action can lead.

A graph lists, for every state s and action a, the states that may follow: `successors[s, a, k]`, k = 0…K−1 the
*outcomes*. A transition model gives each outcome its probability; the graph itself holds none. Outcomes may repeat a
state (their probabilities add up) and an outcome may be the state itself. States may have different sets of actions:
an action that is not *available* in a state is never taken there, neither by a policy nor by a lapse.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from sidestep._arguments import to_integers, to_mask
from sidestep._repr import short_repr
from sidestep.errors import check, check_instance
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.grid import Cell, Grid

if TYPE_CHECKING:
    import scipy.sparse


@short_repr()
class Graph(eqx.Module):
    """The possible outcomes of each action, and its length; made by `graph` or `grid_graph`.

    Attributes:
        successors: The state, in 0…states − 1, that outcome k of action a in state s leads to.
        lengths: The length of each action, for tasks that charge by length; in cell sides on grids. An axis of length 1
            holds for all states or all actions.
        available: Whether an action can be taken in a state, of shape (states, actions); of shape (1, 1) where all can.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> world = grid_graph(Grid.unknown(rows=1, columns=3))
        >>> world.states, world.actions
        (3, 4)
    """

    successors: Int[Array, "states actions outcomes"]
    lengths: Float[Array, "#states #actions"]
    available: Bool[Array, "#states #actions"] = eqx.field(default_factory=lambda: to_jax(np.ones((1, 1), bool)))

    @property
    def states(self) -> int:
        """Return the number of states."""
        return self.successors.shape[0]

    @property
    def actions(self) -> int:
        """Return the number of actions."""
        return self.successors.shape[1]


def available_mask(
    available: Bool[Array, "#states #actions"], states: int, actions: int
) -> Bool[Array, "states actions"] | None:
    """Return which actions are available in each state; None where all are.

    Args:
        available: As in `Graph`.
        states: The number of states.
        actions: The number of actions.
    """
    return None if available.shape == (1, 1) else jnp.broadcast_to(available, (states, actions))


def graph(
    successors: Shaped[ArrayLike, "..."] | Sequence[Any],
    available: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
) -> Graph:
    """Return a graph from a table of successors, in which every action has length 1.

    Args:
        successors: The state that each outcome of each action leads to; whole numbers, as an array or nested lists.
        available: Whether each action can be taken in each state; by default all can. The successors of an action that
            cannot be taken have no meaning, but must be states.

    Raises:
        InputError: For an empty table, a successor that is not a whole number or not a state, and a state without an
            available action.

    Example:
        >>> graph([[[0], [1]], [[1], [0]]]).states
        2
    """
    what = "states, or `from_dense` for probabilities P[s, a, s′]"
    table = to_integers(successors, "successors", ("states", "actions", "outcomes"), least=0, what=what)
    message = f"expected at least one state, action and outcome, found shape {table.shape}"
    check(table.size, message, field="successors")
    check_states(table, len(table), "successors")
    made = Graph(to_jax(table, np.int32), to_jax(np.ones((1, 1))))
    return made if available is None else with_available(made, available)


def with_available(world: Graph, available: Shaped[ArrayLike, "..."] | Sequence[Any]) -> Graph:
    """Return a graph in which only some actions can be taken.

    Args:
        world: The graph.
        available: Whether each action can be taken in each state.

    Raises:
        InputError: For another shape or type, and for a state without an available action.
    """
    mask = np.asarray(to_mask(available, "available", (world.states, world.actions)))
    without = np.flatnonzero(~mask.any(axis=1))[:1]
    message = f"expected an action in every state, found none in state {without}"
    check(not len(without), message, field="available")
    return Graph(world.successors, world.lengths, to_jax(mask if not mask.all() else np.ones((1, 1), bool)))


def check_states(numbers: Int[np.ndarray, "..."], states: int, field: str) -> None:
    """Raise `InputError` unless all numbers are states.

    Args:
        numbers: The states to check.
        states: The number of states.
        field: The argument, for the message.
    """
    wrong = numbers[(numbers < 0) | (numbers >= states)][:1]
    check(not len(wrong), f"expected states in 0…{states - 1}, found {wrong}", field=field)


def grid_graph(grid: Grid) -> Graph:
    """Return the graph of a grid: outcome 0 of a move is the cell entered, outcome 1 staying.

    Moves off the map stay. A diagonal has length √2, other moves 1 (in cell sides).

    Args:
        grid: The cells, which are the states, and the moves, which are the actions.

    Returns:
        The graph, with two outcomes for each move.

    Example:
        >>> grid_graph(Grid.unknown(rows=1, columns=2)).successors[0, 3].tolist()  # from the left cell to the right
        [1, 0]
    """
    check_instance(grid, Grid, "grid")
    return Graph(to_jax(grid_successors(grid), np.int32), to_jax(grid.lengths[None]))


def grid_successors(grid: Grid) -> Int[np.ndarray, "states actions 2"]:
    """Return the successors of `grid_graph` as a NumPy array.

    Args:
        grid: The cells and the moves.
    """
    entered = moves_into(grid)[:, :, 0]
    staying = np.broadcast_to(np.arange(grid.size)[:, None], entered.shape)
    return np.stack([np.where(entered == grid.size, staying, entered), staying], axis=-1)


def straight_moves(grid: Grid) -> Int[np.ndarray, "cells 4"]:
    """Return the cell that each straight move enters; moves off the map stay.

    Args:
        grid: The cells and the moves.
    """
    return grid_successors(grid)[:, :4, 0]


def moves_into(grid: Grid) -> Int[np.ndarray, "states actions 3"]:
    """Return the cells that must be free for each move to succeed: the one moved into, then the two beside a diagonal.

    A diagonal does not cut corners, so both cells beside it must be free. Where there is no such cell the entry is
    `grid.size`, one past the last state; off the map, the first entry is.

    Args:
        grid: The cells and the moves.
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


def walkable_graph(truth: Grid) -> "scipy.sparse.csr_array":
    """Return the legal moves between free cells of a map, as a sparse matrix of lengths in cell sides (1 or √2).

    Entry (s, s′) is the length of the move from state s to s′. Diagonals do not cut corners, and a cell that
    the map does not know counts as not walkable. The matrix is symmetric.

    >>> walkable_graph(Grid(np.array([[0, 0, 1]]))).toarray()[0].tolist()
    [0.0, 1.0, 0.0]

    Args:
        truth: The map.
    """
    from scipy.sparse import csr_array

    needed = moves_into(truth)
    legal = clear_moves(truth, needed) & free_cells(truth)[:, None]
    state, action = np.nonzero(legal)
    lengths = truth.lengths[action]
    return csr_array((lengths, (state, needed[state, action, 0])), shape=(truth.size, truth.size))


def free_cells(truth: Grid) -> Bool[np.ndarray, " states"]:
    """Return which cells a map knows to be free.

    Args:
        truth: The map.
    """
    return truth.known.reshape(-1) == Cell.FREE


def clear_moves(truth: Grid, needed: Int[np.ndarray, "states actions cells"]) -> Bool[np.ndarray, "states actions"]:
    """Return whether each move stays on the map and all cells that it needs are free.

    Args:
        truth: The map.
        needed: The cells that each move needs, from `moves_into`.
    """
    return clear_cells(truth)[needed].all(axis=-1) & (needed[..., 0] < truth.size)


def clear_cells(truth: Grid) -> Bool[np.ndarray, " cells"]:
    """Return which cells are free, and true one past the last: the entry of `moves_into` for "no such cell".

    Args:
        truth: The map.
    """
    return np.append(free_cells(truth), True)
