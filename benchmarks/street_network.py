"""A network of streets of which signs are not known: both directions of every road, turns, their costs, and a map."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from sidestep.errors import InputError
from sidestep.io.roads import EIGHTHS, Roads, demonstrations_from_trips, read_roads, read_trips
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.graph import Graph
from sidestep.tabular.models import TiedModel, road_network

FEATURES = ("100 m", "link", "to one side", "to the other", "sharp", "U-turn")
"""What a turn onto a link may cost: the link's length, that it is one, and how the turn bends."""
KINDS = (0, 1, 1, 2, 2, 2, 3, 3)
"""Of each eighth of a circle: straight on, to one side, sharply back, to the other side."""
ROUNDS = 50
"""How often places are fitted to lengths, with the directions that they have by then."""
Trip = np.ndarray


def opposite(roads: Roads) -> np.ndarray:
    """Return the link that leads back, of each link; −1 where there is none."""
    known = {ends: link for link, ends in enumerate(zip(roads.begins.tolist(), roads.ends.tolist(), strict=True))}
    back = zip(roads.ends.tolist(), roads.begins.tolist(), strict=True)
    return np.asarray([known.get(ends, -1) for ends in back])


def phase(numbers: np.ndarray) -> np.ndarray:
    """Return complex numbers made 1 long; 1 for 0."""
    return np.exp(1j * np.angle(numbers))


def directions_at_nodes(roads: Roads) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions of travel of each link on arrival and on departure, each in its node's own frame.

    Turns have directions in eighths of a circle, so with z the directions as phases,
    exp(iπ/4 · eighths) = z_departure / z_arrival. That is a matrix of rank one but for the rounding; its leading
    singular vectors are the directions.
    """
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


def both_ways(roads: Roads) -> Roads:
    """Return the network without signs: the reverses of one-way links behind its own links, and all possible turns.

    Raises `InputError` for a link that is marked as one-way but has a reverse, or the other way round.
    """
    wrong = np.flatnonzero(roads.one_way != (opposite(roads) < 0))
    if len(wrong):
        label = roads.labels[wrong[0]]
        raise InputError(f"link {label}: expected 1 if no link leads back, and 0 if one does", field="oneway")
    arriving, departing = directions_at_nodes(roads)
    shut = np.flatnonzero(roads.one_way)
    begins, ends = np.append(roads.begins, roads.ends[shut]), np.append(roads.ends, roads.begins[shut])
    departing, arriving = np.append(departing, -arriving[shut]), np.append(arriving, -departing[shut])
    turns = np.argwhere(ends[:, None] == begins)
    turned = np.angle(departing[turns[:, 1]] / arriving[turns[:, 0]])
    return Roads(
        labels=roads.labels + [f"{roads.labels[link]} back" for link in shut],
        begins=begins,
        ends=ends,
        lengths=np.append(roads.lengths, roads.lengths[shut]),
        one_way=np.zeros(len(begins), dtype=bool),
        turns=turns,
        directions=np.rint(turned * EIGHTHS / (2 * np.pi)).astype(int) % EIGHTHS,
    )


def turn_features(roads: Roads, graph: Graph) -> np.ndarray:
    """Return `FEATURES` of each action of a link (links × actions × features); 0 for turns that do not exist."""
    begin, onto = roads.turns.T
    action = (np.asarray(graph.successors)[begin, :, 0] == onto[:, None]).argmax(axis=1)
    kind = np.asarray(KINDS)[roads.directions]
    back = (roads.begins[begin] == roads.ends[onto]) & (roads.ends[begin] == roads.begins[onto])
    columns = [roads.lengths[onto] / 100, np.ones(len(onto)), *((kind == k) & ~back for k in (1, 3, 2)), back]
    features = np.zeros((*graph.successors.shape[:2], len(FEATURES)))
    features[begin, action] = np.stack(columns, axis=1)
    return features


class Town(NamedTuple):
    """A network with both directions of every road (`added`: those that are closed), its model, and `FEATURES`."""

    roads: Roads
    added: np.ndarray
    model: TiedModel
    features: Array

    def demonstrations(self, trips: Sequence[Trip], costs: Array | None = None) -> Demonstrations:
        """Return trips as demonstrations of drivers with some costs of features."""
        demos = demonstrations_from_trips(trips, self.model.graph)
        return demos if costs is None else self.adding_costs(demos, costs)

    def adding_costs(self, demos: Demonstrations, costs: Array) -> Demonstrations:
        """Return the demonstrations with costs of features; a turn that does not exist costs its link's length."""
        reward = jnp.where(self.features[..., 1] == 1, -(self.features @ costs), -self.model.graph.lengths)
        rewards = jnp.broadcast_to(reward, (len(demos.tasks.terminal), *reward.shape))
        return eqx.tree_at(lambda demos: demos.tasks.reward, demos, rewards)

    def uses(self, trips: Sequence[Trip]) -> np.ndarray:
        """Return how often trips used each link."""
        return np.bincount(np.concatenate([np.empty(0, int), *trips]), minlength=len(self.roads))


def read_town(folder: Path) -> tuple[Town, list[Trip]]:
    """Return the network and all trips; raises `InputError` for wrong files."""
    signed = read_roads(folder / "links.csv", folder / "turns.csv")
    roads = both_ways(signed)
    model = road_network(roads.turns, roads.lengths)
    town = Town(roads, np.arange(len(roads)) >= len(signed), model, jnp.asarray(turn_features(roads, model.graph)))
    return town, read_trips(folder / "trips.csv", signed)


def layout(roads: Roads) -> np.ndarray:
    """Return places of the nodes, in metres, of the largest part of a network; NaN for those of other parts.

    The files have no coordinates, but links are nearly straight. First come the rotations of the nodes under which both
    ends of each link have one direction (the leading eigenvector of a matrix of phases); then the places by least
    squares, directions and lengths given, and directions by places, in turns. The map is known up to a rotation.
    """
    nodes = int(max(roads.begins.max(), roads.ends.max())) + 1
    joined = csr_array((np.ones(len(roads)), (roads.begins, roads.ends)), shape=(nodes, nodes))
    part = connected_components(joined, directed=False)[1]
    inside = part == np.bincount(part).argmax()
    number, links = np.cumsum(inside) - 1, inside[roads.begins]
    begins, ends, lengths = number[roads.begins[links]], number[roads.ends[links]], roads.lengths[links]
    arriving, departing = (directions[links] for directions in directions_at_nodes(roads))
    phases = np.zeros((inside.sum(), inside.sum()), dtype=complex)
    np.add.at(phases, (begins, ends), arriving / departing)
    phases = phases + phases.conj().T
    weight = np.sqrt(np.abs(phases).sum(axis=1))
    rotation = phase(np.linalg.eigh(phases / np.outer(weight, weight))[1][:, -1])
    change, rows = np.zeros((len(lengths), inside.sum())), np.arange(len(lengths))
    change[rows, begins], change[rows, ends] = -1, 1
    by_changes = np.linalg.pinv(change)
    places = by_changes @ (lengths * phase(departing * rotation[begins] + arriving * rotation[ends]))
    for _ in range(ROUNDS):
        places = by_changes @ (lengths * phase(places[ends] - places[begins]))
    result = np.full((nodes, 2), np.nan)
    result[inside] = np.stack([np.real(places), -np.imag(places)], axis=1)  # eighths count clockwise
    return result
