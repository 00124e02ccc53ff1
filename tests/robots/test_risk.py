"""The risk of paths over maps that were sampled together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.maps.learned_map import LearnedMap
from sidestep.robots.planners import grid_environment
from sidestep.robots.risk import expected_length, independent_open_probability, open_probability, required_cells
from sidestep.robots.robot import risk_averse_robot
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward

GRID = Grid.unknown(3, 3)
GAPS = np.zeros((4, 3, 3), dtype=bool)
GAPS[:, :2, 1] = True  # a wall in the middle column, with a gap at the bottom
GAPS[::2, 0, 1], GAPS[1::2, 1, 1] = False, False  # and one at the top or in the middle, never both
TOP, MIDDLE, BOTTOM = np.array([0, 1, 2]), np.array([0, 3, 4, 5, 2]), np.array([0, 3, 6, 7, 8, 5, 2])


def test_open_probability_is_the_fraction_of_maps_without_an_obstacle_on_the_path():
    assert [open_probability(GRID, path, GAPS) for path in (TOP, MIDDLE, BOTTOM)] == [0.5, 0.5, 0.9]


def test_open_probability_of_a_path_through_cells_that_exclude_each_other_is_not_the_product():
    """The path enters the top gap and the middle one: one of them is blocked in every map."""
    path = np.array([0, 1, 4, 7])
    assert open_probability(GRID, path, GAPS) == pytest.approx(0.5 / 5)
    assert independent_open_probability(GRID, path, GAPS.mean(axis=0)) == pytest.approx(0.25)


def test_open_probability_is_given_that_start_and_goal_are_free():
    """The middle gap is blocked in half of the maps; where it is free, the top one is blocked."""
    assert open_probability(GRID, np.array([3, 4]), GAPS) == open_probability(GRID, np.array([4, 5]), GAPS) == 1
    assert open_probability(GRID, np.array([0, 3, 4]), GAPS) == pytest.approx(2.5 / 3)
    assert open_probability(GRID, np.array([0, 1, 4]), GAPS) == pytest.approx(0.5 / 3)
    assert open_probability(GRID, np.array([0, 1, 4]), GAPS | True) == 0.5
    assert independent_open_probability(GRID, np.array([0, 1, 4]), GAPS.mean(axis=0)) == pytest.approx(0.5)


def test_open_probability_of_a_path_along_known_cells_is_1():
    known = np.full((3, 3), Cell.UNKNOWN)
    known[0, 1] = Cell.FREE
    grid = Grid(known)
    assert open_probability(grid, np.array([0, 1, 2]), GAPS & False) == 1
    assert open_probability(grid, np.array([0, 1, 4, 7]), GAPS & False) == pytest.approx(4.5 / 5)


def test_expected_length_is_over_maps_with_a_free_start():
    """From the top gap the robot goes around the corner; that is blocked where the gap is blocked too."""
    maps = GAPS.copy()
    maps[1::2, 0, 2] = True
    logits = np.where(np.arange(9) == 4, 0.0, -3.0)
    plan = risk_averse_robot(ObstacleGrid(GRID, logits), [], bump_cost=5.0).plan_to(5)
    path = plan.paths_from(np.array([1]))[0]
    assert path.tolist() == [1, 2, 5]
    assert expected_length(GRID, plan, path, maps) == 2
    assert expected_length(GRID, plan, path, maps | True) is None


def test_required_cells_of_a_diagonal_include_those_beside_it():
    assert required_cells(Grid.unknown(2, 2, connectivity=8), np.array([0, 3])).tolist() == [1, 2, 3]
    with pytest.raises(InputError, match="single moves"):
        required_cells(Grid.unknown(2, 2), np.array([0, 3]))


def test_expected_length_counts_bumps_and_detours():
    """In half of the maps the robot bumps at the top, and goes through the middle instead."""
    plan = risk_averse_robot(ObstacleGrid(GRID, -2.0), [], bump_cost=0.0).plan_to(2)
    path = plan.paths_from(np.array([0]))[0]
    assert path.tolist() == TOP.tolist()
    assert expected_length(GRID, plan, path, GAPS) == (2 + (1 + 4)) / 2
    assert expected_length(GRID, plan, path, GAPS & False) == 2
    assert expected_length(GRID, plan, path, GAPS | True) is None


@pytest.mark.parametrize("connectivity", [4, 8])
def test_expected_length_is_the_mean_of_executed_lengths(connectivity):
    """Where the path is open too, though there no move is followed."""
    grid = Grid.unknown(6, 6, connectivity=connectivity)
    maps = np.random.default_rng(0).random((30, 6, 6)) < 0.15
    maps[:, 0, 0] = False  # the robot stands there
    plan = risk_averse_robot(ObstacleGrid(grid, np.linspace(-3, -1, 36)), [], bump_cost=1.0).plan_to(35)
    path = plan.paths_from(np.array([0]))[0]
    truths = [grid_environment(replace(grid, known=each.astype(int))) for each in maps]
    lengths = np.array([plan.executed_lengths(truth, np.array([0]))[0] for truth in truths])
    assert 0.1 < open_probability(grid, path, maps) < 0.9
    assert expected_length(grid, plan, path, maps) == lengths[np.isfinite(lengths)].mean()


def learned_map(visited: Sequence[int] = (0,)) -> LearnedMap:
    blocked = np.clip(GAPS.mean(axis=0), 0.01, 0.99)
    pairs = np.array([[state, 2] for state in visited])
    return LearnedMap(GRID, blocked, pairs, Reward(), samples=np.repeat(GAPS, 25, axis=0))


def test_plan_with_a_risk_takes_the_longer_sure_way():
    start, goal = (0.5, 2.5), (2.5, 2.5)
    risky, sure = (learned_map().plan(start, goal, bump_cost=1.0, max_risk=risk) for risk in (0.6, 0.05))
    assert risky.states.tolist() == TOP.tolist()
    assert sure.states.tolist() == BOTTOM.tolist()
    assert (sure.length, round(sure.open_probability, 2)) == (6.0, 1.0)
    assert [other.length for other in sure.alternatives] == [2.0]


def test_plan_with_a_risk_that_no_path_has_takes_the_surest():
    path = learned_map().plan((0.5, 2.5), (2.5, 2.5), bump_cost=1.0, max_risk=0.0)
    assert path.states.tolist() == BOTTOM.tolist()
    assert path.within(0.01)
    assert not path.within(0.0)
    with pytest.raises(InputError, match="max_risk"):
        learned_map().plan((0.5, 2.5), (2.5, 2.5), max_risk=1.5)


def test_plan_without_risk_takes_cells_that_walks_passed():
    path = learned_map(visited=BOTTOM.tolist()).plan((0.5, 2.5), (2.5, 2.5), bump_cost=1.0, max_risk=0.0)
    assert (path.states.tolist(), path.open_probability) == (BOTTOM.tolist(), 1.0)
    assert path.within(0.0)


def test_within_a_risk_counts_rounding_for_the_path():
    """1 − .95 is above .05 in floating-point numbers."""
    path = replace(learned_map().plan((0.5, 2.5), (2.5, 2.5)), open_probability=0.95)
    assert path.within(0.05)
    assert not path.within(0.0499)


def test_plan_to_a_doubtful_goal_tells_apart_whether_the_goal_and_the_way_are_free():
    """The goal is the middle gap, blocked in half of the maps; from its neighbor nothing else is in the way."""
    path = learned_map().plan((0.5, 1.5), (1.5, 1.5))
    assert path.states.tolist() == [3, 4]
    assert path.goal_blocked == 0.5
    assert path.open_probability == 1
    assert learned_map(visited=[4]).plan((0.5, 1.5), (1.5, 1.5)).goal_blocked == 0
