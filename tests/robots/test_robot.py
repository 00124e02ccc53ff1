"""The risk-averse robot on maps small enough to plan by hand."""

import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.robots.robot import mark_visited_free, risk_averse_task
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan


def test_risk_averse_task_in_a_corridor_costs_moves_and_bumps():
    """Each of three cells takes 1/(1−p) moves; bumps beyond the first cost a fifth."""
    p, bump_cost = 0.25, 6.0
    moves, bumps = 1 / (1 - p), p / (1 - p)
    model = ObstacleGrid(Grid.unknown(1, 4), float(np.log(p / (1 - p))))
    values = plan(model, risk_averse_task(model, 3, bump_cost)).solution.values
    np.testing.assert_allclose(values, -np.arange(3, -1, -1) * (moves + bump_cost * (p + (bumps - p) / 5)), rtol=1e-9)


def test_risk_averse_task_of_a_move_that_fails_costs_a_fifth_of_a_bump():
    model = ObstacleGrid(Grid(np.full((1, 3), Cell.FREE)))
    task = risk_averse_task(model, 2, 4.0)
    up, down, left, right = np.asarray(task.reward)[0].tolist()
    assert (up, down, left, right) == (-1.8, -1.8, -1.8, -1)


@pytest.mark.slow
def test_risk_averse_task_value_falls_with_the_probability_of_an_obstacle():
    """Although the reward of one move may rise: it is repeated more often."""
    values = []
    for logit in np.linspace(-6, 6, 25):
        model = ObstacleGrid(Grid(np.array([[Cell.FREE, Cell.UNKNOWN]])), np.array([0.0, logit]))
        values.append(float(plan(model, risk_averse_task(model, 1)).solution.values[0]))
    assert (np.diff(values) < 0).all()


def test_risk_averse_task_of_a_diagonal_depends_on_three_cells():
    p, bump_cost = 0.25, 6.0
    model = ObstacleGrid(Grid.unknown(2, 2, connectivity=8), float(np.log(p / (1 - p))))
    across = np.flatnonzero((np.asarray(model.graph.successors)[0] == 3).any(axis=-1))
    fails = 1 - (1 - p) ** 3
    expected = -np.sqrt(2) - bump_cost * fails * (1 - fails + fails / 5)
    np.testing.assert_allclose(
        np.asarray(risk_averse_task(model, 3, bump_cost).reward)[0, across], [expected], rtol=1e-9
    )


def test_mark_visited_free_changes_unknown_visited_cells_only():
    grid = Grid(np.array([[Cell.UNKNOWN, Cell.UNKNOWN, Cell.OCCUPIED, Cell.FREE, Cell.UNKNOWN]]))
    model = ObstacleGrid(grid, np.array([0.0, 1.0, 0.0, 0.0, 2.0]))
    blocked = mark_visited_free(model, np.array([0, 0, 2])).blocked
    np.testing.assert_allclose(blocked, [[0, 1 / (1 + np.exp(-1)), 1, 0, 1 / (1 + np.exp(-2))]])


def test_risk_averse_task_prefers_visited_cells_on_a_short_detour():
    """The middle cell has P(blocked) = 1/2; the walk went around it by the right, two cells longer."""
    logits = np.full((3, 3), -1.0)
    logits[1, 1], logits[1, 0], logits[:, 2] = 0.0, 5.0, -1.0
    model = ObstacleGrid(Grid.unknown(3, 3), logits.reshape(-1))
    visited = [7, 8, 5, 2, 1]
    assert plan(model, risk_averse_task(model, 1, 0.0)).path_from(7).tolist() == [7, 4, 1]
    known = mark_visited_free(model, visited)
    assert plan(known, risk_averse_task(known, 1)).path_from(7).tolist() == visited
    # with cheap bumps it goes straight: 1/(1 − ½) = 2 moves and one more, against four
    assert plan(known, risk_averse_task(known, 1, 0.5)).path_from(7).tolist() == [7, 4, 1]


@pytest.mark.parametrize("bump_cost", [-1.0, np.nan, np.inf])
def test_risk_averse_task_with_an_invalid_bump_cost_raises(bump_cost):
    with pytest.raises(InputError, match="bump_cost"):
        risk_averse_task(ObstacleGrid(Grid.unknown(1, 3)), 2, bump_cost)
