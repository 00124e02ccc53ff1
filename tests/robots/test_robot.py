"""What robots take for known and what they pursue, on maps small enough to plan by hand."""

import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.robots.robot import mark_visited_free, risk_averse_task
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan


def test_a_corridor_costs_its_tries_and_its_bumps():
    """Each of three cells that may be blocked takes 1/(1−p) tries; bumps beyond the first cost a fifth."""
    p, bump_cost = 0.25, 6.0
    tries, bumps = 1 / (1 - p), p / (1 - p)
    model = ObstacleGrid(Grid.unknown(1, 4), float(np.log(p / (1 - p))))
    values = plan(model, risk_averse_task(model, 3, bump_cost)).solution.values
    np.testing.assert_allclose(values, -np.arange(3, -1, -1) * (tries + bump_cost * (p + (bumps - p) / 5)), rtol=1e-9)


def test_a_move_that_is_sure_to_fail_costs_a_fifth_of_a_bump_a_try():
    model = ObstacleGrid(Grid(np.full((1, 3), Cell.FREE)))
    task = risk_averse_task(model, 2, 4.0)
    up, down, left, right = np.asarray(task.reward)[0].tolist()
    assert (up, down, left, right) == (-1.8, -1.8, -1.8, -1)


def test_what_is_more_probably_blocked_is_never_cheaper():
    """R alone is: it is what each try is charged, and who is more often stopped tries more often."""
    worth = []
    for logit in np.linspace(-6, 6, 25):
        model = ObstacleGrid(Grid(np.array([[Cell.FREE, Cell.UNKNOWN]])), np.array([0.0, logit]))
        worth.append(float(plan(model, risk_averse_task(model, 1)).solution.values[0]))
    assert (np.diff(worth) < 0).all()


def test_a_diagonal_move_fails_if_any_of_three_cells_is_blocked():
    p, bump_cost = 0.25, 6.0
    model = ObstacleGrid(Grid.unknown(2, 2, connectivity=8), float(np.log(p / (1 - p))))
    across = np.flatnonzero((np.asarray(model.graph.successors)[0] == 3).any(axis=-1))
    fails = 1 - (1 - p) ** 3
    expected = -np.sqrt(2) - bump_cost * fails * (1 - fails + fails / 5)
    np.testing.assert_allclose(
        np.asarray(risk_averse_task(model, 3, bump_cost).reward)[0, across], [expected], rtol=1e-9
    )


def test_people_have_shown_what_is_free():
    grid = Grid(np.array([[Cell.UNKNOWN, Cell.UNKNOWN, Cell.OCCUPIED, Cell.FREE, Cell.UNKNOWN]]))
    model = ObstacleGrid(grid, np.array([0.0, 1.0, 0.0, 0.0, 2.0]))
    blocked = mark_visited_free(model, np.array([0, 0, 2])).blocked
    np.testing.assert_allclose(blocked, [[0, 1 / (1 + np.exp(-1)), 1, 0, 1 / (1 + np.exp(-2))]])


def test_a_robot_keeps_to_where_people_walked_if_that_is_not_far():
    """Up the middle the second cell may well be blocked; people went around by the right, two cells longer."""
    logits = np.full((3, 3), -1.0)
    logits[1, 1], logits[1, 0], logits[:, 2] = 0.0, 5.0, -1.0
    model = ObstacleGrid(Grid.unknown(3, 3), logits.reshape(-1))
    walked = [7, 8, 5, 2, 1]
    assert plan(model, risk_averse_task(model, 1, 0.0)).path_from(7).tolist() == [7, 4, 1]
    known = mark_visited_free(model, walked)
    assert plan(known, risk_averse_task(known, 1)).path_from(7).tolist() == walked
    # with little to lose it takes its chance, whatever people did: 1/(1 − ½) = 2 tries and one move against four
    assert plan(known, risk_averse_task(known, 1, 0.5)).path_from(7).tolist() == [7, 4, 1]


@pytest.mark.parametrize("bump_cost", [-1.0, np.nan, np.inf])
def test_bumps_cost_something_finite(bump_cost):
    with pytest.raises(InputError, match="bump_cost"):
        risk_averse_task(ObstacleGrid(Grid.unknown(1, 3)), 2, bump_cost)
