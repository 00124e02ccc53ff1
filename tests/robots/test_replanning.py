"""Executed paths: after a bump, repaired values lead as far as new plans, and as far as worked out by hand."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.robots.planners import grid_environment, policy_lengths, replanning_lengths
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan
from sidestep.tabular.reward import Reward
from sidestep.tabular.tasks import reach

REWARDS = [Reward(), Reward(discount=1.0, step_cost=1.0), Reward(discount=0.99, step_cost=0.5)]
ROOT_TWO = 2**0.5


def all_free_model(truth: Grid) -> ObstacleGrid:
    return ObstacleGrid(truth.forget(), -20.0)


def lengths(model, truth, goal, starts, reward=REWARDS[1]):
    task = reward.reach(truth.forget(), goal)
    return replanning_lengths(model, grid_environment(truth), task, goal, np.array(starts)).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("reward", REWARDS)
def test_replanning_lengths_around_a_wall_count_bumps_and_detours(reward):
    """A wall in the way, and a way around its upper end.

    0  1  2  3  4        . . . . .
    5  6  7  8  9        . . . # .
    10 11 12 13 14       . . . # .     from 11 to 14: bumps at 13 and 8; of ties the first, up
    15 16 17 18 19       . . . # .
    """
    drawn = np.zeros((4, 5), dtype=int)
    drawn[1:, 3] = 1
    truth = Grid(drawn)
    # 11, 12, bump, up to 7, bump, up to 2, then 3, 4, 9, 14
    assert lengths(all_free_model(truth), truth, 14, [11, 9, 14], reward) == [9, 1, 0]


def test_replanning_lengths_of_a_failed_diagonal_include_its_length():
    """From 0 to 3 across a corner that cannot be cut: a bump of √2, then around it."""
    truth = Grid(np.array([[0, 1], [0, 0]]), connectivity=8)
    assert lengths(all_free_model(truth), truth, 3, [0]) == [pytest.approx(ROOT_TWO + 2)]


def test_replanning_lengths_with_a_false_known_obstacle_are_infinite():
    truth = Grid(np.zeros((1, 3), dtype=int))
    for reward in REWARDS:
        model = ObstacleGrid(Grid(np.array([[-1, 1, -1]])), -20.0)
        assert lengths(model, truth, 2, [0, 2], reward) == [np.inf, 0]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_replanning_lengths_take_the_better_of_two_ways_with_large_values(dtype):
    """The way over 0 costs .1 more than that over 6, of 20,000; it would be the first of ties, and end in a bump at 1.

    0 # 2
    3 # 5        From 3 to 5; the obstacle at 4 is known, the one at 1 is not.
    6 7 8
    """
    truth, known = Grid(np.array([[0, 1, 0], [0, 1, 0], [0, 0, 0]])), Grid(np.array([[-1] * 3, [-1, 1, -1], [-1] * 3]))
    model = ObstacleGrid(known, jnp.full(9, -30.0, dtype))
    costly = reach(known, 5, discount=1.0, step_cost=5_000.0)
    dearer = replace(costly, reward=jnp.broadcast_to(costly.reward, (9, 4)).at[0].add(-0.1))
    assert replanning_lengths(model, grid_environment(truth), dearer, 5, np.array([3])).tolist() == [4]


def test_replanning_lengths_without_a_path_are_infinite():
    truth = Grid(np.array([[0, 1, 0], [0, 1, 0], [0, 1, 0]]))
    for reward in REWARDS:
        assert lengths(all_free_model(truth), truth, 5, [0, 8], reward) == [np.inf, 1]


def test_replanning_lengths_of_several_robots_are_independent():
    truth = Grid(np.array([[0, 1, 0], [0, 0, 0]]))
    alone = lengths(all_free_model(truth), truth, 2, [0])
    assert lengths(all_free_model(truth), truth, 2, [0, 0, 0]) == alone * 3 == [5] * 3


def length_by_new_plans(model, truth, goal, start, reward):
    """Plan from scratch after every bump."""
    required, obstacles = moves_into(truth), np.append(truth.known.reshape(-1) != Cell.FREE, False)
    known, state, length = np.array(model.known), start, 0.0
    while state != goal:
        updated = eqx.tree_at(lambda model: model.known, model, jnp.asarray(known))
        current = plan(updated, reach(truth.forget(), goal, discount=reward.discount, step_cost=reward.step_cost))
        path = current.follow(np.array([state]))[0]
        if path[-1] != goal:
            return np.inf
        for after in path[1:]:
            action = int(np.flatnonzero(required[state, :, 0] == after)[0])
            length += truth.lengths[action]
            bumped = [cell for cell in required[state, action] if obstacles[cell]]
            known.flat[bumped] = Cell.OCCUPIED
            if bumped:
                break
            state = int(after)
    return length


@pytest.mark.slow
@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize("connectivity", [4, 8])
def test_replanning_lengths_on_random_maps_equal_those_of_new_plans(reward, connectivity):
    """Models are random: some cells are known, and some of these wrongly."""
    random = np.random.default_rng(5)
    infinite = total = 0
    for walls in [0.2, 0.4] * 3:
        truth = Grid((random.random((6, 7)) < walls).astype(int), connectivity=connectivity)
        known = random.choice([Cell.UNKNOWN, Cell.FREE, Cell.OCCUPIED], p=[0.9, 0.08, 0.02], size=(6, 7))
        model = ObstacleGrid(Grid(known.astype(int), connectivity=connectivity), random.normal(-2, 2, size=42))
        free = np.flatnonzero((truth.known.reshape(-1) == Cell.FREE) & (known.reshape(-1) != Cell.OCCUPIED))
        goal, *starts = random.choice(free, 6, replace=False).tolist()
        actual = lengths(model, truth, goal, starts, reward)
        expected = [length_by_new_plans(model, truth, goal, start, reward) for start in starts]
        np.testing.assert_allclose(actual, expected, rtol=1e-9)
        infinite += np.isinf(expected).sum()
        total += len(starts)
    assert 0 < infinite < total


def policy_of(states, *actions):
    """A policy with these actions in every state, the first most probable, and no others."""
    policy = np.zeros((states, 4))
    policy[:, actions] = np.arange(len(actions), 0, -1) / 10
    return policy


def test_policy_lengths_after_a_bump_use_the_next_action():
    """Right, else up: from 11 into the walls at 13 and 8, two moves that fail, and right along the upper side."""
    drawn = np.zeros((4, 5), dtype=int)
    drawn[1:, 3] = 1
    truth = grid_environment(Grid(drawn))
    assert policy_lengths(policy_of(20, 3, 0), truth, 4, np.array([11, 4, 3, 10])).tolist() == [7, 0, 1, 8]
    # from 10: right to 12, a bump, up, a bump, up, right to 4; 13 is not entered twice
    assert policy_lengths(policy_of(20, 3), truth, 4, np.array([11])).tolist() == [np.inf]


def test_policy_lengths_of_a_cycle_are_infinite():
    truth = grid_environment(Grid(np.zeros((1, 4), dtype=int)))
    policy = policy_of(4, 3)
    policy[2] = [0, 0, 1, 0]
    assert policy_lengths(policy, truth, 3, np.array([0, 3])).tolist() == [np.inf, 0]
    # a bump on the way changes the action
    walled = grid_environment(Grid(np.array([[0, 0, 0, 0, 1]])))
    policy = np.array([[0, 0, 0, 1.0]] * 4 + [[0, 0, 0, 1.0]])
    policy[3] = [0, 0, 0.4, 0.6]
    policy[2] = [0, 0, 0.6, 0.4]
    assert policy_lengths(policy, walled, 0, np.array([3])).tolist() == [np.inf]
    policy[1] = [0, 0, 1.0, 0]
    assert policy_lengths(policy, walled, 0, np.array([3])).tolist() == [4]  # a bump, and three to the left


def test_policy_lengths_of_a_diagonal_need_both_cells_beside_it():
    truth = grid_environment(Grid(np.array([[0, 1], [0, 0]]), connectivity=8))
    policy = np.zeros((4, 8))
    policy[:, 7], policy[:, 1], policy[:, 3] = 0.6, 0.3, 0.1  # down right, else down, else right
    policy[0] = [0, 0.3, 0, 0.1, 0, 0, 0, 0.6]
    policy[2] = [0, 0, 0, 1, 0, 0, 0, 0]
    assert policy_lengths(policy, truth, 3, np.array([0])).tolist() == [pytest.approx(ROOT_TWO + 2)]
