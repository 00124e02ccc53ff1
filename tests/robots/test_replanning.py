"""A robot that mends its plan after a bump goes as far as one that plans anew, and as far as can be told by hand."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.robots.replanning import lengths_by_policy, lengths_with_bumps, world_of
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan
from sidestep.tabular.tasks import Reward, reach

REWARDS = [Reward(), Reward(discount=1.0, step_cost=1.0), Reward(discount=0.99, step_cost=0.5)]
ROOT_TWO = 2**0.5


def thinks_all_free(truth: Grid) -> ObstacleGrid:
    return ObstacleGrid(truth.forget(), -20.0)


def lengths(model, truth, goal, starts, reward=REWARDS[1]):
    task = reward.reach(truth.forget(), goal)
    return lengths_with_bumps(model, world_of(truth), task, goal, np.array(starts)).tolist()


@pytest.mark.parametrize("reward", REWARDS)
def test_a_wall_by_hand(reward):
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
    assert lengths(thinks_all_free(truth), truth, 14, [11, 9, 14], reward) == [9, 1, 0]


def test_a_diagonal_that_fails_costs_its_length():
    """From 0 to 3 across a corner that cannot be cut: a bump of √2, then around it."""
    truth = Grid(np.array([[0, 1], [0, 0]]), connectivity=8)
    assert lengths(thinks_all_free(truth), truth, 3, [0]) == [pytest.approx(ROOT_TWO + 2)]


def test_who_is_sure_of_an_obstacle_that_is_not_there_never_arrives():
    truth = Grid(np.zeros((1, 3), dtype=int))
    for reward in REWARDS:
        sure = ObstacleGrid(Grid(np.array([[-1, 1, -1]])), -20.0)
        assert lengths(sure, truth, 2, [0, 2], reward) == [np.inf, 0]


def test_who_finds_all_ways_closed_never_arrives():
    truth = Grid(np.array([[0, 1, 0], [0, 1, 0], [0, 1, 0]]))
    for reward in REWARDS:
        assert lengths(thinks_all_free(truth), truth, 5, [0, 8], reward) == [np.inf, 1]


def test_a_robot_does_not_know_what_others_found_out():
    truth = Grid(np.array([[0, 1, 0], [0, 0, 0]]))
    alone = lengths(thinks_all_free(truth), truth, 2, [0])
    assert lengths(thinks_all_free(truth), truth, 2, [0, 0, 0]) == alone * 3 == [5] * 3


def planning_anew(model, truth, goal, start, reward):
    """The same by a whole plan after every bump."""
    needed, walls = moves_into(truth), np.append(truth.known.reshape(-1) != Cell.FREE, False)
    known, here, length = np.array(model.known), start, 0.0
    while here != goal:
        found_out = eqx.tree_at(lambda model: model.known, model, jnp.asarray(known))
        made = plan(found_out, reach(truth.forget(), goal, discount=reward.discount, step_cost=reward.step_cost))
        path = made.follow(np.array([here]))[0]
        if path[-1] != goal:
            return np.inf
        for after in path[1:]:
            action = int(np.flatnonzero(needed[here, :, 0] == after)[0])
            length += truth.lengths[action]
            bumped = [cell for cell in needed[here, action] if walls[cell]]
            known.flat[bumped] = Cell.OCCUPIED
            if bumped:
                break
            here = int(after)
    return length


@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("walls", [0.2, 0.4])
def test_mending_leads_as_far_as_planning_anew(reward, connectivity, walls):
    """On random maps with random beliefs, some of them sure and some of these wrong."""
    random = np.random.default_rng(5)
    never = followed = 0
    for _ in range(12):
        truth = Grid((random.random((6, 7)) < walls).astype(int), connectivity=connectivity)
        known = random.choice([Cell.UNKNOWN, Cell.FREE, Cell.OCCUPIED], p=[0.9, 0.08, 0.02], size=(6, 7))
        model = ObstacleGrid(Grid(known.astype(int), connectivity=connectivity), random.normal(-2, 2, size=42))
        free = np.flatnonzero((truth.known.reshape(-1) == Cell.FREE) & (known.reshape(-1) != Cell.OCCUPIED))
        goal, *starts = random.choice(free, 6, replace=False).tolist()
        found = lengths(model, truth, goal, starts, reward)
        expected = [planning_anew(model, truth, goal, start, reward) for start in starts]
        np.testing.assert_allclose(found, expected, rtol=1e-9)
        never += np.isinf(expected).sum()
        followed += len(starts)
    assert 0 < never < followed


def ranked(states, *actions):
    """A policy that takes these actions everywhere, the first with most probability, and the others never."""
    policy = np.zeros((states, 4))
    policy[:, actions] = np.arange(len(actions), 0, -1) / 10
    return policy


def test_who_has_but_a_policy_takes_the_next_action_after_a_bump():
    """Right, else up: from 11 into the walls at 13 and 8, which are 2 moves lost, and right along the upper side."""
    drawn = np.zeros((4, 5), dtype=int)
    drawn[1:, 3] = 1
    truth = world_of(Grid(drawn))
    assert lengths_by_policy(ranked(20, 3, 0), truth, 4, np.array([11, 4, 3, 10])).tolist() == [7, 0, 1, 8]
    # from 10: right to 12, a bump, up, a bump, up, right to 4; nobody needs to try 13 twice
    assert lengths_by_policy(ranked(20, 3), truth, 4, np.array([11])).tolist() == [np.inf]


def test_who_goes_round_in_circles_never_arrives():
    truth = world_of(Grid(np.zeros((1, 4), dtype=int)))
    policy = ranked(4, 3)
    policy[2] = [0, 0, 1, 0]
    assert lengths_by_policy(policy, truth, 3, np.array([0, 3])).tolist() == [np.inf, 0]
    # a wall met on the way changes what they do
    walled = world_of(Grid(np.array([[0, 0, 0, 0, 1]])))
    policy = np.array([[0, 0, 0, 1.0]] * 4 + [[0, 0, 0, 1.0]])
    policy[3] = [0, 0, 0.4, 0.6]
    policy[2] = [0, 0, 0.6, 0.4]
    assert lengths_by_policy(policy, walled, 0, np.array([3])).tolist() == [np.inf]
    policy[1] = [0, 0, 1.0, 0]
    assert lengths_by_policy(policy, walled, 0, np.array([3])).tolist() == [4]  # a bump, and three to the left


def test_a_diagonal_that_a_policy_takes_needs_both_cells_beside_it():
    truth = world_of(Grid(np.array([[0, 1], [0, 0]]), connectivity=8))
    policy = np.zeros((4, 8))
    policy[:, 7], policy[:, 1], policy[:, 3] = 0.6, 0.3, 0.1  # down right, else down, else right
    policy[0] = [0, 0.3, 0, 0.1, 0, 0, 0, 0.6]
    policy[2] = [0, 0, 0, 1, 0, 0, 0, 0]
    assert lengths_by_policy(policy, truth, 3, np.array([0])).tolist() == [pytest.approx(ROOT_TWO + 2)]
