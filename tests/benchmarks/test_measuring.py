"""The helpers of the benchmarks; the scripts themselves take too long for tests."""

import argparse
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def script(monkeypatch):
    """Imports a script of the benchmarks by its name."""
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    return importlib.import_module


def test_calls_take_turns_and_slow_ones_take_fewer(script):
    order = []

    def call(name, seconds):
        order.append(name)
        return seconds

    calls = {"fast": lambda: call("fast", 0.1), "slow": lambda: call("slow", 5.0)}
    taken = script("measuring").in_turns(calls, turns=6, budget=1.0, fewest=3)
    assert order[:4] == ["fast", "slow", "fast", "slow"]
    assert [len(taken["fast"]), len(taken["slow"])] == [6, 3]


def test_records_are_written_with_the_settings(script, tmp_path):
    file = tmp_path / "records.json"
    arguments = argparse.Namespace(json=file, quick=True, sizes=[3], maps=[Path("a.yaml")])
    script("measuring").write_records(arguments, [{"name": "a", "seconds": np.float64(1.5)}], extra=[1])
    written = json.loads(file.read_text())
    assert written["settings"] == {"quick": True, "sizes": [3], "maps": ["a.yaml"]}
    assert written["records"] == [{"name": "a", "seconds": 1.5}]
    assert written["extra"] == [1]


def test_a_power_law_is_fitted_and_its_worst_step_found(script):
    sizes = [1.0, 4.0, 16.0]
    fitted, worst = script("scaling").power_law(sizes, [3 * size**1.2 for size in sizes])
    assert fitted == pytest.approx(1.2)
    assert worst == pytest.approx(1.2)
    assert script("scaling").power_law(sizes, [1.0, 2.0, 32.0])[1] == pytest.approx(2.0)


def test_a_world_comes_back_as_it_was_written(script, tmp_path):
    worlds = script("worlds")
    world = worlds.half_learned_office(12, seed=0, walks=2, goals=2)
    world.save(tmp_path / "world.npz")
    again = worlds.load(tmp_path / "world.npz")
    assert all(np.array_equal(one, other) for one, other in zip(world, again, strict=True))
    demos = again.demonstrations(0.9, None)
    assert demos.trajectories == 4
    ends = [path[-1] for path in demos.paths()]
    assert ends == [*np.repeat(world.goals, 2)]


def test_the_problem_for_other_planners_is_the_same(script):
    worlds, planning = script("worlds"), script("planning_problem")
    problem = planning.Problem(worlds.half_learned_office(12, seed=0), 0.9, 5.0)
    given = problem.arrays()
    states, actions = given["reward"].shape
    totals = np.zeros((states, actions))
    np.add.at(totals, (given["state"], given["action"]), given["chance"])
    assert totals == pytest.approx(1.0)
    goal = int(problem.world.goals[0])
    assert set(given["after"][given["state"] == goal]) == {goal}
    assert (given["reward"][goal] == 0).all()


def test_noise_is_told_from_the_gradient(script):
    """Two places whose gradients are (3, 4) and (5, 0), under noise of 1 and 2 a component."""
    gradients = np.array([[3.0, 4.0], [5.0, 0.0]])[:, None] + np.random.default_rng(0).normal(
        0, [[[1.0]], [[2.0]]], size=(2, 20_000, 2)
    )
    noise = script("rollout_noise").noise_of(gradients, 1.0)
    assert noise.mean == pytest.approx([4.0, 2.0], abs=5 * noise.error.max())
    assert noise.error == pytest.approx(np.sqrt(2.5 / 40_000), rel=0.05)
    assert noise.deviation**2 == pytest.approx(5.0, rel=0.05)
    assert noise.square == pytest.approx(25.0, rel=0.05)
    best = noise._replace(deviation=noise.deviation / 10)
    records = script("rollouts").records_of("a", 5, {"score": noise, "pathwise": best})
    assert records[0]["relative"] == pytest.approx(10.0)
    assert records[0]["roll_outs_needed"] == pytest.approx(100 * 5 / 25, rel=0.1)
    assert [record["apart"] for record in records] == [0.0, 0.0]
