"""Moves between the cells of a map, beside a reference that goes through them cell by cell."""

from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.tabular.checks import check_demonstrations, check_task
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import clear_cells, clear_moves, free_cells, graph, moves_into, walkable_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import reach, task

STEPS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1))
MAPS = {f"{rows}×{columns}": (rows, columns) for rows, columns in ((3, 4), (1, 5), (4, 1), (4, 3))}


def cell_by_cell(grid, connectivity):
    """The cells that each move needs by set, whether it is clear, and the lengths of moves between free cells."""
    rows, columns = grid.shape
    cells = {(r, c) for r in range(rows) for c in range(columns)}
    free = {cell for cell in cells if grid.known[cell] == 0}
    needed, clear, lengths = {}, {}, np.zeros((grid.size, grid.size))
    for (r, c), (action, (down, right)) in product(sorted(cells), enumerate(STEPS[:connectivity])):
        target, beside = (r + down, c + right), {(r + down, c), (r, c + right)} - {(r, c), (r + down, c + right)}
        index = r * columns + c, action
        needed[index] = ({target} | (beside if down and right else set())) & cells
        clear[index] = target in cells and needed[index] <= free
        if clear[index] and (r, c) in free:
            lengths[index[0], target[0] * columns + target[1]] = np.hypot(down, right)
    return needed, clear, lengths


@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("name", MAPS)
def test_moves_of_a_map_are_those_cell_by_cell(name, connectivity):
    for seed in range(5):
        known = np.random.default_rng(seed).choice([0, 0, 0, 1, -1], MAPS[name])
        grid = Grid(known, connectivity=connectivity)
        needed, clear, lengths = cell_by_cell(grid, connectivity)
        into = moves_into(grid)
        assert into.shape == (grid.size, connectivity, 3)
        for (state, action), cells in needed.items():
            entries = into[state, action]
            assert {tuple(map(int, np.divmod(e, known.shape[1]))) for e in entries if e < grid.size} == cells
            assert clear_moves(grid, into)[state, action] == clear[state, action]
        np.testing.assert_allclose(walkable_graph(grid).toarray(), lengths)
        np.testing.assert_array_equal(free_cells(grid), known.ravel() == 0)
        np.testing.assert_array_equal(clear_cells(grid), [*(known.ravel() == 0), True])


LINE = graph(np.array([[[1], [0]], [[2], [0]], [[2], [1]]]), available=[[True, True], [True, False], [True, True]])


def moved(states, actions, next_states, trajectory):
    shown = gather([Trajectory(np.array([0, 1]), np.array([0]), 0)], [reach(LINE, 2)])
    values = (states, actions, next_states, np.zeros(len(states), int), trajectory)
    return Demonstrations(*map(jnp.asarray, values), tasks=shown.tasks, weights=jnp.ones(len(states)))


@pytest.mark.parametrize(("moves", "message"), [
    (([0, 1, 2], [0, 0, 0], [1, 2, 2], [0, 0, 0]), r"trajectory 0.*not a terminal state of its task in move 2"),
    (([0, 3], [0, 0], [1, 2], [0, 0]), r"trajectory 0.*expected state 0…2 in move 1, found 3"),
    (([0, -1], [0, 0], [1, 2], [0, 1]), r"trajectory 1.*expected state 0…2 in move 0, found -1"),
    (([0, 0, 0], [0, 0, 2], [1, 1, 1], [0, 1, 1]), r"trajectory 1.*expected action 0…1 in move 1, found 2 in state 0"),
    (([0, 0], [-1, 0], [1, 1], [0, 1]), r"trajectory 0.*expected action 0…1 in move 0, found -1"),
    (([0, 1], [0, 0], [1, 3], [0, 0]), r"trajectory 0.*expected state the world's in move 1, found 3"),
    (([0, 1], [0, 0], [-1, 2], [0, 0]), r"trajectory 0.*expected state the world's in move 0, found -1"),
    (([0, 1], [0, 1], [1, 0], [0, 0]), r"trajectory 0.*available in its state in move 1, found 1 in state 1"),
])  # fmt: skip
def test_check_demonstrations_names_the_first_wrong_move(moves, message):
    with pytest.raises(InputError, match=message):
        check_demonstrations(moved(*moves), LINE)
    check_demonstrations(moved([0, 1, 1], [1, 0, 0], [0, 2, 2], [0, 0, 1]), LINE)


def test_check_task_accepts_rewards_of_the_world_and_axes_of_one():
    for own in (reach(LINE, 2), *(task(np.ones((3, axis)), 0.9, np.zeros(3, bool)) for axis in (1, 2))):
        check_task(own, LINE)


@pytest.mark.parametrize(("wrong", "message"), [
    (task(np.ones((4, 2)), 0.9, np.zeros(4, bool)), "expected a task of the model's 3 states, found one of 4"),
    (task(np.ones((3, 3)), 0.9, np.zeros(3, bool)), r"expected rewards of shape \(3, 2\).*found \(3, 3\)"),
])  # fmt: skip
def test_check_task_of_another_world_raises(wrong, message):
    with pytest.raises(InputError, match=message):
        check_task(wrong, LINE)
