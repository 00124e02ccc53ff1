"""Scores of learned maps, on maps small enough to score by hand."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from sidestep.evaluation import evaluate as evaluation
from sidestep.evaluation.evaluate import evaluate, plan_paths, sample_for
from sidestep.robots.planners import ModelPlanner, PolicyPlanner
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.tasks import Reward

#  0 . #      states 0 1 2
#  . . .             3 4 5     with obstacles at 2 and 7
#  . # .             6 7 8
TRUTH = Grid(np.array([[0, 0, 1], [0, 0, 0], [0, 1, 0]]))
ALL = np.ones((3, 3), dtype=bool)
VISITED = np.array([[0, 5], [6, 8]])
"""From 0 to 5 nobody is in the way of a shorter way (opening 2 gives none); from 6 to 8 the obstacle at 7 is."""


def model_of(blocked) -> ObstacleGrid:
    blocked = np.asarray(blocked, dtype=float)
    return ObstacleGrid(TRUTH.forget(), np.log(blocked / (1 - blocked)).reshape(-1))


def scores(model, reward=Reward(), scored=ALL, truth=TRUTH, visited=VISITED, **settings):  # noqa: B008
    return evaluate(who_pursues(reward, model), np.asarray(model.blocked), truth, scored, visited, **settings)


def who_pursues(reward, model) -> ModelPlanner:
    return ModelPlanner(model, partial(reward.reach, model.blank))


@pytest.mark.parametrize("reward", [Reward(), Reward(discount=1.0, step_cost=1.0)])
def test_a_perfect_map(reward):
    """Nobody can plan to a known obstacle, and none is missed."""
    found = scores(true_model(TRUTH), reward)
    expected = {
        "auc": 1, "average_precision": 1, "auc_relevant": 1, "average_precision_relevant": 1, "recall": 1,
        "mean_obstacle": 1, "mean_free": 0, "max_probability": 1, "legal_share": 1, "excess_length": 0, "regret": 0,
        "arriving_share": 1,
    }  # fmt: skip
    assert found == expected


def test_a_map_that_thinks_everything_free():
    """Of ties the first action is taken, up, down, left, right: plans change rows first, then columns.

    Of 42 pairs of free cells, 13 are so led into an obstacle: 5 and 8 to 0 and 1 (through 2), 1 and 4 to 6 and 8, 5 and
    8 to 6, and 0, 3 and 6 to 8 (through 7). A robot then loses the move that failed; and two more for turning back if
    it came from 5 to 6, 0 to 8 or 3 to 8.
    """
    found = scores(ObstacleGrid(TRUTH.forget(), -20.0))
    assert found["legal_share"] == pytest.approx(29 / 42)
    assert found["excess_length"] == 0  # all legal paths are as short as can be
    assert found["regret"] == pytest.approx((13 + 3 * 2) / 42)
    assert found["arriving_share"] == 1
    assert found["auc"] == found["auc_relevant"] == 0.5
    assert found["average_precision"] == pytest.approx(2 / 9)
    assert found["recall"] == 0
    assert found["mean_free"] == found["mean_obstacle"] == pytest.approx(1 / (1 + np.exp(20)))


def test_cells_by_hand():
    """Obstacles at .8 and .3, free cells at .1 but for one at .5: six of seven are below .3, all below .8."""
    blocked = np.full((3, 3), 0.1)
    blocked[2, 1], blocked[0, 2], blocked[1, 1] = 0.8, 0.3, 0.5
    found = scores(model_of(blocked))
    assert found["auc"] == pytest.approx(13 / 14)
    assert found["average_precision"] == pytest.approx((1 + 2 / 3) / 2)
    assert found["auc_relevant"] == found["average_precision_relevant"] == 1
    assert found["recall"] == pytest.approx(1 / 2)
    assert found["mean_obstacle"] == pytest.approx(0.55)
    assert found["mean_free"] == pytest.approx((6 * 0.1 + 0.5) / 7)
    assert found["max_probability"] == pytest.approx(0.8)


def test_only_cells_that_had_to_be_learned_are_scored():
    blocked = np.full((3, 3), 0.1)
    blocked[2, 1], blocked[0, 2], blocked[1, 1] = 0.8, 0.3, 0.5
    scored = ALL.copy()
    scored[0, 2] = scored[1, 1] = False
    found = scores(model_of(blocked), scored=scored)
    assert (found["auc"], found["recall"], found["mean_obstacle"]) == (1, 1, pytest.approx(0.8))
    assert found["mean_free"] == pytest.approx(0.1)
    assert scores(model_of(blocked), scored=~ALL)["auc"] is None


def test_a_detour_that_nobody_needs():
    """Cell 4 seems blocked: 1 to 4 and 3 to 5 take longer ways, or go through it all the same."""
    blocked = np.full((3, 3), 1e-6)
    blocked[1, 1] = blocked[0, 2] = blocked[2, 1] = 1 - 1e-6
    paths, goals = plan_paths(who_pursues(Reward(), model_of(blocked)), np.array([3, 6]), np.array([0, 3]))
    assert [path.tolist() for path in paths] == [[3, 0], [6, 3, 0], [6, 3]]
    assert goals.tolist() == [0, 0, 3]
    blocked = np.full((3, 3), 1e-6)
    blocked[0, 1] = 1 - 1e-6  # between 0 and 2: two moves in the truth, four in the map
    open_truth = Grid(np.zeros((3, 3), dtype=int))
    found = scores(model_of(blocked), truth=open_truth, visited=np.zeros((0, 2), dtype=int))
    assert found["legal_share"] == 1
    assert found["excess_length"] == found["regret"] == pytest.approx(2 * 2 / 72)
    assert found["auc"] is found["recall"] is found["mean_obstacle"] is None


def test_goals_known_to_be_occupied_are_not_planned_to():
    """The map knows state 4 for occupied although the truth says that it is free."""
    known = np.full((3, 3), Cell.UNKNOWN, dtype=int)
    known[1, 1] = Cell.OCCUPIED
    model = ObstacleGrid(Grid(known), -20.0)
    found = scores(model, truth=Grid(np.zeros((3, 3), dtype=int)), scored=known == Cell.UNKNOWN, visited=VISITED[:0])
    assert found["legal_share"] == 1
    assert found["excess_length"] == pytest.approx(4 * 2 / 56)  # straight across: 1 and 7, 3 and 5, both ways


def test_a_world_without_a_free_cell_has_no_paths():
    found = scores(ObstacleGrid(TRUTH.forget(), 0.0), truth=Grid(np.ones((3, 3), dtype=int)), visited=VISITED[:0])
    assert found["legal_share"] is found["excess_length"] is found["regret"] is found["mean_free"] is None
    assert found["mean_obstacle"] == 0.5


def test_paths_that_never_arrive_end_somewhere():
    """Between known walls the plan leads nowhere: its paths end, and count as not legal."""
    model = true_model(Grid(np.array([[0, 1, 0], [0, 1, 0], [0, 1, 0]])))
    paths, goals = plan_paths(who_pursues(Reward(), model), np.array([0, 5]), np.array([8]))
    assert goals.tolist() == [8, 8]
    assert paths[1].tolist() == [5, 8]
    assert 8 not in paths[0]
    assert len(paths[0]) <= 10
    found = scores(model, truth=Grid(np.array([[0, 1, 0], [0, 1, 0], [0, 0, 0]])), visited=VISITED[:0])
    within = 2 * 3 * 2  # pairs on the same side, of 7 · 6 pairs; none leads to 7, which the map knows for occupied
    assert found["legal_share"] == pytest.approx(within / 30)


def test_large_maps_are_sampled_by_seed(monkeypatch):
    monkeypatch.setattr(evaluation, "MOST_PLACES", 3)
    blocked = np.full((3, 3), 0.1)
    blocked[1, 1] = 0.9
    found = [scores(model_of(blocked), seed=seed) for seed in (0, 0, 1, 2, 3)]
    assert found[0] == found[1]
    paths_differ = [(one["legal_share"], one["excess_length"]) != (found[0]["legal_share"], found[0]["excess_length"])
                    for one in found[2:]]  # fmt: skip
    assert any(paths_differ)
    assert all(one["auc"] == found[0]["auc"] for one in found)


def test_larger_maps_are_sampled_less_but_never_not_at_all():
    samples = [sample_for(cells) for cells in (9, 40_000, 185_428, 1_684_044, 10**8)]
    assert samples[0] == samples[1] == (evaluation.MOST_PLACES, evaluation.MOST_PLACES, evaluation.MOST_FOLLOWED)
    for smaller, larger in pairwise(samples):
        assert all(few <= many for few, many in zip(larger, smaller, strict=True))
    assert samples[-1].goals == samples[-1].followed == evaluation.FEWEST
    assert samples[3].goals * 1_684_044 <= evaluation.MOST_CELLS


def test_the_work_that_is_reported_is_done():
    """Each stage begins, ends, and never goes back; plans go to all goals, and 13 paths bump."""
    told = []
    scores(ObstacleGrid(TRUTH.forget(), -20.0), report=lambda *stage: told.append(stage))
    for stage, total in (("planning to goals", 7), ("following paths that bump", 13)):
        done = [done for name, done, of in told if name == stage and of == total]
        assert done == sorted(done)
        assert (done[0], done[-1]) == (0, total)


def test_a_policy_without_a_map_is_scored_by_its_paths():
    """Always right, else up: in a row of four, half of the pairs; the others never arrive. No cell is ranked."""
    policy = np.tile([0.2, 0.0, 0.0, 0.8], (4, 1))
    truth = Grid(np.zeros((1, 4), dtype=int))
    planner = PolicyPlanner(truth.forget(), lambda goal: policy)  # noqa: ARG005
    found = evaluate(planner, None, truth, np.ones((1, 4), bool), np.zeros((0, 2), int))
    assert found["legal_share"] == found["arriving_share"] == 0.5
    assert found["excess_length"] == 0
    assert found["regret"] is found["auc"] is found["average_precision"] is found["mean_free"] is None
