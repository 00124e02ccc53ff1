"""From a map to walks, from walks to a learned map, and from that to scores and paths, by the command line alone."""

import json
from contextlib import contextmanager
from dataclasses import asdict

import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
import yaml
from PIL import Image

from helpers.office import WALL, call, summary, write_office, written
from sidestep.cli import display
from sidestep.inference.checkpoints import Saver
from sidestep.io.maps import read_map
from sidestep.io.walks import read_walks, write_walks
from sidestep.maps.config import MapConfig
from sidestep.maps.learned_map import load_map
from sidestep.tabular.grid import Cell

SCORES = (
    "auc", "average_precision", "auc_relevant", "mean_obstacle", "mean_free", "max_probability", "legal_fraction",
    "excess_length",
)  # fmt: skip
LEARNED = ["blocked.npy", "learned.png", "map.pgm", "map.yaml", "summary.json", "visited.npy"]


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """The office's maps and `walks.csv`: 80 walks to 5 goals."""
    folder = write_office(tmp_path_factory.mktemp("office"))
    arguments = ("simulate", folder / "true.yaml", "--out", folder / "walks.csv", "--walks", 80, "--goals", 5)
    assert call(*arguments) == 0
    return folder


@pytest.fixture(scope="module")
def learned(office):
    """The map learned from them with half of it known."""
    assert call("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", office / "learned") == 0
    return office / "learned"


def test_simulated_walks_avoid_the_walls(office):
    table = pyarrow.csv.read_csv(office / "walks.csv")
    assert set(table.column_names) == {"walk", "step", "x", "y", "goal_x", "goal_y"}
    x, y = table["x"].to_numpy(), table["y"].to_numpy()
    grid = read_map(office / "true.yaml")
    states = grid.states(np.stack([x, y], axis=1))
    assert not WALL.reshape(-1)[states].any()
    told = json.loads((office / "walks.summary.json").read_text())
    assert told["moves"] == len(table) - 80
    assert len(told["goals"]) == 5
    assert told["settings"]["walks"] == len(set(table["walk"].to_pylist())) == 80


def test_learning_writes_a_map(learned):
    assert written(learned) == LEARNED
    blocked = np.load(learned / "blocked.npy")
    assert (blocked.shape, blocked.dtype) == ((5, 5), np.float64)
    assert blocked[0, 2] == 1  # rows top first: the end of the wall that the map knew, and the cell that it knew free
    assert blocked[4, 0] == 0
    assert ((blocked > 0) & (blocked < 1)).sum() == 23
    assert blocked[1:4, 2].min() > blocked[~WALL].max()
    image = np.asarray(Image.open(learned / "map.pgm"))
    np.testing.assert_array_equal(image, np.rint(255 * (1 - blocked)))
    settings = yaml.safe_load((learned / "map.yaml").read_text())
    assert (settings["mode"], settings["resolution"], settings["origin"]) == ("scale", 0.5, [-1.0, 2.0, 0.0])
    with Image.open(learned / "learned.png") as picture:
        assert min(picture.size) > 100


def test_a_minari_dataset_teaches_what_its_table_does(office, learned, datasets, capsys):
    write_walks("minari:office/walks-v0", read_walks(office / "walks.csv"))
    arguments = ("--map", office / "half.yaml", "--out", office / "from-minari")
    assert call("learn", "minari:office/walks-v0", *arguments) == 0
    np.testing.assert_array_equal(np.load(office / "from-minari" / "blocked.npy"), np.load(learned / "blocked.npy"))
    capsys.readouterr()
    assert call("learn", "minari:office/walks-v1", *arguments) == 1
    assert "office/walks-v1: there is no such dataset here" in capsys.readouterr().err
    assert call("simulate", office / "true.yaml", "--out", "minari:office/walks-v2", "--walks", 4) == 1
    assert not (datasets / "office" / "walks-v2").exists()


def test_learning_says_how_it_went(office, learned):
    told = summary(learned)
    assert told["command"] == "learn"
    assert told["files"] == {"walks": str(office / "walks.csv"), "map": str(office / "half.yaml")}
    assert told["data"]["walks"] == 80
    assert told["data"]["goals"] == 5
    assert told["data"]["unknown_cells"] == 23
    parts = [told[name] for name in ("log_likelihood_actions", "log_likelihood_transitions", "log_prior")]
    assert told["objective"] == pytest.approx(sum(parts), rel=1e-12)
    assert max(parts) < 0
    assert told["converged"]
    assert told["message"].startswith("converged")
    assert [task["converged"] for task in told["tasks"]] == [True] * 5
    assert told["seconds"] > 0
    assert told["peak_memory_bytes"] > 10_000_000
    assert told["connectivity"] == 4
    assert told["settings"] == json.loads(json.dumps(asdict(MapConfig())))


def test_evaluating_adds_the_scores_to_the_summary(office, learned, tmp_path, capsys):
    before = summary(learned)
    assert call("evaluate", learned, "--true-map", office / "true.yaml", "--out", tmp_path / "scores") == 0
    assert summary(learned) == before
    split_by_person = summary(tmp_path / "scores")
    assert call("evaluate", learned, "--true-map", office / "true.yaml") == 0
    together = summary(learned)
    assert {key: together[key] for key in before} == before
    for key in SCORES:
        assert split_by_person[key] == together[key]
    assert set(together["planned_at_most"]) == {"starts", "goals", "executed"}
    assert together["auc"] == 1
    assert together["legal_fraction"] == 1
    assert together["mean_obstacle"] > 0.5 > 0.2 > together["mean_free"]
    assert "1.000" in capsys.readouterr().out
    assert written(learned) == LEARNED


def test_a_planned_path_is_legal_and_written(office, learned, capsys):
    assert call("plan", learned, "--start", "-0.75,4.2", "--goal", "1.25,4.25") == 0
    table = pyarrow.csv.read_csv(learned / "plan" / "path.csv")
    assert table.column_names[:3] == ["step", "x", "y"]
    assert table["step"].to_pylist() == list(range(13))  # down the near side, along the bottom, up the far side
    points = np.stack([table["x"].to_numpy(), table["y"].to_numpy()], axis=1)
    np.testing.assert_allclose(points[[0, -1]], [[-0.75, 4.25], [1.25, 4.25]])
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.5)
    states = read_map(office / "true.yaml").states(points)
    assert not WALL.reshape(-1)[states].any()
    told = summary(learned / "plan")
    assert told["moves"] == 12
    assert told["length_metres"] == pytest.approx(6)
    chances = np.load(learned / "blocked.npy").reshape(-1)[states]
    assert told["max_probability_blocked"] == pytest.approx(chances.max())
    assert told["probability_free"] == pytest.approx(np.prod(1 - chances))
    with Image.open(learned / "plan" / "path.png") as picture:
        assert min(picture.size) > 100
    assert "12 moves, 6 m" in capsys.readouterr().out


def test_a_path_to_where_one_stands_has_no_moves(learned, tmp_path):
    assert call("plan", learned, "--start", "-0.75,4.25", "--goal", "-0.75,4.25", "--out", tmp_path) == 0
    assert pyarrow.csv.read_csv(tmp_path / "path.csv").num_rows == 1
    assert summary(tmp_path)["moves"] == 0


def test_eight_directions_parquet_and_the_paper_s_gradient(office, tmp_path):
    """The other options, through the whole pipeline."""
    walks, out = tmp_path / "walks.parquet", tmp_path / "learned"
    simulate = ("simulate", office / "true.yaml", "--out", walks, "--walks", 40, "--connectivity", 8, "--beta", 40)
    assert call(*simulate, "--seed", 3) == 0
    assert "failed_x" in pyarrow.parquet.read_table(walks).column_names
    options = ("--connectivity", 8, "--gradient", "fixed-policy", "--prior-mean", -2, "--prior-variance", 2)
    assert call("learn", walks, "--map", office / "blank.yaml", "--out", out, *options) == 0
    told = summary(out)
    assert told["settings"]["fit"]["gradient"] == "fixed_policy"
    assert told["connectivity"] == 8
    assert load_map(out).grid.connectivity == 8
    assert call("evaluate", out, "--true-map", office / "true.yaml") == 0
    assert summary(out)["auc"] > 0.9
    assert call("plan", out, "--start", "-0.75,2.25", "--goal", "0.25,3.25") == 0
    assert summary(out / "plan")["moves"] >= 2


@pytest.mark.parametrize("options", [
    ("--discount", 1, "--step-cost", 1, "--beta", 3),
    ("--backup", "mellowmax", "--horizon", 12),
    ("--terms", "transitions", "--wall-prior", 0),
])  # fmt: skip
def test_other_people_and_rewards(office, tmp_path, options):
    assert call("learn", office / "walks.csv", "--map", office / "blank.yaml", "--out", tmp_path, *options) == 0
    told, blocked = summary(tmp_path), np.load(tmp_path / "blocked.npy")
    assert told["converged"]
    if "transitions" in options:
        assert told["log_likelihood_actions"] == 0
        assert blocked.max() <= 1 / (1 + np.exp(-told["settings"]["prior"]["mean"])) + 1e-12
    else:
        assert blocked[WALL].min() > blocked[~WALL].max()


def test_a_sample_is_drawn_by_the_seed(office, tmp_path):
    learn = ("learn", office / "walks.csv", "--map", office / "blank.yaml", "--max-walks", 12, "--terms", "transitions")
    for name, seed in (("one", 1), ("same", 1), ("other", 2)):
        assert call(*learn, "--seed", seed, "--out", tmp_path / name) == 0
        assert summary(tmp_path / name)["data"]["walks"] == 12
    one, same, other = (np.load(tmp_path / name / "blocked.npy") for name in ("one", "same", "other"))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_simulation_repeats_by_seed(office, tmp_path):
    for name, seed in (("one", 1), ("same", 1), ("other", 2)):
        walks = tmp_path / f"{name}.csv"
        assert call("simulate", office / "true.yaml", "--out", walks, "--walks", 10, "--seed", seed) == 0
    one, same, other = ((tmp_path / f"{name}.csv").read_text() for name in ("one", "same", "other"))
    assert one == same != other


def test_an_interrupted_run_goes_on(office, learned, tmp_path, monkeypatch, capsys):
    learn = ("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", tmp_path)
    iterations = []

    @contextmanager
    def interrupting(_):
        def stop(progress):
            if progress.iteration == 4:
                raise KeyboardInterrupt

        yield stop, print

    @contextmanager
    def recording(_):
        yield (lambda progress: iterations.append(progress.iteration)), print

    monkeypatch.setattr(Saver, "pause", lambda *_: 0.0)
    monkeypatch.setattr(display, "fit_progress", interrupting)
    assert call(*learn) == 1
    assert written(tmp_path) == ["fit.checkpoint"]
    told = capsys.readouterr()
    assert "--resume" in told.err
    assert "Traceback" not in told.err

    monkeypatch.setattr(display, "fit_progress", recording)
    assert call(*learn, "--beta", 9, "--resume") == 1  # not the same fit
    assert "other settings" in capsys.readouterr().err
    assert call(*learn, "--resume") == 0
    assert iterations[0] == 4
    assert written(tmp_path) == LEARNED
    np.testing.assert_array_equal(np.load(tmp_path / "blocked.npy"), np.load(learned / "blocked.npy"))


def test_known_cells_of_the_learned_map_are_known_again(learned):
    found = load_map(learned)
    assert found.grid.known[0, 2] == Cell.OCCUPIED
    assert found.grid.known[4, 0] == Cell.FREE
    assert (found.grid.known == Cell.UNKNOWN).sum() == 23
