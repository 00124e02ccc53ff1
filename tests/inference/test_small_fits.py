"""Fits of a corridor, in which each number is known: one cell that moves entered, or bumped into."""

import numpy as np
import pytest
from scipy.optimize import brentq

from sidestep.errors import InputError, NotConverged
from sidestep.inference.fit import fit
from sidestep.inference.maximize import Progress, Status, solve_tolerances
from sidestep.inference.objective import Problem
from sidestep.inference.optimizers import LBFGS, Adam
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach

ROW = Grid(np.array([[0, -1, 0, 0]]))
MODEL, AGENTS = ObstacleGrid(ROW, -1.0), Behavior(BoltzmannAverage(), 2.0)
RIGHT = 3
ENTERED, BUMPED = 5, 2
BUMPS = Trajectory(np.array([0, 0, 0, 1]), np.full(3, RIGHT), task=0)
PRIOR = Normal(0.5, 4.0)


def shown(*walks, grid=ROW, goal=3, **settings):
    return gather(walks, [reach(grid, goal, **settings)])


def entries():
    """Five moves into the cell, two of which bumped into it before."""
    return shown(BUMPS, *[Trajectory(np.array([0, 1]), np.array([RIGHT]), 0)] * (ENTERED - 1))


def sigmoid(theta):
    return 1 / (1 + np.exp(-theta))


def test_fit_of_transitions_is_the_mode_of_a_bernoulli_trial():
    reports = []
    result = fit(MODEL, entries(), AGENTS, prior=PRIOR, terms=("transitions",), report=reports.append)
    exact = brentq(lambda theta: BUMPED - (ENTERED + BUMPED) * sigmoid(theta) - (theta - 0.5) / 4, -9, 9)
    theta = np.asarray(result.model.parameters)
    assert theta[1] == pytest.approx(exact, abs=1e-3)
    np.testing.assert_allclose(theta[[0, 2, 3]], 0.5, atol=1e-3)  # what nothing determines is as the prior has it
    final, p = result.final, sigmoid(theta[1])
    assert final.actions == 0
    assert final.transitions == pytest.approx(ENTERED * np.log(1 - p) + BUMPED * np.log(p))
    assert final.prior == pytest.approx(-((theta - 0.5) ** 2).sum() / 8)
    assert final.objective == pytest.approx(final.transitions + final.prior)
    assert final.gradient <= LBFGS().tolerance
    assert result.converged
    assert result.status is Status.CONVERGED
    first = result.history[0]
    slope = BUMPED - (ENTERED + BUMPED) * sigmoid(-1.0) + 1.5 / 4
    assert first.gradient == pytest.approx(max(abs(slope), 1.5 / 4))
    assert [each.iteration for each in result.history] == list(range(len(result.history)))
    assert tuple(reports) == result.history


def test_fit_of_few_iterations_stops_and_says_so():
    optimizer = Adam(max_iterations=2)
    result = fit(MODEL, entries(), AGENTS, prior=PRIOR, terms=("transitions",), optimizer=optimizer)
    assert len(result.history) == 3
    assert result.status is Status.MAX_ITERATIONS
    assert not result.converged
    assert result.message.startswith(f"stopped at max_iterations: the largest gradient is {result.final.gradient:.2g}")
    assert result.message.endswith(Status.MAX_ITERATIONS.advice)


def test_fit_of_a_move_through_a_known_obstacle_names_it():
    grid = Grid(np.array([[-1, 1, -1, -1]]))
    walks = [Trajectory(np.array([2, 3]), np.array([RIGHT]), 0), Trajectory(np.array([0, 1]), np.array([RIGHT]), 0)]
    message = "trajectory 2: action 3 in state 0 led to state 1, to which the model gives probability 0"
    with pytest.raises(InputError, match=message):
        fit(ObstacleGrid(grid), shown(*walks, grid=grid), AGENTS)


def test_fit_of_values_that_do_not_converge_names_the_task():
    few = SolveOptions(solver=Jacobi(max_sweeps=1))
    with pytest.raises(NotConverged, match=r"task\(s\) \[0\] \(residual up to"):
        fit(MODEL, entries(), AGENTS, options=few)


def test_fit_of_a_state_without_a_way_to_the_goal_names_its_walk():
    grid = Grid(np.array([[-1, -1, 1, -1, -1]]))
    walks = [Trajectory(np.array([3, 4]), np.array([RIGHT]), 0), Trajectory(np.array([0, 1]), np.array([RIGHT]), 0)]
    demos = shown(*walks, grid=grid, goal=4, discount=1.0, step_cost=1.0)
    with pytest.raises(InputError, match="trajectory 2: state 0 is visited, but the goal cannot be reached from it"):
        fit(ObstacleGrid(grid), demos, AGENTS)


def test_progress_says_the_objective_and_the_gradient():
    progress = Progress(3, -12.34567, -10.0, -2.0, -0.34567, 0.01234)
    assert progress.description == "objective -12.346, largest gradient 0.012"
    assert progress.total is None


@pytest.mark.parametrize(
    ("large_map", "given", "loose"), [(3, None, True), (4, None, True), (5, None, False), (4, 1e-5, False)]
)
def test_solve_tolerances_are_loose_first_on_large_maps(large_map, given, loose):
    solver = Jacobi(tolerance=given)
    options = SolveOptions(solver=solver)
    problem = Problem(MODEL, behavior_model(AGENTS), entries(), PRIOR, ALL_TERMS, options)
    tolerances = solve_tolerances(problem, LBFGS(), large_map)
    exact = float(solver.tolerance_for(np.dtype(np.float64)))
    assert tolerances == ([LBFGS().solve_tolerance, exact] if loose else [None])


def test_fit_of_which_the_next_points_have_no_values_has_not_converged():
    """Agents that would rather stay than arrive: at discount 1, a larger taste for staying has no values."""
    grid = Grid(np.zeros((1, 4), int))
    features = (np.arange(4) == 0).astype(float)[:, None, None]
    walk = Trajectory(np.array([1] + [0] * 8 + [1, 2, 3]), np.array([2] + [2] * 7 + [3, 3, 3]), 0)
    demos = gather([walk] * 20, [reach(grid, 3, discount=1.0, step_cost=1.0)])
    agents = behavior_model(Behavior(BoltzmannAverage(), 3.0), features=features)
    result = fit(true_model(grid), demos, agents, terms=("actions",))
    assert result.final.gradient > 1
    assert not result.converged
    assert result.status is Status.NO_VALUES
    assert "the maximum may lie where a task has no values" in result.message
