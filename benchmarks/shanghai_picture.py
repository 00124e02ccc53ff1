"""The picture of `shanghai.py`: the town with what was learned of its links, and how precise rankings are.

The files have no coordinates. But links are nearly straight, so nodes have places: first the rotations of the nodes
under which both ends of each link have one direction (the leading eigenvector of a matrix of phases), then the places
by least squares, directions and lengths given, and directions by places, in turns. Lengths come out right within a
percent. The map is known up to a rotation.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import rankdata
from sklearn.metrics import precision_recall_curve

from sidestep.io.roads import Roads
from two_way import directions_at_nodes, phase

_ROUNDS = 50
"""How often places are fitted to lengths, with the directions that they have by then."""
_SHADES = LinearSegmentedColormap.from_list("shades", ["0.72", "0.0"])
_ASIDE = 14.0
"""How far to the right of its road a link is drawn, in metres."""


def figure(roads: Roads, closed: Bool[np.ndarray, " links"], records: Sequence[Mapping[str, Any]]) -> Figure:
    """The town as learned from the first record's trips, beside precision and recall for each number of trips.

    - `closed`: which links are.
    - `records`: those of `shanghai.score`; of each number of trips, the first one counts.
    """
    first_moves = list({record["trips"]: record for record in reversed(records)}.values())[::-1]
    picture = Figure(figsize=(10.4, 7.4), layout="constrained")
    grid = picture.add_gridspec(len(first_moves), 2, width_ratios=[5.6, 4.6])
    town = picture.add_subplot(grid[:, 0])
    label = "rank by P(closed) among unused links (1: most surely closed)"
    picture.colorbar(draw_town(town, roads, closed, first_moves[0]), ax=town, shrink=0.5, pad=0.01, label=label)
    for row, record in enumerate(first_moves):
        axes = picture.add_subplot(grid[row, 1])
        draw_precision(axes, closed, record)
        axes.set_xlabel("recall of closed links" if record is first_moves[-1] else "")
        if record is first_moves[0]:
            axes.legend(fontsize="small", frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.2))
    return picture


def draw_town(
    axes: Axes, roads: Roads, closed: Bool[np.ndarray, " links"], record: Mapping[str, Any]
) -> LineCollection:
    """Used links as light lines, the wider the more they were used; unused ones darker the higher P(closed) ranks them.

    Each lies on the right of its road. Unused links that are open have a circle.
    """
    places = layout(roads)
    ends = np.stack([places[roads.begins], places[roads.ends]], axis=1)
    along = ends[:, 1] - ends[:, 0]
    right = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    ends = ends + _ASIDE * right[:, None]
    uses, placed = np.asarray(record["uses"]), np.isfinite(ends).all(axis=(1, 2))
    used, unused = (uses > 0) & placed, (uses == 0) & placed
    widths = 0.4 + 3 * np.sqrt(uses[used] / uses.max())
    axes.add_collection(LineCollection(list(ends[used]), colors="0.85", linewidths=widths))
    ranks = rankdata(np.asarray(record["rankings"]["P(closed)"])[unused]) / unused.sum()
    order = np.argsort(ranks)
    shades = LineCollection(list(ends[unused][order]), linewidths=2.2, array=ranks[order], cmap=_SHADES, clim=(0, 1))
    axes.add_collection(shades)
    middles, ranks = ends[unused].mean(axis=1)[~closed[unused]], ranks[~closed[unused]]
    axes.scatter(*middles.T, s=26, c=ranks, cmap=_SHADES, vmin=0, vmax=1, edgecolors="black", linewidths=0.7, zorder=3)
    handles = [
        Line2D([], [], color="0.85", linewidth=3, label="used (wider: more often)"),
        Line2D([], [], color="0.3", linewidth=2.2, label="unused, and closed"),
        Line2D([], [], color="0.3", linewidth=2.2, marker="o", markeredgecolor="black", label="unused, but open"),
    ]
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=3, frameon=False, fontsize="small"
    )
    axes.autoscale()
    axes.set(aspect="equal", xlabel="metres", title=f"learned from {record['trips']} trips")
    return shades


def draw_precision(axes: Axes, closed: Bool[np.ndarray, " links"], record: Mapping[str, Any]) -> None:
    """Precision against recall of rankings of the unused links."""
    unused = np.asarray(record["uses"]) == 0
    for (name, ranks), style in zip(record["rankings"].items(), ("-", "--", ":"), strict=True):
        precision, recall, _ = precision_recall_curve(closed[unused], np.asarray(ranks)[unused])
        axes.plot(recall[:-1], precision[:-1], style, color="black", label=name)
    axes.axhline(record["share"], color="0.6", linewidth=3, zorder=0, label="share of closed links")
    open_links = max(1 - record["share"], 0.01)
    axes.set(
        ylim=(1 - 1.3 * open_links, 1 + 0.03 * open_links),
        ylabel="precision",
        title=f"unused links, {record['trips']} trips",
    )
    axes.spines[["top", "right"]].set_visible(False)


def layout(roads: Roads) -> Float[np.ndarray, "nodes 2"]:
    """Places of the nodes, in metres, of the largest part of a network; NaN for those of other parts."""
    nodes = int(max(roads.begins.max(), roads.ends.max())) + 1
    shape = (nodes, nodes)
    joined = csr_array((np.ones(len(roads)), (roads.begins, roads.ends)), shape=shape)
    part = connected_components(joined, directed=False)[1]
    inside = part == np.bincount(part).argmax()
    number = np.cumsum(inside) - 1
    links = inside[roads.begins]
    begins, ends = number[roads.begins[links]], number[roads.ends[links]]
    arriving, departing = (found[links] for found in directions_at_nodes(roads))
    places = _places(begins, ends, roads.lengths[links], arriving, departing)
    found = np.full((nodes, 2), np.nan)
    # eighths count clockwise
    found[inside] = np.stack([np.real(places), -np.imag(places)], axis=1)
    return found


def _places(
    begins: Int[np.ndarray, " links"],
    ends: Int[np.ndarray, " links"],
    lengths: Float[np.ndarray, " links"],
    arriving: np.ndarray,
    departing: np.ndarray,
) -> np.ndarray:
    """Places of the nodes of one part, as complex numbers, by the directions and lengths of its links."""
    links, nodes = np.arange(len(lengths)), int(max(begins.max(), ends.max())) + 1
    phases = np.zeros((nodes, nodes), dtype=complex)
    np.add.at(phases, (begins, ends), arriving / departing)
    phases = phases + phases.conj().T
    weight = np.sqrt(np.abs(phases).sum(axis=1))
    rotation = phase(np.linalg.eigh(phases / np.outer(weight, weight))[1][:, -1])
    change = np.zeros((len(links), nodes))
    change[links, begins], change[links, ends] = -1, 1
    by_changes = np.linalg.pinv(change)
    places = by_changes @ (lengths * phase(departing * rotation[begins] + arriving * rotation[ends]))
    for _ in range(_ROUNDS):
        places = by_changes @ (lengths * phase(places[ends] - places[begins]))
    return places
