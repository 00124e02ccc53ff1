"""What the benchmarks share, and their helpers; the benchmarks themselves take too long for tests."""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.__main__ import main, run

import benchmarks
from benchmarks import planning, rollouts, scaling
from sidestep.errors import InputError
from sidestep.maps.config import MapConfig


@dataclass
class Options:
    """What a benchmark of a test is asked for."""

    sizes: list[int] = benchmarks.option([3], "sizes", quick=[1])
    maps: list[Path] = benchmarks.option([Path("a.yaml")], "maps")


def test_in_turns_slow_calls_take_fewer_turns():
    order = []

    def call(name, seconds):
        order.append(name)
        return seconds

    calls = {"fast": lambda: call("fast", 0.1), "slow": lambda: call("slow", 5.0)}
    taken = benchmarks.in_turns(calls, turns=6, budget=1.0, fewest=3)
    assert order[:4] == ["fast", "slow", "fast", "slow"]
    assert [len(taken["fast"]), len(taken["slow"])] == [6, 3]


def test_run_writes_records_with_the_settings_and_reads_them_again(tmp_path):
    file, shown = tmp_path / "records.json", []
    records = [{"name": "a", "seconds": np.float64(1.5)}]
    module = SimpleNamespace(Options=Options, measure=lambda _: records, show=lambda own, _: shown.append(own))
    common = {"sizes": [3], "maps": [Path("a.yaml")], "picture": None}
    run(module, argparse.Namespace(json=file, records=None, **common), argparse.ArgumentParser())
    run(module, argparse.Namespace(json=None, records=file, **common), argparse.ArgumentParser())
    written = json.loads(file.read_text())
    assert written["settings"] == {"sizes": [3], "maps": ["a.yaml"]}
    assert written["records"] == records == shown[0] == shown[1]


@pytest.mark.parametrize("arguments", [["scaling", "--turns", "0"], ["scaling", "--backups", "none"], ["nothing"]])
def test_main_with_wrong_options_exits_with_2(arguments, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert "usage" in capsys.readouterr().err


def test_changed_reads_fields_and_refuses_others():
    settings = scaling.Options()
    changed = benchmarks.changed(settings, ["beta=2", "goal_pays=true"])
    assert (changed.beta, changed.goal_pays, settings.beta) == (2, True, 5.0)
    for wrong in ("sizes", "beta=x", "nothing=1"):
        with pytest.raises(InputError, match="--set"):
            benchmarks.changed(settings, [wrong])


def test_changed_checks_fields_that_go_together_after_all_are_set():
    config = benchmarks.changed(MapConfig(), ["posterior.method=mode", "prior.kind=normal", "prior.mean=-2"])
    assert (config.posterior.method, config.prior.kind, config.prior.mean) == ("mode", "normal", -2.0)
    with pytest.raises(InputError, match="posterior"):
        benchmarks.changed(MapConfig(), ["posterior.method=mode"])


def test_mean_over_averages_within_groups_first():
    records = [{"town": town, "auc": auc} for town, auc in (("a", 0.2), ("a", 0.4), ("b", 0.9), ("b", None))]
    assert benchmarks.mean_over(records, "auc", within="town") == pytest.approx(0.6)
    assert benchmarks.mean_over(records, "auc") == pytest.approx(0.5)
    assert benchmarks.mean_over(records[3:], "auc", within="town") is None


def test_power_law_returns_the_exponent_and_the_largest_step():
    sizes = [1.0, 4.0, 16.0]
    fitted, worst = scaling.power_law(sizes, [3 * size**1.2 for size in sizes])
    assert fitted == pytest.approx(1.2)
    assert worst == pytest.approx(1.2)
    assert scaling.power_law(sizes, [1.0, 2.0, 32.0])[1] == pytest.approx(2.0)


def test_demonstrations_of_an_office_end_at_its_goals():
    world = scaling.half_learned_office(12, seed=0, walks=2, goals=2)
    demos = world.demonstrations(0.9, None)
    assert demos.trajectories == 4
    assert [path[-1] for path in demos.paths()] == [*np.repeat(world.goals, 2)]


def test_problem_arrays_hold_the_goal_and_all_probabilities():
    problem = planning.Problem(scaling.half_learned_office(12, seed=0), 0.9, 5.0)
    arrays = problem.arrays
    totals = np.zeros(arrays["reward"].shape)
    np.add.at(totals, (arrays["state"], arrays["action"]), arrays["chance"])
    assert totals == pytest.approx(1.0)
    goal = int(problem.world.goals[0])
    assert set(arrays["after"][arrays["state"] == goal]) == {goal}
    assert (arrays["reward"][goal] == 0).all()


def test_noise_of_tells_noise_from_the_gradient():
    """Gradients of two places are (3, 4) and (5, 0), under noise of 1 and 2 a component."""
    gradients = np.array([[3.0, 4.0], [5.0, 0.0]])[:, None] + np.random.default_rng(0).normal(
        0, [[[1.0]], [[2.0]]], size=(2, 20_000, 2)
    )
    noise = rollouts.noise_of(gradients, 1.0)
    assert noise.mean == pytest.approx([4.0, 2.0], abs=5 * noise.error.max())
    assert noise.error == pytest.approx(np.sqrt(2.5 / 40_000), rel=0.05)
    assert noise.deviation**2 == pytest.approx(5.0, rel=0.05)
    assert noise.square == pytest.approx(25.0, rel=0.05)
    best = noise._replace(deviation=noise.deviation / 10)
    records = list(rollouts.noise_records("a", 5, {"score": noise, "pathwise": best}))
    assert records[0]["relative"] == pytest.approx(10.0)
    assert records[0]["roll_outs_needed"] == pytest.approx(100 * 5 / 25, rel=0.1)
    assert [record["errors_from_best"] for record in records] == [0.0, 0.0]
