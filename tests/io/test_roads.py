"""Tables of road networks and trips: what is read, what is refused and where, and trips as demonstrations."""

import re

import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.io.roads import demonstrations_from_trips, read_roads, read_trips
from sidestep.tabular.models import road_network

LINKS = """link,from_node,to_node,length_m,oneway,name
a,7,8,120.5,0,High Street
b,8,7,120.5,0,High Street
c,8,9,40,1,
007,9,8,30,1,Back Lane
"""
TURNS = """link,action,next_link
a,4,b
a,0,c
b,4,a
c,4,007
007,2,b
"""
TRIPS = """trip,origin,destination,links
1,a,007,a c 007
2,007,a,007 b a
"""


@pytest.fixture
def files(tmp_path):
    """Where the three tables are, after some text in one of them has been replaced."""

    def write(table="", old="", new=""):
        paths = []
        for name, text in (("links", LINKS), ("turns", TURNS), ("trips", TRIPS)):
            assert name != table or old in text
            paths.append(tmp_path / f"{name}.csv")
            paths[-1].write_text(text.replace(old, new) if name == table else text)
        return paths

    return write


def test_read_roads_numbers_links_and_joins_turns(files):
    links, turns, _ = files()
    roads = read_roads(links, turns)
    assert (len(roads), roads.labels) == (4, ["a", "b", "c", "007"])
    assert roads.lengths.tolist() == [120.5, 120.5, 40, 30]
    assert roads.one_way.tolist() == [False, False, True, True]
    assert roads.turns.tolist() == [[0, 1], [0, 2], [1, 0], [2, 3], [3, 1]]
    assert roads.directions.tolist() == [4, 0, 4, 4, 2]
    # nodes are the same where links meet, and different where they do not
    assert (roads.begins[:, None] == roads.ends).tolist() == [
        [False, True, False, False],
        [True, False, False, True],
        [True, False, False, True],
        [False, False, True, False],
    ]


def test_read_roads_with_numeric_labels_in_any_order(files):
    links, turns, trips = files()
    number = {"a": "10", "b": "2", "c": "0", "007": "30"}
    for path in (links, turns, trips):
        text = re.sub(r"\b(a|b|c|007)\b", lambda found: number[found[0]], path.read_text())
        path.write_text(text)
    roads = read_roads(links, turns)
    assert roads.labels == ["10", "2", "0", "30"]
    assert [trip.tolist() for trip in read_trips(trips, roads)] == [[0, 2, 3], [3, 1, 0]]


@pytest.mark.parametrize(
    ("table", "old", "new", "match"),
    [
        ("links", "length_m", "metres", r"links\.csv, field 'length_m': the column is missing"),
        ("links", "b,8,7", "a,8,7", r"links\.csv, row 2, field 'link': the link appears more than once"),
        ("links", "c,8,9,40", "c,8,9,0", r"links\.csv, row 3, field 'length_m': expected metres above 0"),
        ("links", "c,8,9,40", "c,8,9,far", r"links\.csv, row 3, field 'length_m': expected a number, found 'far'"),
        ("links", "c,8,9,40", "c,8,9,", r"links\.csv, row 3, field 'length_m': .*an empty cell"),
        ("links", "c,8,9,40,1", "c,8,9,40,2", r"links\.csv, row 3, field 'oneway': expected a whole number, 0…1"),
        ("links", "c,8,", "c,,", r"links\.csv, row 3, field 'from_node': expected a label"),
        ("turns", "next_link", "onto", r"turns\.csv, field 'next_link': the column is missing"),
        ("turns", "a,0,c", "a,0,d", r"turns\.csv, row 2, field 'next_link': expected a link of the table of .*found d"),
        ("turns", "a,0,c", "d,0,c", r"turns\.csv, row 2, field 'link': expected a link of the table of .*found d"),
        ("turns", "b,4,a", "b,4,c", r"turns\.csv, row 3, field 'next_link': expected a link that begins where"),
        ("turns", "a,0,c", "a,0,b", r"turns\.csv, row 2, field 'next_link': the turn appears more than once"),
        ("turns", "a,0,c", "a,8,c", r"turns\.csv, row 2, field 'action': expected a whole number, 0…7"),
        ("turns", "a,0,c", "a,0.5,c", r"turns\.csv, row 2, field 'action': expected a whole number, 0…7"),
    ],
)
def test_read_roads_of_bad_tables_raises(files, table, old, new, match):
    links, turns, _ = files(table, old, new)
    with pytest.raises(InputError, match=match):
        read_roads(links, turns)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("destination", "to", r"trips\.csv, field 'destination': the column is missing"),
        ("a c 007", "a x 007", r"trips\.csv, row 1, field 'links': there is no link x"),
        ("a c 007", "a 007", r"trips\.csv, row 1, field 'links': there is no turn from a to 007"),
        ("2,007,a", "2,b,a", r"trips\.csv, row 2, field 'origin': expected 007, as in its links, found b"),
        ("2,007,a", "2,007,c", r"trips\.csv, row 2, field 'destination': expected a, as in its links, found c"),
        ("007 b a", "007", r"trips\.csv, row 2, field 'links': expected at least two links, found 1"),
        ("007 b a", "007 b a b a", r"trips\.csv, row 2, field 'links': continues after it has reached"),
        ("a c 007\n", "\n", r"trips\.csv, row 1, field 'links': expected a label"),
        (TRIPS, "trip,origin,destination,links\n", r"trips\.csv: expected at least one row"),
    ],
)
def test_read_trips_of_bad_tables_raises(files, old, new, match):
    links, turns, trips = files("trips", old, new)
    roads = read_roads(links, turns)
    with pytest.raises(InputError, match=match):
        read_trips(trips, roads)


def test_demonstrations_from_trips_have_one_task_per_destination(files):
    links, turns, trips = files()
    roads = read_roads(links, turns)
    graph = road_network(roads.turns, roads.lengths).graph
    demos = demonstrations_from_trips(read_trips(trips, roads), graph, step_cost=0.5)
    assert demos.states.tolist() == [0, 2, 3, 1]
    assert demos.next_states.tolist() == [2, 3, 1, 0]
    assert graph.successors[demos.states, demos.actions, 0].tolist() == demos.next_states.tolist()
    assert demos.task.tolist() == [1, 1, 0, 0]
    assert np.argwhere(np.asarray(demos.tasks.terminal)).tolist() == [[0, 0], [1, 3]]
    paid = -demos.tasks.reward[demos.task, demos.states, demos.actions]
    assert paid.tolist() == [20, 15, 60.25, 60.25]
    with pytest.raises(InputError, match="trip, row 2: expected a turn"):
        demonstrations_from_trips([np.array([0, 2]), np.array([0, 3])], graph)
