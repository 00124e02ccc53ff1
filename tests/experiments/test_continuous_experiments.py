"""The continuous experiments from the command line, with few people and few steps: what they write."""

import json

import pytest

from sidestep.cli import main
from sidestep.continuous.fit import Schedule
from sidestep.continuous.planner import Planner
from sidestep.experiments import pendulum, room

pytestmark = pytest.mark.usefixtures("unoptimised")
PLANNER = Planner(horizon=3, places=4, samples=2, critic_width=4)
SCHEDULE = Schedule(iterations=2, rehearsals=1, moves=4)
KEYS = {
    "room": {"auc", "mean_inside", "mean_outside", "transitions_only", "seconds", "converged", "message"},
    "pendulum": {"gravity_true", "gravity_estimate", "seconds", "converged", "message"},
    "representations": {"auc", "mean_inside", "mean_outside", "representations", "seconds"},
}


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    for module in (room, pendulum):
        monkeypatch.setattr(module, "PLANNER", PLANNER)
        monkeypatch.setattr(module, "SCHEDULE", SCHEDULE)
        monkeypatch.setattr(module, "WALKERS", 1)
        monkeypatch.setattr(module, "_WIDTH", 4)
    monkeypatch.setattr(pendulum, "MOVES", 5)


@pytest.mark.parametrize("name", ["room", "pendulum", "representations"])
def test_an_experiment_writes_its_picture_and_its_figures(name, tmp_path, capsys):
    assert main(["experiment", name, "--out", str(tmp_path), "--seed", "1"]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert KEYS[name] <= set(summary)
    assert summary["command"] == f"experiment {name}"
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert "seconds" in capsys.readouterr().out


def test_an_experiment_that_does_not_exist_is_wrong_usage(capsys):
    assert main(["experiment", "kitchen"]) == 2
    assert "kitchen" in capsys.readouterr().err


def test_moves_into_the_wall_are_taken_out():
    world = room.room()
    demonstrations, collisions = room.demonstrated(world, seed=3)
    aims = demonstrations.states + world.actions[demonstrations.actions]
    assert collisions >= 0
    assert not world.inside(aims.__array__()).any()
