"""Costs of cells against a transition model when the reward changes: by hand, and the experiment's claims."""

import json

import numpy as np
import pytest

import sidestep as ss
from sidestep.baselines.interface import ModelResult
from sidestep.baselines.maxent_irl import CostlyReward
from sidestep.experiments import motivation
from sidestep.experiments.motivation import COLUMNS, FORMS, ROWS, Form, run_trial, task_at_stakes, true_result
from sidestep.maps.fit import behavior_of

pytestmark = pytest.mark.slow

BLANK = ss.Grid.unknown(ROWS, COLUMNS)
GOAL = 8 * COLUMNS + 12
"""The lower right corner, beyond the wall and below the mud."""


def uniform_costs(form: Form, cost: float) -> ModelResult:
    """Return a model without obstacles, in which all cells cost the same."""
    reward = CostlyReward(form.config.reward.discount, form.config.reward.step_cost, costs=np.full(BLANK.size, cost))
    free, behavior = ss.ObstacleGrid(BLANK.passable()), behavior_of(form.config)
    return ModelResult(free, reward, behavior, np.zeros(BLANK.shape), ss.risk_averse_robot(free, []), True)


def steps_to_the_goal(starts):
    row, column = np.divmod(starts, COLUMNS)
    return (8 - row) + (12 - column)


def test_task_at_stakes_multiplies_the_reward_and_not_the_costs():
    task = task_at_stakes(uniform_costs(FORMS["steps"], 0.25), FORMS["steps"], GOAL, 3.0)
    np.testing.assert_allclose(task.reward, -3.25)
    np.testing.assert_allclose(np.broadcast_to(task.terminal_reward, BLANK.size)[GOAL], 3 * 40)
    task = task_at_stakes(uniform_costs(FORMS["goal"], 0.25), FORMS["goal"], GOAL, 3.0)
    np.testing.assert_allclose(task.reward, -0.25)
    np.testing.assert_allclose(np.broadcast_to(task.terminal_reward, BLANK.size)[GOAL], 3)


def test_run_trial_stays_put_where_a_path_costs_more_than_the_goal_pays():
    """With a cost c of every cell a path of d moves has the value kγ^d − c(1 − γ^d)/(1 − γ)."""
    trial = run_trial(uniform_costs(FORMS["goal"], 0.05), FORMS["goal"], GOAL, 0.1)
    decay = 0.95 ** steps_to_the_goal(trial.starts)
    away = 0.1 * decay <= 0.05 * (1 - decay) / 0.05
    assert 0 < away.sum() < len(away)
    np.testing.assert_array_equal(trial.outcomes == "stays_put", away)


def test_run_trial_without_costs_bumps_into_the_wall():
    trial = run_trial(uniform_costs(FORMS["steps"], 0.0), FORMS["steps"], 2 * COLUMNS + 12, 1.0)
    wall, column = COLUMNS // 2, trial.starts % COLUMNS
    assert (trial.outcomes[column < wall] == "bumps").all()
    assert (trial.outcomes[column > wall] == "arrives").all()


def test_run_trial_in_the_true_model_takes_the_fewest_moves():
    """A move into mud takes five times as long."""
    form, in_mud = FORMS["steps"], 3 * COLUMNS + 9
    trial = run_trial(true_result(form), form, in_mud, 10.0)
    assert (trial.outcomes == "arrives").all()
    np.testing.assert_allclose(trial.expected, trial.fewest, rtol=1e-9)
    above, corner = (trial.expected[trial.starts == state][0] for state in (1 * COLUMNS + 9, 0))
    assert above == pytest.approx(10)  # two cells of mud
    assert corner == pytest.approx(8 + 6 + 3 + 5 - 2 + 10)  # down, to the door, and up to the mud


def test_run_shows_that_costs_fail_when_the_stakes_change(tmp_path):
    """The transition model does not depend on the stakes; two goals of the agents suffice for that."""
    usual = motivation.MotivationConfig()
    goals, new_goals = tuple(usual.goals[index] for index in (2, 4)), usual.new_goals[:2]
    config = motivation.MotivationConfig(1, goals, 8, stakes=(0.1, 1.0, 10.0), new_goals=new_goals)
    summary = motivation.run(tmp_path, config=config)
    assert json.loads((tmp_path / "summary.json").read_text()) == json.loads(json.dumps(summary))
    assert summary["command"] == "experiment motivation"
    assert (tmp_path / "motivation.png").read_bytes().startswith(b"\x89PNG")
    goal, steps = summary["forms"]["goal"], summary["forms"]["steps"]
    for form in (goal, steps):
        assert form["truth"]["arrives"] == [1, 1, 1]
        for values in form["behavior"]["arrives"], form["behavior"]["relative_length"]:
            assert len(set(values)) == 1  # whatever the stakes
        assert min(form["behavior"]["arrives"]) > max(0.7, form["costs"]["arrives"][2] + 0.1)
        assert form["costs"]["bumps"][0] < 0.1
        assert form["costs"]["bumps"][2] > 0.3
        for method in form.values():
            np.testing.assert_allclose(np.sum([method[outcome] for outcome in motivation.OUTCOMES], axis=0), 1)
    assert goal["costs"]["stays_put"][0] > 0.6
    assert goal["costs"]["goal_in_mud"]["stays_put"][0] > 0.6
    assert goal["costs"]["stays_put"][2] == steps["costs"]["stays_put"][2] == 0
