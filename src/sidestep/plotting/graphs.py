"""Pictures of worlds without a map: states as nodes of a graph, and the moves between them as arrows.

The layout is networkx's. An arrow is as wide and dark as its move is probable, so the picture reads in black and white;
a self-loop stays. Terminal states are diamonds, others circles.
"""

from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import offset_copy

from sidestep.errors import check
from sidestep.plotting import palette
from sidestep.plotting.layout import DOTS_PER_INCH
from sidestep.tabular.demonstration_tables import Labels
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.planning import Plan

if TYPE_CHECKING:
    from networkx import DiGraph

MAX_STATES = 100
"""The most states of a picture."""
_TEXTS = 8
"""The most states with which arrows have the names of actions."""
_LEAST = 0.005
"""The least probability of an arrow."""
_KEY = (1.0, 0.5, 0.1)
"""The probabilities of the arrows in the key."""
_CURVE = "arc3,rad=0.15"
"""The shape of arrows: bent, so that those of both directions are seen."""
_HEAD = 13
"""The size of the head of an arrow, in points."""

Positions = Mapping[int, tuple[float, float]] | Float[np.ndarray, "states 2"]


def figure_graph(
    model: TransitionModel,
    plan: Plan | None = None,
    *,
    labels: Labels | None = None,
    positions: Positions | None = None,
) -> Figure:
    """Return a picture of a world as a graph: how probable each move between two states is.

    Args:
        model: The transition model, of at most 100 states.
        plan: A plan, for the policy by which actions are chosen, and terminal states; by default all available actions
            are equally probable.
        labels: Names of states and actions.
        positions: The place of each state; by default networkx chooses it.

    Returns:
        The figure; `figure.savefig("world.png")` writes it.

    Raises:
        InputError: For too many states, a plan of another world, and too few labels or positions.

    Example:
        >>> import sidestep as ss
        >>> coin = ss.TiedModel(ss.graph(np.array([[[1, 0]], [[1, 1]]])), np.array([[[0, ss.FIXED]], [[0, ss.FIXED]]]))
        >>> figure = figure_graph(coin, labels=ss.Labels(states=("start", "end"), actions=("go",)))
        >>> len(figure.axes)
        1
    """
    states = model.graph.states
    check(states <= MAX_STATES, f"expected at most {MAX_STATES} states, found {states}", field="model")
    side = 2.6 + 0.9 * np.sqrt(states)
    figure = Figure(figsize=(1.25 * side, side), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots()
    draw_graph(axes, model, plan, labels=labels, positions=positions)
    figure.legend(handles=_key(plan), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
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
        axes: Where to draw.
        model, plan, labels, positions: As for `figure_graph`.
    """
    import networkx

    labels, probabilities = labels or Labels(), _transitions(model)
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
    places = _places(network, positions)
    names = dict(enumerate(names_of(labels.states, states, "states")))
    of_actions = names_of(labels.actions, actions, "actions")
    size = (10 + 5.5 * max(map(len, names.values()))) ** 2
    for shape, color, some in (("o", "white", ~terminal), ("D", palette.GOAL, terminal)):
        which = np.flatnonzero(some).tolist()
        networkx.draw_networkx_nodes(
            network, places, which, size, color, shape, ax=axes, edgecolors="black", linewidths=1.2
        )
    networkx.draw_networkx_labels(network, places, names, font_size=9, ax=axes)
    edges = [edge for edge in network.edges if edge[0] != edge[1]]
    weights = np.array([moves[edge] for edge in edges])
    networkx.draw_networkx_edges(
        network, places, edges, ax=axes, node_size=size, connectionstyle=_CURVE, arrowsize=_HEAD,
        width=_width(weights).tolist(), edge_color=[_gray(weight) for weight in weights],
    )  # fmt: skip
    texts = {}
    if states <= _TEXTS:
        offered = np.where(available[:, :, None], probabilities, 0.0)
        texts = {edge: _text(offered[edge[0], :, edge[1]], of_actions) for edge in network.edges}
        between = {edge: texts[edge] for edge in edges}
        networkx.draw_networkx_edge_labels(
            network, places, between, font_size=7, ax=axes, connectionstyle=_CURVE, node_size=size, rotate=False
        )
    for state in (state for state in range(states) if network.has_edge(state, state)):
        # the diameter of a node in points is the root of its size
        text = texts.get((state, state), "")
        _draw_loop(axes, places[state], np.sqrt(size), float(moves[state, state]), text)
    axes.set_axis_off()
    axes.margins(0.2)


def _draw_loop(axes: Axes, place: tuple[float, float], diameter: float, probability: float, text: str) -> None:
    """Draw an arrow from the top of a node to itself; networkx's loops may be smaller than their node."""
    figure = axes.get_figure(root=True)
    left, right = (
        offset_copy(axes.transData, figure, side * diameter, 0.4 * diameter, "points") for side in (-0.3, 0.3)
    )
    shape = {
        "arrowstyle": "-|>", "connectionstyle": "arc3,rad=-1.9", "mutation_scale": _HEAD, "shrinkA": 0, "shrinkB": 0,
        "linewidth": float(_width(probability)), "color": _gray(probability),
    }  # fmt: skip
    axes.annotate("", place, place, xycoords=right, textcoords=left, arrowprops=shape)
    above = (0.0, diameter * 1.1)
    axes.annotate(text, place, above, textcoords="offset points", ha="center", va="bottom", fontsize=7)


def names_of(labels: Sequence[Hashable], count: int, field: str) -> list[str]:
    """Return the names of all states or actions, numbers by default.

    Args:
        labels: The labels; none for numbers.
        count: How many there are.
        field: What they name, for the error.

    Raises:
        InputError: For another number of labels.
    """
    names = [str(label) for label in (labels if len(labels) else range(count))]
    check(len(names) == count, f"expected {count} labels, found {len(names)}", source="labels", field=field)
    return names


def _transitions(model: TransitionModel) -> Float[np.ndarray, "states actions states"]:
    """Return T(s, a, s′) as a dense array."""
    successors, probabilities = np.asarray(model.graph.successors), np.asarray(model.probabilities(), np.float64)
    result = np.zeros((*successors.shape[:2], model.graph.states))
    states, actions, _ = np.indices(successors.shape)
    np.add.at(result, (states, actions, successors), probabilities)
    return result


def _places(network: "DiGraph", positions: Positions | None) -> dict[int, tuple[float, float]]:
    """Return the place of each state."""
    import networkx

    if positions is None:
        places = networkx.kamada_kawai_layout(network.to_undirected())
    else:
        places = positions if isinstance(positions, Mapping) else dict(enumerate(np.asarray(positions)))
    missing = [state for state in network if state not in places]
    check(not missing, f"expected a place of each state, found none of {missing[:5]}", field="positions")
    return {state: (float(places[state][0]), float(places[state][1])) for state in network}


def _text(probabilities: Float[np.ndarray, " actions"], names: list[str]) -> str:
    """Return the actions that lead along an arrow, with their probabilities."""
    some = [(name, p) for name, p in zip(names, probabilities, strict=True) if p >= _LEAST]
    return "\n".join(f"{name}: {f'{p:.2f}'.removeprefix('0') if p < 0.995 else '1'}" for name, p in some)


def _width(probability: float | Float[np.ndarray, " arrows"]) -> Float[np.ndarray, "*arrows"]:
    """Return the width of arrows in points."""
    return np.asarray(0.6 + 3.4 * probability)


def _gray(probability: float) -> str:
    """Return the gray of an arrow."""
    return f"{0.75 * (1 - probability):.3f}"


def _key(plan: Plan | None) -> list[Line2D]:
    """Return what the key shows: arrows of some probabilities, and the kinds of states."""
    lines = [Line2D([], [], color=_gray(p), linewidth=float(_width(p)), label=f"P(s′ | s) = {p:g}") for p in _KEY]
    states = [("o", "white", "state")] + ([("D", palette.GOAL, "terminal")] if plan is not None else [])
    return lines + [
        Line2D([], [], linestyle="", marker=shape, markerfacecolor=color, markeredgecolor="black", label=text)
        for shape, color, text in states
    ]
