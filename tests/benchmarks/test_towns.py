"""Mazes and towns so small that what is hidden is plain to see."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from benchmarks.__main__ import main

from benchmarks import changed, people, street_network, towns
from sidestep.errors import InputError
from sidestep.io.maps import write_map
from sidestep.tabular.grid import Grid

# ---------------------------------------------------------------------------------------------------- buildings

BUILDING = np.zeros((9, 13))
BUILDING[3:6, 5:8] = 1


@pytest.fixture
def data(tmp_path):
    """A folder with one town: a building in the middle, which all drives from west to east go around."""
    folder = tmp_path / "magellan" / "town_A"
    folder.mkdir(parents=True)
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


def read(data):
    """The town in the folder."""
    return people.read_mazes(data / "magellan", "town_*", "drives.csv", connectivity=8)[0]


METHODS = ("behavior", "visits", "transitions")


@pytest.mark.slow
def test_learn_by_a_building_that_all_drive_around_is_found(data):
    config = changed(towns.DRIVES, ["beta=3"])
    results = {record["method"]: (record, result) for record, result, _ in people.learn_by(METHODS, read(data), config)}
    record, result = results["behavior"]
    blocked = result.ranking
    # cells that no drive visits either, but which are in no one's way
    assert blocked[4, 5:8].min() > blocked[[0, 0, -1, -1], [0, -1, 0, -1]].max() + 0.02
    assert record["moves"] == 8 * 10
    assert record["converged"]
    assert record["behavior.beta"] == 3
    # neither of the others can tell the building from what else was not visited
    precision = {name: own["average_precision"] for name, (own, _) in results.items()}
    assert precision.pop("behavior") > max(precision.values()) + 0.2


def test_learn_by_moves_into_buildings_are_counted_and_survived(data):
    with (data / "magellan" / "town_A" / "drives.csv").open("a") as file:
        # straight through the building's three cells
        file.write("8,0,0.15,0.45,1.15,0.45\n8,1,1.15,0.45,1.15,0.45\n")
    ((_, result, demos),) = people.learn_by(["behavior"], read(data), towns.DRIVES)
    assert towns.into_buildings(demos, read(data).truth) == 3
    assert np.isfinite(result.ranking).all()
    assert result.ranking[4, 5:8].max() < 0.2


def test_means_average_over_the_draws_of_a_town_then_over_towns():
    scores = [("a", 0.2, None), ("a", 0.4, None), ("b", 0.9, None)]
    records = [{"walks": 3, "method": "visits", "problem": p, "auc": a, "auc_relevant": r} for p, a, r in scores]
    (row,) = people.means(records, {"AUC": "auc .3f", "relevant": "auc_relevant .3f"}, "problem")
    assert row == {"walks": 3, "method": "visits", "auc": pytest.approx(0.6), "auc_relevant": None}


@pytest.mark.slow
def test_main_buildings_writes_records_and_a_picture(data, tmp_path, capsys):
    file, picture = tmp_path / "records.json", tmp_path / "town.png"
    options = ["--what", "buildings", "--data", str(data / "magellan"), "--counts", "4", "8", "--seeds", "2"]
    settings = ["--set", "max_iterations=3", "--json", str(file), "--picture", str(picture)]
    assert main(["towns", *options, *settings]) == 0
    written = json.loads(file.read_text())
    # two draws of 4, and all 8 once
    drawn = [(r["walks"], r["drawn"], r["draw"]) for r in written["records"] if r["method"] == "behavior"]
    assert drawn == [(4, 4, 0), (4, 4, 1), (8, 8, 0)]
    assert written["records"][0]["fit.max_iterations"] == 3
    assert picture.read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr()
    assert "into buildings" in printed.out
    assert "did not converge" in printed.err


def test_read_mazes_names_what_is_missing(data, tmp_path, capsys):
    assert main(["people", "--data", str(tmp_path / "nowhere")]) == 1
    assert "nowhere: expected folders maze_*" in capsys.readouterr().err
    for name in ("drives.csv", "truth.yaml"):
        (data / "magellan" / "town_A" / name).unlink()
        with pytest.raises(InputError, match=name):
            read(data)


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
"""Drivers from node 1 or 4 to 7 take a street at the side; no one has a reason to drive it back."""


@pytest.fixture
def city(tmp_path):
    """The small town as the learner knows it, and all trips."""
    return street_network.read_town(write_network(tmp_path, SHUT, TRIPS))


def test_both_ways_restores_links_and_turns(tmp_path):
    """What was taken out of a network is put in again as it was: links, turns, and where they lead."""

    def described(roads):
        nodes = np.unique([label.split("-")[0] for label in roads.labels if " " not in label])
        ends = list(zip(nodes[roads.begins], nodes[roads.ends], strict=True))
        return {(ends[a], ends[b], int(way)) for (a, b), way in zip(roads.turns, roads.directions, strict=True)}

    read = street_network.read_roads
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder, shut in ((whole, set()), (cut, SHUT)):
        folder.mkdir()
        write_network(folder, shut)
    results = street_network.both_ways(read(cut / "links.csv", cut / "turns.csv"))
    assert described(results) == described(read(whole / "links.csv", whole / "turns.csv"))
    assert results.labels[-2:] == ["4-1 back", "7-4 back"]


def test_both_ways_refuses_a_one_way_street_with_a_reverse(tmp_path):
    links = write_network(tmp_path, SHUT) / "links.csv"
    links.write_text(links.read_text().replace("0-1,0,1,100,0", "0-1,0,1,100,1"))
    with pytest.raises(InputError, match="field 'oneway': link 0-1: expected 1 if no link"):
        street_network.read_town(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("times", "many"), [(1, 1_000_000), (100, 1)])
def test_score_streets_that_drivers_avoid_are_found(city, times, many):
    """From few trips, and from above from many."""
    town, trips = city[0], city[1] * times
    record = towns.score(town, trips, trips[:4], towns.StreetConfig(many=many))
    chances, unused = np.asarray(record["rankings"]["P(closed)"]), town.uses(trips) == 0
    closed = town.added
    assert unused[closed].all()
    assert (unused & ~closed).any()
    assert chances[closed].min() > chances[unused & ~closed].max()
    assert record["P(closed)"] == pytest.approx(1.0)
    assert record["closed_fraction"] == pytest.approx(closed.sum() / unused.sum())
    assert record["gain"] == pytest.approx(1 - record["closed_fraction"])
    assert record["likely"] == (chances[unused] > 0.5).sum()
    assert record["converged"]
    # the four trips show nothing that the others do not
    assert record["later"] is None
    assert -np.log(4) < record["log_likelihood"] < 0


def test_draw_trips_are_different_and_leave_others_out():
    draws = towns.draw_trips
    trips = [np.array([number, number + 1]) for number in range(20)]
    results = list(draws(trips, 5, 2, 4))
    assert [seed for seed, _, _ in results] == [0, 1]
    for _, drawn, others in results:
        first = {int(trip[0]) for trip in (*drawn, *others)}
        assert (len(drawn), len(others), len(first)) == (5, 4, 9)
    assert {int(trip[0]) for trip in results[0][1]} != {int(trip[0]) for trip in results[1][1]}
    (everything,) = draws(trips, 50, 2, 4)
    assert (len(everything[1]), len(everything[2])) == (20, 0)


def test_later_tells_a_good_ranking_from_a_bad_one():
    later = towns.later
    chances, uses = np.array([0.9, 0.8, 0.1, 0.2]), np.array([0, 0, 3, 1])
    assert later(chances, uses) == 1.0
    assert later(-chances, uses) == 0.0
    assert later(chances, np.zeros(4)) is None


def test_layout_has_the_true_distances(city):
    """Distances between the places of nodes, for the map is known up to a rotation."""
    town, _ = city
    places = street_network.layout(town.roads)
    true = 100 * np.array(PLACES)
    distances = [np.linalg.norm(each[:, None] - each, axis=-1) for each in (places, true)]
    assert distances[0] == pytest.approx(distances[1], abs=1.0)
    # no mirror image
    turn = np.linalg.lstsq(true - true.mean(axis=0), places - places.mean(axis=0), rcond=None)[0]
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=0.05)


def test_read_town_names_missing_tables(tmp_path):
    write_network(tmp_path, SHUT, TRIPS)
    for name in ("trips.csv", "turns.csv", "links.csv"):
        (tmp_path / name).unlink()
        with pytest.raises(InputError, match=name):
            street_network.read_town(tmp_path)
