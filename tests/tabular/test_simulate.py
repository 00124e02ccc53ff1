"""Simulated agents in a known world: their walks, and the files of them."""

from collections import Counter

import jax
import numpy as np
import pytest
from scipy.sparse.csgraph import dijkstra

import sidestep as ss
from sidestep.errors import InputError
from sidestep.io.demonstrations import demonstrations_from_walks, walks_from_trajectories
from sidestep.io.walks import read_walks, write_walks
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach

pytestmark = pytest.mark.slow

OPEN = np.zeros((3, 3), dtype=int)
ROOMS = np.array([[0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0], [1, 0, 1, 1, 0], [0, 0, 0, 1, 0]])
CORRIDOR = np.zeros((1, 6), dtype=int)


def walked(grid, goals, starts, behavior=None, seed=0, moves=None):
    tasks = [reach(grid.forget(), goal) for goal in goals]
    each = [np.asarray(own) for own in starts]
    return simulate(jax.random.key(seed), true_model(grid), tasks, each, behavior, moves)


def test_simulate_breaks_ties_at_random():
    """From corner to corner of nine cells lead six shortest paths; at each cell both good moves are equally likely."""
    agents = 800
    walks = Counter(tuple(walk.states.tolist()) for walk in walked(Grid(OPEN), [8], [[0] * agents]))
    chances = {
        (0, 1, 2, 5, 8): 1 / 4,
        (0, 1, 4, 5, 8): 1 / 8,
        (0, 1, 4, 7, 8): 1 / 8,
        (0, 3, 4, 5, 8): 1 / 8,
        (0, 3, 4, 7, 8): 1 / 8,
        (0, 3, 6, 7, 8): 1 / 4,
    }
    assert set(walks) == set(chances)
    for path, chance in chances.items():
        assert abs(walks[path] / agents - chance) <= 4 * np.sqrt(chance * (1 - chance) / agents), path


@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("behavior", [None, Behavior(BoltzmannAverage(), 30.0)])
def test_simulate_makes_legal_walks_and_optimal_ones_are_shortest(connectivity, behavior):
    grid = Grid(ROOMS, connectivity=connectivity)
    goals, starts = [3, 20], [[0, 11, 24, 20], [4, 24, 5, 22]]
    graph = walkable_graph(grid)
    walks = walked(grid, goals, starts, behavior)
    assert [walk.task for walk in walks] == [0] * 4 + [1] * 4
    assert [int(walk.states[0]) for walk in walks] == [*starts[0], *starts[1]]
    longer = 0.0
    for walk in walks:
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


def test_simulate_with_equal_keys_is_equal():
    one, same, other = (
        [walk.states.tolist() for walk in walked(Grid(OPEN), [8], [[0] * 20], seed=seed)] for seed in (3, 3, 4)
    )
    assert one == same != other


def test_simulate_of_equal_tasks_draws_independent_walks():
    walks = walked(Grid(OPEN), [8, 8], [[0] * 20, [0] * 20])
    assert [walk.states.tolist() for walk in walks[:20]] != [walk.states.tolist() for walk in walks[20:]]


def test_simulate_of_agents_that_cannot_arrive_raises():
    walled_in = Grid(np.array([[0, 1, 0, 0, 0, 0]]))
    with pytest.raises(InputError, match=r"task 0: an agent from state 0 had not arrived after"):
        walked(walled_in, [5], [[4, 0]], moves=None)


@pytest.mark.parametrize("moves", [1, 4])
def test_simulate_with_too_few_moves_returns_truncated_walks(moves):
    """Five moves are needed from state 0, and one from state 4."""
    arrived, stopped = walked(Grid(CORRIDOR), [5], [[4, 0]], moves=moves)
    assert arrived.states.tolist() == [4, 5]
    assert not arrived.truncated
    assert stopped.states.tolist() == list(range(moves + 1))
    assert stopped.truncated


def test_simulate_of_a_continuing_task_stops_at_the_limit():
    world = ss.tabular_model(ss.graph([[[1], [0]], [[0], [1]]]), np.ones((2, 2, 1)))
    endless = ss.task(np.array([0.0, 1.0]), 0.9, np.zeros(2, bool))
    [walk] = ss.simulate(jax.random.key(0), world, [endless], [[0]], max_moves=300)
    assert walk.truncated
    assert walk.states.tolist() == [0] + [1] * 300
    with pytest.raises(InputError, match="had not arrived"):
        ss.simulate(jax.random.key(0), world, [endless], [[0]])


def test_simulate_arriving_with_the_last_move_is_allowed():
    assert [len(walk.actions) for walk in walked(Grid(CORRIDOR), [5], [[0, 3]], moves=5)] == [5, 2]


@pytest.mark.parametrize(("connectivity", "ending"), [(4, ".csv"), (8, ".parquet")])
def test_write_walks_of_simulated_walks_reads_back_as_their_demonstrations(tmp_path, connectivity, ending):
    """Imperfect agents fail at walls and edges, on a map that is rotated and away from the origin."""
    grid = Grid(ROOMS, resolution=0.3, origin=(-2.0, 5.0, 0.7), connectivity=connectivity)
    goals = [20, 3]
    trajectories = walked(grid, goals, [[4, 24, 5, 22], [0, 11, 24, 20]], Behavior(BoltzmannAverage(), 30.0))
    failed = sum(int((walk.states[1:] == walk.states[:-1]).sum()) for walk in trajectories)
    assert failed > 5
    write_walks(tmp_path / f"walks{ending}", walks_from_trajectories(trajectories, goals, grid))
    walks = demonstrations_from_walks(read_walks(tmp_path / f"walks{ending}"), grid.forget())
    order = [1, 0]  # tasks come back in the order of their goals
    expected = gather([walk._replace(task=order[walk.task]) for walk in trajectories], [
        reach(grid, goal) for goal in sorted(goals)
    ])  # fmt: skip
    for field in ("states", "actions", "next_states", "task", "trajectory"):
        np.testing.assert_array_equal(getattr(walks, field), getattr(expected, field), err_msg=field)
    np.testing.assert_array_equal(walks.tasks.terminal, expected.tasks.terminal)


def test_walks_from_trajectories_without_failures_has_no_failed_moves():
    grid = Grid(OPEN)
    walks = walks_from_trajectories(walked(grid, [8], [[0, 4]]), [8], grid)
    assert np.isnan(walks.failed_moves).all()
    np.testing.assert_allclose(walks.goals, [[2.5, 0.5], [2.5, 0.5]])
    np.testing.assert_allclose(next(iter(walks))[[0, -1]], [[0.5, 2.5], [2.5, 0.5]])


def test_simulate_with_blocked_cells_repeats_moves():
    """P(blocked) = 1/2 everywhere: about every other move fails."""
    grid = Grid.unknown(1, 4)
    walks = simulate(jax.random.key(0), ObstacleGrid(grid, 0.0), [reach(grid, 3)], [np.zeros(300, dtype=int)])
    moves = np.array([len(walk.actions) for walk in walks])
    assert abs(moves.mean() - 6) <= 4 * np.sqrt(6 / 300)  # three successes at 1/2: mean 6, variance 6
