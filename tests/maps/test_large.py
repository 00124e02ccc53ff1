"""Large maps are learned from above: by steps that stay off cliffs, from cells taken as blocked."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.evaluation.metrics import score_map, visit_ranking
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.inference import batching, maximize
from sidestep.inference.fit import fit
from sidestep.inference.maximize import Approximation
from sidestep.inference.objective import Objective
from sidestep.inference.optimizers import LBFGS, Adam, Rprop
from sidestep.inference.priors import FreeCellEvidence, Normal
from sidestep.maps import fit as map_fit
from sidestep.maps.config import BehaviorConfig, FitConfig, MapConfig, PriorConfig, SimulationConfig
from sidestep.maps.fit import fit_map, max_iterations, optimizer_for
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.tabular.tasks import reach
from sidestep.worlds.offices import office
from sidestep.worlds.walks import simulate_walks

TRUTH = office(20, 24, seed=0)
UNKNOWN = Grid.unknown(20, 24)
CONFIG = MapConfig(Reward(1.0, 1.0), BehaviorConfig("logsumexp", 5.0), PriorConfig(0.5, 4.0, wall_prior=0.0))


@pytest.fixture(scope="module")
def demonstrations():
    trajectories, goals = simulate_walks(TRUTH, SimulationConfig(60, 6, reward=Reward(1.0, 1.0), seed=0))
    return gather(trajectories, [reach(UNKNOWN, goal, discount=1.0, step_cost=1.0) for goal in goals])


@pytest.fixture
def everything_is_large(monkeypatch):
    """For the choice of the optimiser, for solves that are only as exact as it needs, and for a batch for each task."""
    monkeypatch.setattr(map_fit, "LARGE_MAP", 1)
    monkeypatch.setattr(batching, "cores", lambda: 1)


@pytest.mark.usefixtures("everything_is_large")
def test_a_large_map_is_learned(demonstrations):
    found = fit_map(ObstacleGrid(UNKNOWN, 0.5), demonstrations, CONFIG)
    objectives = [progress.objective for progress in found.history]
    assert found.converged, found.message
    assert "promises" in found.message
    assert objectives == sorted(objectives)
    visited = demonstrations.visited_state_goals()
    relevant = relevant_obstacles(TRUTH, visited[:, 0], visited[:, 1])
    everywhere = np.ones(TRUTH.shape, dtype=bool)
    learned = score_map(np.asarray(found.model.blocked), TRUTH, everywhere, relevant).average_precision_relevant
    visit_counts = score_map(
        visit_ranking(visited[:, 0], TRUTH), TRUTH, everywhere, relevant
    ).average_precision_relevant
    assert learned is not None
    assert visit_counts is not None
    assert learned > 2 * visit_counts


def two_offices():
    """An office that nobody knows beside one that is known, a wall between them, and walks in each to its own goals."""
    offices, wall = [office(20, 24, seed).known for seed in (0, 1)], np.ones((20, 1), dtype=int)
    unknown = Grid(np.hstack([np.full((20, 24), -1), wall, offices[1]]))
    walks, goals = [], []
    for side in (0, 1):
        shown = [known if own == side else np.ones_like(known) for own, known in enumerate(offices)]
        found, ends = simulate_walks(
            Grid(np.hstack([shown[0], wall, shown[1]])), SimulationConfig(30, 3, reward=Reward(1.0, 1.0))
        )
        walks += [trajectory._replace(task=trajectory.task + len(goals)) for trajectory in found]
        goals += ends
    return unknown, gather(walks, [reach(unknown, goal, discount=1.0, step_cost=1.0) for goal in goals])


@pytest.mark.usefixtures("everything_is_large")
def test_taking_over_what_does_not_change_changes_nothing_but_the_work(monkeypatch):
    solves, solve_batch = [], Objective.evaluate_batch

    def counted(*given):
        solves.append(given)
        return solve_batch(*given)

    monkeypatch.setattr(Objective, "evaluate_batch", counted)
    unknown, demonstrations = two_offices()
    found = fit_map(ObstacleGrid(unknown, 0.5), demonstrations, CONFIG)
    once = len(solves)
    solves.clear()
    monkeypatch.setattr(maximize, "Approximation", lambda: Approximation(0.0, 0.0))
    expected = fit_map(ObstacleGrid(unknown, 0.5), demonstrations, CONFIG)
    assert once < len(solves)
    assert len(found.history) == len(expected.history)
    for one, other in zip(found.history, expected.history, strict=True):
        assert one.objective == pytest.approx(other.objective, rel=1e-5)
    np.testing.assert_allclose(found.model.blocked, expected.model.blocked, atol=1e-3)


def test_it_ends_where_a_search_along_the_gradient_does(demonstrations, monkeypatch):
    """But for what the tolerance leaves: some thousandths of a nat a move."""
    by_search = fit_map(ObstacleGrid(UNKNOWN, 0.5), demonstrations, CONFIG)
    monkeypatch.setattr(map_fit, "LARGE_MAP", 1)
    from_above = fit_map(ObstacleGrid(UNKNOWN, 0.5), demonstrations, CONFIG)
    assert len(from_above.history) < len(by_search.history)
    assert from_above.final.objective > by_search.final.objective - 5e-3 * len(demonstrations)


def transitions_only(grid, demonstrations):
    """Where the transitions alone lead, and where walks begin."""
    begun = np.bincount(demonstrations.states[demonstrations.first_moves()], minlength=grid.size)
    prior = FreeCellEvidence(Normal(0.5, 4.0), jnp.asarray(np.where(grid.known.ravel() == -1, begun, 0.0)))
    behavior = Behavior(LogSumExp(), 5.0)
    return fit(ObstacleGrid(grid, 0.5), demonstrations, behavior, prior=prior, terms=("transitions",)).final


@pytest.mark.usefixtures("everything_is_large")
def test_the_climb_begins_with_cells_that_nobody_visited_taken_as_blocked(demonstrations):
    start = fit_map(ObstacleGrid(UNKNOWN, 0.5), demonstrations, CONFIG).history[0]
    by_walks = transitions_only(UNKNOWN, demonstrations)
    unseen = TRUTH.size - len(np.unique([*demonstrations.states, *demonstrations.next_states]))
    # P(blocked) = σ(8), 7.5 from the prior's mean
    assert start.prior == pytest.approx(by_walks.prior - 7.5**2 / 8 * unseen)
    assert start.transitions == pytest.approx(by_walks.transitions)


@pytest.mark.usefixtures("everything_is_large")
def test_what_the_map_knows_is_left_alone(demonstrations):
    half = Grid(np.where(np.arange(24) < 12, TRUTH.known, -1))
    start = fit_map(ObstacleGrid(half, 0.5), demonstrations, replace(CONFIG, fit=FitConfig(max_iterations=1))).history[
        0
    ]
    visited = np.unique([*demonstrations.states, *demonstrations.next_states])
    unseen = np.setdiff1d(np.flatnonzero(half.known == -1), visited)
    by_walks = transitions_only(half, demonstrations)
    assert start.prior == pytest.approx(by_walks.prior - 7.5**2 / 8 * len(unseen))


@pytest.mark.parametrize(("options", "cells", "kind"), [
    ({}, 9_999, LBFGS),
    ({}, 10_000, Rprop),
    ({"terms": "actions"}, 10_000, Rprop),
    ({"terms": "transitions"}, 10_000, LBFGS),
    ({"gradient": "fixed_policy"}, 10_000, Adam),
])  # fmt: skip
def test_who_climbs(options, cells, kind):
    config = FitConfig(**options)
    chosen = optimizer_for(config, cells, moves=2000)
    assert isinstance(chosen, kind)
    if isinstance(chosen, Rprop):
        assert chosen.tolerance == pytest.approx(2.0)
    assert optimizer_for(replace(config, max_iterations=7), cells, moves=2000).max_iterations == 7
    assert max_iterations(config) == chosen.max_iterations
