"""Whether plans with risk mean what they say: the scores of some plans, and a small run."""

import json

import numpy as np
import pytest
from benchmarks.__main__ import main

from benchmarks import risk
from sidestep.maps.learned_map import LearnedMap
from sidestep.tabular.grid import Grid
from sidestep.tabular.reward import Reward


def plan(draw: int, chance: float, is_open: bool, bound: float | None = None) -> dict:
    """Return the record of a plan."""
    met = None if bound is None else chance >= 1 - bound
    said = {"open_probability": chance, "open": is_open, "max_risk": bound, "met": met, "length": 3.0, "shortest": 2.0}
    return {"draw": draw, "mixed": True, "seconds": 1.0, "start": 0, "goal": 1, "walked": True, **said}


def test_scores_are_those_of_all_plans_together():
    """At .75 one of two is open, at 1 both."""
    scored = risk.scores([plan(1, 0.75, True), plan(1, 0.75, False), plan(2, 1.0, True), plan(2, 1.0, True)])
    assert (scored["plans"], scored["offices"], scored["predicted"], scored["open"]) == (4, 2, 0.875, 0.75)
    assert scored["calibration_error"] == pytest.approx(0.25 / 2)
    assert scored["brier_score"] == pytest.approx((0.25**2 + 0.75**2) / 4)
    assert scored["excess"] == 1.5


def test_scores_have_a_standard_error_over_offices():
    """Ten equal plans in each of four offices say as much as one."""
    once = [plan(draw, 0.9, draw < 2) for draw in range(4)]
    assert risk.scores(10 * once)["error"] == risk.scores(once)["error"] == pytest.approx(np.sqrt(0.25 / 4))


def test_show_counts_plans_with_a_warning_on_their_own(capsys):
    bounded = [plan(1, 0.96, True, 0.05), plan(1, 0.95, False, 0.05), plan(1, 0.9, False, 0.05)]
    risk.show([plan(1, 0.5, True), *bounded], risk.Options())
    printed = capsys.readouterr().out
    assert "2 plans with a risk of at most 0.05: 50.0%" in printed
    assert "1 plans with a warning that there is none: 0.0%" in printed
    assert "1 of 1 offices had mixed" in printed


def test_plans_say_whether_the_path_is_open_in_truth():
    """A wall that the map does not have is in the way of the first pair, not of the second."""
    truth = Grid(np.array([[0, 0, 1, 0], [0, 0, 0, 0]]))
    samples = np.zeros((10, 2, 4), dtype=bool)
    learned = LearnedMap(truth.forget(), np.full((2, 4), 0.01), np.array([[0, 4], [4, 4]]), Reward(), samples=samples)
    first, _, second, bounded = risk.plans(learned, truth, [(1, 3), (0, 4)], max_risk=0.05)
    assert (first["open"], first["walked"], first["length"], first["shortest"]) == (False, False, 2, 4)
    assert (second["open"], second["walked"], second["met"], second["max_risk"]) == (True, True, None, None)
    assert (bounded["open_probability"], bounded["met"], bounded["max_risk"]) == (1, True, 0.05)


@pytest.mark.slow
def test_main_risk_writes_two_records_a_pair(tmp_path, capsys):
    file, picture = tmp_path / "records.json", tmp_path / "reliability.png"
    size = ["--rows", "10", "--columns", "10", "--offices", "2", "--walks", "8", "--goals", "2", "--plans", "3"]
    options = ["--set", "sweeps=12", "--json", str(file), "--picture", str(picture)]
    assert main(["risk", *size, *options]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    records = json.loads(file.read_text())["records"]
    assert [(r["draw"], r["max_risk"]) for r in records] == 3 * [(1, None), (1, 0.05)] + 3 * [(2, None), (2, 0.05)]
    assert all(0 < record["open_probability"] <= 1 for record in records)
    printed = capsys.readouterr().out
    assert "2 offices of 10×10, 2 goals, 8 walks" in printed
