"""From positions in metres to single-cell moves on a grid.

The path of a walk is the straight line between successive positions, and its moves lead through every cell on that line
in order (`sidestep.io.crossings`). Two cases need a rule.

- *Exactly through a corner.* With 8-connected moves that is a diagonal move, unless it would cut the corner of a cell
  known to be occupied. Then, and always with 4-connected moves, it is two moves: first sideways, then up or down, or in
  the other order if the cell at the side is known to be occupied.
- *Clipping a cell* (8-connected moves only). A straight line at 45 degrees that misses the corners passes through cells
  on a staircase, which is longer than the diagonal. It would look like a detour, and so like knowledge of an obstacle.
  A cell is therefore left out, and the move is the diagonal, if the walk enters the cell by one side and leaves it by
  an adjacent one after at most half the diagonal of a cell; again, unless the diagonal would cut the corner of a cell
  known to be occupied. In a series of cells that could be left out, every other one is, from the first.

Staying in a cell is not a move, except where the table marks a failed move: the walk first moves to the position of
that row, and the failed move comes next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from sidestep.errors import check, check_instance
from sidestep.io.crossings import TOUCH, Occupied, Points, Visits, cells_at, visited_cells
from sidestep.io.tables import check_rows
from sidestep.io.walks import Walks
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.grid import Cell, Grid

_HALF_DIAGONAL = np.sqrt(0.5)
_Failures = Int[np.ndarray, " failures"]
_Steps = Int[np.ndarray, "failures 2"]


@dataclass(frozen=True, eq=False)
class Moves:
    """Single-cell moves, walk after walk; each move of a walk starts in the next state of the move before.

    Attributes:
        states: The state in which each move starts.
        actions: An index into `Grid.steps` for each move.
        next_states: The state in which each move ends, the same state if the move failed.
        walk: The index of the walk of each move.
        rows: The data row (from 1) of the position at or after the end of each move, for error messages.
        goals: The goal state of each walk.
        source: The name of the file, for error messages.
    """

    states: Int[np.ndarray, " moves"]
    actions: Int[np.ndarray, " moves"]
    next_states: Int[np.ndarray, " moves"]
    walk: Int[np.ndarray, " moves"]
    rows: Int[np.ndarray, " moves"]
    goals: Int[np.ndarray, " walks"]
    source: str

    def __len__(self) -> int:
        """Return the number of moves."""
        return len(self.states)

    def before_goal(self) -> "Moves":
        """Return the moves that start before their walk has reached its goal."""
        arrivals = np.cumsum(self.states == self.goals[self.walk])
        before_walk = np.append(0, arrivals)[np.searchsorted(self.walk, self.walk)]
        by_move = ("states", "actions", "next_states", "walk", "rows")
        return replace(self, **{name: getattr(self, name)[arrivals == before_walk] for name in by_move})

    def trajectories(self, tasks: Sequence[int] | None = None) -> list[Trajectory]:
        """Return one trajectory for each walk that has a move.

        Args:
            tasks: The index of the task of each such walk; by default 0.
        """
        starts = np.flatnonzero(np.diff(self.walk)) + 1
        parts = [np.split(each, starts) for each in (self.states, self.actions, self.next_states)]
        tasks = [0] * len(parts[0]) if tasks is None else tasks
        return [
            Trajectory(np.append(states, next_states[-1]), actions, task)
            for states, actions, next_states, task in zip(*parts, tasks, strict=True)
        ]


def grid_walks(walks: Walks, grid: Grid) -> Moves:
    """Return the moves of walks on a grid, by the rules of this module.

    Args:
        walks: Positions and goals in metres. A goal on a border between cells counts as in the cell where the walk
            ends, if that is one of them.
        grid: The map; moves are 4- or 8-connected as the grid is.

    Raises:
        InputError: Naming file, row and column, for positions and goals outside the map, walks through cells known to
            be occupied, goals in such cells, failed moves that do not lead to an adjacent cell (which may lie just
            outside the map), and walks without any move.

    Example:
        >>> import pyarrow as pa
        >>> from sidestep.io.walks import walks_from_table
        >>> walks = walks_from_table(pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 2.5], "y": [0.5, 0.5]}))
        >>> grid_walks(walks, Grid.unknown(rows=1, columns=3)).next_states.tolist()
        [1, 2]
    """
    check_instance(grid, Grid, "grid")
    check(len(walks) > 0, "expected at least one walk, found none", source=walks.source)
    _check_inside(walks.positions, walks.rows, "", walks, grid)
    _check_inside(walks.goals, walks.rows[walks.offsets[:-1]], "goal_", walks, grid)
    occupied = grid.known == Cell.OCCUPIED
    visits = visited_cells(grid.to_cell_units(walks.positions), walks.offsets, occupied)
    visits = _around_corners(visits, occupied, diagonals=grid.connectivity == 8)
    message = "the way to this position leads through a cell that the map shows as occupied "
    message += "(image row {}, column {}, from 0); expected walks around known obstacles"
    check_rows(~occupied[tuple(visits.cell.T)], message, walks.source, "x", walks.rows[visits.arrival], visits.cell)
    goals = _goal_cells(walks, grid, visits, occupied)
    failures = np.flatnonzero(np.isfinite(walks.failed_moves[:, 0]))
    if grid.connectivity == 8:
        visits = _without_clipped(visits, occupied, _visit_at(failures, visits, walks))
    return _moves(visits, failures, goals, walks, grid)


def _around_corners(visits: Visits, occupied: Occupied, diagonals: bool) -> Visits:
    """Insert a side cell wherever a walk passes a corner and a diagonal move is not possible."""
    before, after = visits.cell[:-1], visits.cell[1:]
    corner = (visits.walk[:-1] == visits.walk[1:]) & (before != after).all(axis=1)
    sideways = np.stack([before[:, 0], after[:, 1]], axis=1)
    upright = np.stack([after[:, 0], before[:, 1]], axis=1)
    blocked_sideways = occupied[sideways[:, 0], sideways[:, 1]]
    if diagonals:
        corner &= blocked_sideways | occupied[upright[:, 0], upright[:, 1]]
    index = np.flatnonzero(corner)
    side = np.where(blocked_sideways[:, None], upright, sideways)[index]
    walk = np.insert(visits.walk, index + 1, visits.walk[index])
    arrival = np.insert(visits.arrival, index + 1, visits.arrival[index + 1])
    length = np.insert(visits.length, index + 1, 0.0)
    return Visits(walk, np.insert(visits.cell, index + 1, side, axis=0), length, arrival)


def _without_clipped(visits: Visits, occupied: Occupied, kept: _Failures) -> Visits:
    """Remove the cells that a walk only clips, except the visits `kept`, where a move failed."""
    before, clipped, after = visits.cell[:-2], visits.cell[1:-1], visits.cell[2:]
    possible = (visits.walk[:-2] == visits.walk[2:]) & (visits.length[1:-1] <= _HALF_DIAGONAL + TOUCH)
    possible &= (np.abs(after - before) == 1).all(axis=1) & (np.abs(clipped - before).sum(axis=1) == 1)
    possible[np.setdiff1d(kept - 1, [-1, len(possible)])] = False
    opposite = (before + after - clipped)[possible]
    possible[possible] = ~occupied[opposite[:, 0], opposite[:, 1]]
    middle = np.flatnonzero(possible)
    new_run = np.diff(middle, prepend=-2) != 1
    rank = middle - np.maximum.accumulate(np.where(new_run, middle, 0))
    return visits[np.delete(np.arange(len(visits.walk)), middle[rank % 2 == 0] + 1)]


def _visit_at(positions: _Failures, visits: Visits, walks: Walks) -> _Failures:
    """Return the index of the visit to which each position (an index) belongs."""
    latest = np.searchsorted(visits.arrival, positions, side="right") - 1
    walk = np.searchsorted(walks.offsets, positions, side="right") - 1
    return np.maximum(latest, np.searchsorted(visits.walk, walk))


def _moves(visits: Visits, failures: _Failures, goals: Int[np.ndarray, " walks"], walks: Walks, grid: Grid) -> Moves:
    """Return the moves between successive visits and the failed moves, in their order."""
    state = visits.cell @ np.array([grid.shape[1], 1])
    entered = np.flatnonzero(np.diff(visits.walk, prepend=-1) == 0)
    stayed = _visit_at(failures, visits, walks)
    failed_steps = _failed_steps(failures, visits.cell[stayed], walks, grid)
    steps = np.concatenate([visits.cell[entered] - visits.cell[entered - 1], failed_steps])
    order = np.argsort(np.concatenate([entered, stayed + 0.5]), kind="stable")
    states = np.concatenate([state[entered - 1], state[stayed]])[order]
    next_states = np.concatenate([state[entered], state[stayed]])[order]
    walk = np.concatenate([visits.walk[entered], visits.walk[stayed]])[order]
    rows = np.concatenate([walks.rows[visits.arrival[entered]], walks.rows[failures]])[order]
    moving, first_rows = np.bincount(walk, minlength=len(walks)) > 0, walks.rows[walks.offsets[:-1]]
    message = "expected at least one move, but walk {!r} never leaves its cell"
    check_rows(moving, message, walks.source, "walk", first_rows, walks.labels)
    action_of = np.full((3, 3), -1)
    action_of[tuple((grid.steps + 1).T)] = np.arange(len(grid.steps))
    return Moves(states, action_of[tuple((steps + 1).T)][order], next_states, walk, rows, goals, walks.source)


def _failed_steps(failures: _Failures, cells: _Steps, walks: Walks, grid: Grid) -> _Steps:
    """Return the row and column change of each failed move from its cell."""
    column, row_up = np.floor(grid.to_cell_units(walks.failed_moves[failures]) + TOUCH).T
    steps = np.stack([grid.shape[0] - 1 - row_up, column], axis=1) - cells
    adjacent = (steps[:, None, :] == grid.steps).all(axis=2).any(axis=1)
    message = f"expected a failed move to one of the {grid.connectivity} adjacent cells, found ({{}}, {{}})"
    check_rows(adjacent, message, walks.source, "failed_x", walks.rows[failures], walks.failed_moves[failures])
    return steps.astype(np.int64)


def _goal_cells(walks: Walks, grid: Grid, visits: Visits, occupied: Occupied) -> Int[np.ndarray, " walks"]:
    """Return the goal state of each walk."""
    goals = grid.to_cell_units(walks.goals)
    last = visits.cell[np.searchsorted(visits.walk, np.arange(len(walks)), side="right") - 1]
    corner = np.stack([last[:, 1], grid.shape[0] - 1 - last[:, 0]], axis=1)
    ends_there = np.all((goals >= corner - TOUCH) & (goals <= corner + 1 + TOUCH), axis=1)
    cells = np.where(ends_there[:, None], last, cells_at(goals, occupied))
    message = "the goal ({}, {}) lies in a cell that the map shows as occupied"
    check_rows(~occupied[tuple(cells.T)], message, walks.source, "goal_x", walks.rows[walks.offsets[:-1]], walks.goals)
    return cells @ np.array([grid.shape[1], 1])


def _check_inside(positions: Points, rows: Int[np.ndarray, " points"], prefix: str, walks: Walks, grid: Grid) -> None:
    """Raise `InputError` for the first position outside the map; its columns are x and y after the prefix."""
    inside, column = grid.contains(positions), grid.to_cell_units(positions)[:, 0]
    field = prefix + ("y" if 0 <= column[np.argmin(np.where(inside, np.inf, rows))] <= grid.shape[1] else "x")
    message = f"expected a position on the map, {grid.extent()} by its `resolution` and `origin`, found ({{}}, {{}})"
    check_rows(inside, message, walks.source, field, rows, positions)
