"""Road networks and trips in files: links, the turns between them, and the links of each trip.

Three tables (CSV or Parquet), each with any number of other columns:

- links, one row a link (a road in one direction): `link` any label, `from_node` and `to_node` labels, `length_m` in
  metres, above 0, and `oneway`, 1 or 0;
- turns, one row a turn: `link`, `next_link` (which begins where `link` ends), and `action`, its direction in eighths of
  a circle, 0…7: 0 straight on, 4 back;
- trips, one row a trip: `trip` any label, `origin`, `destination`, and `links`, the labels of all its links in order,
  separated by spaces.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Int

from sidestep._arguments import to_states
from sidestep.errors import check, check_instance, to_list, to_path
from sidestep.io.tables import check_columns, check_rows, finite_column, read_table
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import Graph
from sidestep.tabular.tasks import reach

EIGHTHS = 8
"""The number of directions of turns."""


@dataclass(frozen=True, eq=False)
class Roads:
    """A road network; links are numbered in the order of their table.

    Attributes:
        labels: The label of each link.
        begins: The number of the node where each link begins.
        ends: The number of the node where each link ends.
        lengths: The length of each link in metres.
        one_way: Whether each link is the only direction of its road.
        turns: The two links of each turn.
        directions: Of each turn, in eighths of a circle, 0 straight on.
    """

    labels: list[str]
    begins: Int[np.ndarray, " links"]
    ends: Int[np.ndarray, " links"]
    lengths: Float[np.ndarray, " links"]
    one_way: Bool[np.ndarray, " links"]
    turns: Int[np.ndarray, "turns 2"]
    directions: Int[np.ndarray, " turns"]

    def __len__(self) -> int:
        """Return the number of links."""
        return len(self.labels)


def read_roads(links: str | Path, turns: str | Path) -> Roads:
    """Return the road network in a table of links and a table of turns.

    Args:
        links: The table of links, `.csv` or `.parquet`.
        turns: The table of turns, `.csv` or `.parquet`.

    Raises:
        InputError: Naming file, row and column, for columns that are missing, links that repeat or do not exist,
            lengths that are not above 0, turns that repeat or lead onto a link that begins elsewhere, and directions
            other than 0…7.

    Example:
        >>> roads = read_roads("links.csv", "turns.csv")  # doctest: +SKIP
    """
    table = _read(links, ("link", "from_node", "to_node", "length_m", "oneway"))
    labels = _labels(table, "link", links)
    check_rows(_is_first(np.asarray(labels)), "the link appears more than once", links, "link")
    nodes = np.asarray([_labels(table, name, links) for name in ("from_node", "to_node")])
    begins, ends = np.unique(nodes, return_inverse=True)[1].reshape(nodes.shape)
    lengths = finite_column(table, "length_m", str(links))
    check_rows(lengths > 0, "expected metres above 0", links, "length_m")
    one_way = _whole(table, "oneway", links, 1) == 1
    table = _read(turns, ("link", "action", "next_link"))
    number = {label: index for index, label in enumerate(labels)}
    pairs = np.stack([_numbered(table, name, turns, number) for name in ("link", "next_link")], axis=1)
    meets = ends[pairs[:, 0]] == begins[pairs[:, 1]]
    check_rows(meets, "expected a link that begins where the first one ends", turns, "next_link")
    check_rows(_is_first(pairs), "the turn appears more than once", turns, "next_link")
    return Roads(labels, begins, ends, lengths, one_way, pairs, _whole(table, "action", turns, EIGHTHS - 1))


def read_trips(path: str | Path, roads: Roads) -> list[Int[np.ndarray, " _"]]:
    """Return the links of each trip in a table, numbered as in `roads`.

    Args:
        path: The table of trips, `.csv` or `.parquet`.
        roads: The road network.

    Raises:
        InputError: Naming file, row and column, for columns that are missing, links that do not exist, trips of fewer
            than two links, without a turn from one link to the next, that begin or end elsewhere than at their origin
            and destination, or that continue after they have reached it.

    Example:
        >>> trips = read_trips("trips.csv", roads)  # doctest: +SKIP
    """
    check_instance(roads, Roads, "roads")
    table = _read(path, ("trip", "origin", "destination", "links"))
    number = {label: index for index, label in enumerate(roads.labels)}
    turns = {(int(begin), int(onto)) for begin, onto in roads.turns}
    columns = [_labels(table, name, path) for name in ("origin", "destination", "links")]
    trips = []
    for row, (origin, destination, cell) in enumerate(zip(*columns, strict=True), start=1):
        trip = cell.split()
        check_trip = partial(check, source=path, row=row)
        check_trip(len(trip) >= 2, f"expected at least two links, found {len(trip)}", field="links")
        for link in trip:
            check_trip(link in number, f"there is no link {link}", field="links")
        for one, other in pairwise(trip):
            check_trip((number[one], number[other]) in turns, f"there is no turn from {one} to {other}", field="links")
        for field, label, link in (("origin", origin, trip[0]), ("destination", destination, trip[-1])):
            check_trip(label == link, f"expected {link}, as in its links, found {label}", field=field)
        check_trip(destination not in trip[:-1], "continues after it has reached its destination", field="links")
        trips.append(np.asarray([number[link] for link in trip]))
    return trips


def demonstrations_from_trips(
    trips: Sequence[Int[np.ndarray, " _"]], graph: Graph, *, discount: float = 1.0, step_cost: float | None = 1.0
) -> Demonstrations:
    """Return demonstrations on the graph of a road network (`road_network`), with one task for every destination.

    Args:
        trips: The links of each trip, from `read_trips`.
        graph: The graph of the road network.
        discount: γ in (0, 1], as in `reach`.
        step_cost: The cost of a metre, as in `reach`.

    Raises:
        InputError: Naming the trip, for one without a turn from one link to the next.
    """
    check_instance(graph, Graph, "graph")
    links = [
        to_states(trip, graph.states, f"trips[{place}]") for place, trip in enumerate(to_list(trips, object, "trips"))
    ]
    next_links = np.asarray(graph.successors)[:, :, 0]
    goals, task = np.unique([trip[-1] for trip in links], return_inverse=True)
    trajectories = []
    for row, (trip, goal) in enumerate(zip(links, task.tolist(), strict=True), start=1):
        matches = next_links[trip[:-1]] == trip[1:, None]
        check(
            matches.any(axis=1).all(), "expected a turn from each link to the next, found none", source="trip", row=row
        )
        trajectories.append(Trajectory(trip, matches.argmax(axis=1), goal))
    return gather(trajectories, [reach(graph, int(goal), discount=discount, step_cost=step_cost) for goal in goals])


def _read(path: str | Path, names: tuple[str, ...]) -> pa.Table:
    """Return a table that has these columns, and rows."""
    table = read_table(to_path(path), labels=tuple(name for name in names if name != "length_m"))
    check_columns(table, names, str(path))
    check(len(table), "expected at least one row", source=path)
    return table


def _labels(table: pa.Table, name: str, path: object) -> list[str]:
    """Return a column without empty cells as text."""
    check_rows(table[name].is_valid().to_numpy(), "expected a label, found an empty cell", path, name)
    return [str(cell) for cell in table[name].to_pylist()]


def _numbered(table: pa.Table, name: str, path: object, number: dict[str, int]) -> Int[np.ndarray, " rows"]:
    """Return the numbers of the links in a column of labels."""
    labels = _labels(table, name, path)
    valid = np.array([label in number for label in labels])
    check_rows(valid, "expected a link of the table of links, found {}", path, name, values=labels)
    return np.asarray([number[label] for label in labels])


def _whole(table: pa.Table, name: str, path: object, most: int) -> Int[np.ndarray, " rows"]:
    """Return a column of whole numbers from 0."""
    values = finite_column(table, name, str(path))
    check_rows((values >= 0) & (values <= most) & (values % 1 == 0), f"expected a whole number, 0…{most}", path, name)
    return values.astype(np.int64)


def _is_first(values: np.ndarray) -> Bool[np.ndarray, " rows"]:
    """Return which rows differ from all rows before them."""
    return np.isin(np.arange(len(values)), np.unique(values, axis=0, return_index=True)[1])
