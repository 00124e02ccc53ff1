"""Pictures of worlds without a map: arrows as wide as probable, and heat maps with the plan's numbers."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from scipy.spatial.distance import pdist

import sidestep as ss
from sidestep.errors import InputError
from sidestep.plotting.graphs import draw_graph
from sidestep.plotting.heat_maps import draw_table

LABELS = ss.Labels(states=("home", "road", "work"), actions=("walk", "bus"))
POSITIONS = {0: (0.0, 0.0), 1: (1.0, 0.0), 2: (1.0, 1.0)}


def world() -> tuple[ss.TabularModel, ss.Plan]:
    """From home, walking leads on with ¾ and the bus with ½; from the road, both lead to work."""
    graph = ss.graph(np.array([[[1, 0], [2, 0]], [[2, 1], [2, 1]], [[2, 2], [2, 2]]]))
    chances = np.array([[[3.0, 1], [1, 1]], [[3, 1], [1, 1]], [[1, 1], [1, 1]]])
    model = ss.TabularModel(graph, jnp.log(chances))
    return model, ss.plan(model, ss.reach(graph, 2, discount=0.9), ss.Behavior(ss.BoltzmannAverage(), 5.0))


def drawn(plan=None, **options) -> Any:
    axes = Figure().subplots()
    draw_graph(axes, world()[0], plan, positions=POSITIONS, **options)
    return axes


def arrows(axes) -> list[float]:
    """The widths of arrows between two nodes, narrowest first."""
    return sorted(patch.get_linewidth() for patch in axes.patches if isinstance(patch, FancyArrowPatch))


@pytest.mark.parametrize("planned", [False, True])
def test_draw_graph_arrows_are_as_wide_as_probable(planned):
    plan = world()[1] if planned else None
    policy = np.full((3, 2), 0.5) if plan is None else np.asarray(plan.policy)
    axes = drawn(plan)
    walk, bus = policy[0] * [3 / 4, 1 / 2]
    on = policy[1] @ [3 / 4, 1 / 2]
    np.testing.assert_allclose(arrows(axes), 0.6 + 3.4 * np.sort([walk, bus, on]))
    loops = [note.arrow_patch.get_linewidth() for note in axes.texts if getattr(note, "arrow_patch", None)]
    ends = [] if planned else [1.0]  # where the task ends, no action is taken
    np.testing.assert_allclose(sorted(loops), 0.6 + 3.4 * np.sort([1 - walk - bus, 1 - on, *ends]))


def test_draw_graph_names_states_and_the_chances_of_actions():
    texts = {text.get_text() for text in drawn(world()[1], labels=LABELS).texts} - {""}
    assert texts == {"home", "road", "work", "walk: .75", "bus: .50", "walk: .75\nbus: .50", "walk: .25\nbus: .50"}


def test_draw_graph_has_available_actions_only():
    """From home the bus alone leads to the road, and walking, which cannot be chosen, to work."""
    graph = ss.graph([[[2], [1]], [[2], [2]], [[2], [2]]], available=[[False, True], [True, True], [True, True]])
    axes = Figure().subplots()
    draw_graph(axes, ss.TabularModel(graph, jnp.zeros((3, 2, 1))), labels=LABELS, positions=POSITIONS)
    np.testing.assert_allclose(arrows(axes), [4.0, 4.0])  # home to road and road to work, of probability 1
    assert {text.get_text() for text in axes.texts} - {""} == {"home", "road", "work", "bus: 1", "walk: 1\nbus: 1"}


def test_draw_graph_of_a_plan_names_available_actions_only():
    """Both actions lead from home to the road, and walking cannot be chosen."""
    graph = ss.graph([[[1], [1]], [[2], [2]], [[2], [2]]], available=[[False, True], [True, True], [True, True]])
    model, axes = ss.TabularModel(graph, jnp.zeros((3, 2, 1))), Figure().subplots()
    draw_graph(axes, model, ss.plan(model, ss.reach(graph, 2)), labels=LABELS, positions=POSITIONS)
    texts = [text.get_text() for text in axes.texts]
    assert "bus: 1" in texts


def test_draw_graph_terminal_states_have_another_shape():
    nodes = [each for each in drawn(world()[1]).collections if isinstance(each, PathCollection)]
    places = [np.asarray(each.get_offsets()).tolist() for each in nodes]
    assert places == [[[0, 0], [1, 0]], [[1, 1]]]
    assert len({np.size(each.get_paths()[0].vertices) for each in nodes}) == 2


def test_draw_graph_of_states_apart_has_a_place_for_each():
    """Two pairs of states with no way between the pairs."""
    model = ss.TabularModel(ss.graph(np.array([[[1]], [[0]], [[3]], [[2]]])), jnp.zeros((4, 1, 1)))
    axes = Figure().subplots()
    draw_graph(axes, model)
    places = [np.asarray(each.get_offsets()) for each in axes.collections if isinstance(each, PathCollection)]
    assert pdist(np.concatenate(places)).min() > 0.5  # of a layout in [−1, 1]


def test_figure_graph_has_a_key_and_is_written(tmp_path):
    model, plan = world()
    figure = ss.figure_graph(model, plan, labels=LABELS)
    key = [text.get_text() for text in figure.legends[0].get_texts()]
    assert key == ["P(s′ | s) = 1", "P(s′ | s) = 0.5", "P(s′ | s) = 0.1", "state", "terminal"]
    figure.savefig(tmp_path / "world.png")
    assert (tmp_path / "world.png").stat().st_size > 5_000


@pytest.mark.parametrize(("options", "message"), [
    ({"labels": ss.Labels(states=("a", "b"))}, "labels, field 'states': expected 3 labels, found 2"),
    ({"labels": ss.Labels(actions=("a", "b", "c"))}, "labels, field 'actions': expected 2 labels, found 3"),
    ({"positions": {0: (0.0, 0.0)}}, r"field 'positions': expected a place of each state, found none of \[1, 2\]"),
    ({"positions": np.zeros((2, 2))}, r"field 'positions': .* found none of \[2\]"),
])  # fmt: skip
def test_figure_graph_with_too_few_names_or_places_raises(options, message):
    with pytest.raises(InputError, match=message):
        ss.figure_graph(world()[0], **options)


def test_figure_graph_of_another_or_a_large_world_raises():
    large = ss.grid_graph(ss.Grid.unknown(11, 10))
    with pytest.raises(InputError, match="field 'model': expected at most 100 states, found 110"):
        ss.figure_graph(ss.TabularModel(large, jnp.zeros((110, 4, 2))))
    grid = ss.Grid.unknown(1, 3)
    other = ss.plan(ss.ObstacleGrid(grid), ss.reach(grid, 2))
    with pytest.raises(InputError, match=r"field 'plan': expected a plan of 3 states and 2 actions, found .*\(3, 4\)"):
        ss.figure_graph(world()[0], other)


def test_figure_plan_shows_policy_and_values():
    plan = world()[1]
    figure = ss.figure_plan(plan, labels=LABELS)
    policy, values = (np.ma.asarray(axes.images[0].get_array()) for axes in figure.axes[:2])
    for shown, expected in ((policy, plan.policy), (values, plan.solution.action_values)):
        np.testing.assert_allclose(shown[:2], expected[:2])
        assert shown.mask.tolist() == [[False] * 2, [False] * 2, [True] * 2]  # no action is taken at work
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["home", "road", "work"]
    assert [text.get_text() for text in figure.axes[1].get_xticklabels()] == ["walk", "bus"]
    assert {axes.get_xlabel() for axes in figure.axes[2:]} == {"π(a | s)", "Q(s, a), reward"}
    assert figure.axes[0].texts[0].get_text() == f"{float(plan.policy[0, 0]):.2f}"


def test_figure_plan_hatches_values_that_are_not_finite():
    grid = ss.Grid(np.array([[0, 0, 1, 0]]))
    plan = ss.plan(ss.true_model(grid), ss.reach(grid, 0, discount=1.0, step_cost=1.0))
    values = np.ma.asarray(ss.figure_plan(plan).axes[1].images[0].get_array())
    assert np.asarray(values.mask).all(axis=1).tolist() == [True, False, False, True]  # the goal, and behind the wall


def test_draw_table_numbers_are_readable_on_every_color():
    axes = Figure().subplots()
    values = np.linspace(-1, 1, 6).reshape(3, 2)
    image = draw_table(axes, values, np.zeros((3, 2), bool), ["a", "b", "c"], ["x", "y"])
    for text in axes.texts:
        column, row = (int(at) for at in text.get_position())
        background = np.asarray(image.to_rgba(values))[row, column, :3] @ [0.299, 0.587, 0.114]
        assert abs(background - (text.get_color() == "white")) > 0.4


def test_draw_table_of_many_states_has_no_numbers():
    axes = Figure().subplots()
    draw_table(axes, np.zeros((50, 2)), np.zeros((50, 2), bool), list("a" * 50), ["x", "y"])
    assert not axes.texts
