"""`sidestep learn --person` and `--candidates`: who walked, and walks that do not name their goals."""

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest

from helpers.office import call, summary, write_office, written
from sidestep.io.maps import read_map, write_map
from sidestep.io.walks import read_walks
from sidestep.maps.annotations import WalkAnnotations
from sidestep.maps.goal_candidates import read_goal_candidates
from sidestep.maps.learn import learn_map


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    return write_office(tmp_path_factory.mktemp("office"))


def walked(office, name, *options):
    file = office / f"{name}.csv"
    assert call("simulate", office / "true.yaml", "--out", file, "--goals", 3, *options) == 0
    return pyarrow.csv.read_csv(file)


def learn(office, walks, out, *options):
    return call("learn", walks, "--map", office / "blank.yaml", "--out", out, *options)


def test_goals_that_walks_do_not_name_are_found_among_candidates(office, tmp_path):
    """The walks' own three goals and one that elsewhere had; each walk stops a step before its goal."""
    table = walked(office, "named", "--walks", 40, "--seed", 2)
    goals = np.stack([table["goal_x"], table["goal_y"]], axis=1)
    arrived = np.isclose(np.stack([table["x"], table["y"]], axis=1), goals).all(axis=1)
    left = table.filter(pa.array(~arrived)).drop_columns(["goal_x", "goal_y"])
    _, lengths = np.unique(left["walk"], return_counts=True)
    left = left.filter(pa.array(np.isin(left["walk"], np.flatnonzero(lengths > 1))))
    pyarrow.csv.write_csv(left, tmp_path / "walks.csv")
    own = np.unique(goals, axis=0)
    grid = read_map(office / "true.yaml")
    elsewhere = grid.centers(np.setdiff1d(np.flatnonzero(grid.known.ravel() == 0), grid.states(own))[:1])
    columns = dict(zip(("goal_x", "goal_y"), np.concatenate([own, elsewhere]).T, strict=True))
    pyarrow.csv.write_csv(pa.table(columns), tmp_path / "goals.csv")

    assert learn(office, tmp_path / "walks.csv", tmp_path / "out", "--goal-candidates", tmp_path / "goals.csv") == 0
    told = summary(tmp_path / "out")["behavior"]["goals"]
    assert told["converged"]
    assert told["candidates"] == 4
    assert told["probabilities"][3] < 0.1  # elsewhere had it
    assert all(later >= before - 1e-6 for before, later in zip(told["evidence"], told["evidence"][1:], strict=False))
    found = pyarrow.csv.read_csv(tmp_path / "out" / "posterior.csv")
    chances = found["probability"].to_numpy().reshape(-1, 4)
    np.testing.assert_allclose(chances.sum(axis=1), 1, atol=1e-9)
    true = dict(zip(table["walk"].to_pylist(), goals.tolist(), strict=True))
    walks = found["walk"].to_numpy().reshape(-1, 4)[:, 0]
    right = [int(np.argmin(np.abs(own - true[walk]).sum(axis=1))) for walk in walks.tolist()]
    share = np.mean(chances.argmax(axis=1) == right)
    assert share > 0.6  # some walks have a move or two, and one way leads to several goals
    assert abs(share - chances.max(axis=1).mean()) < 0.2  # and the posterior says how sure one can be


def test_a_fit_is_reported_in_every_round(office, tmp_path):
    places = tmp_path / "goals.csv"
    own = walked(office, "reported", "--walks", 6).select(["goal_x", "goal_y"]).group_by(["goal_x", "goal_y"])
    pyarrow.csv.write_csv(own.aggregate([]), places)
    told = []
    annotations = WalkAnnotations(goal_candidates=read_goal_candidates(places))
    walks, grid = read_walks(office / "reported.csv"), read_map(office / "blank.yaml")
    learned = learn_map(grid, walks, annotations=annotations, callback=told.append)
    rounds = len(learned.summary()["behavior"]["goals"]["evidence"]) - 1
    assert [progress.iteration for progress in told].count(0) == rounds > 1


def test_who_is_sharper_is_told_by_name(office, tmp_path):
    sharp = walked(office, "sharp", "--walks", 40, "--beta", 30, "--seed", 1)
    vague = walked(office, "vague", "--walks", 40, "--beta", 3, "--seed", 2)
    vague = vague.set_column(vague.column_names.index("walk"), "walk", pa.array(vague["walk"].to_numpy() + 100))
    tables = [
        table.append_column("who", pa.array([name] * len(table))) for table, name in ((sharp, "Ada"), (vague, "Bo"))
    ]
    pyarrow.csv.write_csv(pa.concat_tables(tables), tmp_path / "walks.csv")
    assert learn(office, tmp_path / "walks.csv", tmp_path / "out", "--person-column", "who") == 0
    persons = summary(tmp_path / "out")["behavior"]["persons"]
    assert list(persons) == ["Ada", "Bo"]
    assert persons["Ada"] > 2 * persons["Bo"]
    assert summary(tmp_path / "out")["settings"]["behavior"]["learn"] == ["beta"]


def test_what_cannot_be_is_refused(office, tmp_path, capsys):
    """One line that names file, row and field, and nothing written."""
    walked(office, "walks", "--walks", 10)
    walks = office / "walks.csv"
    for name, rows in (("outside", "-0.75,2.25\n9,9\n"), ("twice", "-0.75,2.25\n-0.7,2.3\n"), ("one", "-0.75,2.25\n")):
        (tmp_path / f"{name}.csv").write_text("goal_x,goal_y\n" + rows)
    (tmp_path / "wall.csv").write_text("goal_x,goal_y\n-0.75,2.25\n0.25,4.25\n")
    (tmp_path / "two.csv").write_text("goal_x,goal_y\n-0.75,2.25\n0.75,2.25\n")
    for options, expected in (
        (("--person-column", "who"), "walks.csv, field 'who': the column is missing"),
        (("--goal-candidates", tmp_path / "none.csv"), "none.csv"),
        (("--person-column", "step"), "walks.csv, field 'step': expected a column of metadata"),
        (("--select-behavior", "--tempering", 0.5), "field 'tempering'"),
        (("--goal-candidates", walks, "--person-column", "who"), "field 'person_column'"),
        (("--goal-candidates", walks, "--select-behavior"), "field 'select_behavior'"),
        (("--goal-candidates", tmp_path / "two.csv", "--learn", "lapse"), "field 'learn'"),
        (("--goal-candidates", tmp_path / "outside.csv"), "outside.csv, row 2, field 'goal_x, goal_y'"),
        (("--goal-candidates", tmp_path / "twice.csv"), "twice.csv, row 2"),
        (("--goal-candidates", tmp_path / "one.csv"), "one.csv: expected at least 2"),
    ):
        assert learn(office, walks, tmp_path / "out", *options) == 1, expected
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert expected in lines[0]
        assert written(tmp_path / "out") == []
    (tmp_path / "behind.csv").write_text("goal_x,goal_y\n-0.75,2.25\n-0.75,4.25\n")
    known = np.full((5, 5), 0.5)
    known[1, :2] = known[0, 2] = 1.0  # the upper left corner is walled off
    known[0, :2] = 0.0
    write_map(tmp_path / "corner.yaml", known, read_map(office / "blank.yaml"))
    walk = tmp_path / "walk.csv"
    walk.write_text("walk,step,x,y\n0,0,-0.75,2.25\n0,1,-0.25,2.25\n")
    arguments = ("learn", walk, "--map", tmp_path / "corner.yaml", "--out", tmp_path / "out")
    assert call(*arguments, "--goal-candidates", tmp_path / "behind.csv") == 1
    assert (
        "behind.csv, row 2, field 'goal_x, goal_y': expected a position that every walk can reach"
        in capsys.readouterr().err
    )
    half = ("learn", walks, "--map", office / "half.yaml", "--out", tmp_path / "out")
    assert call(*half, "--goal-candidates", tmp_path / "wall.csv") == 1
    assert "wall.csv, row 2" in capsys.readouterr().err
