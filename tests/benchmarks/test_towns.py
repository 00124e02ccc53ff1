"""Towns of which nobody says where one cannot drive, each so small that what is hidden is plain to see."""

import argparse
import importlib
import json
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.io.maps import write_map
from sidestep.tabular.grid import Grid

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SCORES = {"auc", "average_precision", "auc_relevant", "average_precision_relevant"}


@pytest.fixture
def script(monkeypatch):
    """Imports a script of the benchmarks by its name."""
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    return importlib.import_module


# ---------------------------------------------------------------------------------------------------- buildings

BUILDING = np.zeros((9, 13))
BUILDING[3:6, 5:8] = 1


@pytest.fixture
def towns(tmp_path):
    """A folder with one town: a building in the middle, which all drives from west to east go around."""
    folder = tmp_path / "town_A"
    folder.mkdir()
    grid = Grid(BUILDING.astype(int), resolution=0.1)
    write_map(folder / "truth.yaml", BUILDING, grid)
    write_map(folder / "blank.yaml", np.full(BUILDING.shape, 0.5), replace(grid, known=np.full(BUILDING.shape, -1)))
    lines = ["walk,step,x,y,goal_x,goal_y"]
    for walk in range(8):
        x = [0.15, 0.45, 0.85, 1.15][:: 1 if walk % 2 else -1]
        edge = 0.25 if walk % 4 < 2 else 0.65
        y = [0.45, edge, edge, 0.45]
        lines += [f"{walk},{step},{x[step]},{y[step]},{x[-1]},{y[-1]}" for step in range(4)]
    (folder / "drives.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_a_building_that_all_drive_around_is_found(script, towns):
    magellan = script("magellan")
    town = magellan.read_town(towns / "town_A", magellan.DRIVERS)
    record = magellan.score(town, town.walks, replace(magellan.DRIVERS, beta=3.0))
    blocked = np.asarray(record["blocked"])
    # a place that nobody drove to either, but which was in nobody's way
    assert blocked[4, 5:8].min() > blocked[[0, 0, -1, -1], [0, -1, 0, -1]].max() + 0.02
    assert record["into_buildings"] == 0
    assert record["moves"] == 8 * 10
    assert record["converged"]
    assert set(record["learned"]) == set(record["visits"]) == set(record["transitions"]) == SCORES
    # neither of the others can tell the building from what else was not visited
    learned, *others = (record[method]["average_precision"] for method in ("learned", "visits", "transitions"))
    assert learned > max(others) + 0.2


def test_moves_into_buildings_are_counted_and_survived(script, towns):
    magellan = script("magellan")
    with (towns / "town_A" / "drives.csv").open("a") as file:
        # straight through the building's three cells
        file.write("8,0,0.15,0.45,1.15,0.45\n8,1,1.15,0.45,1.15,0.45\n")
    town = magellan.read_town(towns / "town_A", magellan.DRIVERS)
    record = magellan.score(town, town.walks, magellan.DRIVERS)
    assert record["into_buildings"] == 3
    assert np.isfinite(record["blocked"]).all()
    assert np.asarray(record["blocked"])[4, 5:8].max() < 0.2


def test_scores_are_averaged_over_the_draws_of_a_town_then_over_towns(script):
    magellan = script("magellan")

    def record(town, seed, auc, converged=True):
        scores = {**dict.fromkeys(SCORES, 0.5), "auc": auc, "auc_relevant": None}
        methods = dict.fromkeys(magellan.METHODS, scores)
        return {"town": town, "drives": 3, "seed": seed, "moves": 10, "into_buildings": 2, **methods} | {
            "converged": converged
        }

    records = [record("a", 0, 0.2), record("a", 1, 0.4), record("b", 0, 0.9, converged=False)]
    (row,) = magellan.summarise(records, [3])
    assert row["learned"]["auc"] == pytest.approx(0.6)
    assert row["learned"]["auc_relevant"] is None
    assert row["into_buildings"] == 6
    assert not row["converged"]


def test_the_whole_script_writes_records_and_a_picture(script, towns, tmp_path, capsys):
    magellan = script("magellan")
    arguments = argparse.Namespace(
        data=towns,
        drives=[4, 8],
        seeds=2,
        picture=tmp_path / "town.png",
        json=tmp_path / "records.json",
        quick=False,
        set=["iterations=3"],
    )
    magellan.run(arguments)
    written = json.loads(arguments.json.read_text())
    # two draws of 4, and all 8 once
    found = [(record["drives"], record["drives_found"], record["seed"]) for record in written["records"]]
    assert found == [(4, 4, 0), (4, 4, 1), (8, 8, 0)]
    assert [row["drives"] for row in written["means"]] == [4, 8]
    assert written["learner"]["iterations"] == 3
    assert arguments.picture.read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr()
    assert "into buildings" in printed.out
    assert "have not converged" in printed.err


def test_towns_that_are_not_there_are_named(script, towns, tmp_path):
    magellan = script("magellan")
    arguments = argparse.Namespace(data=tmp_path / "nowhere", set=[], quick=False)
    with pytest.raises(InputError, match=r"nowhere: expected folders town_A"):
        magellan.run(arguments)
    for name in ("drives.csv", "truth.yaml"):
        (towns / "town_A" / name).unlink()
        with pytest.raises(InputError, match=name):
            magellan.read_town(towns / "town_A", magellan.DRIVERS)


# ---------------------------------------------------------------------------------------------------- one-way streets

SIDE = 3
PLACES = [(x, y) for y in range(SIDE) for x in range(SIDE)]
"""Of the nodes of a small town, in units of 100 m."""
STREETS = [(a, b) for a in range(9) for b in range(9) if abs(np.subtract(PLACES[a], PLACES[b])).sum() == 1]
SHUT = {(1, 4), (4, 7)}
"""The middle street leads down only."""


def eighths(one, other):
    """The direction of a turn between two streets, clockwise."""
    before, after = (complex(*np.subtract(PLACES[b], PLACES[a])) for a, b in (one, other))
    return int(np.rint(-np.angle(after / before) * 4 / np.pi)) % 8


def write_network(folder, shut, trips=()):
    """The three tables of the small town without some of its streets."""
    streets = [street for street in STREETS if street not in shut]
    links = [f"{a}-{b},{a},{b},100,{int((b, a) not in streets)}" for a, b in streets]
    turns = [
        f"{one[0]}-{one[1]},{eighths(one, other)},{other[0]}-{other[1]}"
        for one in streets
        for other in streets
        if one[1] == other[0]
    ]
    names = [[f"{a}-{b}" for a, b in pairwise(trip)] for trip in trips]
    rows = [f"{number},{trip[0]},{trip[-1]},{' '.join(trip)}" for number, trip in enumerate(names)]
    for name, header, table in (
        ("links", "link,from_node,to_node,length_m,oneway", links),
        ("turns", "link,action,next_link", turns),
        ("trips", "trip,origin,destination,links", rows),
    ):
        (folder / f"{name}.csv").write_text("\n".join([header, *table]) + "\n")
    return folder


TRIPS = [
    *[[0, 1, 2, 5, 8, 7, 6], [2, 1, 0, 3, 6, 7, 8], [5, 4, 3, 6, 7, 8], [3, 4, 5, 8, 7, 6]] * 5,
    *[[6, 7, 4, 1, 0], [8, 7, 4, 1, 2], [3, 4, 1], [5, 4, 1]] * 5,
]
"""Who is at node 1 or 4 and wants to 7 takes a street at the side, which nobody has a reason to drive back."""


@pytest.fixture
def city(script, tmp_path):
    """The small town as the learner knows it, and all trips."""
    return script("drivers").read_town(write_network(tmp_path, SHUT, TRIPS))


def test_both_directions_of_each_street_come_back_with_their_turns(script, tmp_path):
    """What was taken out of a network is put in again as it was: links, turns, and where they lead."""
    two_way = script("two_way")

    def described(roads):
        nodes = np.unique([label.split("-")[0] for label in roads.labels if " " not in label])
        ends = list(zip(nodes[roads.begins], nodes[roads.ends], strict=True))
        return {(ends[a], ends[b], int(way)) for (a, b), way in zip(roads.turns, roads.directions, strict=True)}

    read = script("drivers").read_roads
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder, shut in ((whole, set()), (cut, SHUT)):
        folder.mkdir()
        write_network(folder, shut)
    found = two_way.two_way(read(cut / "links.csv", cut / "turns.csv"))
    assert described(found.roads) == described(read(whole / "links.csv", whole / "turns.csv"))
    assert [found.roads.labels[link] for link in np.flatnonzero(found.added)] == ["4-1 back", "7-4 back"]


def test_a_street_that_says_it_is_one_way_but_leads_back_is_refused(script, tmp_path):
    links = write_network(tmp_path, SHUT) / "links.csv"
    links.write_text(links.read_text().replace("0-1,0,1,100,0", "0-1,0,1,100,1"))
    with pytest.raises(InputError, match="field 'oneway': link 0-1: expected 1 if no link"):
        script("drivers").read_town(tmp_path)


@pytest.mark.parametrize(("times", "many"), [(1, 1_000_000), (100, 1)])
def test_streets_that_drivers_drive_around_are_found(script, city, times, many):
    """From few trips, and from above from many."""
    shanghai = script("shanghai")
    town, trips = city[0], city[1] * times
    record = shanghai.score(town, trips, trips[:4], shanghai.Settings(many=many))
    chances, unused = np.asarray(record["rankings"]["P(closed)"]), town.uses(trips) == 0
    closed = town.network.added
    assert unused[closed].all()
    assert (unused & ~closed).any()
    assert chances[closed].min() > chances[unused & ~closed].max()
    assert record["P(closed)"] == pytest.approx(1.0)
    assert record["share"] == pytest.approx(closed.sum() / unused.sum())
    assert record["gain"] == pytest.approx(1 - record["share"])
    assert record["likely"] == (chances[unused] > 0.5).sum()
    assert record["converged"]
    # the four trips show nothing that the others do not
    assert record["later"] is None
    assert -np.log(4) < record["log-likelihood"] < 0


def test_draws_are_different_and_leave_others_out(script):
    draws = script("shanghai").draws
    trips = [np.array([number, number + 1]) for number in range(20)]
    found = list(draws(trips, 5, 2, 4))
    assert [seed for seed, _, _ in found] == [0, 1]
    for _, drawn, others in found:
        first = {int(trip[0]) for trip in (*drawn, *others)}
        assert (len(drawn), len(others), len(first)) == (5, 4, 9)
    assert {int(trip[0]) for trip in found[0][1]} != {int(trip[0]) for trip in found[1][1]}
    (everything,) = draws(trips, 50, 2, 4)
    assert (len(everything[1]), len(everything[2])) == (20, 0)


def test_later_trips_tell_a_good_ranking_from_a_bad_one(script):
    later = script("shanghai").later
    chances, uses = np.array([0.9, 0.8, 0.1, 0.2]), np.array([0, 0, 3, 1])
    assert later(chances, uses) == 1.0
    assert later(-chances, uses) == 0.0
    assert later(chances, np.zeros(4)) is None


def test_the_town_is_laid_out_as_it_is(script, city):
    """Distances between the places of nodes, for the map is known up to a rotation."""
    town, _ = city
    places = script("shanghai_picture").layout(town.roads)
    true = 100 * np.array(PLACES)
    split_by_person = [np.linalg.norm(each[:, None] - each, axis=-1) for each in (places, true)]
    assert split_by_person[0] == pytest.approx(split_by_person[1], abs=1.0)
    # no mirror image
    turn = np.linalg.lstsq(true - true.mean(axis=0), places - places.mean(axis=0), rcond=None)[0]
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=0.05)


def test_a_road_network_without_its_tables_is_named(script, tmp_path):
    read = script("drivers").read_town
    write_network(tmp_path, SHUT, TRIPS)
    for name in ("trips.csv", "turns.csv", "links.csv"):
        (tmp_path / name).unlink()
        with pytest.raises(InputError, match=name):
            read(tmp_path)
