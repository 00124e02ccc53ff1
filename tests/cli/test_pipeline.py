"""The command line: walks from a map, a learned map from walks, scores and paths from the learned map."""

import json
from contextlib import contextmanager
from dataclasses import asdict

import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
import yaml
from PIL import Image

from helpers.office import BLANK, WALL, call, simulated, summary, write_office, written
from sidestep.cli import display
from sidestep.io.maps import read_map
from sidestep.io.walks import read_walks, write_walks
from sidestep.maps.config import BehaviorConfig, FitConfig, MapConfig, PriorConfig
from sidestep.maps.learn import learn_map, sample_walks
from sidestep.maps.learned_map import LearnedMap, load_map
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.reward import Reward

pytestmark = pytest.mark.slow

SCORES = (
    "auc", "average_precision", "auc_relevant", "calibration_error", "brier_score", "log_loss", "mean_obstacle",
    "mean_free", "max_probability", "legal_fraction", "excess_length",
)  # fmt: skip
LEARNED = [
    "blocked.npy", "information.npy", "learned.png", "map.pgm", "map.yaml",
    "samples.npz", "summary.json", "visited.npy",
]  # fmt: skip


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """A folder with the maps of the office and `walks.csv`: 80 walks to 5 goals."""
    folder = write_office(tmp_path_factory.mktemp("office"))
    arguments = ("simulate", folder / "true.yaml", "--out", folder / "walks.csv", "--walks", 80, "--goals", 5)
    assert call(*arguments) == 0
    return folder


@pytest.fixture(scope="module")
def learned(office):
    """The map that is learned from these walks, with two cells known."""
    assert call("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", office / "learned") == 0
    return office / "learned"


def test_simulate_writes_walks_that_avoid_the_walls(office):
    table = pyarrow.csv.read_csv(office / "walks.csv")
    assert set(table.column_names) == {"walk", "step", "x", "y", "goal_x", "goal_y"}
    x, y = table["x"].to_numpy(), table["y"].to_numpy()
    grid = read_map(office / "true.yaml")
    states = grid.states(np.stack([x, y], axis=1))
    assert not WALL.reshape(-1)[states].any()
    result = json.loads((office / "walks.summary.json").read_text())
    assert result["moves"] == len(table) - 80
    assert len(result["goals"]) == 5
    assert result["settings"]["walks"] == len(set(table["walk"].to_pylist())) == 80


def test_learn_writes_a_map_and_a_picture(learned):
    assert written(learned) == LEARNED
    blocked = np.load(learned / "blocked.npy")
    assert (blocked.shape, blocked.dtype) == ((5, 5), np.float64)
    assert (blocked[0, 2], blocked[4, 0]) == (1, 0)  # the known cells; the top row is first
    known = load_map(learned).grid.known
    assert (known[0, 2], known[4, 0], (known == Cell.UNKNOWN).sum()) == (Cell.OCCUPIED, Cell.FREE, 23)
    assert ((blocked > 0) & (blocked < 1)).sum() == 23
    assert blocked[1:4, 2].min() > blocked[~WALL].max()
    image = np.asarray(Image.open(learned / "map.pgm"))
    np.testing.assert_array_equal(image, np.where(load_map(learned).without_evidence, 205, np.rint(100 * blocked)))
    entries = yaml.safe_load((learned / "map.yaml").read_text())
    assert (entries["mode"], entries["resolution"], entries["origin"]) == ("raw", 0.5, [-1.0, 2.0, 0.0])
    with Image.open(learned / "learned.png") as picture:
        assert min(picture.size) > 100


def test_learn_reads_walks_from_minari_datasets(office, tmp_path, datasets, capsys):
    write_walks("minari:office/walks-v0", read_walks(office / "walks.csv"))
    options = ("--map", office / "half.yaml", "--out", tmp_path, "--terms", "transitions")
    assert call("learn", "minari:office/walks-v0", *options) == 0
    assert summary(tmp_path)["data"]["walks"] == 80
    capsys.readouterr()
    assert call("learn", "minari:office/walks-v1", *options) == 1
    assert "office/walks-v1: there is no such dataset here" in capsys.readouterr().err
    assert call("simulate", office / "true.yaml", "--out", "minari:office/walks-v2", "--walks", 4) == 1
    assert not (datasets / "office" / "walks-v2").exists()


def test_learn_writes_a_summary(office, learned):
    result = summary(learned)
    assert result["command"] == "learn"
    assert result["files"] == {"walks": str(office / "walks.csv"), "map": str(office / "half.yaml")}
    assert result["data"]["walks"] == 80
    assert result["data"]["goals"] == 5
    assert result["data"]["unknown_cells"] == 23
    parts = [result[name] for name in ("log_likelihood_actions", "log_likelihood_transitions", "log_prior")]
    assert result["objective"] == pytest.approx(sum(parts), rel=1e-12)
    assert max(parts) < 0
    assert result["converged"]
    assert result["message"].startswith("mixed")
    assert (result["posterior"], result["chains"]) == ("sample", 2)
    assert result["seconds"] > 0
    assert result["peak_memory_bytes"] > 10_000_000
    assert result["connectivity"] == 4
    assert result["settings"] == json.loads(json.dumps(asdict(MapConfig().completed())))


def test_evaluate_adds_scores_to_the_summary(office, learned, tmp_path, capsys):
    before = summary(learned)
    assert call("evaluate", learned, "--true-map", office / "true.yaml", "--out", tmp_path / "scores") == 0
    assert summary(learned) == before
    alone = summary(tmp_path / "scores")
    assert call("evaluate", learned, "--true-map", office / "true.yaml") == 0
    together = summary(learned)
    assert {key: together[key] for key in before} == before
    assert {key: together[key] for key in SCORES} == {key: alone[key] for key in SCORES}
    assert set(together["planned_at_most"]) == {"starts", "goals", "executed"}
    assert together["auc"] == together["legal_fraction"] == 1
    assert together["mean_obstacle"] > 0.5 > 0.2 > together["mean_free"]
    printed = capsys.readouterr().out
    assert "1.000" in printed
    assert f"Brier score           │ {together['brier_score']:.3f}" in printed
    assert f"reliability diagram and numbers in {learned}" in printed
    assert written(learned) == sorted([*LEARNED, "reliability.png"])
    with Image.open(tmp_path / "scores" / "reliability.png") as picture:
        assert min(picture.size) > 300


def test_evaluate_scores_the_calibration_of_unknown_cells(office, learned, tmp_path):
    """The two cells that the map knew beforehand do not count."""
    assert call("evaluate", learned, "--true-map", office / "true.yaml", "--out", tmp_path) == 0
    blocked, unknown = np.load(learned / "blocked.npy"), load_map(learned).grid.known == Cell.UNKNOWN
    right = np.where(WALL, blocked, 1 - blocked)[unknown]
    assert right.size == 23
    scores = summary(tmp_path)
    assert scores["brier_score"] == pytest.approx(np.mean((1 - right) ** 2))
    assert scores["log_loss"] == pytest.approx(-np.log(right).mean())
    own = (10 * blocked[unknown]).astype(int)
    bias = [abs((blocked[unknown] - WALL[unknown])[own == each].sum()) for each in range(10)]
    assert scores["calibration_error"] == pytest.approx(sum(bias) / 23)


def test_plan_writes_a_legal_path(office, learned, capsys):
    assert call("plan", learned, "--start", "-0.75,4.2", "--goal", "1.25,4.25") == 0
    table = pyarrow.csv.read_csv(learned / "plan" / "path.csv")
    assert table.column_names[:3] == ["step", "x", "y"]
    assert table["step"].to_pylist() == list(range(13))  # down the near side, along the bottom, up the far side
    points = np.stack([table["x"].to_numpy(), table["y"].to_numpy()], axis=1)
    np.testing.assert_allclose(points[[0, -1]], [[-0.75, 4.25], [1.25, 4.25]])
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.5)
    states = read_map(office / "true.yaml").states(points)
    assert not WALL.reshape(-1)[states].any()
    result = summary(learned / "plan")
    assert result["moves"] == 12
    assert result["length_metres"] == pytest.approx(6)
    blocked = np.load(learned / "blocked.npy").reshape(-1)[states]
    assert result["max_probability_blocked"] == pytest.approx(blocked.max())
    assert 0.5 < result["open_probability"] <= 1
    assert result["expected_length_metres"] >= 6
    with Image.open(learned / "plan" / "path.png") as picture:
        assert min(picture.size) > 100
    assert "12 moves, 6 m" in capsys.readouterr().out


def test_plan_warns_of_a_doubtful_goal_and_of_a_risk_that_no_path_has(tmp_path, capsys):
    """The second cell is blocked in a tenth of the maps, the goal in half; walks passed the first and the third."""
    samples = np.zeros((200, 1, 4), dtype=bool)
    samples[:20, 0, 1], samples[::2, 0, 3] = True, True
    blocked = np.array([[0.01, 0.1, 0.01, 0.5]])
    LearnedMap(Grid.unknown(1, 4), blocked, np.array([[0, 2], [2, 2]]), Reward(), samples=samples).save(tmp_path)
    plan = ("plan", tmp_path, "--start", "0.5,0.5", "--goal")
    assert call(*plan, "3.5,0.5", "--max-risk", 0.05) == 0
    printed = capsys.readouterr()
    assert "open with probability 0.896 in maps from the posterior, given that start and goal are free" in printed.out
    assert "note: the goal itself is blocked with probability 0.5;" in printed.err
    assert "warning: no path has a risk of at most 0.05; this one has the least, 0.1" in printed.err
    result = summary(tmp_path / "plan")
    assert (result["goal_probability_blocked"], result["open_probability"]) == (0.5, pytest.approx(90.5 / 101))
    assert call(*plan, "2.5,0.5", "--max-risk", 0.15) == 0
    assert capsys.readouterr().err == ""


def test_plan_from_a_cell_to_itself_has_no_moves(learned, tmp_path):
    assert call("plan", learned, "--start", "-0.75,4.25", "--goal", "-0.75,4.25", "--out", tmp_path) == 0
    assert pyarrow.csv.read_csv(tmp_path / "path.csv").num_rows == 1
    assert summary(tmp_path)["moves"] == 0


def test_commands_with_eight_directions_parquet_and_fixed_policy_gradient(office, tmp_path):
    walks, out = tmp_path / "walks.parquet", tmp_path / "learned"
    simulate = ("simulate", office / "true.yaml", "--out", walks, "--walks", 40, "--connectivity", 8, "--beta", 40)
    assert call(*simulate, "--seed", 3) == 0
    assert "failed_x" in pyarrow.parquet.read_table(walks).column_names
    options = (
        "--connectivity",
        8,
        "--gradient",
        "fixed-policy",
        "--prior",
        "normal",
        "--prior-mean",
        -2,
        "--prior-variance",
        2,
    )
    assert call("learn", walks, "--map", office / "blank.yaml", "--out", out, *options) == 0
    result = summary(out)
    assert result["settings"]["fit"]["gradient"] == "fixed_policy"
    assert result["connectivity"] == 8
    assert load_map(out).grid.connectivity == 8
    assert call("evaluate", out, "--true-map", office / "true.yaml") == 0
    assert summary(out)["auc"] > 0.9
    assert call("plan", out, "--start", "-0.75,2.25", "--goal", "0.25,3.25") == 0
    assert summary(out / "plan")["moves"] >= 2


@pytest.mark.parametrize("config", [
    MapConfig(Reward(1.0, 1.0), BehaviorConfig(beta=3.0)),
    MapConfig(behavior=BehaviorConfig("mellowmax", horizon=12)),
    MapConfig(prior=PriorConfig("normal", wall_prior=0.0), fit=FitConfig("transitions")),
])  # fmt: skip
def test_learn_map_with_other_configurations_converges(office, config):
    learned = learn_map(BLANK, read_walks(office / "walks.csv"), config)
    assert learned.converged
    if config.fit.terms == "transitions":
        assert learned.summary()["log_likelihood_actions"] == 0
        assert learned.blocked.max() <= 1 / (1 + np.exp(-config.prior.mean)) + 1e-12
    else:
        assert learned.blocked[WALL].min() > learned.blocked[~WALL].max()


def test_sample_walks_and_simulate_walks_repeat_by_seed():
    walks = simulated(walks=80, goals=5)
    one, same, other = (sample_walks(walks, MapConfig(max_walks=12, seed=seed)).labels for seed in (1, 1, 2))
    assert len(one) == 12
    assert one == same != other
    one, same, other = (simulated(walks=10, seed=seed).positions.tolist() for seed in (1, 1, 2))
    assert one == same != other


def test_learn_resumes_after_an_interruption(office, learned, tmp_path, monkeypatch, capsys):
    command = ("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", tmp_path)
    iterations = []

    @contextmanager
    def interrupting(_):
        def stop(progress):
            if progress.iteration == 4:
                raise KeyboardInterrupt

        yield stop

    @contextmanager
    def recording(_):
        yield lambda progress: iterations.append(progress.iteration)

    monkeypatch.setattr(display, "fit_progress", interrupting)
    assert call(*command) == 1
    assert written(tmp_path) == ["fit.checkpoint"]
    printed = capsys.readouterr()
    assert "--resume" in printed.err
    assert "Traceback" not in printed.err

    monkeypatch.setattr(display, "fit_progress", recording)
    assert call(*command, "--beta", 9, "--resume") == 1  # not the same fit
    assert "other settings" in capsys.readouterr().err
    assert call(*command, "--resume") == 0
    assert 0 < iterations[0] <= 4  # saved at the first iteration, and then every few seconds
    assert written(tmp_path) == LEARNED
    np.testing.assert_array_equal(np.load(tmp_path / "blocked.npy"), np.load(learned / "blocked.npy"))
