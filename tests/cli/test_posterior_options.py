"""`sidestep learn`: the prior, how the posterior is found, and what is written of samples."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from helpers.office import WALL, call, simulated, summary, write_office, written
from sidestep.io.maps import read_map
from sidestep.io.walks import write_walks
from sidestep.maps.learned_map import load_map
from sidestep.tabular.grid import Cell


@pytest.fixture(scope="module")
def office(tmp_path_factory) -> Path:
    folder = write_office(tmp_path_factory.mktemp("office"))
    write_walks(folder / "walks.csv", simulated(walks=20, goals=3))
    return folder


def learn(office: Path, out: Path, *options: object) -> int:
    return call("learn", office / "walks.csv", "--map", office / "half.yaml", "--out", out, *options)


@pytest.fixture(scope="module")
def learned(office) -> Path:
    assert learn(office, office / "learned", "--sweeps", 60, "--seed", 3) == 0
    return office / "learned"


def test_learn_writes_samples_and_what_they_are_worth(learned):
    written_summary, loaded = summary(learned), load_map(learned)
    assert loaded.samples is not None
    assert loaded.samples.shape == (80, 5, 5)
    expected = {"posterior": "sample", "chains": 2, "draws": 40, "iterations": 60}
    assert expected.items() <= written_summary.items()
    assert isinstance(written_summary["converged"], bool)
    assert written_summary["settings"]["prior"]["kind"] == "binary"
    assert written_summary["settings"]["posterior"] == {"method": None, "sweeps": 60, "chains": 2}
    assert ("chains have not mixed" in written_summary["message"]) != written_summary["converged"]
    # the known end of the wall and the known free cell
    assert loaded.samples[:, 0, 2].all()
    assert not loaded.samples[:, 4, 0].any()
    assert loaded.blocked[WALL].min() > loaded.blocked[~WALL].mean()
    assert "fit.checkpoint" not in written(learned)


def test_learn_prints_the_samples(office, tmp_path, capsys):
    assert learn(office, tmp_path / "out", "--sweeps", 12) == 0
    printed = capsys.readouterr()
    assert "8 samples of each of 2 chains" in printed.out
    warned = "more sweeps let the chains agree" in printed.err
    assert warned != summary(tmp_path / "out")["converged"]


def test_learn_prints_and_writes_the_cells_of_which_walks_say_little(office, tmp_path, capsys):
    few = "--max-walks", 2, "--sweeps", 12
    assert learn(office, tmp_path / "out", *few, "--unknown-below", 0.3) == 0
    loaded, printed = load_map(tmp_path / "out"), capsys.readouterr().out
    count = int(loaded.without_evidence.sum())
    assert 0 < count < 23
    assert f"{count} of 23 unknown cells: walks say less than 0.3 nats (hatched)" in printed
    assert summary(tmp_path / "out")["cells_without_evidence"] == count
    assert summary(tmp_path / "out")["settings"]["unknown_below"] == 0.3
    assert (read_map(tmp_path / "out" / "map.yaml").known[loaded.without_evidence] == Cell.UNKNOWN).all()
    assert learn(office, tmp_path / "all", *few, "--unknown-below", 0) == 0
    everything = load_map(tmp_path / "all")
    assert not everything.without_evidence.any()
    np.testing.assert_array_equal(everything.blocked, loaded.blocked)
    assert np.asarray(Image.open(tmp_path / "all" / "map.pgm")).max() <= 100


@pytest.mark.parametrize("threshold", ["-1", "nan", "inf"])
def test_learn_refuses_another_threshold_of_unknown_cells(office, tmp_path, capsys, threshold):
    assert learn(office, tmp_path / "out", "--unknown-below", threshold) == 1
    assert "'unknown_below': expected a finite number, at least 0" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_learn_with_the_same_seed_writes_the_same_bytes(office, learned, tmp_path):
    assert learn(office, tmp_path / "again", "--sweeps", 60, "--seed", 3) == 0
    for name in ("blocked.npy", "map.pgm"):
        assert (tmp_path / "again" / name).read_bytes() == (learned / name).read_bytes()
    np.testing.assert_array_equal(load_map(tmp_path / "again").samples, load_map(learned).samples)


@pytest.mark.slow
@pytest.mark.parametrize(("options", "kind", "method"), [
    (("--posterior", "mean-field"), "binary", "mean_field"),
    (("--posterior", "mode"), "normal", "mode"),
    (("--prior", "normal"), "normal", None),
    (("--prior", "normal", "--prior-mean", 0.5, "--posterior", "mode"), "normal", "mode"),
])  # fmt: skip
def test_learn_by_a_fit_removes_the_samples_of_an_earlier_run(office, options, kind, method):
    out = office / f"fitted-{'-'.join(str(each) for each in options)}"
    assert learn(office, out, "--sweeps", 12, "--posterior", "sample") == 0
    assert "samples.npz" in written(out)
    assert learn(office, out, *options) == 0
    assert "samples.npz" not in written(out)
    settings = summary(out)["settings"]
    assert (settings["prior"]["kind"], settings["posterior"]["method"]) == (kind, method)
    assert load_map(out).samples is None


@pytest.mark.slow
def test_learn_log_odds_moves_cells_of_which_walks_say_nothing(office):
    """Of three walks; cells that they passed are free either way."""
    expected = {}
    for log_odds in (-3, 1):
        out = office / f"log-odds{log_odds}"
        assert learn(office, out, "--max-walks", 3, "--sweeps", 30, "--log-odds", log_odds) == 0
        assert summary(out)["settings"]["prior"]["log_odds"] == log_odds
        result = load_map(out)
        passed = np.isin(np.arange(25), result.visited[:, 0]).reshape(5, 5)
        assert result.blocked[passed].max() < 0.05
        expected[log_odds] = result.blocked[result.unknown & ~passed].mean()
    assert expected[1] > expected[-3] + 0.1


@pytest.mark.parametrize(("options", "expected"), [
    (("--prior-mean", 1), "--prior-mean"),
    (("--prior", "binary", "--prior-variance", 2), "--prior-variance"),
    (("--wall-prior", 1), "--wall-prior"),
    (("--prior", "normal", "--log-odds", -1), "--log-odds"),
    (("--posterior", "mode", "--log-odds", -1), "--log-odds"),
    (("--posterior", "modes"), "--posterior"),
    (("--prior", "paper"), "--prior"),
    (("--sweeps", "many"), "--sweeps"),
])  # fmt: skip
def test_learn_with_options_of_the_other_prior_is_wrong_usage(office, capsys, options, expected):
    before = written(office)
    assert learn(office, office / "refused", *options) == 2
    assert expected in capsys.readouterr().err
    assert written(office) == before


@pytest.mark.parametrize(("options", "expected"), [
    (("--posterior", "mode", "--prior", "binary"), "field 'posterior'"),
    (("--posterior", "sample", "--prior", "normal"), "field 'posterior'"),
    (("--posterior", "mean-field", "--prior", "normal"), "field 'posterior'"),
    (("--sweeps", 11), "field 'sweeps'"),
    (("--posterior", "sample", "--horizon", 5), "field 'horizon'"),
    (("--log-odds", "nan"), "field 'log_odds'"),
])  # fmt: skip
def test_learn_with_a_posterior_that_does_not_fit_is_refused(office, capsys, options, expected):
    before = written(office)
    assert learn(office, office / "refused", *options) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert expected in lines[0]
    assert written(office) == before


def test_evaluate_refuses_samples_of_another_map(office, learned, capsys):
    copy = office / "copy"
    copy.mkdir()
    for path in learned.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    np.savez(copy / "samples.npz", blocked=np.zeros((3, 4, 4), bool))
    assert call("plan", copy, "--start", "-0.75,2.25", "--goal", "1.25,2.25", "--out", office / "plan") == 1
    assert "samples.npz" in capsys.readouterr().err
    assert json.loads((copy / "summary.json").read_text())["posterior"] == "sample"
