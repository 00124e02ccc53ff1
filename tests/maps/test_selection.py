"""`learn --behavior auto`: what is chosen for walks whose walkers are known."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.csv as tables
import pytest

from helpers.office import WALL, call, summary, write_office
from sidestep.errors import NotConverged
from sidestep.inference import calibration
from sidestep.io.maps import write_map
from sidestep.maps import selection as behavior
from sidestep.maps.config import MapConfig
from sidestep.tabular.grid import Cell, Grid


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    return write_office(tmp_path_factory.mktemp("office"))


def walked(folder, name, *options):
    """Walks in the office of people who are described by options; the file."""
    file = folder / f"{name}.csv"
    assert call("simulate", folder / "true.yaml", "--out", file, *options) == 0
    return file


def chosen(folder, walks, out, *options):
    """The summary of a map learned from them."""
    command = ("learn", walks, "--map", folder / "blank.yaml", "--out", out, "--select-behavior", *options)
    assert call(*command) == 0
    return summary(out)


def test_people_who_never_err_are_taken_to_be_sharper(office, tmp_path, capsys):
    told = chosen(office, walked(office, "optimal", "--walks", 60, "--goals", 5), tmp_path)
    assert told["behavior"]["beta"] == told["settings"]["behavior"]["beta"] >= 14
    assert told["settings"]["behavior"]["tempering"] == 1
    assert (told["settings"]["reward"]["discount"], told["settings"]["reward"]["step_cost"]) == (0.95, None)
    assert told["behavior"]["lapse"] < 0.05
    assert "the reward is a goal that pays 1" in capsys.readouterr().out
    blocked = np.load(tmp_path / "blocked.npy")
    assert blocked[WALL].min() > blocked[~WALL].max()


def test_some_sharp_and_some_aimless_people_say_less_than_so_many_alike(office, tmp_path):
    """Who is aimless is so in every step of the walk."""
    kinds = [
        tables.read_csv(walked(office, f"kind{beta}", "--walks", 60, "--goals", 2, "--beta", beta, "--seed", 3))
        for beta in (0.5, 60)
    ]
    other = kinds[1].set_column(0, "walk", pa.array([f"{label}b" for label in kinds[1]["walk"].to_pylist()]))
    both = pa.concat_tables([kinds[0].set_column(0, "walk", kinds[0]["walk"].cast(pa.string())), other])
    tables.write_csv(both, tmp_path / "both.csv")
    told = chosen(office, tmp_path / "both.csv", tmp_path / "learned", "--beta", 10)
    assert told["settings"]["behavior"]["tempering"] < 0.6
    assert told["settings"]["behavior"]["tempering"] == pytest.approx(
        told["behavior"]["trials"][0]["effective_sample_ratio"]
    )
    assert any("actions count by" in reason for reason in told["behavior"]["reasons"])


def test_where_walks_are_long_people_pay_for_steps(tmp_path):
    """Sixty cells from the goal a reward of 1 with the discount .95 is next to nothing."""
    free = np.zeros((2, 60))
    write_map(tmp_path / "true.yaml", free, Grid(free.astype(int) * int(Cell.OCCUPIED)))
    write_map(tmp_path / "blank.yaml", free + 0.5, Grid.unknown(2, 60))
    walks = walked(tmp_path, "steps", "--walks", 30, "--goals", 2, "--beta", 2, "--step-cost", 1, "--discount", 1)
    told = chosen(tmp_path, walks, tmp_path / "learned")
    assert (told["settings"]["reward"]["discount"], told["settings"]["reward"]["step_cost"]) == (1, 1)
    assert "the reward is a cost of every cell" in told["behavior"]["reasons"][0]


def test_people_of_whom_no_values_are_found_are_passed_over(office, tmp_path, monkeypatch):
    """As it happens now and then to Boltzmann averages of people who pay for steps."""

    def not_of_those_who_pay(model, shown, agent, *, options):
        if float(shown.tasks.discount[0]) == 1:
            raise NotConverged("the values of a task were not found")
        return calibration.score_statistics(model, shown, agent, options=options)

    monkeypatch.setattr(behavior, "score_statistics", not_of_those_who_pay)
    told = chosen(office, walked(office, "some", "--walks", 12), tmp_path)
    assert told["settings"]["reward"]["step_cost"] is None
    assert {trial["step_cost"] for trial in told["behavior"]["trials"]} == {None}
    reasons = told["behavior"]["reasons"]
    assert "a cost of every cell has no values" in reasons[0]
    assert sum("was passed over: the values of a task were not found" in reason for reason in reasons) == 2


def test_where_the_settings_own_people_have_no_values_there_is_nothing_to_compare(office, tmp_path, capsys):
    walks = walked(office, "few", "--walks", 6)
    command = ("learn", walks, "--map", office / "blank.yaml", "--out", tmp_path / "out", "--select-behavior")
    assert call(*command, "--backup", "logsumexp", "--step-cost", 1, "--discount", 1, "--beta", 0.5) == 1
    assert "never wants to arrive" in capsys.readouterr().err


def test_people_who_never_want_to_arrive_are_passed_over(office, tmp_path):
    """By log-sum-exp, those to whom ways differ as little as by half a cost a cell."""
    told = chosen(office, walked(office, "soft", "--walks", 12), tmp_path, "--backup", "logsumexp", "--beta", 10)
    assert any("a cost of every cell with β = 0.5 was passed over" in reason for reason in told["behavior"]["reasons"])


def test_walks_that_do_not_vary_are_told():
    none = np.zeros(3)
    trial = behavior.Trial(MapConfig(), none, none, moves=5, ratio=np.inf, lapse=0.0)
    assert json.loads(json.dumps(trial.summary(), allow_nan=False))["effective_sample_ratio"] is None


def test_one_walk_is_too_few_to_choose_by(office, tmp_path, capsys):
    walks = walked(office, "one", "--walks", 1, "--goals", 1)
    assert call("learn", walks, "--map", office / "blank.yaml", "--out", tmp_path, "--select-behavior") == 1
    assert "field 'select_behavior': expected at least 2 walks to select by, found 1" in capsys.readouterr().err
    assert not (tmp_path / "summary.json").exists()


def test_traits_that_are_not_there_are_refused(office, tmp_path, capsys):
    walks = walked(office, "two", "--walks", 2, "--goals", 1)
    assert call("learn", walks, "--map", office / "blank.yaml", "--out", tmp_path, "--learn", "mood") == 1
    assert "field 'learn': expected one of beta, lapse, discount, found 'mood'" in capsys.readouterr().err
