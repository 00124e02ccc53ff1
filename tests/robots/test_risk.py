"""The risk of paths over maps that were sampled together."""

from dataclasses import replace

import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.maps.learned_map import LearnedMap
from sidestep.robots.planners import grid_environment
from sidestep.robots.risk import expected_length, independent_open_probability, open_probability, required_cells
from sidestep.robots.robot import risk_averse_robot
from sidestep.tabular.grid import Grid
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
    path = np.array([0, 1, 4])
    assert open_probability(GRID, path, GAPS) == pytest.approx(0.5 / 5)
    assert independent_open_probability(GRID, path, GAPS.mean(axis=0)) == pytest.approx(0.25)


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
    plan = risk_averse_robot(ObstacleGrid(grid, np.linspace(-3, -1, 36)), [], bump_cost=1.0).plan_to(35)
    path = plan.paths_from(np.array([0]))[0]
    truths = [grid_environment(replace(grid, known=each.astype(int))) for each in maps]
    lengths = np.array([plan.executed_lengths(truth, np.array([0]))[0] for truth in truths])
    assert 0.1 < open_probability(grid, path, maps) < 0.9
    assert expected_length(grid, plan, path, maps) == lengths[np.isfinite(lengths)].mean()


def learned_map() -> LearnedMap:
    blocked = np.clip(GAPS.mean(axis=0), 0.01, 0.99)
    return LearnedMap(GRID, blocked, np.array([[0, 2]]), Reward(), samples=np.repeat(GAPS, 25, axis=0))


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
    with pytest.raises(InputError, match="max_risk"):
        learned_map().plan((0.5, 2.5), (2.5, 2.5), max_risk=1.5)
