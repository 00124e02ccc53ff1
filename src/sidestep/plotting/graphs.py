"""Pictures of worlds without a map: states as nodes of a graph, and the moves between them as arrows.

An arrow is as wide and dark as its move is probable, so the picture reads in black and white; a self-loop stays.
Terminal states are diamonds, others circles. Names are drawn above all else.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from matplotlib.transforms import offset_copy

from sidestep.errors import check, check_instance
from sidestep.plotting.graph_layout import (
    POINTS,
    Nodes,
    Places,
    Positions,
    Vector,
    bent,
    best_bend,
    border,
    free_direction,
    names_of,
    picture_size,
    places_of,
    set_limits,
    sized_nodes,
    text_size,
)
from sidestep.plotting.layout import DOTS_PER_INCH
from sidestep.tabular.demonstration_tables import Labels
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.planning import Plan

MAX_STATES = 100
"""The most states of a picture."""
_TEXTS = 8
"""The most states with which arrows have the names of actions."""
_TERMINAL = "#80cfb9"
"""The color of terminal states: half the color of goals and half white, on which names are read."""
_LEAST = 0.005
"""The least probability of an arrow."""
_KEY = (1.0, 0.5, 0.1)
"""The probabilities of the arrows in the key."""
_KEY_SIZE = 400.0, 40.0
"""The width and height of the key in points."""
_LOOP = math.radians(35)
"""How far the ends of a self-loop are from its middle, seen from the node."""
_LOOP_HEIGHT = 0.97
"""How far a self-loop reaches from the center of its node, in diameters."""
_EDGE = 9.0
"""The empty space around all, in points."""
_SMALL = 7.0
"""The size of the texts of arrows, in points."""


class _World(NamedTuple):
    """What is drawn.

    Attributes:
        moves: The probability of each move under the policy.
        terminal: Where the task ends.
        texts: The actions that lead along each arrow, where arrows have texts.
        nodes: The names and the size of nodes.
        places: Of the states.
    """

    moves: Float[np.ndarray, "states states"]
    terminal: Bool[np.ndarray, " states"]
    texts: dict[tuple[int, int], str]
    nodes: Nodes
    places: Places

    @property
    def margin(self) -> Vector:
        """Return the room beside and above the outermost places, in points."""
        diameter = self.nodes.diameter
        loops = [state for state in range(len(self.moves)) if self.moves[state, state] >= _LEAST]
        sizes = [text_size(self.texts[state, state], _SMALL) for state in loops if (state, state) in self.texts]
        reach = max(_LOOP_HEIGHT if loops else 0.0, 0.75) * diameter + _EDGE
        # the distance of a text beside a slanted loop depends on both its width and its height
        return reach + np.max([(w + h / 4, h + w / 4) for w, h in sizes] or [(0.0, 0.0)], axis=0)


def figure_graph(
    model: TransitionModel,
    plan: Plan | None = None,
    *,
    labels: Labels | None = None,
    positions: Positions | None = None,
) -> Figure:
    """Return a picture of a world as a graph: how probable each move between two states is.

    Long names break into lines, and nodes and the picture are as large as the names need.

    Args:
        model: The transition model, of at most 100 states.
        plan: A plan, for the policy by which actions are chosen, and terminal states; by default all available actions
            are equally probable.
        labels: Names of states and actions.
        positions: The place of each state; by default networkx chooses it.

    Returns:
        The figure; `figure.savefig("world.png")` writes it.

    Raises:
        InputError: For arguments of other types, too many states, a plan of another world, and too few labels or
            positions.

    Example:
        >>> import sidestep as ss
        >>> coin = ss.TiedModel(ss.graph(np.array([[[1, 0]], [[1, 1]]])), np.array([[[0, ss.FIXED]], [[0, ss.FIXED]]]))
        >>> figure = figure_graph(coin, labels=ss.Labels(states=("start", "end"), actions=("go",)))
        >>> len(figure.axes)
        1
    """
    check_instance(model, TransitionModel, "model")
    states = model.graph.states
    check(states <= MAX_STATES, f"expected at most {MAX_STATES} states, found {states}", field="model")
    world = _world(model, plan, labels, positions)
    room = max((text_size(text, _SMALL)[0] for text in world.texts.values()), default=0.0)
    width, height = picture_size(world.places, world.nodes.diameter, room, world.margin)
    whole = max(width, _KEY_SIZE[0]), height + _KEY_SIZE[1]
    figure = Figure(figsize=(whole[0] / POINTS, whole[1] / POINTS), dpi=DOTS_PER_INCH)
    _draw(figure.add_axes((0, _KEY_SIZE[1] / whole[1], 1, height / whole[1])), world)
    figure.legend(handles=_key(plan), loc="lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def draw_graph(
    axes: Axes,
    model: TransitionModel,
    plan: Plan | None = None,
    *,
    labels: Labels | None = None,
    positions: Positions | None = None,
) -> None:
    """Draw a world as a graph, without a key.

    Args:
        axes: Where to draw, of the size that they keep.
        model, plan, labels, positions: As for `figure_graph`.
    """
    _draw(axes, _world(model, plan, labels, positions))


def _world(model: TransitionModel, plan: Plan | None, labels: Labels | None, positions: Positions | None) -> _World:
    """Return what is drawn."""
    import networkx

    check_instance(model, TransitionModel, "model")
    check_instance(plan, (Plan, type(None)), "plan")
    check_instance(labels, (Labels, type(None)), "labels")
    labels = labels or Labels()
    probabilities = _transitions(model)
    states, actions = probabilities.shape[:2]
    available = np.broadcast_to(np.asarray(model.graph.available), (states, actions))
    policy, terminal = available / available.sum(axis=1, keepdims=True), np.zeros(states, bool)
    if plan is not None:
        policy, terminal = np.asarray(plan.policy), np.asarray(plan.terminal)
        message = f"expected a plan of {states} states and {actions} actions, found one of {policy.shape}"
        check(policy.shape == (states, actions), message, field="plan")
    moves = np.where(terminal[:, None], 0.0, np.einsum("sa,sat->st", policy, probabilities))
    network = networkx.DiGraph()
    network.add_nodes_from(range(states))
    network.add_edges_from((int(state), int(after)) for state, after in np.argwhere(moves >= _LEAST))
    of_actions = names_of(labels.actions, actions, "actions")
    offered = np.where(available[:, :, None], probabilities, 0.0)
    edges = network.edges if states <= _TEXTS else []
    texts = {edge: _text(offered[edge[0], :, edge[1]], of_actions) for edge in edges}
    nodes = sized_nodes(names_of(labels.states, states, "states"))
    return _World(moves, terminal, texts, nodes, places_of(network, positions))


def _draw(axes: Axes, world: _World) -> None:
    places, nodes, edges = world.places, world.nodes, world.moves >= _LEAST
    unit = set_limits(axes, places, world.margin)
    for shape, color, some in (("o", "white", ~world.terminal), ("D", _TERMINAL, world.terminal)):
        style = {"facecolor": color, "edgecolors": "black", "linewidths": 1.2, "zorder": 3}
        axes.scatter(places[some, 0], places[some, 1], s=nodes.diameter**2, marker=shape, **style)
    style = {"ha": "center", "va": "center", "fontsize": nodes.font, "linespacing": 1.1, "zorder": 6}
    for (x, y), name in zip(places.tolist(), nodes.names, strict=True):
        axes.text(x, y, name, **style)
    for start, end in np.argwhere(edges & ~np.eye(len(edges), dtype=bool)).tolist():
        _draw_arrow(axes, world, unit, start, end)
    points, either = places * unit, edges | edges.T
    for state in np.flatnonzero(np.diag(edges)).tolist():
        others = np.delete(points, state, axis=0)
        direction = free_direction(points[state], others, np.delete(either[state], state), 2.5 * nodes.diameter)
        _draw_loop(axes, world, state, direction)
    axes.set_axis_off()


def _draw_arrow(axes: Axes, world: _World, unit: float, start: int, end: int) -> None:
    """Draw the arrow of a move, bent so that it meets no other node if possible."""
    points, diameter, probability = world.places * unit, world.nodes.diameter, float(world.moves[start, end])
    bend = best_bend(points, start, end, bool(world.moves[end, start] >= _LEAST), 0.6 * diameter)
    direction = math.atan2(*(points[end] - points[start])[::-1])
    turn, width = math.atan(2 * bend), float(_width(probability))
    shrinks = (
        border(angle, diameter, bool(world.terminal[state])) + 1.5
        for state, angle in ((start, direction - turn), (end, direction + turn))
    )
    first, second = shrinks
    arrow = FancyArrowPatch(
        world.places[start], world.places[end], arrowstyle="-|>", connectionstyle=f"arc3,rad={bend}", shrinkA=first,
        shrinkB=second, mutation_scale=_head(width), linewidth=width, color=_gray(probability), zorder=2,
    )  # fmt: skip
    axes.add_patch(arrow)
    if text := world.texts.get((start, end)):
        outwards = direction - math.copysign(math.pi / 2, bend)
        middle = bent(points[start], points[end], bend, np.array([0.5]))[0] - points[start]
        _draw_text(axes, world.places[start], middle, outwards, text)


def _draw_loop(axes: Axes, world: _World, state: int, direction: float) -> None:
    """Draw an arrow from a node to itself."""
    figure, place, diameter = axes.get_figure(root=True), world.places[state], world.nodes.diameter
    probability = float(world.moves[state, state])
    width = float(_width(probability))
    ends = []
    for angle in (direction + _LOOP, direction - _LOOP):
        distance = border(angle, diameter, bool(world.terminal[state])) + 1
        x, y = _along(angle, distance).tolist()
        ends.append(offset_copy(axes.transData, figure, x, y, "points"))
    shape = {
        "arrowstyle": "-|>", "connectionstyle": "arc3,rad=-1.9", "mutation_scale": _head(width), "shrinkA": 0,
        "shrinkB": 0, "linewidth": width, "color": _gray(probability),
    }  # fmt: skip
    at = float(place[0]), float(place[1])
    axes.annotate("", at, at, xycoords=ends[1], textcoords=ends[0], arrowprops=shape)
    if text := world.texts.get((state, state)):
        _draw_text(axes, place, _along(direction, _LOOP_HEIGHT * diameter), direction, text)


def _along(direction: float, distance: float) -> Vector:
    """Return the vector of a direction in radians and a length."""
    return distance * np.array([math.cos(direction), math.sin(direction)])


def _draw_text(axes: Axes, place: Vector, offset: Vector, outwards: float, text: str) -> None:
    """Draw the text of an arrow beside the tangent of a point of it.

    Args:
        axes: Where to draw.
        place: A place.
        offset: From there to the point, in points.
        outwards: The direction, across the tangent, in which the text lies, in radians.
        text: The text.
    """
    width, height = text_size(text, _SMALL)
    distance = abs(math.cos(outwards)) * width / 2 + abs(math.sin(outwards)) * height / 2 + 3
    box = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    x, y = (offset + _along(outwards, distance)).tolist()
    axes.annotate(
        text, (float(place[0]), float(place[1])), (x, y), textcoords="offset points", ha="center", va="center",
        fontsize=_SMALL, linespacing=1.0, bbox=box, zorder=5,
    )  # fmt: skip


def _transitions(model: TransitionModel) -> Float[np.ndarray, "states actions states"]:
    """Return T(s, a, s′) as a dense array."""
    successors, probabilities = np.asarray(model.graph.successors), np.asarray(model.probabilities(), np.float64)
    result = np.zeros((*successors.shape[:2], model.graph.states))
    states, actions, _ = np.indices(successors.shape)
    np.add.at(result, (states, actions, successors), probabilities)
    return result


def _text(probabilities: Float[np.ndarray, " actions"], names: list[str]) -> str:
    """Return the actions that lead along an arrow, with their probabilities."""
    some = [(name, p) for name, p in zip(names, probabilities, strict=True) if p >= _LEAST]
    return "\n".join(f"{name}: {f'{p:.2f}'.removeprefix('0') if p < 0.995 else '1'}" for name, p in some)


def _width(probability: float | Float[np.ndarray, " arrows"]) -> Float[np.ndarray, "*arrows"]:
    """Return the width of arrows in points."""
    return np.asarray(0.6 + 3.4 * probability)


def _head(width: float) -> float:
    """Return the size of the head of an arrow in points."""
    return 9 + 3.5 * width


def _gray(probability: float) -> str:
    """Return the gray of an arrow."""
    return f"{0.75 * (1 - probability):.3f}"


def _key(plan: Plan | None) -> list[Line2D]:
    """Return what the key shows: arrows of some probabilities, and the kinds of states."""
    lines = [Line2D([], [], color=_gray(p), linewidth=float(_width(p)), label=f"P(s′ | s) = {p:g}") for p in _KEY]
    states = [("o", "white", "state")] + ([("D", _TERMINAL, "terminal")] if plan is not None else [])
    return lines + [
        Line2D([], [], linestyle="", marker=shape, markerfacecolor=color, markeredgecolor="black", label=text)
        for shape, color, text in states
    ]
