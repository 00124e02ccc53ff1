"""Costs of places against a model of moves, when the reward changes: by hand, and what the experiment claims."""

import json

import numpy as np
import pytest

from sidestep.baselines.interface import ModelResult
from sidestep.baselines.maxent_irl import CostlyReward
from sidestep.cli.app import main
from sidestep.experiments import motivation
from sidestep.experiments.motivation import COLUMNS, FORMS, Form, at_stakes, tried, true_world
from sidestep.maps.fit import behavior_of
from sidestep.robots.robot import risk_averse_robot
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid

pytestmark = pytest.mark.usefixtures("unoptimised")
BLANK = Grid.unknown(motivation.ROWS, COLUMNS)
GOAL = 8 * COLUMNS + 12
"""The lower right corner, beyond the wall and below the mud."""


def with_state_costs(form: Form, cost: float) -> ModelResult:
    """Who takes nothing to be in the way, and every cell to cost the same."""
    reward = CostlyReward(form.config.reward.discount, form.config.reward.step_cost, np.full(BLANK.size, cost))
    free = ObstacleGrid(BLANK.passable())
    return ModelResult(
        free, reward, behavior_of(form.config.behavior), np.zeros(BLANK.shape), risk_averse_robot(free, []), True
    )


def steps_to_the_goal(starts):
    row, column = np.divmod(starts, COLUMNS)
    return (8 - row) + (12 - column)


def test_stakes_multiply_what_the_task_pays_and_not_what_cells_cost():
    task = at_stakes(with_state_costs(FORMS["steps"], 0.25), FORMS["steps"], GOAL, 3.0)
    np.testing.assert_allclose(task.reward, -3.25)
    np.testing.assert_allclose(np.broadcast_to(task.terminal_reward, BLANK.size)[GOAL], 3 * 40)
    task = at_stakes(with_state_costs(FORMS["goal"], 0.25), FORMS["goal"], GOAL, 3.0)
    np.testing.assert_allclose(task.reward, -0.25)
    np.testing.assert_allclose(np.broadcast_to(task.terminal_reward, BLANK.size)[GOAL], 3)


@pytest.mark.parametrize("stakes", [0.1, 1.0])
def test_a_robot_stays_put_where_its_way_costs_more_than_the_goal_pays(stakes):
    """With a cost c of every cell a way of d moves is worth kγ^d − c(1 − γ^d)/(1 − γ)."""
    trial = tried(with_state_costs(FORMS["goal"], 0.05), FORMS["goal"], GOAL, stakes)
    decay = 0.95 ** steps_to_the_goal(trial.starts)
    away = stakes * decay <= 0.05 * (1 - decay) / 0.05
    assert 0 < away.sum() < len(away)
    np.testing.assert_array_equal(trial.outcomes == "stays_put", away)


def test_a_robot_that_fears_nothing_walks_into_the_wall():
    trial = tried(with_state_costs(FORMS["steps"], 0.0), FORMS["steps"], 2 * COLUMNS + 12, 1.0)
    wall, column = COLUMNS // 2, trial.starts % COLUMNS
    assert (trial.outcomes[column < wall] == "bumps").all()
    assert (trial.outcomes[column > wall] == "arrives").all()


def test_mud_takes_five_times_as_long_and_who_knows_it_goes_the_best_way():
    form, world = FORMS["steps"], true_world()
    known = ModelResult(
        world,
        form.config.reward,
        behavior_of(form.config.behavior),
        np.asarray(world.blocked),
        risk_averse_robot(world, []),
        True,
    )
    in_mud = 3 * COLUMNS + 9
    trial = tried(known, form, in_mud, 10.0)
    assert (trial.outcomes == "arrives").all()
    np.testing.assert_allclose(trial.expected, trial.fewest, rtol=1e-9)
    above, corner = (trial.expected[trial.starts == state][0] for state in (1 * COLUMNS + 9, 0))
    assert above == pytest.approx(10)  # two cells of mud
    assert corner == pytest.approx(8 + 6 + 3 + 5 - 2 + 10)  # down, to the door, and up to the mud


def test_costs_overwhelm_small_stakes_and_are_overwhelmed_by_large_ones(tmp_path, monkeypatch, capsys):
    """The paper's motivation, on one draw: the model of moves does not care."""
    monkeypatch.setattr(motivation, "DRAWS", 1)
    monkeypatch.setattr(motivation, "STAKES", (0.1, 1.0, 10.0))
    monkeypatch.setattr(motivation, "NEW_GOALS", motivation.NEW_GOALS[:2])
    assert main(["experiment", "motivation", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["command"] == "experiment motivation"
    assert (tmp_path / "motivation.png").read_bytes().startswith(b"\x89PNG")
    assert "stays put by costs" in capsys.readouterr().out
    goal, steps = summary["forms"]["goal"], summary["forms"]["steps"]
    for form in (goal, steps):
        assert form["truth"]["arrives"] == [1, 1, 1]
        assert min(form["behavior"]["arrives"]) > 0.95
        assert len(set(form["behavior"]["relative_length"])) == 1  # whatever the stakes
        assert form["costs"]["bumps"][0] == 0
        assert form["costs"]["bumps"][2] > 0.3
        for method in form.values():
            total = np.sum([method[outcome] for outcome in motivation.OUTCOMES], axis=0)
            np.testing.assert_allclose(total, 1)
    assert goal["costs"]["stays_put"][0] > 0.6
    assert goal["costs"]["stays_put"][2] == 0
    assert goal["costs"]["arrives"][1] > 0.8
    assert goal["costs"]["goal_in_mud"]["stays_put"][0] > 0.6
    assert max(steps["costs"]["stays_put"]) == 0  # where people had to arrive, cells cost little
