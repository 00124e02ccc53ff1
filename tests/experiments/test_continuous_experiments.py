"""The continuous experiments with few agents and few steps: their files, and moves that are removed."""

import json

import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from sidestep.cli.app import main
from sidestep.experiments import pendulum, representations, room
from sidestep.worlds import continuous_room
from sidestep.worlds.continuous_room import without_moves

pytestmark = pytest.mark.slow

PLANNER = sc.Planner(horizon=3, batch_size=4, samples=2, critic_width=4)
SCHEDULE = sc.Schedule(iterations=2, policy_warmup=0, batch_size=4)
QUICK = {"planner": PLANNER, "schedule": SCHEDULE, "agents_per_goal": 1, "width": 4}
ROOM = representations.RepresentationsConfig(**QUICK, lattice_points=21, grid_optimizer=ss.LBFGS(max_iterations=1))
PENDULUM = pendulum.PendulumConfig(**QUICK, moves=5, lattice_points=(24, 21))


def check_run(module, config, keys, folder):
    """Check the picture, the summary and the lines of progress of an experiment."""
    lines, name = [], module.__name__.rpartition(".")[2]
    summary = module.run(folder, 1, lines.append, config)
    assert json.loads((folder / "summary.json").read_text()) == summary
    assert summary["command"] == f"experiment {name}"
    assert keys | {"seconds"} <= set(summary)
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert any("iteration 1 of 2" in line for line in lines)


def test_run_in_the_room_writes_pictures_and_summaries(tmp_path):
    """Both experiments compile the same functions."""
    scores = {"auc", "mean_inside", "mean_outside"}
    check_run(room, ROOM, scores | {"transitions_only", "converged", "message"}, tmp_path)
    check_run(representations, ROOM, scores | {"representations"}, tmp_path)


def test_run_of_the_pendulum_writes_picture_and_summary(tmp_path):
    check_run(pendulum, PENDULUM, {"gravity_true", "gravity_estimate", "converged", "message"}, tmp_path)


def test_experiment_command_unknown_name_is_wrong_usage(capsys):
    assert main(["experiment", "kitchen"]) == 2
    assert "kitchen" in capsys.readouterr().err


def test_demonstrations_never_aim_at_the_wall():
    world = continuous_room.room(ROOM.lattice_points)
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
    walk = ss.Trajectory(np.arange(7)[:, None], np.arange(10, 16), 3)
    left = without_moves(walk, np.array([hit == "x" for hit in hits]))
    assert [each.states.ravel().tolist() for each in left] == [list(piece) for piece in pieces]
    assert [each.actions.tolist() for each in left] == [[10 + state for state in piece[:-1]] for piece in pieces]
    assert all(each.task == 3 for each in left)
