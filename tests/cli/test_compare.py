"""`sidestep compare`: one table for all methods, from files."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.office import call, write_office
from sidestep.cli import compare
from sidestep.cli.compare import METHODS
from sidestep.cli.display import console
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.gridding import grid_walks
from sidestep.io.maps import read_map, write_map
from sidestep.io.walks import read_walks
from sidestep.maps.config import Settings, fit_map
from sidestep.maps.selection import choose_behavior
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    folder = write_office(tmp_path_factory.mktemp("office"))
    walked = ("--out", folder / "walks.csv", "--walks", 80, "--goals", 5)
    assert call("simulate", folder / "true.yaml", *walked) == 0
    return folder


@pytest.fixture(scope="module")
def compared_table(office):
    """What the command prints."""
    files = (office / "walks.csv", "--map", office / "half.yaml", "--truth", office / "true.yaml")
    with console.capture() as captured:
        assert call("compare", *files, "--out", office / "compared", "--seed", 3) == 0
    return captured.get()


@pytest.fixture(scope="module")
def compared(office, compared_table):
    assert compared_table
    return json.loads((office / "compared" / "summary.json").read_text())


def test_every_method_has_every_score(office, compared):
    assert set(compared["methods"]) == set(METHODS)
    for name, scores in compared["methods"].items():
        for key in ("legal_fraction", "arriving_fraction", "heldout_log_likelihood", "seconds"):
            assert np.isfinite(scores[key])
        assert scores["arriving_fraction"] >= scores["legal_fraction"]
        assert scores["converged"] is True
        assert (scores["regret"] is None) == (scores["arriving_fraction"] < 1)
        for key in ("auc", "average_precision"):
            assert scores[key] is None if name == "cloning" else np.isfinite(scores[key])
    assert compared["data"]["walks"] == 64
    assert compared["data"]["heldout_walks"] == 16
    assert (office / "compared" / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_what_one_method_cannot_do_is_no_reason_to_say_nothing_of_the_others(office, tmp_path, monkeypatch, capsys):
    """Whose entropy is worth more to them than a step costs never arrive, so there are no costs of cells to find."""
    monkeypatch.setattr(compare, "METHODS", {name: METHODS[name] for name in ("costs", "behavior")})
    files = (office / "walks.csv", "--map", office / "half.yaml", "--truth", office / "true.yaml", "--out", tmp_path)
    assert call("compare", *files, "--discount", 1, "--step-cost", 1, "--beta", 0.5) == 0
    methods = json.loads((tmp_path / "summary.json").read_text())["methods"]
    assert methods["costs"]["auc"] is methods["costs"]["seconds"] is None
    assert methods["costs"]["failed"] in " ".join(capsys.readouterr().err.split())
    assert np.isfinite(methods["behavior"]["auc"])


def test_who_has_not_converged_is_named(office, tmp_path, monkeypatch, capsys):
    def hurried(name):
        return lambda grid, shown, settings: METHODS[name](grid, shown, replace(settings, iterations=1))

    monkeypatch.setattr(compare, "METHODS", {name: hurried(name) for name in ("behavior", "visits", "joint")})
    files = (office / "walks.csv", "--map", office / "half.yaml", "--truth", office / "true.yaml", "--out", tmp_path)
    assert call("compare", *files) == 0
    methods = json.loads((tmp_path / "summary.json").read_text())["methods"]
    assert {name: scores["converged"] for name, scores in methods.items()} == {
        "behavior": False,
        "visits": True,
        "joint": False,
    }
    notes = capsys.readouterr().err
    assert "behavior did not converge" in notes
    assert "joint did not converge" in notes
    assert "visits" not in notes


def test_behavior_is_chosen_by_the_walks_that_are_learned_from(office, tmp_path, monkeypatch):
    monkeypatch.setattr(compare, "METHODS", {name: METHODS[name] for name in ("behavior", "transitions")})
    files = (office / "walks.csv", "--map", office / "half.yaml", "--truth", office / "true.yaml", "--out", tmp_path)
    with console.capture() as captured:
        assert call("compare", *files, "--behavior", "auto", "--seed", 3) == 0
    grid, walks = read_map(office / "half.yaml"), read_walks(office / "walks.csv")
    own = walks.select(np.sort(np.random.default_rng(3).permutation(80)[16:]))
    choice = choose_behavior(grid, grid_walks(own, grid), Settings(seed=3))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["behavior"]["reasons"] == choice.reasons
    assert summary["settings"]["beta"] == choice.settings.beta
    assert summary["settings"]["unknown"] == ["lapses"]
    assert all(reason in captured.get() for reason in choice.reasons)


def test_a_truth_of_another_place_is_refused(office, tmp_path, capsys):
    shifted = replace(read_map(office / "true.yaml"), origin=(0.0, 2.0, 0.0))
    write_map(tmp_path / "far.yaml", np.zeros(shifted.shape), shifted)
    files = (office / "walks.csv", "--map", office / "half.yaml", "--truth", tmp_path / "far.yaml")
    assert call("compare", *files, "--out", tmp_path / "out") == 1
    assert "far.yaml, field 'origin'" in capsys.readouterr().err


def test_behavior_sees_walls_and_transitions_alone_do_not(compared):
    methods = compared["methods"]
    assert methods["behavior"]["mean_obstacle"] > methods["transitions"]["mean_obstacle"] + 0.1
    assert methods["behavior"]["legal_fraction"] >= methods["transitions"]["legal_fraction"]
    assert methods["behavior"]["heldout_log_likelihood"] > methods["transitions"]["heldout_log_likelihood"]


def test_held_out_walks_are_judged_by_what_the_others_taught(office, compared):
    grid, walks = read_map(office / "half.yaml"), read_walks(office / "walks.csv")
    drawn = np.random.default_rng(3).permutation(80)
    own, others = (demonstrations_from_walks(walks.select(np.sort(some)), grid) for some in (drawn[16:], drawn[:16]))
    assert isinstance(others, Demonstrations)
    model = fit_map(ObstacleGrid(grid, Settings().prior_mean), own, Settings()).model
    people = Behavior(BoltzmannAverage(), Settings.beta)
    expected = log_likelihood(model, others, people, terms=("actions",)).actions / len(others)
    assert compared["methods"]["behavior"]["heldout_log_likelihood"] == pytest.approx(float(expected), rel=1e-6)


def test_the_table_says_where_there_is_no_score(compared_table):
    rows = {line.split()[1]: line for line in compared_table.splitlines() if len(line.split()) > 8}
    assert set(METHODS) <= set(rows)
    assert [cell.strip() for cell in rows["cloning"].split("│")[2:5]] == ["–", "–", "–"]
    assert "–" not in rows["behavior"].split("│")[2:5]


def test_joint_sees_the_wall_too(compared):
    methods = compared["methods"]
    assert methods["joint"]["mean_obstacle"] > methods["transitions"]["mean_obstacle"] + 0.1


@pytest.mark.parametrize("share", [0, 1, 0.001])
def test_a_share_that_leaves_nothing_is_refused(office, share, capsys):
    files = (office / "walks.csv", "--map", office / "half.yaml", "--truth", office / "true.yaml")
    assert call("compare", *files, "--out", office / "none", "--hold-out", share) == 1
    assert "hold_out" in capsys.readouterr().err
    assert not (office / "none").exists()
