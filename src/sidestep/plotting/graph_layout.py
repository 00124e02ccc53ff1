"""The geometry of pictures of graphs, in points: where nodes are, how large they are, and how large the picture is.

A node is as large as the longest name in it, and names break into lines. The picture is so large that the two nearest
nodes have room for an arrow between them.
"""

import math
import re
from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes

from sidestep._arguments import to_finite
from sidestep.errors import check

if TYPE_CHECKING:
    from networkx import DiGraph

Positions = Mapping[int, tuple[float, float]] | Float[np.ndarray, "states 2"]
Places = Float[np.ndarray, "states 2"]
Vector = Float[np.ndarray, " 2"]

POINTS = 72.0
"""Points in an inch."""
_LINE, _WORD = 10, 12
"""The most letters of a line of several words, and of a word that is not broken."""
_FONT, _SMALLEST = 9.0, 5.5
"""Sizes of names in points."""
_LARGEST, _LEAST = 64.0, 26.0
"""The diameters of the largest and the smallest node."""
_PAD = 6.0
"""The space around a name in its node."""
_ARROW = 34.0
"""The room between the two nearest nodes."""
_BENDS = (0.15, 0.3, 0.45)
"""How much arrows may be bent: so that those of both directions are seen, and that they meet no other node."""
_SKEWED = 10.0
"""The ratio of height and width from which given places are not drawn to scale."""
_WIDTHS, _HEIGHTS = (400.0, 1440.0), (120.0, 1200.0)
"""The least and the largest width and height of a picture."""


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


class Nodes(NamedTuple):
    """What all nodes have in common.

    Attributes:
        names: With line breaks.
        font: The size of the names in points.
        diameter: In points.
    """

    names: list[str]
    font: float
    diameter: float


def sized_nodes(names: Sequence[str]) -> Nodes:
    """Return names with line breaks, and nodes in which they fit.

    Args:
        names: Of all states.
    """
    lines = [wrap(name) for name in names]
    longest = max(math.hypot(*text_size(name, _FONT)) for name in lines)
    factor = min(1.0, (_LARGEST - _PAD) / longest)
    font = max(_FONT * factor, _SMALLEST)
    return Nodes(lines, font, max(longest * font / _FONT + _PAD, _LEAST))


def wrap(name: str) -> str:
    """Break a name into lines: after spaces and marks such as underscores, and in very long words.

    Args:
        name: The name.

    Example:
        >>> wrap("living_room_3").splitlines()
        ['living_', 'room_3']
    """
    lines = [""]
    for word in re.findall(r"[^\s_./-]*[\s_./-]*", name):
        parts = -(-len(word.strip()) // _WORD) or 1
        length = -(-len(word) // parts)
        for start in range(0, len(word), max(length, 1)):
            piece = word[start : start + length]
            if len((lines[-1] + piece).strip()) <= _LINE or not lines[-1]:
                lines[-1] += piece
            else:
                lines.append(piece)
    return "\n".join(line.strip() for line in lines)


def text_size(text: str, font: float) -> tuple[float, float]:
    """Return about how wide and high a text is, in points.

    Args:
        text: With line breaks.
        font: The size of its letters.
    """
    lines = text.split("\n")
    return 0.62 * font * max(map(len, lines)), 1.25 * font * len(lines)


def places_of(network: "DiGraph", positions: Positions | None) -> Places:
    """Return the place of each state.

    Args:
        network: States and moves.
        positions: The places, in any units; None for those that networkx chooses, wider than high.

    Raises:
        InputError: Where a state has no place, and for places that are not two finite numbers each.
    """
    if positions is None:
        return _turned(_apart(_chosen(network)))
    is_mapping = isinstance(positions, Mapping)
    places = positions if is_mapping else dict(enumerate(to_finite(positions, "positions", ("states", 2))))
    missing = [state for state in network if state not in places]
    check(not missing, f"expected a place of each state, found none of {missing[:5]}", field="positions")
    result = np.asarray(to_finite([places[state] for state in network], "positions", ("states", 2)), np.float64)
    extent = np.ptp(result, axis=0)
    skewed = extent.min() > 0 and extent.max() > _SKEWED * extent.min()
    return result / extent if skewed else result


def _chosen(network: "DiGraph") -> Places:
    """Return places at distances that are about the numbers of moves between states (Kamada and Kawai 1989).

    The search starts from classical scaling, so that it unfolds the graph, with a small circle added, so that no two
    states start in one place. States without a path between them are a little farther apart than any others.
    """
    import networkx

    count = len(network)
    lengths = dict(networkx.all_pairs_shortest_path_length(network.to_undirected()))
    farthest = 1.0 + max(max(own.values()) for own in lengths.values())
    distances = np.array([[lengths[one].get(other, farthest) for other in network] for one in network])
    centering = np.eye(count) - 1 / count
    eigenvalues, vectors = np.linalg.eigh(-0.5 * centering @ distances**2 @ centering)
    scaled = (vectors * np.sqrt(np.maximum(eigenvalues, 0.0)))[:, ::-1][:, :2]
    angles = 2 * math.pi * np.arange(count) / count
    start = np.pad(scaled, ((0, 0), (0, 2 - scaled.shape[1])))
    start = start + 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rows = {one: dict(zip(network, row, strict=True)) for one, row in zip(network, distances, strict=True)}
    chosen = networkx.kamada_kawai_layout(network, dist=rows, pos=dict(zip(network, start, strict=True)))
    return np.array([chosen[state] for state in network])


def _distances(places: Places) -> Float[np.ndarray, "states states"]:
    """Return the distances between states; ∞ of each to itself."""
    distances = np.linalg.norm(places[:, None] - places, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return distances


def _apart(places: Places) -> Places:
    """Return places from which those that are far nearer to each other than most are moved apart."""
    if len(places) < 3:
        return places
    least = 0.8 * float(np.median(_distances(places).min(axis=1)))
    for _ in range(100):
        distances = _distances(places)
        overlap = np.maximum(least - distances, 0.0)
        if not overlap.any():
            break
        away = (places[:, None] - places) / np.maximum(distances, 1e-6)[..., None]
        places = places + 0.5 * np.sum(away * overlap[..., None], axis=1)
    return places


def _turned(places: Places) -> Places:
    """Return places turned so that they are wider than high, with the first state on the left."""
    centered = places - places.mean(axis=0)
    axes = np.linalg.svd(centered, full_matrices=True)[2]
    turned = centered @ axes.T
    return turned * np.where(turned[0] > 0, -1.0, 1.0) * [1.0, -1.0]


def picture_size(places: Places, diameter: float, room: float, margin: Vector) -> tuple[float, float]:
    """Return the width and height, in points, at which the nearest nodes have room for an arrow.

    Args:
        places: Of the states.
        diameter: Of the nodes, in points.
        room: For a text on an arrow, in points.
        margin: To the left and right of the outermost places, and above and below, in points.
    """
    extent = np.ptp(places, axis=0)
    nearest = _distances(places).min()
    scale = (diameter + _ARROW + room) / nearest if 0 < nearest < np.inf else 0.0
    width, height = extent * scale + 2 * margin
    return float(np.clip(width, *_WIDTHS)), float(np.clip(height, *_HEIGHTS))


def set_limits(axes: Axes, places: Places, margin: Vector) -> float:
    """Set the limits of axes so that all places have a margin; return the points of a unit of x and of y.

    Args:
        axes: Of the size that they keep.
        places: Of the states.
        margin: To the left and right, and above and below, in points.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    size = np.array([axes.bbox.width, axes.bbox.height]) * POINTS / figure.dpi
    inner = np.maximum(size - 2 * margin, 0.2 * size)
    low, extent = places.min(axis=0), np.ptp(places, axis=0)
    wide = extent > 0
    unit = float((inner[wide] / extent[wide] if wide.any() else size).min())
    before = (size / unit - extent) / 2
    axes.set_xlim(low[0] - before[0], low[0] + extent[0] + before[0])
    axes.set_ylim(low[1] - before[1], low[1] + extent[1] + before[1])
    return unit


def border(direction: float, diameter: float, diamond: bool) -> float:
    """Return how far the border of a node is from its center, in points.

    Args:
        direction: From the center, in radians.
        diameter: Of a circle, or the side of a diamond.
        diamond: Whether the node is a diamond.
    """
    if not diamond:
        return diameter / 2
    return diameter / math.sqrt(2) / (abs(math.cos(direction)) + abs(math.sin(direction)))


def bent(start: Vector, end: Vector, bend: float, at: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t 2"]:
    """Return points of the curve of an arrow, a quadratic one as Matplotlib's "arc3".

    Args:
        start: Of the arrow.
        end: Of the arrow.
        bend: How far the middle control point is to the right of the straight line, in lengths of it.
        at: Where along the curve, from 0 to 1.
    """
    across = (end - start)[::-1] * [1.0, -1.0]
    t = at[:, None]
    return start * (1 - t) + end * t + 2 * t * (1 - t) * bend * across


def best_bend(points: Places, start: int, end: int, back: bool, near: float) -> float:
    """Return how far an arrow is bent, to the right if above 0: as little as it can be without meeting other nodes.

    Args:
        points: Of all nodes.
        start, end: The nodes that the arrow is between.
        back: Whether there is an arrow back. Without one, the arrow is rather bent away from the middle of the picture.
        near: The distance from a node at which an arrow meets it.
    """
    others, along, bends = np.delete(points, [start, end], axis=0), np.linspace(0.05, 0.95, 19), np.array(_BENDS)
    if not back:
        middle = points[[start, end]].mean(axis=0)
        right = (points[end] - points[start])[::-1] * [1.0, -1.0]
        bends = np.copysign(1.0, right @ (middle - points.mean(axis=0))) * np.concatenate([bends, -bends])
    curves = (bent(points[start], points[end], bend, along) for bend in bends)
    met = [(np.linalg.norm(curve[:, None] - others, axis=-1).min(axis=0) < near).sum() for curve in curves]
    return float(bends[np.argmin(met)])


def free_direction(place: Vector, others: Places, neighbors: Bool[np.ndarray, " others"], near: float) -> float:
    """Return the direction in radians in which a node has most room: the middle of the widest gap, or up.

    Args:
        place: Of the node, in points.
        others: Of the other nodes.
        neighbors: Those to or from which arrows lead.
        near: Others nearer than this take room as well.
    """
    away = others - place
    away = away[neighbors | (np.linalg.norm(away, axis=1) < near)]
    if not len(away):
        return math.pi / 2
    taken = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    gaps = np.diff(taken, append=taken[0] + 2 * math.pi)
    middles = taken + gaps / 2
    # of gaps of about the same width the uppermost
    return float(middles[np.argmax(gaps + 0.3 * np.sin(middles))])
