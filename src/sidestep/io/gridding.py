"""From positions in metres to single-cell moves on a grid.

The path of a walk is the straight line between its successive positions, and its moves lead through every
cell on that line in turn. Two cases need a rule.

- *Exactly through a corner.* With 8-connected moves that is a diagonal move, unless it would cut the corner
  of a cell known to be occupied. Then, and with 4-connected moves always, it is two moves: first sideways,
  then up or down, or the other way round if the cell at the side is known to be occupied.
- *Clipping a cell* (8-connected moves only). A straight line at 45 degrees that misses the corners passes
  through cells on a staircase, and a staircase is longer than the diagonal: it would look like a detour,
  and so like knowledge of an obstacle. So a cell that the walk enters by one side and leaves by an adjacent
  one, after at most half the diagonal of a cell, is left out and the move is the diagonal; again, unless it
  would cut the corner of a cell known to be occupied. Of cells in a row that could be left out, the first,
  third, … are.

Staying in a cell is no move, except where the table marks a failed move: then the walk moves to the row's
position first, and tries next.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.errors import InputError
from sidestep.io.crossings import TOUCH, Visits, cells_of, visits_of
from sidestep.io.walks import Walks
from sidestep.tabular.grid import Cell, Grid

_HALF_DIAGONAL = np.sqrt(0.5)


@dataclass(frozen=True, eq=False)
class Moves:
    """Single-cell moves, walk after walk; within a walk each starts where the one before has led.

    - `states`, `next_states`: where a move starts and where it leads; the same state if the move failed.
    - `actions`: which move, an index into `Grid.steps`.
    - `walk`: the index of the walk.
    - `rows`: the data row (from 1) of the position at or after the end of the move, for error messages.
    - `goals`: the state that each walk wants to reach.
    - `source`: the file, for error messages.
    """

    states: Int[np.ndarray, " moves"]
    actions: Int[np.ndarray, " moves"]
    next_states: Int[np.ndarray, " moves"]
    walk: Int[np.ndarray, " moves"]
    rows: Int[np.ndarray, " moves"]
    goals: Int[np.ndarray, " walks"]
    source: str


def grid_walks(walks: Walks, grid: Grid) -> Moves:
    """The moves of walks on a grid, 4- or 8-connected as the grid is; see the module for the rules.

    A goal on the border of cells counts as in the cell where the walk ends, if that is one of them.
    Raises `InputError`, naming file, row and column, for positions and goals outside the map, walks through
    cells known to be occupied, goals in such cells, failed moves that do not lead to an adjacent cell
    (which may lie just outside the map), and walks that never leave their cell nor try to.

    >>> import pyarrow as pa
    >>> from sidestep.io.walks import walks_of_table
    >>> walks = walks_of_table(pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 2.5], "y": [0.5, 0.5]}))
    >>> grid_walks(walks, Grid.unknown(rows=1, columns=3)).next_states.tolist()
    [1, 2]
    """
    if len(walks) == 0:
        raise InputError("expected at least one walk, found none", source=walks.source)
    _refuse_outside(walks.positions, walks.rows, ("x", "y"), walks, grid)
    _refuse_outside(walks.goals, walks.rows[walks.offsets[:-1]], ("goal_x", "goal_y"), walks, grid)
    occupied = grid.known == Cell.OCCUPIED
    visits = visits_of(grid.to_cell_units(walks.positions), walks.offsets, occupied)
    visits = _around_corners(visits, occupied, diagonals=grid.connectivity == 8)
    _refuse_obstacles(visits, occupied, walks)
    goals = _goal_cells(walks, grid, visits, occupied)
    attempts = np.flatnonzero(np.isfinite(walks.failed_moves[:, 0]))
    if grid.connectivity == 8:
        visits = _without_clipped(visits, occupied, _visit_at(attempts, visits, walks))
    return _moves(visits, attempts, goals, walks, grid)


def _around_corners(visits: Visits, occupied: Bool[np.ndarray, "rows columns"], diagonals: bool) -> Visits:
    """Visits with a side cell put in wherever a walk passes a corner and may make no diagonal move there."""
    before, after = visits.cell[:-1], visits.cell[1:]
    corner = (visits.walk[:-1] == visits.walk[1:]) & (before != after).all(axis=1)
    sideways = np.stack([before[:, 0], after[:, 1]], axis=1)
    upright = np.stack([after[:, 0], before[:, 1]], axis=1)
    blocked_sideways = occupied[sideways[:, 0], sideways[:, 1]]
    if diagonals:
        corner &= blocked_sideways | occupied[upright[:, 0], upright[:, 1]]
    at = np.flatnonzero(corner)
    side = np.where(blocked_sideways[:, None], upright, sideways)[at]
    return Visits(
        np.insert(visits.walk, at + 1, visits.walk[at]),
        np.insert(visits.cell, at + 1, side, axis=0),
        np.insert(visits.length, at + 1, 0.0),
        np.insert(visits.arrival, at + 1, visits.arrival[at + 1]),
    )


def _without_clipped(
    visits: Visits, occupied: Bool[np.ndarray, "rows columns"], held: Int[np.ndarray, " attempts"]
) -> Visits:
    """Visits without the cells that the walk only clips; visits in `held`, where a move failed, stay."""
    before, clipped, after = visits.cell[:-2], visits.cell[1:-1], visits.cell[2:]
    possible = (visits.walk[:-2] == visits.walk[2:]) & (visits.length[1:-1] <= _HALF_DIAGONAL + TOUCH)
    possible &= (np.abs(after - before) == 1).all(axis=1) & (np.abs(clipped - before).sum(axis=1) == 1)
    possible[np.setdiff1d(held - 1, [-1, len(possible)])] = False
    opposite = (before + after - clipped)[possible]
    possible[possible] = ~occupied[opposite[:, 0], opposite[:, 1]]
    middle = np.flatnonzero(possible)
    new_run = np.diff(middle, prepend=-2) != 1
    rank = middle - np.maximum.accumulate(np.where(new_run, middle, 0))
    return visits[np.delete(np.arange(len(visits.walk)), middle[rank % 2 == 0] + 1)]


def _visit_at(positions: Int[np.ndarray, " attempts"], visits: Visits, walks: Walks) -> Int[np.ndarray, " attempts"]:
    """The visit during which the walk is at each of some positions, given by index."""
    latest = np.searchsorted(visits.arrival, positions, side="right") - 1
    walk = np.searchsorted(walks.offsets, positions, side="right") - 1
    return np.maximum(latest, np.searchsorted(visits.walk, walk))


def _moves(
    visits: Visits,
    attempts: Int[np.ndarray, " attempts"],
    goals: Int[np.ndarray, " walks"],
    walks: Walks,
    grid: Grid,
) -> Moves:
    """The moves between successive visits, and those that failed, in their order."""
    columns = grid.shape[1]
    state = visits.cell @ np.array([columns, 1])
    entered = np.flatnonzero(np.diff(visits.walk, prepend=-1) == 0)
    stayed = _visit_at(attempts, visits, walks)
    steps = np.concatenate(
        [visits.cell[entered] - visits.cell[entered - 1], _attempted(attempts, stayed, visits, walks, grid)]
    )
    order = np.argsort(np.concatenate([entered, stayed + 0.5]), kind="stable")
    moves = Moves(
        states=np.concatenate([state[entered - 1], state[stayed]])[order],
        actions=_actions(steps, grid)[order],
        next_states=np.concatenate([state[entered], state[stayed]])[order],
        walk=np.concatenate([visits.walk[entered], visits.walk[stayed]])[order],
        rows=np.concatenate([walks.rows[visits.arrival[entered]], walks.rows[attempts]])[order],
        goals=goals,
        source=walks.source,
    )
    _refuse_idle(moves, walks)
    return moves


def _attempted(
    attempts: Int[np.ndarray, " attempts"],
    stayed: Int[np.ndarray, " attempts"],
    visits: Visits,
    walks: Walks,
    grid: Grid,
) -> Int[np.ndarray, "attempts 2"]:
    """The row and column change of each failed move."""
    column, row_up = np.floor(grid.to_cell_units(walks.failed_moves[attempts]) + TOUCH).T
    steps = np.stack([grid.shape[0] - 1 - row_up, column], axis=1) - visits.cell[stayed]
    adjacent = (steps[:, None, :] == grid.steps).all(axis=2).any(axis=1)
    if not adjacent.all():
        index = attempts[np.argmin(adjacent)]
        target = tuple(walks.failed_moves[index].tolist())
        message = f"expected a failed move to one of the {grid.connectivity} adjacent cells, found {target}"
        raise InputError(message, source=walks.source, row=int(walks.rows[index]), field="failed_x")
    return steps.astype(np.int64)


def _actions(steps: Int[np.ndarray, "moves 2"], grid: Grid) -> Int[np.ndarray, " moves"]:
    """The action that each row and column change is."""
    table = np.full((3, 3), -1)
    table[tuple((grid.steps + 1).T)] = np.arange(len(grid.steps))
    return table[tuple((steps + 1).T)]


def _goal_cells(
    walks: Walks, grid: Grid, visits: Visits, occupied: Bool[np.ndarray, "rows columns"]
) -> Int[np.ndarray, " walks"]:
    """The goal state of each walk."""
    goals = grid.to_cell_units(walks.goals)
    last = visits.cell[np.searchsorted(visits.walk, np.arange(len(walks)), side="right") - 1]
    corner = np.stack([last[:, 1], grid.shape[0] - 1 - last[:, 0]], axis=1)
    ends_there = np.all((goals >= corner - TOUCH) & (goals <= corner + 1 + TOUCH), axis=1)
    cells = np.where(ends_there[:, None], last, cells_of(goals, occupied))
    blocked = np.flatnonzero(occupied[cells[:, 0], cells[:, 1]])
    if blocked.size:
        index = blocked[0]
        message = f"the goal {tuple(walks.goals[index].tolist())} lies in a cell that the map shows as occupied"
        row = int(walks.rows[walks.offsets[index]])
        raise InputError(message, source=walks.source, row=row, field="goal_x")
    return cells @ np.array([grid.shape[1], 1])


def _refuse_outside(
    positions: Float[np.ndarray, "points 2"],
    rows: Int[np.ndarray, " points"],
    fields: tuple[str, str],
    walks: Walks,
    grid: Grid,
) -> None:
    """Refuse the first position that lies outside the map."""
    inside = grid.contains(positions)
    if inside.all():
        return
    outside = np.flatnonzero(~inside)
    index = outside[np.argmin(rows[outside])]
    column = grid.to_cell_units(positions[index][None])[0, 0]
    field = fields[1] if 0 <= column <= grid.shape[1] else fields[0]
    message = f"expected a position on the map, found {tuple(positions[index].tolist())}"
    raise InputError(message, source=walks.source, row=int(rows[index]), field=field)


def _refuse_obstacles(visits: Visits, occupied: Bool[np.ndarray, "rows columns"], walks: Walks) -> None:
    """Refuse walks through cells that the map shows as occupied."""
    blocked = np.flatnonzero(occupied[visits.cell[:, 0], visits.cell[:, 1]])
    if blocked.size:
        rows = walks.rows[visits.arrival[blocked]]
        row, column = visits.cell[blocked[np.argmin(rows)]].tolist()
        message = (
            "the way to this position leads through a cell that the map shows as occupied "
            f"(image row {row}, column {column}, from 0); expected walks around known obstacles"
        )
        raise InputError(message, source=walks.source, row=int(rows.min()), field="x")


def _refuse_idle(moves: Moves, walks: Walks) -> None:
    """Refuse walks without a move."""
    idle = np.bincount(moves.walk, minlength=len(walks)) == 0
    if idle.any():
        index = int(np.argmax(idle))
        message = f"expected at least one move, but walk {walks.labels[index]!r} never leaves its cell"
        raise InputError(message, source=walks.source, row=int(walks.rows[walks.offsets[index]]), field="walk")
