"""`sidestep compare`: one table for all methods, from files."""

import shutil
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from helpers.office import OFFICE, call, simulated, summary, write_office
from sidestep.baselines import BASELINES
from sidestep.baselines.comparison import compare_methods
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.maps import read_map, write_map
from sidestep.io.walks import read_walks, write_walks
from sidestep.maps.annotations import WalkAnnotations
from sidestep.maps.config import NEAR_OPTIMAL, BehaviorConfig, FitConfig, MapConfig
from sidestep.maps.learn import learn_map
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.likelihood import log_likelihood, log_policies
from sidestep.tabular.reward import Reward

pytestmark = pytest.mark.slow
METHODS = {"behavior", *BASELINES}
WALKS = 40
README = Path(__file__).parents[2] / "README.md"


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    folder = write_office(tmp_path_factory.mktemp("office"))
    write_walks(folder / "walks.csv", simulated(walks=WALKS, goals=4))
    return folder


@pytest.fixture(scope="module")
def data(office):
    """The half-known map, the true map, and the walks."""
    return read_map(office / "half.yaml"), read_map(office / "true.yaml"), read_walks(office / "walks.csv")


def compare(office, out, *options):
    files = (office / "walks.csv", "--map", office / "half.yaml", "--true-map", office / "true.yaml")
    return call("compare", *files, "--out", out, *options)


@pytest.fixture(scope="module")
def printed(office):
    """What the command prints."""
    with redirect_stdout(StringIO()) as output:
        assert compare(office, office / "compared", "--seed", 3) == 0
    return output.getvalue()


@pytest.fixture(scope="module")
def compared(office, printed):
    assert printed
    return summary(office / "compared")


def test_compare_with_defaults_gives_every_method_every_score(office, compared):
    assert set(compared["methods"]) == METHODS
    for name, scores in compared["methods"].items():
        for key in ("legal_fraction", "arriving_fraction", "heldout_log_likelihood", "seconds"):
            assert np.isfinite(scores[key])
        assert scores["arriving_fraction"] >= scores["legal_fraction"]
        assert scores["converged"] is True
        assert scores["failure"] is None
        assert (scores["regret"] is None) == (scores["arriving_fraction"] < 1)
        for key in ("auc", "average_precision"):
            assert scores[key] is None if name == "cloning" else np.isfinite(scores[key])
        for key in ("calibration_error", "brier_score", "log_loss"):
            assert (scores[key] is None) == (name in ("visits", "costs", "cloning"))
    assert compared["data"]["walks"] == 32
    assert compared["data"]["heldout_walks"] == 8
    assert (office / "compared" / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_readme_code_learn_and_compare_give_the_same_map(office, tmp_path, monkeypatch):
    """The block of Python in README.md, in a folder with the files that it names."""
    for name, file in (("office.yaml", "half.yaml"), ("truth.yaml", "true.yaml")):
        shutil.copy(office / file, tmp_path / name)
    for name in ("half.pgm", "true.pgm", "walks.csv"):
        shutil.copy(office / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    code = README.read_text().split("```python\n")[1].split("```")[0]
    # a start and a goal in the office of this test
    names: dict[str, Any] = {}
    exec(code.replace("start=(3.5, 1.5), goal=(5.5, 7.5)", "start=(-0.75, 4.2), goal=(1.25, 4.25)"), names)
    assert len(names["path"]) == 13
    assert compare(office, tmp_path / "compared", "--hold-out", 0) == 0
    assert call("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", tmp_path / "by_learn") == 0
    for folder in ("learned", "by_learn", "compared/behavior"):
        np.testing.assert_array_equal(np.load(tmp_path / folder / "blocked.npy"), names["learned"].blocked)
    assert summary(tmp_path / "compared")["methods"]["behavior"]["heldout_log_likelihood"] is None


def test_compare_with_goal_candidates_and_one_iteration_names_what_did_not_converge(office, data, tmp_path, capsys):
    """Candidates are the goals of the walks; held-out walks are scored all the same."""
    goals = np.unique(data[2].goals, axis=0)
    np.savetxt(tmp_path / "goals.csv", goals, delimiter=",", header="goal_x,goal_y", comments="")
    options = ("--goal-candidates", tmp_path / "goals.csv", "--seed", 3, "--max-iterations", 1)
    assert compare(office, tmp_path / "out", *options) == 0
    methods, notes = summary(tmp_path / "out")["methods"], capsys.readouterr().err
    for name, converges in (("behavior", False), ("joint", False), ("visits", True)):
        assert methods[name]["converged"] is converges
        assert (f"{name} did not converge" in notes) is not converges
    assert all(np.isfinite(methods[name]["heldout_log_likelihood"]) for name in METHODS)
    assert (tmp_path / "out" / "behavior" / "posterior.csv").exists()


def test_compare_with_a_true_map_of_another_place_is_refused(office, tmp_path, capsys):
    write_map(tmp_path / "far.yaml", np.zeros((5, 5)), replace(OFFICE, origin=(0.0, 2.0, 0.0)))
    files = (office / "walks.csv", "--map", office / "half.yaml", "--true-map", tmp_path / "far.yaml")
    assert call("compare", *files, "--out", tmp_path / "out") == 1
    assert "far.yaml, field 'origin'" in capsys.readouterr().err


def test_compare_ranks_behavior_above_transitions_alone(compared):
    methods = compared["methods"]
    for name in ("behavior", "joint"):
        assert methods[name]["mean_obstacle"] > methods["transitions"]["mean_obstacle"] + 0.1
    assert methods["behavior"]["legal_fraction"] >= methods["transitions"]["legal_fraction"]
    assert methods["behavior"]["heldout_log_likelihood"] > methods["transitions"]["heldout_log_likelihood"]


def test_compare_scores_held_out_walks_by_the_map_of_the_others(data, compared):
    grid, _, walks = data
    drawn = np.random.default_rng(3).permutation(WALKS)
    learned = learn_map(grid, walks.select(np.sort(drawn[8:])), MapConfig(seed=3))
    heldout = demonstrations_from_walks(walks.select(np.sort(drawn[:8])), grid)
    behavior = Behavior(BoltzmannAverage(), NEAR_OPTIMAL.beta, NEAR_OPTIMAL.lapse)
    expected = log_likelihood(learned.model, heldout, behavior, terms=("actions",)).actions / len(heldout)
    assert compared["methods"]["behavior"]["heldout_log_likelihood"] == pytest.approx(float(expected), rel=1e-6)


def test_compare_prints_a_row_for_every_method(printed, compared):
    rows = {line.split()[1]: line for line in printed.splitlines() if line.startswith("│")}
    assert set(rows) == METHODS
    without_regret = compared["methods"]["cloning"]["regret"] is None
    assert [rows[name].count("–") for name in ("behavior", "cloning")] == [0, 3 + without_regret]


@pytest.mark.parametrize("fraction", [-0.1, 1, 0.001])
def test_compare_without_walks_to_learn_or_to_hold_out_is_refused(office, fraction, capsys):
    assert compare(office, office / "none", "--hold-out", fraction) == 1
    assert "hold_out" in capsys.readouterr().err
    assert not (office / "none").exists()


def test_compare_takes_every_option_of_learn(capsys):
    options = []
    for command in ("learn", "compare"):
        assert call(command, "--help") == 0
        options.append({word for word in capsys.readouterr().out.split() if word.startswith("--")})
    assert {"--map", "--beta", "--sensor-map"} <= options[0] <= options[1]


def test_compare_methods_with_a_method_without_values_scores_the_others(data):
    """With a step cost below log(4)/β a log-sum-exp agent gains by walking on, so the costs have no values."""
    config = MapConfig(Reward(1.0, 1.0), BehaviorConfig(beta=0.5), fit=FitConfig(max_iterations=3))
    comparison = compare_methods(*data, config=config, baselines={"costs": BASELINES["costs"]})
    behavior, costs = comparison.records
    assert (behavior.method, costs.method) == ("behavior", "costs")
    assert costs.failure is not None
    assert costs.result is None
    assert costs.evaluation.auc is None
    assert behavior.failure is None
    assert behavior.evaluation.auc is not None


def test_compare_methods_with_persons_scores_held_out_walks_by_their_own_beta(data):
    grid, truth, walks = data
    names = np.array(["ann", "bob"])[np.arange(WALKS) % 2]
    column = pa.array(np.repeat(names, np.diff(walks.offsets)))
    walks = replace(walks, metadata=pa.table({"person": column}))
    comparison = compare_methods(grid, truth, walks, MapConfig(), baselines={}, annotations=WalkAnnotations("person"))
    assert comparison.learned is not None
    assert comparison.learned.learning is not None
    betas, heldout = comparison.learned.learning.persons, comparison.problem.heldout
    assert heldout is not None
    drawn = np.sort(np.random.default_rng(0).permutation(WALKS)[:8])
    of_moves = names[drawn][np.asarray(heldout.trajectory)]
    own = {
        name: np.asarray(log_policies(comparison.learned.model, heldout, Behavior(BoltzmannAverage(), beta)))
        for name, beta in betas.items()
    }
    expected = np.where(of_moves == "ann", own["ann"], own["bob"]).mean()
    assert comparison.records[0].heldout_log_likelihood == pytest.approx(expected, rel=1e-9)
