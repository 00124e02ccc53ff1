"""`fit_map`: the first cells of walks are evidence."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import root_scalar

from sidestep.inference.fit import fit
from sidestep.inference.goals import weighted_demonstrations
from sidestep.inference.priors import Normal
from sidestep.maps.config import FitConfig, MapConfig, PriorConfig
from sidestep.maps.fit import behavior_of, fit_map
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import Task, reach

GRID = Grid.unknown(1, 4)
CONFIG = MapConfig(prior=PriorConfig("normal", mean=1.0, variance=2.5, wall_prior=0.0), fit=FitConfig("transitions"))


def walks(*lengths: int) -> Demonstrations[Task]:
    """Return walks of these numbers of moves to the right end of a corridor."""
    right, goal = 3, 3
    paths = [np.arange(goal - length, goal + 1) for length in lengths]
    return gather([Trajectory(path, np.full(len(path) - 1, right), 0) for path in paths], [reach(GRID, goal)])


def logits(demonstrations: Demonstrations[Task], config: MapConfig = CONFIG) -> np.ndarray:
    """Return the learned logits."""
    result = fit_map(ObstacleGrid(GRID, config.prior.mean), demonstrations, config)
    assert result.converged
    return np.asarray(result.model.parameters)


def most_probable(observations: float) -> float:
    """Return the maximum of −(θ − b)²/(2σ²) + n ln(1 − p), of a cell that was free n times."""

    def slope(logit: float) -> float:
        return -(logit - 1.0) / 2.5 - observations / (1 + np.exp(-logit))

    return root_scalar(slope, bracket=(-20, 20)).root


def test_fit_map_counts_first_cells_as_free():
    learned = logits(walks(3, 3, 1))
    # two begin in cell 0; through cell 1 two pass; two enter cell 2, where one begins; three arrive
    np.testing.assert_allclose(learned, [most_probable(n) for n in (2, 2, 3, 3)], atol=1e-4)


def test_fit_map_of_a_known_map_has_no_evidence():
    known = ObstacleGrid(GRID.passable(), 1.0)
    assert fit_map(known, walks(3, 1), CONFIG).final.prior == 0


def test_fit_map_with_several_candidate_goals_counts_a_first_cell_once():
    candidates = [reach(GRID, goal) for goal in (3, 2)]
    walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), 0)
    shown = weighted_demonstrations([walk, walk], candidates, np.array([[0.3, 0.7], [1.0, 0.0]]))
    np.testing.assert_allclose(logits(shown), [*[most_probable(2)] * 3, 1.0], atol=1e-4)


def test_fit_map_ignores_first_cells_of_walks_of_weight_0():
    learned = logits(walks(3, 1).with_only(np.array([False, True])))
    np.testing.assert_allclose(learned, [1.0, 1.0, most_probable(1), most_probable(1)], atol=1e-4)


@pytest.mark.slow
def test_fit_map_of_actions_alone_ignores_first_cells():
    config = replace(CONFIG, fit=FitConfig("actions"))
    prior = Normal(config.prior.mean, config.prior.variance)
    model = ObstacleGrid(GRID, config.prior.mean)
    by_actions = fit(model, walks(3, 3), behavior_of(config), prior=prior, terms=("actions",)).model.parameters
    np.testing.assert_allclose(logits(walks(3, 3), config), by_actions, atol=1e-6)
    # with transitions, the first cell is freer than by actions
    assert logits(walks(3, 3), replace(CONFIG, fit=FitConfig("both")))[0] < float(by_actions[0]) - 1
