"""Worlds to try: the paper's grids cell by cell, and what every random office must be."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components, dijkstra

from sidestep.domains.grids import WORLDS, block, wall
from sidestep.domains.offices import office, places
from sidestep.errors import InputError
from sidestep.scoring import walkable_graph
from sidestep.tabular.grid import Cell, Grid


def test_block_and_wall_are_the_maps_they_are_said_to_be():
    expected = np.zeros((9, 9), dtype=int)
    expected[3:6, 3:6] = 1
    np.testing.assert_array_equal(block().truth.known, expected)
    expected = np.zeros((9, 9), dtype=int)
    expected[0:6, 3:6] = 1
    np.testing.assert_array_equal(wall().truth.known, expected)


def test_the_places_of_the_block():
    world = block()
    assert world.starts == (0, 36, 76)
    assert world.goals == (4, 8, 44, 72, 80)


@pytest.mark.parametrize("name", WORLDS)
def test_every_start_of_a_world_reaches_every_goal(name):
    world = WORLDS[name]()
    assert world.name == name
    assert world.source
    assert not set(world.starts) & set(world.goals)
    distance = dijkstra(walkable_graph(world.truth), indices=world.starts)[:, list(world.goals)]
    assert np.isfinite(distance).all()


@pytest.mark.parametrize("name", WORLDS)
def test_optimal_walks_pass_around_every_obstacle_that_can_be_seen(name):
    """Beside each obstacle that borders a free cell lies a cell on a shortest way from a start to a goal."""
    world = WORLDS[name]()
    graph = walkable_graph(world.truth)
    from_start, to_goal = dijkstra(graph, indices=world.starts), dijkstra(graph, indices=world.goals)
    length = from_start[:, list(world.goals)]
    on_way = (from_start[:, None] + to_goal[None] == length[..., None]).any(axis=(0, 1))
    near = dilated(on_way.reshape(world.truth.shape))
    seen = dilated(world.truth.known == Cell.FREE) & (world.truth.known == Cell.OCCUPIED)
    assert seen.any()
    assert near[seen].all()


def dilated(cells):
    """The cells and their neighbours on four sides."""
    padded = np.pad(cells, 1)
    return cells | padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]


@pytest.mark.parametrize("shape", [(10, 8), (20, 30), (28, 8), (30, 14), (45, 90), (60, 61)])
def test_offices_are_walled_in_and_connected(shape):
    for seed in range(25):
        grid = office(*shape, seed=seed)
        free = grid.known == Cell.FREE
        assert grid.shape == shape
        assert np.isin(grid.known, [Cell.FREE, Cell.OCCUPIED]).all()
        assert not free[[0, -1]].any()
        assert not free[:, [0, -1]].any()
        label = connected_components(walkable_graph(grid), directed=False)[1]
        assert len(np.unique(label[free.reshape(-1)])) == 1, seed
        assert 0.3 < free.mean() < 0.9


def test_an_office_of_20_by_30_has_rooms_on_both_sides_of_a_corridor():
    for seed in range(25):
        free = office(20, 30, seed=seed).known == Cell.FREE
        corridor = np.flatnonzero(free[:, 1:-1].all(axis=1))
        assert len(corridor) == 2
        walls_of_rooms = (~free[[1, -2], 1:-1]).sum(axis=1)
        assert ((walls_of_rooms >= 2) & (walls_of_rooms <= 6)).all()


def test_offices_repeat_by_seed():
    first = office(20, 30, seed=3)
    np.testing.assert_array_equal(first.known, office(20, 30, seed=3).known)
    assert (first.known != office(20, 30, seed=4).known).any()
    assert first.connectivity == 4
    assert office(20, 30, seed=3, connectivity=8).connectivity == 8


@pytest.mark.parametrize("shape", [(9, 30), (20, 7)])
def test_offices_too_small_are_refused(shape):
    with pytest.raises(InputError, match="at least 10 rows and 8 columns"):
        office(*shape, seed=0)


def test_places_are_free_different_and_well_apart():
    for seed in range(10):
        grid = office(20, 30, seed=seed)
        chosen = places(grid, 8, seed=seed)
        assert len(set(chosen.tolist())) == 8
        assert (grid.known.reshape(-1)[chosen] == Cell.FREE).all()
        apart = dijkstra(walkable_graph(grid), indices=chosen)[:, chosen] + 1e9 * np.eye(8)
        assert apart.min() >= 6


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
