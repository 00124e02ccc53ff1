"""Evaluations of learned maps that are small enough to score by hand."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from sidestep.evaluation.evaluate import (
    MAX_CELLS,
    MAX_EXECUTED,
    MAX_PLACES,
    MIN_PLANS,
    SampleSizes,
    evaluate,
    plan_paths,
    sample_sizes,
)
from sidestep.evaluation.reliability import LEAST_PROBABILITY
from sidestep.robots.planners import ModelPlanner, PolicyPlanner
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.reward import Reward

#  0 . #      states 0 1 2
#  . . .             3 4 5     with obstacles at 2 and 7
#  . # .             6 7 8
TRUTH = Grid(np.array([[0, 0, 1], [0, 0, 0], [0, 1, 0]]))
ALL = np.ones((3, 3), dtype=bool)
VISITED = np.array([[0, 5], [6, 8]])
"""No obstacle lengthens the path from 0 to 5 (opening 2 is no gain); the one at 7 lengthens that from 6 to 8."""


def model_of(blocked) -> ObstacleGrid:
    blocked = np.asarray(blocked, dtype=float)
    return ObstacleGrid(TRUTH.forget(), np.log(blocked / (1 - blocked)).reshape(-1))


def evaluate_model(model, reward=Reward(), scored=ALL, truth=TRUTH, visited=VISITED, **options):  # noqa: B008
    return evaluate(planner_of(model, reward), np.asarray(model.blocked), truth, scored, visited, **options)


def planner_of(model, reward=Reward()) -> ModelPlanner:  # noqa: B008
    return ModelPlanner(model, partial(reward.reach, model.blank))


@pytest.mark.parametrize("reward", [Reward(), Reward(discount=1.0, step_cost=1.0)])
def test_evaluate_of_a_perfect_map_has_perfect_scores(reward):
    scores = evaluate_model(true_model(TRUTH), reward).to_dict()
    assert scores.pop("log_loss") == pytest.approx(LEAST_PROBABILITY, rel=1e-3)
    assert scores == {
        "auc": 1, "average_precision": 1, "auc_relevant": 1, "average_precision_relevant": 1, "calibration_error": 0,
        "brier_score": 0, "recall": 1, "mean_obstacle": 1, "mean_free": 0, "max_probability": 1, "legal_fraction": 1,
        "excess_length": 0, "regret": 0, "arriving_fraction": 1,
    }  # fmt: skip


def test_evaluate_of_a_map_without_obstacles_counts_bumps_and_detours():
    """Of ties the first action is taken, up, down, left, right: plans change rows first, then columns.

    Of 42 pairs of free cells, 13 lead into an obstacle: 5 and 8 to 0 and 1 (through 2), 1 and 4 to 6 and 8, 5 and 8 to
    6, and 0, 3 and 6 to 8 (through 7). A robot then loses the move that failed, and two more for turning back from 5 to
    6, 0 to 8 and 3 to 8. Plans go to all goals, and the callback counts up to all of them.
    """
    stages = []
    result = evaluate_model(ObstacleGrid(TRUTH.forget(), -20.0), callback=lambda *stage: stages.append(stage))
    assert result.legal_fraction == pytest.approx(29 / 42)
    assert result.excess_length == 0  # all legal paths are shortest paths
    assert result.regret == pytest.approx((13 + 3 * 2) / 42)
    assert result.arriving_fraction == 1
    assert result.auc == result.auc_relevant == 0.5
    assert result.average_precision == pytest.approx(2 / 9)
    assert result.recall == 0
    assert result.mean_free == result.mean_obstacle == pytest.approx(1 / (1 + np.exp(20)))
    for stage, total in (("planned paths", 42), ("executed paths", 13)):
        done = [done for name, done, of in stages if name == stage and of == total]
        assert done == sorted(done)
        assert (done[0], done[-1]) == (0, total)


def test_evaluate_ranks_cells_by_probability():
    """Obstacles at .8 and .3, free cells at .1 but for one at .5: six of seven are below .3, all below .8."""
    blocked = np.full((3, 3), 0.1)
    blocked[2, 1], blocked[0, 2], blocked[1, 1] = 0.8, 0.3, 0.5
    result = evaluate(None, blocked, TRUTH, ALL, VISITED)
    assert result.auc == pytest.approx(13 / 14)
    assert result.average_precision == pytest.approx((1 + 2 / 3) / 2)
    assert result.auc_relevant == result.average_precision_relevant == 1
    # bin errors: six free cells at .1, an obstacle at .3, a free cell at .5, an obstacle at .8
    assert result.calibration_error == pytest.approx((6 * 0.1 + 0.7 + 0.5 + 0.2) / 9)
    assert result.brier_score == pytest.approx((6 * 0.01 + 0.49 + 0.25 + 0.04) / 9)
    assert result.log_loss == pytest.approx(-np.log([*[0.9] * 6, 0.3, 0.5, 0.8]).mean())
    assert result.recall == pytest.approx(1 / 2)
    assert result.mean_obstacle == pytest.approx(0.55)
    assert result.mean_free == pytest.approx((6 * 0.1 + 0.5) / 7)
    assert result.max_probability == pytest.approx(0.8)
    assert result.legal_fraction is result.regret is None
    scored = ALL.copy()
    scored[0, 2] = scored[1, 1] = False
    result = evaluate(None, blocked, TRUTH, scored, VISITED)
    assert (result.auc, result.recall, result.mean_obstacle) == (1, 1, pytest.approx(0.8))
    assert result.mean_free == pytest.approx(0.1)
    assert evaluate(None, blocked, TRUTH, ~ALL, VISITED).auc is None


def test_evaluate_counts_unnecessary_detours():
    blocked = np.full((3, 3), 1e-6)
    blocked[0, 1] = 1 - 1e-6  # between 0 and 2: two moves in the truth, four in the map
    open_truth = Grid(np.zeros((3, 3), dtype=int))
    result = evaluate_model(model_of(blocked), truth=open_truth, visited=VISITED[:0])
    assert result.legal_fraction == 1
    assert result.excess_length == result.regret == pytest.approx(2 * 2 / 72)
    assert result.auc is result.recall is result.mean_obstacle is None


def test_evaluate_leaves_out_goals_known_to_be_occupied():
    """The map knows state 4 as occupied although the truth says that it is free."""
    known = np.full((3, 3), Cell.UNKNOWN, dtype=int)
    known[1, 1] = Cell.OCCUPIED
    open_truth = Grid(np.zeros((3, 3), dtype=int))
    scored = known == Cell.UNKNOWN
    result = evaluate_model(ObstacleGrid(Grid(known), -20.0), truth=open_truth, scored=scored, visited=VISITED[:0])
    assert result.legal_fraction == 1
    assert result.excess_length == pytest.approx(4 * 2 / 56)  # straight across: 1 and 7, 3 and 5, both ways


def test_evaluate_of_a_world_without_free_cells_has_no_path_scores():
    full = Grid(np.ones((3, 3), dtype=int))
    result = evaluate_model(ObstacleGrid(TRUTH.forget(), 0.0), truth=full, visited=VISITED[:0])
    assert result.legal_fraction is result.excess_length is result.regret is result.mean_free is None
    assert result.mean_obstacle == 0.5


def test_plan_paths_goes_around_probable_obstacles():
    blocked = np.full((3, 3), 1e-6)
    blocked[1, 1] = blocked[0, 2] = blocked[2, 1] = 1 - 1e-6
    paths, goals = plan_paths(planner_of(model_of(blocked)), np.array([3, 6]), np.array([0, 3]))
    assert [path.tolist() for path in paths] == [[3, 0], [6, 3, 0], [6, 3]]
    assert goals.tolist() == [0, 0, 3]


def test_plan_paths_between_known_walls_end_and_are_not_legal():
    model = true_model(Grid(np.array([[0, 1, 0], [0, 1, 0], [0, 1, 0]])))
    paths, goals = plan_paths(planner_of(model), np.array([0, 5]), np.array([8]))
    assert goals.tolist() == [8, 8]
    assert paths[1].tolist() == [5, 8]
    assert 8 not in paths[0]
    assert len(paths[0]) <= 10
    result = evaluate_model(model, truth=Grid(np.array([[0, 1, 0], [0, 1, 0], [0, 0, 0]])), visited=VISITED[:0])
    within = 2 * 3 * 2  # pairs on the same side, of 7 · 6 pairs; none leads to 7, which the map knows as occupied
    assert result.legal_fraction == pytest.approx(within / 30)


def test_evaluate_draws_samples_by_seed():
    blocked = np.full((3, 3), 0.1)
    blocked[1, 1] = 0.9
    sample = SampleSizes(starts=3, goals=3, executed=200)
    results = [evaluate_model(model_of(blocked), seed=seed, sample=sample) for seed in (0, 0, 1, 2, 3)]
    assert results[0] == results[1]
    assert len({(result.legal_fraction, result.excess_length) for result in results}) > 1
    assert all(result.auc == results[0].auc for result in results)


def test_sample_sizes_fall_with_the_size_of_the_map():
    sizes = [sample_sizes(cells) for cells in (9, 40_000, 185_428, 1_684_044, 10**8)]
    assert sizes[0] == sizes[1] == (MAX_PLACES, MAX_PLACES, MAX_EXECUTED)
    for smaller, larger in pairwise(sizes):
        assert all(few <= many for few, many in zip(larger, smaller, strict=True))
    assert sizes[-1].goals == sizes[-1].executed == MIN_PLANS
    assert sizes[3].goals * 1_684_044 <= MAX_CELLS


def test_evaluate_of_a_policy_without_a_map_scores_paths_only():
    """Always right, else up: in a row of four, half of the pairs; the others never arrive."""
    policy = np.tile([0.2, 0.0, 0.0, 0.8], (4, 1))
    truth = Grid(np.zeros((1, 4), dtype=int))
    planner = PolicyPlanner(truth.forget(), lambda goal: policy)  # noqa: ARG005
    result = evaluate(planner, None, truth, np.ones((1, 4), bool), np.zeros((0, 2), int))
    assert result.legal_fraction == result.arriving_fraction == 0.5
    assert result.excess_length == 0
    assert result.regret is result.auc is result.average_precision is result.mean_free is None
