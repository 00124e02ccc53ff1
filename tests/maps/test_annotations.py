"""Walks with a column of persons, and walks without goals."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest

from helpers.office import BLANK, OFFICE, WALL, call, simulated, summary, write_office, written
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.io.maps import write_map
from sidestep.io.walks import table_from_walks, write_walks
from sidestep.maps.annotations import WalkAnnotations
from sidestep.maps.config import NEAR_OPTIMAL, SOFT, Agents, BehaviorConfig, MapConfig
from sidestep.maps.goal_candidates import GoalCandidates
from sidestep.maps.learn import learn_map, with_annotations
from sidestep.tabular.demonstrations import Trajectory

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    folder = write_office(tmp_path_factory.mktemp("office"))
    write_walks(folder / "walks.csv", simulated(walks=10, goals=3))
    return folder


def learn(office, walks, out, *options):
    return call("learn", walks, "--map", office / "blank.yaml", "--out", out, *options)


def test_learn_with_goal_candidates_infers_goals(office, tmp_path):
    """Candidates are the three goals and another cell; walks stop a step before their goals."""
    walks = simulated(walks=40, goals=3, seed=2)
    lengths = np.diff(walks.offsets) - 1
    walks = walks.select(lengths > 1)
    last = np.isin(np.arange(len(walks.steps)), walks.offsets[1:] - 1)
    pyarrow.csv.write_csv(
        table_from_walks(walks).filter(pa.array(~last)).drop_columns(["goal_x", "goal_y"]), tmp_path / "walks.csv"
    )
    goals, goal_of_walk = np.unique(walks.goals, axis=0, return_inverse=True)
    other = OFFICE.centers(np.setdiff1d(np.flatnonzero(~WALL), OFFICE.states(goals))[:1])
    rows = np.concatenate([goals, other])
    np.savetxt(tmp_path / "goals.csv", rows, delimiter=",", header="goal_x,goal_y", comments="")

    assert learn(office, tmp_path / "walks.csv", tmp_path / "out", "--goal-candidates", tmp_path / "goals.csv") == 0
    result = summary(tmp_path / "out")["behavior"]["goals"]
    assert result["converged"]
    assert result["candidates"] == 4
    assert result["probabilities"][3] < 0.1
    assert (np.diff(result["evidence"]) >= -1e-6).all()
    table = pyarrow.csv.read_csv(tmp_path / "out" / "posterior.csv")
    posterior = table["probability"].to_numpy().reshape(-1, 4)
    np.testing.assert_allclose(posterior.sum(axis=1), 1, atol=1e-9)
    correct = np.mean(posterior.argmax(axis=1) == goal_of_walk.ravel())
    assert correct > 0.6  # some walks have a move or two, and several goals lie on one path
    assert abs(correct - posterior.max(axis=1).mean()) < 0.2  # the posterior is calibrated


def test_learn_map_with_goal_candidates_reports_every_fit():
    walks, reports = simulated(walks=6, goals=3), []
    annotations = WalkAnnotations(goal_candidates=GoalCandidates(np.unique(walks.goals, axis=0)))
    learned = learn_map(BLANK, walks, annotations=annotations, callback=reports.append)
    fits = len(learned.summary()["behavior"]["goals"]["evidence"]) - 1
    assert [progress.iteration for progress in reports].count(0) == fits > 1


def test_learn_with_a_person_column_estimates_beta_of_each_person(office, tmp_path):
    walks = {
        "Ada": simulated(walks=20, goals=3, beta=30.0, seed=1),
        "Bo": simulated(walks=20, goals=3, beta=3.0, seed=2),
    }
    tables = []
    for name, own in walks.items():
        labels = pa.array([f"{name} {label}" for label in own.labels])
        table = table_from_walks(replace(own, labels=labels.to_pylist()))
        tables.append(table.append_column("person", pa.array([name] * len(table))))
    pyarrow.csv.write_csv(pa.concat_tables(tables, promote_options="default"), tmp_path / "walks.csv")
    assert learn(office, tmp_path / "walks.csv", tmp_path / "out", "--person-column", "person") == 0
    result = summary(tmp_path / "out")
    persons = result["behavior"]["persons"]
    assert list(persons) == ["Ada", "Bo"]
    assert persons["Ada"] > 2 * persons["Bo"]
    behavior = result["settings"]["behavior"]
    assert behavior["learn"] == ["beta"]
    assert Agents(*(behavior[name] for name in Agents._fields)) == SOFT


@pytest.mark.parametrize(("annotations", "agents"), [
    (WalkAnnotations(), NEAR_OPTIMAL),
    (WalkAnnotations("person"), SOFT),
    (WalkAnnotations(goal_candidates=GoalCandidates(np.zeros((2, 2)))), SOFT),
])  # fmt: skip
def test_with_annotations_has_the_numbers_of_the_agents(annotations, agents):
    config = with_annotations(MapConfig(), annotations)
    assert Agents(*(getattr(config.behavior, name) for name in Agents._fields)) == agents
    assert with_annotations(config, annotations) == config
    own = MapConfig(behavior=BehaviorConfig(beta=3.0, lapse=0.1))
    assert with_annotations(own, annotations).agents == (3.0, 0.1, 1.0)


CANDIDATES = {
    "outside.csv": "-0.75,2.25\n9,9\n",
    "twice.csv": "-0.75,2.25\n-0.7,2.3\n",
    "one.csv": "-0.75,2.25\n",
    "two.csv": "-0.75,2.25\n0.75,2.25\n",
    "wall.csv": "-0.75,2.25\n0.25,4.25\n",
    "corner.csv": "-0.75,2.25\n-0.75,4.25\n",
}


@pytest.mark.parametrize(("options", "expected"), [
    ("--person-column person", "walks.csv, field 'person': the column is missing"),
    ("--person-column step", "walks.csv, field 'step': expected a column of metadata"),
    ("--goal-candidates none.csv", "none.csv"),
    ("--goal-candidates two.csv --person-column person", "field 'person_column'"),
    ("--goal-candidates two.csv --tempering 0.5", "field 'tempering'"),
    ("--goal-candidates two.csv --learn lapse", "field 'learn'"),
    ("--goal-candidates outside.csv", "outside.csv, row 2, field 'goal_x, goal_y'"),
    ("--goal-candidates twice.csv", "twice.csv, row 2"),
    ("--goal-candidates one.csv", "one.csv: expected at least 2"),
    ("--goal-candidates wall.csv --map half.yaml", "wall.csv, row 2"),
    ("--goal-candidates corner.csv --map corner.yaml", "row 2, field 'goal_x, goal_y': expected a position that every"),
])  # fmt: skip
def test_learn_with_invalid_annotations_names_file_row_and_field(
    office, tmp_path, capsys, monkeypatch, options, expected
):
    monkeypatch.chdir(office)
    for name, rows in CANDIDATES.items():
        (office / name).write_text("goal_x,goal_y\n" + rows)
    known = np.full((5, 5), 0.5)
    known[1, :2] = known[0, 2] = 1.0  # separates the upper left corner
    known[0, :2] = 0.0
    write_map("corner.yaml", known, OFFICE)
    write_walks("walk.csv", walks_from_trajectories([Trajectory(np.array([20, 21]), np.array([3]), 0)], [21], OFFICE))
    walks = "walk.csv" if "corner" in options else "walks.csv"
    assert learn(office, walks, tmp_path / "out", *options.split()) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert expected in line
    assert written(tmp_path / "out") == []
