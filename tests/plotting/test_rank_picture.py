"""Pictures of ranks: curves and band at places that can be worked out."""

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sidestep.evaluation.ranks import uniform_band
from sidestep.plotting.maps import save
from sidestep.plotting.ranks import draw_ranks, figure_ranks

BAND = uniform_band(4, 3)
RANKS = {"sampler": np.array([0, 1, 1, 3]), "mean field": np.array([3, 3, 3, 3])}


@pytest.fixture
def axes() -> Axes:
    return Figure().subplots()


def line_of(axes, label):
    return next(line for line in axes.lines if line.get_label() == label)


def test_draw_ranks_places_differences_between_zeros_at_both_ends(axes):
    draw_ranks(axes, RANKS, BAND)
    expected = [[0, 0], [1 / 4, 0], [2 / 4, 1 / 4], [3 / 4, 0], [1, 0]]
    np.testing.assert_allclose(np.asarray(line_of(axes, "sampler").get_xydata()), expected)
    expected = [[0, 0], [1 / 4, -1 / 4], [2 / 4, -2 / 4], [3 / 4, -3 / 4], [1, 0]]
    np.testing.assert_allclose(np.asarray(line_of(axes, "mean field").get_xydata()), expected)


def test_draw_ranks_fills_the_band(axes):
    draw_ranks(axes, RANKS, BAND)
    [path] = axes.collections[0].get_paths()
    corners = {(round(float(x), 6), round(float(y), 6)) for x, y in np.asarray(path.vertices)}
    for k, (low, high) in enumerate(zip(BAND.low, BAND.high, strict=True), start=1):
        assert {(k / 4, round(low / 4 - k / 4, 6)), (k / 4, round(high / 4 - k / 4, 6))} <= corners


def test_draw_ranks_distinguishes_methods_without_color(axes):
    draw_ranks(axes, RANKS, BAND)
    assert line_of(axes, "sampler").get_linestyle() != line_of(axes, "mean field").get_linestyle()


def test_figure_ranks_has_a_panel_for_each_quantity_and_one_legend(tmp_path):
    figure = figure_ranks({"length": RANKS, "door": RANKS}, BAND)
    assert [axes.get_title() for axes in figure.axes] == ["length", "door"]
    assert all(axes.get_xlabel() for axes in figure.axes)
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["95 % band of uniform ranks", *RANKS]
    save(figure, tmp_path / "ranks.png")
    assert (tmp_path / "ranks.png").read_bytes().startswith(b"\x89PNG")
