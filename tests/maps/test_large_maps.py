"""Large maps are learned by Rprop, from a start where all unvisited cells are blocked."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.evaluation.metrics import score_map, visit_ranking
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.inference.fit import fit
from sidestep.inference.optimizers import LBFGS, Adam, Rprop
from sidestep.inference.priors import FreeCellEvidence, Normal
from sidestep.maps.config import BehaviorConfig, FitConfig, MapConfig, PriorConfig, SimulationConfig
from sidestep.maps.fit import behavior_of, fit_map, max_iterations, optimizer_for
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.worlds.offices import office
from sidestep.worlds.walks import simulate_walks

pytestmark = pytest.mark.slow

TRUTH = office(20, 24, seed=0)
UNKNOWN = TRUTH.forget()
SMALL = MapConfig(
    Reward(1.0, 1.0), BehaviorConfig("logsumexp", 5.0), PriorConfig("normal", mean=0.5, variance=4.0, wall_prior=0.0)
)
LARGE = replace(SMALL, fit=FitConfig(large_map=1))
FIRST_STEP = replace(SMALL, fit=FitConfig(large_map=1, max_iterations=1))


@pytest.fixture(scope="module")
def demonstrations():
    trajectories, goals = simulate_walks(TRUTH, SimulationConfig(60, 6, reward=SMALL.reward))
    return gather(trajectories, [SMALL.reward.reach(UNKNOWN, goal) for goal in goals])


@pytest.fixture(scope="module")
def learned(demonstrations):
    return fit_map(ObstacleGrid(UNKNOWN, 0.5), demonstrations, LARGE)


def test_fit_map_of_a_large_map_ranks_relevant_cells_better_than_visits(demonstrations, learned):
    objectives = [progress.objective for progress in learned.history]
    assert learned.converged, learned.message
    assert "promises" in learned.message
    assert objectives == sorted(objectives)
    states, goals = demonstrations.visited_state_goals().T
    relevant = relevant_obstacles(TRUTH, states, goals)
    everywhere = np.ones(TRUTH.shape, dtype=bool)
    of_map, of_visits = (
        score_map(ranking, TRUTH, everywhere, relevant).average_precision_relevant
        for ranking in (np.asarray(learned.model.blocked), visit_ranking(states, TRUTH))
    )
    assert of_map is not None
    assert of_visits is not None
    assert of_map > 2 * of_visits


def test_fit_map_by_rprop_is_no_worse_than_by_lbfgs(demonstrations, learned):
    """Up to the tolerance: some thousandths of a nat a move."""
    by_lbfgs = fit_map(ObstacleGrid(UNKNOWN, 0.5), demonstrations, SMALL)
    assert len(learned.history) < len(by_lbfgs.history)
    assert learned.final.objective > by_lbfgs.final.objective - 5e-3 * len(demonstrations)


@pytest.mark.parametrize("known_columns", [0, 12])
def test_fit_map_of_a_large_map_starts_with_unvisited_unknown_cells_blocked(demonstrations, known_columns):
    grid = Grid(np.where(np.arange(24) < known_columns, TRUTH.known, -1))
    start = fit_map(ObstacleGrid(grid, 0.5), demonstrations, FIRST_STEP).history[0]
    unknown = grid.known.ravel() == -1
    first = np.bincount(demonstrations.states[demonstrations.first_moves()], minlength=grid.size)
    prior = FreeCellEvidence(Normal(0.5, 4.0), jnp.asarray(np.where(unknown, first, 0.0)))
    behavior = behavior_of(SMALL)
    by_transitions = fit(ObstacleGrid(grid, 0.5), demonstrations, behavior, prior=prior, terms=("transitions",)).final
    visited = np.unique([*demonstrations.states, *demonstrations.next_states])
    unvisited = np.setdiff1d(np.flatnonzero(unknown), visited)
    # the logit 8 is 7.5 from the prior's mean
    assert start.prior == pytest.approx(by_transitions.prior - 7.5**2 / 8 * len(unvisited))
    assert start.transitions == pytest.approx(by_transitions.transitions)


@pytest.mark.parametrize(("options", "cells", "kind"), [
    ({}, 9_999, LBFGS),
    ({}, 10_000, Rprop),
    ({"large_map": 50}, 50, Rprop),
    ({"terms": "actions"}, 10_000, Rprop),
    ({"terms": "transitions"}, 10_000, LBFGS),
    ({"gradient": "fixed_policy"}, 10_000, Adam),
])  # fmt: skip
def test_optimizer_for_depends_on_terms_gradient_and_cells(options, cells, kind):
    config = FitConfig(**options)
    optimizer = optimizer_for(config, cells, moves=2000)
    assert isinstance(optimizer, kind)
    if isinstance(optimizer, Rprop):
        assert optimizer.tolerance == pytest.approx(2.0)
    assert optimizer_for(replace(config, max_iterations=7), cells, moves=2000).max_iterations == 7
    assert max_iterations(config) == optimizer.max_iterations
