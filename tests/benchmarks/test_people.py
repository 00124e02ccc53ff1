"""The calibration error of several maps together."""

import numpy as np
import pytest

from benchmarks import people
from sidestep.evaluation.reliability import reliability


def record(problem, draw, blocked, obstacle, method="behavior", walks=10):
    """A record of cells with the same P(blocked), some of which are obstacles; None has no reliability."""
    bins = None
    if blocked is not None:
        bins = reliability(np.full(len(obstacle), blocked), np.array(obstacle, dtype=bool)).to_dict()
    return {"problem": problem, "draw": draw, "method": method, "walks": walks, "reliability": bins}


def test_pooled_error_is_that_of_all_cells_of_a_draw_and_a_mean_over_draws():
    """Cells at .5: in the first draw two of four are obstacles, though none or all of each map; in the second all."""
    first = [record("a", 0, 0.5, [0, 0]), record("b", 0, 0.5, [1, 1])]
    second = [record("a", 1, 0.5, [1, 1]), record("b", 1, 0.5, [1, 1])]
    assert people.pooled_error(first) == pytest.approx(0)
    assert people.pooled_error(first + second) == pytest.approx((0 + 0.5) / 2)


def test_pooled_error_counts_a_problem_with_one_draw_in_every_draw():
    """Map b was drawn once, with all its walks: without it, map a has an error of .5 in both draws."""
    records = [record("a", 0, 0.5, [0, 0]), record("a", 1, 0.5, [0, 0]), record("b", 0, 0.5, [1, 1])]
    assert people.pooled_error(records) == pytest.approx(0)


def test_pooled_error_leaves_out_records_without_probabilities():
    records = [record("a", 0, None, []), record("b", 0, 0.25, [0, 0])]
    assert people.pooled_error(records) == pytest.approx(0.25)
    assert people.pooled_error(records[:1]) is None


def test_means_have_the_pooled_error_beside_the_mean_of_the_maps():
    records = [record("a", 0, 0.5, [0, 0]) | {"calibration_error": 0.5}]
    records += [record("b", 0, 0.5, [1, 1]) | {"calibration_error": 0.5}]
    columns = {"calibration error": "calibration_error .3f", "pooled": f"{people.POOLED} .3f"}
    (row,) = people.means(records, columns, "problem")
    assert row == {"walks": 10, "method": "behavior", "calibration_error": 0.5, people.POOLED: pytest.approx(0)}


def test_reliability_figure_pools_the_records_of_behavior_by_their_number_of_walks():
    records = [record("a", 0, 0.5, [0, 0]), record("b", 0, 0.5, [1, 1]), record("a", 0, 0.75, [1, 1], walks=40)]
    figure = people.reliability_figure([*records, record("a", 0, 0.5, [1], "transitions"), record("a", 0, None, [])])
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == ["10 walks\ncalibration error 0.000", "40 walks\ncalibration error 0.250"]
