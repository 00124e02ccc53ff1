"""Selection of the behavior, for walks of simulated agents with known parameters."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.office import BLANK, OFFICE, WALL, call, simulated, summary, write_office
from sidestep.errors import ImproperTask, InputError
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.io.gridding import grid_walks
from sidestep.io.walks import write_walks
from sidestep.maps.config import BehaviorConfig, FitConfig, MapConfig, PriorConfig, SimulationConfig
from sidestep.maps.learn import learn_map
from sidestep.maps.selection import Trial, select_behavior
from sidestep.tabular.grid import Grid
from sidestep.tabular.reward import Reward
from sidestep.worlds.walks import simulate_walks

pytestmark = pytest.mark.slow

SHORT = FitConfig(max_iterations=2)
"""Two iterations take a map close enough to compare rewards."""


def select(walks, config=MapConfig(), grid=BLANK):  # noqa: B008
    return select_behavior(grid, grid_walks(walks, grid), replace(config, fit=SHORT))


def test_learn_with_selection_of_optimal_walks_raises_beta(tmp_path, capsys):
    write_office(tmp_path)
    write_walks(tmp_path / "walks.csv", simulated(walks=40, goals=4))
    command = ("learn", tmp_path / "walks.csv", "--map", tmp_path / "blank.yaml", "--out", tmp_path)
    assert call(*command, "--select-behavior", "--max-iterations", 8) == 0
    result = summary(tmp_path)
    settings, behavior = result["settings"], result["behavior"]
    assert behavior["beta"] == settings["behavior"]["beta"] >= 14
    assert settings["behavior"]["tempering"] == 1
    assert (settings["reward"]["discount"], settings["reward"]["step_cost"]) == (0.95, None)
    assert behavior["lapse"] < 0.05
    assert "the reward is a goal that pays 1" in capsys.readouterr().out
    blocked = np.load(tmp_path / "blocked.npy")
    assert blocked[WALL].min() > blocked[~WALL].max()


def test_select_behavior_of_agents_with_different_beta_tempers_their_actions():
    """An agent with a small β has it in every move of the walk, so moves are not independent."""
    random, sharp = (simulate_walks(OFFICE, SimulationConfig(10, 2, beta, seed=3)) for beta in (0.5, 60.0))
    walks = walks_from_trajectories([*random[0], *sharp[0]], random[1], OFFICE)
    selection = select(walks, MapConfig(behavior=BehaviorConfig(beta=10.0)))
    assert selection.config.behavior.tempering == selection.trials[0].ratio < 0.6
    assert any("actions count by" in reason for reason in selection.reasons)


def test_select_behavior_of_long_walks_with_step_costs_selects_them():
    """At sixty cells from the goal a reward of 1 with the discount .95 is close to 0."""
    grid = Grid(np.zeros((1, 60), dtype=int))
    walks = simulated(grid, walks=30, goals=2, beta=2.0, reward=Reward(1.0, 1.0))
    selection = select(walks, grid=grid.forget())
    assert selection.config.reward == Reward(1.0, 1.0)
    assert "the reward is a cost of every cell" in selection.reasons[0]


@pytest.mark.parametrize(("config", "message"), [
    # two cells from all walks an agent pays for some 5·10⁸ moves that fail: values do not converge
    (MapConfig(prior=PriorConfig("normal", mean=20.0)), "converge"),
    # by log-sum-exp, four actions are worth log(4)/β, more than they cost
    (MapConfig(behavior=BehaviorConfig("logsumexp", 10.0)), "an endless path is worth more"),
])  # fmt: skip
def test_select_behavior_passes_over_rewards_without_values(config, message):
    """In a corridor of which walks visit the left half."""
    half = Grid(np.zeros((1, 3), dtype=int))
    selection = select(simulated(half, walks=6, goals=2), config, Grid.unknown(1, 6))
    reason = next(
        reason for reason in selection.reasons if "a cost of every cell with β = 0.5 was passed over" in reason
    )
    assert message in reason


def test_learn_map_with_selection_of_an_own_reward_without_values_raises():
    config = MapConfig(Reward(1.0, 1.0), BehaviorConfig("logsumexp", 0.5, select=True))
    with pytest.raises(ImproperTask, match="an endless path is worth more"):
        learn_map(BLANK, simulated(walks=6), config)


def test_summary_of_walks_without_variation_has_no_ratio():
    none = np.zeros(3)
    trial = Trial(MapConfig(), none, none, moves=5, ratio=np.inf, lapse=0.0, converged=0)
    assert json.loads(json.dumps(trial.summary(), allow_nan=False))["effective_sample_ratio"] is None


def test_select_behavior_of_one_walk_is_refused():
    with pytest.raises(InputError, match="field 'select_behavior': expected at least 2 walks to select by, found 1"):
        select(simulated(walks=1, goals=1))


def test_behavior_config_refuses_unknown_parameters():
    with pytest.raises(InputError, match="field 'learn': expected one of beta, lapse, discount, found 'mood'"):
        BehaviorConfig(learn=("mood",))
