"""Pictures of worlds without a map: arrows as wide as probable, and heat maps with the plan's numbers."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
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


def chain(states: int) -> tuple[ss.TabularModel, ss.Plan]:
    """A step to either side, which may fail."""
    after = [[[max(state - 1, 0), state], [min(state + 1, states - 1), state]] for state in range(states)]
    model = ss.TabularModel(ss.graph(after), jnp.zeros((states, 2, 2)))
    return model, ss.plan(model, ss.reach(model.graph, states - 1), ss.Behavior("boltzmann", 5.0))


def tree(states: int) -> tuple[ss.TabularModel, ss.Plan]:
    """From each state to three below, one action each, or back."""
    below = [[3 * state + k for k in (1, 2, 3)] for state in range(states)]
    after = [[[each if each < states else state] for each in below[state]] for state in range(states)]
    world = ss.graph([[*row, [max(state - 1, 0) // 3]] for state, row in enumerate(after)])
    model = ss.TabularModel(world, jnp.zeros((states, 4, 1)))
    return model, ss.plan(model, ss.reach(model.graph, states - 1), ss.Behavior("boltzmann", 5.0))


WORLDS = {
    "15 rooms": (tree(15), [f"living_room_{number}" for number in range(15)]),
    "6 places": (tree(6), ["home", "road", "work", "shop", "park", "gym"]),
    "40 numbers": (tree(40), ()),
    "a chain": (chain(10), ()),
    "long words": (chain(4), ["Schrodingerstrasse", "main station north", "a", "work"]),
}


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("placed", [False, True])
def test_figure_graph_names_are_in_their_nodes_and_nodes_apart_and_all_is_in_the_picture(name, placed):
    (model, plan), names = WORLDS[name]
    positions = (
        {state: (float(state % 4), float(state // 4)) for state in range(model.graph.states)} if placed else None
    )
    figure = ss.figure_graph(model, plan, labels=ss.Labels(states=names), positions=positions)
    FigureCanvasAgg(figure).draw()
    axes: Any = figure.axes[0]
    unit = figure.dpi / 72
    nodes = [each for each in axes.collections if isinstance(each, PathCollection)]
    centers = np.concatenate([each.get_offset_transform().transform(each.get_offsets()) for each in nodes]) / unit
    diameter = float(np.sqrt(nodes[0].get_sizes()[0]))
    assert pdist(centers).min() > diameter * 1.25  # a diamond is 1.4 diameters high and wide
    size = figure.get_size_inches() * 72
    assert (centers > 0.75 * diameter).all()
    assert (centers + 0.75 * diameter < size).all()
    drawn = [text for text in axes.texts if text.get_zorder() == 6]
    expected = [str(each) for each in (names or range(model.graph.states))]
    assert [text.get_text().replace("\n", "").replace(" ", "") for text in drawn] == [
        each.replace(" ", "") for each in expected
    ]
    places = np.concatenate([each.get_offsets() for each in nodes])
    assert all(any(np.allclose(text.get_position(), place) for place in places) for text in drawn)
    for text in drawn:
        assert np.hypot(*text.get_window_extent().size) / unit < diameter
    others = [each for each in axes.get_children() if each not in drawn]
    assert max(each.get_zorder() for each in others) < 6
    low, high = figure.get_tightbbox().get_points() * 72
    assert (low >= -0.01).all()
    assert (high <= size + 0.01).all()


def test_figure_graph_of_a_chain_is_a_line_in_order():
    model, plan = chain(10)
    axes: Any = ss.figure_graph(model, plan).axes[0]
    places = np.array([text.get_position() for text in axes.texts if text.get_zorder() == 6])
    assert (np.diff(places[:, 0]) > 0).all()
    assert np.ptp(places[:, 1]) < 0.05 * np.ptp(places[:, 0])


def test_draw_graph_places_of_other_units_fill_the_picture():
    """Time in minutes to the right, a probability upwards."""
    axes = Figure().subplots()
    draw_graph(axes, world()[0], positions={0: (0.0, 0.1), 1: (600.0, 0.5), 2: (900.0, 0.2)})
    places = np.concatenate([np.asarray(each.get_offsets()) for each in axes.collections])
    np.testing.assert_allclose(np.ptp(places, axis=0), 1.0)


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
