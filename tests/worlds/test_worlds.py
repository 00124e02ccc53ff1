"""The paper's grids cell by cell, and properties of random offices, apartments, blocks and rooms."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import ndimage
from scipy.sparse.csgraph import connected_components, dijkstra

from sidestep.errors import InputError
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.worlds.apartments import apartment
from sidestep.worlds.blocks import blocks, polyomino
from sidestep.worlds.grids import WORLDS, block, wall
from sidestep.worlds.offices import office, places
from sidestep.worlds.rooms import rooms_in_a_row


def test_block_and_wall_have_the_obstacles_of_the_paper():
    expected = np.zeros((9, 9), dtype=int)
    expected[3:6, 3:6] = 1
    np.testing.assert_array_equal(block().truth.known, expected)
    expected = np.zeros((9, 9), dtype=int)
    expected[0:6, 3:6] = 1
    np.testing.assert_array_equal(wall().truth.known, expected)


def test_block_has_the_starts_and_goals_of_the_paper():
    world = block()
    assert world.starts == (0, 36, 76)
    assert world.goals == (4, 8, 44, 72, 80)


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_connect_every_start_with_every_goal(name):
    world = WORLDS[name]()
    assert world.name == name
    assert not set(world.starts) & set(world.goals)
    distance = dijkstra(walkable_graph(world.truth), indices=world.starts)[:, list(world.goals)]
    assert np.isfinite(distance).all()


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_have_optimal_walks_beside_every_visible_obstacle(name):
    """Beside each obstacle that borders a free cell lies a cell on a shortest path from a start to a goal."""
    world = WORLDS[name]()
    graph = walkable_graph(world.truth)
    from_start, to_goal = dijkstra(graph, indices=world.starts), dijkstra(graph, indices=world.goals)
    length = from_start[:, list(world.goals)]
    on_path = (from_start[:, None] + to_goal[None] == length[..., None]).any(axis=(0, 1))
    near = dilated(on_path.reshape(world.truth.shape))
    seen = dilated(world.truth.known == Cell.FREE) & (world.truth.known == Cell.OCCUPIED)
    assert seen.any()
    assert near[seen].all()


def dilated(cells):
    """Return the cells and their neighbors on four sides."""
    padded = np.pad(cells, 1)
    return cells | padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]


@given(rows=st.integers(10, 70), columns=st.integers(8, 100), seed=st.integers(0, 2**32 - 1))
@example(rows=10, columns=8, seed=0)
@example(rows=28, columns=8, seed=0)
@example(rows=300, columns=9, seed=0)
def test_office_of_any_size_is_walled_in_and_connected(rows, columns, seed):
    grid = office(rows, columns, seed=seed)
    free = grid.known == Cell.FREE
    assert grid.shape == (rows, columns)
    assert np.isin(grid.known, [Cell.FREE, Cell.OCCUPIED]).all()
    assert not free[[0, -1]].any()
    assert not free[:, [0, -1]].any()
    assert rooms_of(grid) == 1
    assert 0.3 < free.mean() < 0.9


def test_office_of_20_by_30_has_rooms_on_both_sides_of_a_corridor():
    for seed in range(25):
        free = office(20, 30, seed=seed).known == Cell.FREE
        corridor = np.flatnonzero(free[:, 1:-1].all(axis=1))
        assert len(corridor) == 2
        walls_of_rooms = (~free[[1, -2], 1:-1]).sum(axis=1)
        assert ((walls_of_rooms >= 2) & (walls_of_rooms <= 6)).all()


def test_office_repeats_by_seed():
    first = office(20, 30, seed=3)
    np.testing.assert_array_equal(first.known, office(20, 30, seed=3).known)
    assert (first.known != office(20, 30, seed=4).known).any()
    assert first.connectivity == 4
    assert office(20, 30, seed=3, connectivity=8).connectivity == 8


@pytest.mark.parametrize("shape", [(9, 30), (20, 7)])
def test_office_of_a_few_cells_is_refused(shape):
    with pytest.raises(InputError, match="at least 10 rows and 8 columns"):
        office(*shape, seed=0)


@given(rows=st.integers(5, 60), columns=st.integers(5, 60), seed=st.integers(0, 2**32 - 1))
@example(rows=5, columns=5, seed=0)
@example(rows=7, columns=100, seed=0)
def test_apartment_of_any_size_is_walled_in_and_connected_by_doors(rows, columns, seed):
    grid = apartment(rows, columns, seed=seed)
    free = grid.known == Cell.FREE
    assert grid.shape == (rows, columns)
    assert np.isin(grid.known, [Cell.FREE, Cell.OCCUPIED]).all()
    assert not free[[0, -1]].any()
    assert not free[:, [0, -1]].any()
    assert rooms_of(grid) == 1
    # walls are one cell thick, so there is no square of four
    squares = ~(free[1:, 1:] | free[1:, :-1] | free[:-1, 1:] | free[:-1, :-1])
    assert not squares.any()
    rooms, count, doors = separate_rooms(grid)
    assert count == doors + 1
    for room in range(1, count + 1):
        inside = np.argwhere(rooms == room)
        assert (np.ptp(inside, axis=0) + 1).prod() == len(inside), "rooms are rectangles"
        assert min(np.ptp(inside, axis=0) + 1) >= min(3, rows - 2, columns - 2)


def components(cells, corners=False):
    """Return the number of the connected part that each cell belongs to, from 1; 0 where there is none."""
    labels = np.zeros(cells.shape, dtype=np.int32)
    ndimage.label(cells, np.ones((3, 3)) if corners else None, output=labels)
    return labels


def separate_rooms(grid):
    """Return the number of the room of each cell, of rooms, and of doors: free cells between two walls."""
    free = grid.known == Cell.FREE
    wall = np.pad(~free, 1, constant_values=True)
    vertical = wall[2:, 1:-1] & wall[:-2, 1:-1]
    horizontal = wall[1:-1, 2:] & wall[1:-1, :-2]
    doors = free & (vertical ^ horizontal)
    rooms = components(free & ~doors)
    return rooms, rooms.max(), doors.sum()


def test_apartment_of_20_by_30_has_a_dozen_rooms():
    for seed in range(25):
        grid = apartment(20, 30, seed=seed)
        assert 8 <= separate_rooms(grid)[1] <= 28
        assert 0.3 < grid.known.mean() < 0.45


@given(
    rows=st.integers(3, 14),
    columns=st.integers(3, 14),
    seed=st.integers(0, 2**32 - 1),
    density=st.sampled_from([0.1, 0.2, 0.9]),
    sizes=st.sampled_from([(2, 5), (1, 1), (4, 4)]),
)
def test_blocks_stand_apart_and_free_cells_are_connected(rows, columns, seed, density, sizes):
    grid = blocks(rows, columns, seed, density, sizes)
    assert grid.shape == (rows, columns)
    assert rooms_of(grid) == 1
    occupied = grid.known == Cell.OCCUPIED
    assert occupied.sum() < density * grid.size + sizes[1]
    # connected by sides alone as by corners: no two touch
    obstacles = components(occupied)
    assert obstacles.max() == components(occupied, corners=True).max()
    cells = np.bincount(obstacles.ravel())[1:]
    assert ((cells >= sizes[0]) & (cells <= sizes[1])).all()


def test_blocks_have_the_density_and_repeat_by_seed():
    for seed in range(2):
        assert blocks(20, 30, seed).known.mean() == pytest.approx(0.2, abs=5 / 600)
    first, dense = blocks(20, 30, 3), blocks(20, 30, 3, density=0.4, touching=True)
    np.testing.assert_array_equal(first.known, blocks(20, 30, 3).known)
    assert (first.known != blocks(20, 30, 4).known).any()
    assert (first.connectivity, blocks(20, 30, 3, connectivity=8).connectivity) == (4, 8)
    assert dense.known.mean() == pytest.approx(0.4, abs=5 / 600)
    assert rooms_of(dense) == 1
    # some touch
    assert np.bincount(components(dense.known).ravel())[1:].max() > 5


def test_apartment_repeats_by_seed():
    first = apartment(20, 30, seed=3)
    np.testing.assert_array_equal(first.known, apartment(20, 30, seed=3).known)
    assert (first.known != apartment(20, 30, seed=4).known).any()
    assert (first.connectivity, apartment(20, 30, 3, connectivity=8).connectivity) == (4, 8)


def test_polyomino_of_four_cells_has_every_shape_of_a_tetromino():
    """Five up to rotations and reflections: I, L, O, S, T."""
    random, shapes = np.random.default_rng(0), set()
    for _ in range(300):
        cells = polyomino(4, random)
        assert len(np.unique(cells, axis=0)) == 4
        turned = [cells @ turn for turn in ROTATIONS]
        shapes.add(min(tuple(sorted(map(tuple, (each - each.min(axis=0)).tolist()))) for each in turned))
    assert len(shapes) == 5


_TURN, _MIRROR = np.array([[0, 1], [-1, 0]]), np.diag([1, -1])
ROTATIONS = [np.linalg.matrix_power(_TURN, k) @ mirror for k in range(4) for mirror in (np.eye(2, dtype=int), _MIRROR)]


@pytest.mark.parametrize(("call", "match"), [
    (lambda: apartment(4, 30, seed=0), "at least 5 rows and 5 columns, found 4 and 30"),
    (lambda: blocks(2, 30, seed=0), "at least 3 rows and 3 columns, found 2 and 30"),
    (lambda: blocks(9, 9, seed=0, density=1.0), "'density': expected a finite number above 0 and below 1, found 1.0"),
    (lambda: blocks(9, 9, seed=0, sizes=(5, 2)), r"'sizes': expected two numbers in order, found \(5, 2\)"),
])  # fmt: skip
def test_worlds_of_impossible_sizes_are_refused(call, match):
    with pytest.raises(InputError, match=match):
        call()


def test_places_are_free_different_and_distant():
    for seed in range(10):
        grid = office(20, 30, seed=seed)
        states = places(grid, 8, seed=seed)
        assert len(set(states.tolist())) == 8
        assert (grid.known.reshape(-1)[states] == Cell.FREE).all()
        distances = dijkstra(walkable_graph(grid), indices=states)[:, states] + 1e9 * np.eye(8)
        assert distances.min() >= 6


def test_places_repeat_by_seed():
    grid = office(20, 30, seed=0)
    np.testing.assert_array_equal(places(grid, 8, seed=9), places(grid, 8, seed=9))
    assert set(places(grid, 8, seed=9).tolist()) != set(places(grid, 8, seed=10).tolist())


def test_places_lie_in_the_largest_connected_part():
    grid = Grid(np.array([[0, 1, 0, 0, -1, -1, -1, -1]]))
    assert set(places(grid, 2, seed=0).tolist()) == {2, 3}
    for count in (0, 3):
        with pytest.raises(InputError, match=r"'count': expected 1…2"):
            places(grid, count, seed=0)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_rooms_are_connected_by_their_doors_only(connectivity):
    for rows, columns in ((1, 3), (4, 6), (7, 13)):
        for door in range(rows):
            check_rooms(rooms_in_a_row(rows, columns, (door,), connectivity), {(columns + 1) // 2 - 1: door})
    for columns in range(5, 20):
        for doors in ((0, 0), (3, 1)):
            grid = rooms_in_a_row(4, columns, doors, connectivity)
            left, right = np.flatnonzero((grid.known == Cell.OCCUPIED).any(axis=0))
            check_rooms(grid, {left: doors[0], right: doors[1]})
            widths = [left, right - left - 1, columns - right - 1]
            assert max(widths) - min(widths) <= 1


def check_rooms(grid, doors):
    """Check walls in some columns, with one free cell each, without which the rooms beside it are separate."""
    expected = np.zeros(grid.shape, dtype=int)
    for column, row in doors.items():
        expected[:, column] = 1
        expected[row, column] = 0
    np.testing.assert_array_equal(grid.known, expected)
    assert rooms_of(grid) == 1
    for column, row in doors.items():
        closed = grid.known.copy()
        closed[row, column] = Cell.OCCUPIED
        assert rooms_of(Grid(closed, connectivity=grid.connectivity)) == 2


def rooms_of(grid):
    label = connected_components(walkable_graph(grid), directed=False)[1]
    return len(np.unique(label[grid.known.reshape(-1) == Cell.FREE]))


@pytest.mark.parametrize(("arguments", "match"), [
    ((3, 2, (0,)), "'columns': expected at least 3, found 2"),
    ((0, 3, (0,)), "'rows': expected at least 1, found 0"),
    ((3, 3, (3,)), "'doors': expected rows in 0…2, found 3"),
    ((3, 4, (0, 0)), "'columns': expected at least 5, found 4"),
    ((3, 5, (0, -1)), "'doors': expected rows in 0…2, found -1"),
])  # fmt: skip
def test_rooms_of_impossible_sizes_are_refused(arguments, match):
    with pytest.raises(InputError, match=match):
        rooms_in_a_row(*arguments)
