"""The continuous experiments with few agents and few steps: their files, and moves that are removed."""

import json

import numpy as np
import pytest

from sidestep.cli.app import main
from sidestep.continuous.likelihood import Schedule
from sidestep.continuous.planner import Planner
from sidestep.experiments import pendulum, representations, room
from sidestep.inference.optimizers import LBFGS
from sidestep.tabular.demonstrations import Trajectory
from sidestep.worlds import continuous_room
from sidestep.worlds.continuous_room import without_moves

pytestmark = pytest.mark.usefixtures("unoptimised")
QUICK = {
    "planner": Planner(horizon=3, batch_size=4, samples=2, critic_width=4),
    "schedule": Schedule(iterations=2, policy_warmup=1, batch_size=4),
    "agents_per_goal": 1,
    "width": 4,
}
ROOM = room.RoomConfig(**QUICK, lattice_points=21)
PENDULUM = pendulum.PendulumConfig(**QUICK, moves=5, lattice_points=(24, 21))
REPRESENTATIONS = representations.RepresentationsConfig(
    **QUICK, lattice_points=21, grid_optimizer=LBFGS(max_iterations=1)
)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "run", "config", "keys"), [
    ("room", room.run, ROOM, {"auc", "mean_inside", "mean_outside", "transitions_only", "converged", "message"}),
    ("pendulum", pendulum.run, PENDULUM, {"gravity_true", "gravity_estimate", "converged", "message"}),
    (
        "representations",
        representations.run,
        REPRESENTATIONS,
        {"auc", "mean_inside", "mean_outside", "representations"},
    ),
])  # fmt: skip
def test_run_writes_picture_and_summary(name, run, config, keys, tmp_path):
    reports = []
    summary = run(tmp_path, 1, reports.append, config)
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert summary["command"] == f"experiment {name}"
    assert keys | {"seconds"} <= set(summary)
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert reports


def test_experiment_command_unknown_name_is_wrong_usage(capsys):
    assert main(["experiment", "kitchen"]) == 2
    assert "kitchen" in capsys.readouterr().err


def test_demonstrations_never_aim_at_the_wall():
    world = continuous_room.room()
    demonstrations, _ = ROOM.demonstrations(world, seed=3)
    targets = demonstrations.states + world.actions[demonstrations.actions]
    assert not world.inside(np.asarray(targets)).any()


@pytest.mark.parametrize(("hits", "pieces"), [
    ("......", [range(7)]),
    ("x....x", [range(1, 6)]),
    ("..xx..", [range(3), range(4, 7)]),
    (".x.x.x", [range(2), range(2, 4), range(4, 6)]),
    ("xxxxxx", []),
])  # fmt: skip
def test_without_moves_returns_the_pieces_between(hits, pieces):
    walk = Trajectory(np.arange(7)[:, None], np.arange(10, 16), 3)
    left = without_moves(walk, np.array([hit == "x" for hit in hits]))
    assert [each.states.ravel().tolist() for each in left] == [list(piece) for piece in pieces]
    assert [each.actions.tolist() for each in left] == [[10 + state for state in piece[:-1]] for piece in pieces]
    assert all(each.task == 3 for each in left)
