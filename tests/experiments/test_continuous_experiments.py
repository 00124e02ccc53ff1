"""The continuous experiments from the command line, with few people and few steps: what they write."""

import json

import numpy as np
import pytest

from sidestep.cli.app import main
from sidestep.continuous.fit import Schedule
from sidestep.continuous.planner import Planner
from sidestep.experiments import pendulum, room
from sidestep.tabular.demonstrations import Trajectory
from sidestep.worlds.continuous_room import without

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
    world = room.room()  # pyright: ignore
    demonstrations, _ = room.demonstrated(world, seed=3)
    aims = demonstrations.states + world.actions[demonstrations.actions]
    assert not world.inside(aims.__array__()).any()


@pytest.mark.parametrize(
    ("hits", "pieces"),
    [
        ("......", [range(7)]),
        ("x....x", [range(1, 6)]),
        ("..xx..", [range(3), range(4, 7)]),
        (".x.x.x", [range(2), range(2, 4), range(4, 6)]),
        ("xxxxxx", []),
    ],
)
def test_what_is_left_of_a_walk_are_the_pieces_between(hits, pieces):
    walk = Trajectory(np.arange(7)[:, None], np.arange(10, 16), 3)
    left = without(np.array([hit == "x" for hit in hits]), walk)
    assert [each.states.ravel().tolist() for each in left] == [list(piece) for piece in pieces]
    assert [each.actions.tolist() for each in left] == [[10 + state for state in piece[:-1]] for piece in pieces]
    assert all(each.task == 3 for each in left)
