"""A road network of which nobody says what is one-way, and what drivers may mind of its turns.

Turns tell their direction in eighths of a circle, so links have directions as seen from a node: with z the directions
of travel, on arrival and on departure, exp(iπ/4 · eighths) = z_departure / z_arrival. That is a matrix of rank one but
for the rounding, and its leading singular vectors are the directions (`directions_at_nodes`). With them the reverse of
a link has turns like any other link.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.errors import InputError
from sidestep.io.roads import EIGHTHS, Roads
from sidestep.tabular.graph import Graph

FEATURES = ("100 m", "link", "to one side", "to the other", "sharp", "U-turn")
"""What drivers may mind of a turn and of the link that it leads onto: its length, that it is one, and how it turns."""
_CLASSES = (0, 1, 1, 2, 2, 2, 3, 3)
"""Of each eighth of a circle: straight on, to one side, sharply back, to the other side."""


class TwoWay(NamedTuple):
    """A network with the reverses of its one-way links behind its own links; `added` marks them."""

    roads: Roads
    added: Bool[np.ndarray, " links"]


def two_way(roads: Roads) -> TwoWay:
    """The network as who has never seen a sign knows it: both directions of each road, and each turn that is possible.

    Raises `InputError` for a link that is said to be one-way but has a reverse, or the other way round.
    """
    reverse = opposite(roads)
    wrong = np.flatnonzero(roads.one_way != (reverse < 0))
    if len(wrong):
        label = roads.labels[wrong[0]]
        raise InputError(f"link {label}: expected 1 if no link leads back, and 0 if one does", field="oneway")
    arriving, departing = directions_at_nodes(roads)
    shut = np.flatnonzero(roads.one_way)
    begins, ends = np.append(roads.begins, roads.ends[shut]), np.append(roads.ends, roads.begins[shut])
    departing, arriving = np.append(departing, -arriving[shut]), np.append(arriving, -departing[shut])
    turns = np.argwhere(ends[:, None] == begins)
    turned = np.angle(departing[turns[:, 1]] / arriving[turns[:, 0]])
    both = Roads(
        labels=roads.labels + [f"{roads.labels[link]} back" for link in shut],
        begins=begins,
        ends=ends,
        lengths=np.append(roads.lengths, roads.lengths[shut]),
        one_way=np.zeros(len(begins), dtype=bool),
        turns=turns,
        directions=np.rint(turned * EIGHTHS / (2 * np.pi)).astype(int) % EIGHTHS,
    )
    return TwoWay(both, np.arange(len(begins)) >= len(roads))


def opposite(roads: Roads) -> Int[np.ndarray, " links"]:
    """The link that leads back, of each link; −1 where there is none."""
    known = {ends: link for link, ends in enumerate(zip(roads.begins.tolist(), roads.ends.tolist(), strict=True))}
    back = zip(roads.ends.tolist(), roads.begins.tolist(), strict=True)
    return np.asarray([known.get(ends, -1) for ends in back])


def directions_at_nodes(roads: Roads) -> tuple[np.ndarray, np.ndarray]:
    """The directions of travel of each link on arrival and on departure, as phases, each in its node's own frame."""
    turned = np.exp(2j * np.pi * roads.directions / EIGHTHS)
    first, last = roads.turns.T
    arriving, departing = np.ones((2, len(roads)), dtype=complex)
    for node in np.unique(roads.ends[first]):
        here = roads.ends[first] == node
        (incoming, row), (outgoing, column) = (np.unique(links[here], return_inverse=True) for links in (first, last))
        matrix = np.zeros((len(incoming), len(outgoing)), dtype=complex)
        matrix[row, column] = turned[here]
        left, _, right = np.linalg.svd(matrix)
        arriving[incoming], departing[outgoing] = phase(left[:, 0].conj()), phase(right[0])
    return arriving, departing


def turn_features(roads: Roads, graph: Graph) -> Float[np.ndarray, "links actions features"]:
    """What drivers may mind of each action of a link (see `FEATURES`); nothing of turns that are not there.

    `graph` is that of the model of the network, whose actions are its turns. All but the length are 0 or 1.
    """
    begin, onto = roads.turns.T
    action = (np.asarray(graph.successors)[begin, :, 0] == onto[:, None]).argmax(axis=1)
    kind = np.asarray(_CLASSES)[roads.directions]
    back = (roads.begins[begin] == roads.ends[onto]) & (roads.ends[begin] == roads.begins[onto])
    features = np.zeros((*graph.successors.shape[:2], len(FEATURES)))
    features[begin, action, 0] = roads.lengths[onto] / 100
    features[begin, action, 1] = 1
    for column, which in ((2, 1), (3, 3), (4, 2)):
        features[begin, action, column] = (kind == which) & ~back
    features[begin, action, 5] = back
    return features


def phase(numbers: np.ndarray) -> np.ndarray:
    """Complex numbers made 1 long; 1 for 0."""
    return np.exp(1j * np.angle(numbers))
