"""Walkers in a known world: where they walk, and what they leave in a file."""

from collections import Counter

import jax
import numpy as np
import pytest
from scipy.sparse.csgraph import dijkstra

from sidestep.errors import InputError
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.trajectories import walks_from_trajectories
from sidestep.io.walks import read_walks, write_walks
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach

OPEN = np.zeros((3, 3), dtype=int)
ROOMS = np.array([[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0], [1, 0, 1, 1, 0], [0, 0, 0, 1, 0]])
CORRIDOR = np.zeros((1, 6), dtype=int)


def walked(grid, goals, starts, behavior=None, seed=0, moves=None):
    tasks = [reach(grid.forget(), goal) for goal in goals]
    each = [np.asarray(own) for own in starts]
    return simulate(jax.random.key(seed), true_model(grid), tasks, each, behavior, moves)


def test_ties_are_broken_at_random():
    """From corner to corner of nine cells lead six shortest ways; at each cell both good moves are equally likely."""
    walkers = 800
    found = Counter(tuple(walk.states.tolist()) for walk in walked(Grid(OPEN), [8], [[0] * walkers]))
    chances = {
        (0, 1, 2, 5, 8): 1 / 4,
        (0, 1, 4, 5, 8): 1 / 8,
        (0, 1, 4, 7, 8): 1 / 8,
        (0, 3, 4, 5, 8): 1 / 8,
        (0, 3, 4, 7, 8): 1 / 8,
        (0, 3, 6, 7, 8): 1 / 4,
    }
    assert set(found) == set(chances)
    for way, chance in chances.items():
        assert abs(found[way] / walkers - chance) <= 4 * np.sqrt(chance * (1 - chance) / walkers), way


@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("behavior", [None, Behavior(BoltzmannAverage(), 30.0)])
def test_walks_are_legal_and_optimal_walkers_take_shortest_ways(connectivity, behavior):
    grid = Grid(ROOMS, connectivity=connectivity)
    goals, starts = [3, 20], [[0, 11, 24, 20], [4, 24, 5, 22]]
    graph = walkable_graph(grid)
    found = walked(grid, goals, starts, behavior)
    assert [walk.task for walk in found] == [0] * 4 + [1] * 4
    assert [int(walk.states[0]) for walk in found] == [*starts[0], *starts[1]]
    longer = 0.0
    for walk in found:
        goal = goals[walk.task]
        assert walk.states[-1] == goal
        assert not (walk.states[:-1] == goal).any()
        assert len(walk.states) == len(walk.actions) + 1
        before, after = walk.states[:-1], walk.states[1:]
        moved = before != after
        lengths = graph[before[None], after[None]].toarray()[0]
        assert (lengths[moved] > 0).all()
        change = np.stack(np.divmod(after, 5), axis=1) - np.stack(np.divmod(before, 5), axis=1)
        np.testing.assert_array_equal(change[moved], grid.steps[walk.actions[moved]])
        if behavior is None:
            assert moved.all()
            if connectivity == 4:
                assert len(walk.actions) == dijkstra(graph, indices=goal)[walk.states[0]]
        longer += len(walk.actions) - dijkstra(graph, indices=goal, unweighted=True)[walk.states[0]]
    assert (longer > 0) == (behavior is not None)


def test_equal_keys_give_equal_walks():
    one, same, other = (
        [walk.states.tolist() for walk in walked(Grid(OPEN), [8], [[0] * 20], seed=seed)] for seed in (3, 3, 4)
    )
    assert one == same != other


def test_walkers_of_different_tasks_choose_on_their_own():
    found = walked(Grid(OPEN), [8, 8], [[0] * 20, [0] * 20])
    assert [walk.states.tolist() for walk in found[:20]] != [walk.states.tolist() for walk in found[20:]]


@pytest.mark.parametrize(("cells", "start", "moves"), [
    (np.array([[0, 1, 0, 0, 0, 0]]), 0, None),  # walled in
    (CORRIDOR, 0, 4),  # five moves are needed
    (CORRIDOR, 0, 1),
])  # fmt: skip
def test_walkers_who_cannot_arrive_are_refused(cells, start, moves):
    with pytest.raises(InputError, match=rf"task 0: an agent from state {start} had not arrived after"):
        walked(Grid(cells), [5], [[4, start]], moves=moves)


def test_the_last_move_allowed_may_be_the_one_that_arrives():
    assert [len(walk.actions) for walk in walked(Grid(CORRIDOR), [5], [[0, 3]], moves=5)] == [5, 2]


@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_walks_in_a_file_are_the_demonstrations_that_were_walked(tmp_path, connectivity, ending):
    """Clumsy walkers who bump into walls and edges, on a map that is turned and away from the origin."""
    grid = Grid(ROOMS, resolution=0.3, origin=(-2.0, 5.0, 0.7), connectivity=connectivity)
    goals = [20, 3]
    trajectories = walked(grid, goals, [[4, 24, 5, 22], [0, 11, 24, 20]], Behavior(BoltzmannAverage(), 30.0))
    failed = sum(int((walk.states[1:] == walk.states[:-1]).sum()) for walk in trajectories)
    assert failed > 5
    write_walks(tmp_path / f"walks{ending}", walks_from_trajectories(trajectories, goals, grid))
    found = demonstrations_from_walks(read_walks(tmp_path / f"walks{ending}"), grid.forget())
    order = [1, 0]  # tasks come back in the order of their goals
    expected = gather([walk._replace(task=order[walk.task]) for walk in trajectories], [
        reach(grid, goal) for goal in sorted(goals)
    ])  # fmt: skip
    for field in ("states", "actions", "next_states", "task", "trajectory"):
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field), err_msg=field)
    np.testing.assert_array_equal(found.tasks.terminal, expected.tasks.terminal)


def test_walks_without_a_failed_move_have_no_column_for_them():
    grid = Grid(OPEN)
    walks = walks_from_trajectories(walked(grid, [8], [[0, 4]]), [8], grid)
    assert np.isnan(walks.failed_moves).all()
    np.testing.assert_allclose(walks.goals, [[2.5, 0.5], [2.5, 0.5]])
    np.testing.assert_allclose(next(iter(walks))[[0, -1]], [[0.5, 2.5], [2.5, 0.5]])


def test_a_slippery_world_makes_walkers_slip():
    """P(blocked) = 1/2 everywhere: about every other move fails."""
    grid = Grid.unknown(1, 4)
    found = simulate(jax.random.key(0), ObstacleGrid(grid, 0.0), [reach(grid, 3)], [np.zeros(300, dtype=int)])
    moves = np.array([len(walk.actions) for walk in found])
    assert abs(moves.mean() - 6) <= 4 * np.sqrt(6 / 300)  # three successes at 1/2: mean 6, variance 6
