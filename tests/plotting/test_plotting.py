"""Pictures: what is drawn where, on maps so small that every number can be worked out by hand; saving."""

from typing import cast

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from PIL import Image

from sidestep.errors import InputError
from sidestep.plotting import maps as plotting
from sidestep.tabular.grid import Grid
from sidestep.worlds.grids import block, wall
from sidestep.worlds.offices import office

KNOWN = np.array([[0, 1, -1], [0, 0, 0]])
GRID = Grid(KNOWN, resolution=0.5, origin=(10.0, -2.0, 0.0))
"""Two rows and three columns of half a metre: x from 10 to 11.5, y from -2 to -1."""
BLOCKED = np.array([[0.0, 0.9, 0.5], [0.1, 0.2, 0.3]])


@pytest.fixture
def axes() -> Axes:
    return Figure().subplots()


def collection(axes: Axes, label: str) -> LineCollection:
    """The lines drawn under a label."""
    return next(cast(LineCollection, drawn) for drawn in axes.collections if drawn.get_label() == label)


def segments(axes: Axes, label: str) -> list[np.ndarray]:
    return [np.asarray(segment) for segment in collection(axes, label).get_segments()]


def line(axes: Axes, label: str):
    return next(drawn for drawn in axes.lines if drawn.get_label() == label)


def points(axes: Axes, label: str) -> np.ndarray:
    return np.asarray(line(axes, label).get_xydata())


def corners_in_metres(image: AxesImage, axes: Axes) -> np.ndarray:
    """Where the image's top left and bottom right corners lie, on the axes' scale."""
    left, right, bottom, top = image.get_extent()
    to_metres = image.get_transform() - axes.transData
    return to_metres.transform([[left, top], [right, bottom]])


def test_draw_map_has_axes_in_metres_and_row_0_at_the_top(axes):
    image = plotting.draw_map(axes, GRID)
    np.testing.assert_array_equal(image.get_array(), KNOWN)
    assert image.origin == "upper"
    np.testing.assert_allclose(corners_in_metres(image, axes), [[10, -1], [11.5, -2]])
    assert axes.get_xlim() == (10, 11.5)
    assert axes.get_ylim() == (-2, -1)
    assert axes.get_aspect() == 1
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "y (m)")


def test_draw_map_orders_free_unknown_occupied_by_lightness(axes):
    image = plotting.draw_map(axes, GRID)
    unknown, free, occupied = image.to_rgba(np.array([-1, 0, 1]))[:, 0]
    assert free == 1 > unknown > 0.7 > 0.3 > occupied


def test_draw_map_with_yaw_places_corners_by_the_origin(axes):
    turned = Grid(KNOWN, origin=(1.0, 2.0, np.pi / 2))
    image = plotting.draw_map(axes, turned)
    # a quarter turn to the left: the map's right is up, its up is left; top left (0, 2) → (1 − 2, 2 + 0)
    np.testing.assert_allclose(corners_in_metres(image, axes), [[-1, 2], [1, 5]])
    np.testing.assert_allclose(axes.get_xlim(), (-1, 1))
    np.testing.assert_allclose(axes.get_ylim(), (2, 5))


def test_draw_blocked_colors_probabilities_from_0_to_1(axes):
    image = plotting.draw_blocked(axes, BLOCKED, GRID)
    np.testing.assert_array_equal(image.get_array(), BLOCKED)
    assert image.get_clim() == (0, 1)
    np.testing.assert_allclose(corners_in_metres(image, axes), [[10, -1], [11.5, -2]])
    luminance = image.to_rgba(np.linspace(0, 1, 50))[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) < 0).all()


def test_draw_blocked_outlines_true_obstacles(axes):
    plotting.draw_blocked(axes, BLOCKED, GRID.forget(), truth=GRID)
    sides = {frozenset(map(tuple, side.tolist())) for side in segments(axes, "true obstacle")}
    # the cell in the middle of the top row
    left, right, bottom, top = 10.5, 11.0, -1.5, -1.0
    assert sides == {
        frozenset({(left, bottom), (left, top)}),
        frozenset({(right, bottom), (right, top)}),
        frozenset({(left, bottom), (right, bottom)}),
        frozenset({(left, top), (right, top)}),
    }


def test_draw_blocked_outlines_no_sides_between_obstacles(axes):
    truth = Grid(np.array([[1, 1, 0]]))
    plotting.draw_blocked(axes, np.zeros((1, 3)), truth, truth)
    assert len(segments(axes, "true obstacle")) == 6


def test_draw_map_separates_cells_on_small_maps_only(axes):
    plotting.draw_map(axes, GRID)
    drawn = [np.asarray(side).tolist() for side in cast(LineCollection, axes.collections[0]).get_segments()]
    upright = [[[x, -2.0], [x, -1.0]] for x in (10.0, 10.5, 11.0, 11.5)]
    assert drawn == [*upright, *([[10.0, y], [11.5, y]] for y in (-2.0, -1.5, -1.0))]
    large = Figure().subplots()
    plotting.draw_map(large, office(20, 30, seed=0))
    assert not large.collections


def test_draw_blocked_outlines_thinner_on_larger_maps():
    def width(grid):
        axes = Figure().subplots()
        plotting.draw_blocked(axes, np.zeros(grid.shape), grid, grid)
        return np.ravel(collection(axes, "true obstacle").get_linewidth())[0]

    assert width(block().truth) > width(office(60, 60, seed=0)) > width(office(150, 200, seed=0))


def test_draw_walks_shifts_each_walk_a_little(axes):
    paths = [np.array([3, 4, 5])] * 4
    plotting.draw_walks(axes, paths, GRID)
    drawn = np.array(segments(axes, "walk"))
    np.testing.assert_allclose(drawn[0], [[10.25, -1.75], [10.75, -1.75], [11.25, -1.75]])
    shifts = drawn - drawn[0]
    np.testing.assert_allclose(shifts, shifts[:, :1].repeat(3, axis=1))
    assert np.abs(shifts).max() <= 0.3 * GRID.resolution
    assert len(np.unique(shifts[:, 0].round(6), axis=0)) == 4


def test_draw_walks_and_places_without_any_draw_nothing(axes):
    plotting.draw_walks(axes, [], GRID)
    plotting.draw_places(axes, [], [], GRID)
    assert not axes.collections
    assert not axes.lines


def test_draw_path_marks_start_and_goal(axes):
    plotting.draw_path(axes, np.array([0, 3, 4]), GRID)
    np.testing.assert_allclose(points(axes, "path"), [[10.25, -1.25], [10.25, -1.75], [10.75, -1.75]])
    np.testing.assert_allclose(points(axes, "start"), [[10.25, -1.25]])
    np.testing.assert_allclose(points(axes, "goal"), [[10.75, -1.75]])
    assert (line(axes, "start").get_marker(), line(axes, "goal").get_marker()) == ("s", "*")


def test_draw_places_differ_by_shape_and_color(axes):
    plotting.draw_places(axes, (0,), (3, 5), GRID)
    start, goal = line(axes, "start"), line(axes, "goal")
    np.testing.assert_allclose(points(axes, "start"), [[10.25, -1.25]])
    np.testing.assert_allclose(points(axes, "goal"), [[10.25, -1.75], [11.25, -1.75]])
    assert (start.get_marker(), goal.get_marker()) == ("s", "D")
    assert start.get_color() != goal.get_color()


def test_figure_environments_shows_true_maps_without_a_color_bar():
    worlds = [block(), wall()]
    figure = plotting.figure_environments(worlds)
    assert [axes.get_title() for axes in figure.axes] == ["block", "wall"]  # and no colour bar
    for axes, world in zip(figure.axes, worlds, strict=True):
        np.testing.assert_array_equal(axes.images[0].get_array(), world.truth.known)
        np.testing.assert_allclose(points(axes, "goal"), world.truth.centers(np.array(world.goals)))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["start", "goal"]


def test_figure_learned_has_one_color_bar_and_rows_of_panels():
    paths = [np.array([0, 3, 4])]
    panels = [plotting.Panel(title, GRID.forget(), BLOCKED, GRID, paths, (0,), (4,)) for title in "012"]
    figure = plotting.figure_learned(panels, columns=2)
    *maps, bar = figure.axes
    assert [axes.get_title() for axes in maps] == ["0", "1", "2"]
    assert bar.get_ylabel() == "P(blocked)"
    assert bar.get_ylim() == (0, 1)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["true obstacle", "path", "start", "goal"]
    figure.canvas.draw()
    first, second, third = (axes.get_position() for axes in maps)
    assert first.y0 == pytest.approx(second.y0)
    assert third.y1 < first.y0
    assert third.x0 == pytest.approx(first.x0)


def test_figure_fit_shows_walks_goals_map_and_objective():
    objective = np.array([-9.0, -4.0, -3.0])
    figure = plotting.figure_fit(GRID.forget(), [np.array([0, 3])], BLOCKED, objective, goals=np.array([3]))
    before, after, progress, bar = figure.axes
    np.testing.assert_array_equal(before.images[0].get_array(), np.full((2, 3), -1))
    assert len(segments(before, "walk")) == 1
    for axes in (before, after):
        np.testing.assert_allclose(points(axes, "goal"), [[10.25, -1.75]])
    np.testing.assert_array_equal(after.images[0].get_array(), BLOCKED)
    np.testing.assert_array_equal(np.asarray(progress.lines[0].get_xydata()), [[0, -9], [1, -4], [2, -3]])
    assert bar.get_ylabel() == "P(blocked)"


def test_draw_without_evidence_hatches_these_cells(axes):
    silent = np.array([[False, True, True], [True, False, False]])
    plotting.draw_blocked(axes, BLOCKED, GRID)
    plotting.draw_without_evidence(axes, silent, GRID)
    (patch,) = axes.patches
    assert patch.get_hatch()
    centers = GRID.centers(np.arange(6))
    inside = patch.get_path().contains_points(centers)
    np.testing.assert_array_equal(inside.reshape(2, 3), silent)


def test_draw_without_evidence_of_no_cells_draws_nothing(axes):
    plotting.draw_without_evidence(axes, np.zeros((2, 3), bool), GRID)
    assert not axes.patches


@pytest.mark.parametrize("figure", [
    lambda silent: plotting.figure_fit(GRID, [], BLOCKED, np.zeros(2), without_evidence=silent),
    lambda silent: plotting.figure_learned([plotting.Panel("", GRID, BLOCKED, without_evidence=silent)]),
])  # fmt: skip
def test_figures_hatch_cells_without_evidence_and_say_so_in_the_key(figure):
    labels = [text.get_text() for text in figure(BLOCKED > 0.4).legends[0].get_texts()]
    assert labels == ["walks say next to nothing"]
    assert not figure(BLOCKED > 2).legends


def test_figure_plan_shows_map_and_path():
    figure = plotting.figure_plan(GRID, BLOCKED, np.array([0, 3, 4]))
    axes, bar = figure.axes
    np.testing.assert_array_equal(axes.images[0].get_array(), BLOCKED)
    assert len(points(axes, "path")) == 3
    assert bar.get_ylabel() == "P(blocked)"


def test_save_writes_a_png(tmp_path):
    path = tmp_path / "new folder" / "plan.png"
    plotting.save(plotting.figure_plan(GRID, BLOCKED, np.array([0, 3, 4])), path)
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert min(image.size) > 300
    assert [file.name for file in path.parent.iterdir()] == ["plan.png"]


def test_save_that_fails_keeps_the_old_file(tmp_path):
    path = tmp_path / "old.png"
    path.write_bytes(b"old")
    broken = Figure()
    broken.text(0.5, 0.5, "$\\unknown$")
    with pytest.raises(ValueError, match="unknown"):
        plotting.save(broken, path)
    assert path.read_bytes() == b"old"
    with pytest.raises(InputError, match="cannot be written"):
        plotting.save(Figure(), tmp_path)
