"""Reliability diagrams: points, intervals and numbers of cells at the places that can be worked out."""

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from PIL import Image
from scipy.stats import binomtest

from sidestep.evaluation.reliability import BINS, reliability
from sidestep.plotting.maps import save
from sidestep.plotting.reliability import draw_cell_numbers, draw_reliability, figure_reliability, wilson_intervals

CELLS = reliability(np.array([0.02, 0.04, 0.04, 0.52, 0.54, 1.0]), np.array([0, 0, 1, 1, 1, 1], dtype=bool))
"""Three cells in the first bin, two in the sixth, one in the last."""


@pytest.fixture
def axes() -> Axes:
    return Figure().subplots()


def test_draw_reliability_places_fractions_of_obstacles_over_predictions(axes):
    draw_reliability(axes, CELLS)
    points = next(drawn for drawn in axes.containers if isinstance(drawn, ErrorbarContainer))
    expected = [[0.1 / 3, 1 / 3], [0.53, 1], [1, 1]]
    np.testing.assert_allclose(np.asarray(points.lines[0].get_xydata()), expected)
    intervals = [np.asarray(line) for line in points.lines[2][0].get_segments()]
    for (x, _), (successes, trials), line in zip(expected, [(1, 3), (2, 2), (1, 1)], intervals, strict=True):
        interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
        np.testing.assert_allclose(line, [[x, interval.low], [x, interval.high]], atol=1e-6)
    diagonal = next(line for line in axes.lines if line.get_label() == "calibrated")
    np.testing.assert_array_equal(np.asarray(diagonal.get_xydata()), [[0, 0], [1, 1]])


def test_draw_reliability_distinguishes_points_and_diagonal_without_color(axes):
    draw_reliability(axes, CELLS)
    points = next(drawn for drawn in axes.containers if isinstance(drawn, ErrorbarContainer)).lines[0]
    diagonal = next(line for line in axes.lines if line.get_label() == "calibrated")
    assert (points.get_linestyle(), points.get_marker()) == ("-", "o")
    assert (diagonal.get_linestyle(), diagonal.get_marker()) == ("--", "None")


def test_draw_cell_numbers_names_the_number_of_every_bin(axes):
    draw_cell_numbers(axes, CELLS)
    numbers = {round(text.get_position()[0], 2): text.get_text() for text in axes.texts}
    assert len(numbers) == BINS
    assert {place: number for place, number in numbers.items() if number != "0"} == {0.05: "3", 0.55: "2", 0.95: "1"}


def test_figure_reliability_has_a_column_for_each_name_with_its_error():
    figure = figure_reliability({"first": CELLS, "pooled": CELLS + CELLS})
    expected = (abs(0.1 - 1) + abs(1.06 - 2)) / 6
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == [f"{name}\ncalibration error {expected:.3f}" for name in ("first", "pooled")]
    assert len(figure.axes) == 4
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["calibrated", "cells, 95 % interval"]
    numbers = [text.get_text() for text in figure.axes[3].texts]
    assert (numbers[0], numbers[5], numbers[9]) == ("6", "4", "2")


def test_figure_reliability_without_cells_is_drawn(tmp_path):
    nothing = reliability(np.zeros(0), np.zeros(0, dtype=bool))
    save(figure_reliability({"nothing": nothing}), tmp_path / "nothing.png")
    with Image.open(tmp_path / "nothing.png") as image:
        assert min(image.size) > 300


@pytest.mark.parametrize("trials", [1, 7, 1000])
def test_wilson_intervals_equal_those_of_scipy(trials):
    successes = np.unique([0, 1, trials // 2, trials])
    low, high = wilson_intervals(successes, np.full(len(successes), trials))
    expected = [binomtest(int(count), trials).proportion_ci(0.95, method="wilson") for count in successes]
    np.testing.assert_allclose(low, [interval.low for interval in expected], atol=1e-6)
    np.testing.assert_allclose(high, [interval.high for interval in expected], atol=1e-6)
    assert low[0] == 0
    assert high[-1] == 1
