"""Maximization: which evaluations are approximate, and why it stops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.walled import BLANK, walks
from sidestep.inference.batching import BatchPlan
from sidestep.inference.fit import fit
from sidestep.inference.maximize import Status, maximize, solve_tolerances
from sidestep.inference.objective import Objective, Problem
from sidestep.inference.optimizers import LBFGS, Adam, Rprop
from sidestep.inference.priors import Normal
from sidestep.maps.config import SimulationConfig
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.tasks import reach
from sidestep.worlds.offices import office
from sidestep.worlds.walks import simulate_walks

pytestmark = pytest.mark.slow

LOOSE = Rprop.solve_tolerance


class Watched(Objective):
    """Records the arguments of evaluations, and which batches were evaluated with all states."""

    def __init__(self, problem, reuses):
        super().__init__(problem, BatchPlan(1, keeps_warm_starts=True, reuses=reuses))
        self.evaluations, self.solves, self.reused = [], [], set()

    def evaluate(self, parameters, warm_starts, *, tolerance=None, known=(), reuse_below=0.0, partial_below=0.0):
        self.evaluations.append((tolerance, reuse_below > 0, partial_below > 0))
        if partial_below == 0:
            here = jax.tree.leaves(parameters)
            self.reused |= {
                each.all_states for each in known if all(map(np.array_equal, jax.tree.leaves(each.parameters), here))
            }
        settings = {"reuse_below": reuse_below, "partial_below": partial_below}
        result, starts = super().evaluate(parameters, warm_starts, tolerance=tolerance, known=known, **settings)
        assert partial_below > 0 or all(each.all_states for each in result.contributions)
        return result, starts

    def evaluate_batch(self, problem, parameters, batch, start, all_states):
        self.solves.append((self.evaluations[-1], all_states))
        return super().evaluate_batch(problem, parameters, batch, start, all_states)


@pytest.fixture(scope="module")
def problem():
    truth = office(12, 14, 2)
    trajectories, goals = simulate_walks(truth, SimulationConfig(16, 4, reward=Reward(1.0, 1.0)))
    demos = gather(trajectories, [reach(truth.forget(), goal, discount=1.0, step_cost=1.0) for goal in goals])
    behavior = behavior_model(Behavior(LogSumExp(), 5.0))
    options = SolveOptions(solver=GaussSeidel())
    return Problem(ObstacleGrid(truth.forget(), 0.0), behavior, demos, Normal(), ALL_TERMS, options)


def maximized(problem, reuses):
    """Maximize with a batch for each task; return the objective and the result."""
    optimizer, objective = Rprop(), Watched(problem, reuses)
    return objective, maximize(objective, optimizer, tolerances=solve_tolerances(problem, optimizer, large_map=1))


@pytest.fixture(scope="module")
def approximate(problem):
    return maximized(problem, reuses=True)


def test_maximize_solves_a_part_of_the_states_only_at_trial_points(approximate):
    objective, result = approximate
    assert result.status is Status.CONVERGED
    # only approximate evaluations with the loose tolerance leave out states
    assert {evaluation for evaluation, all_states in objective.solves if not all_states} == {(LOOSE, True, True)}
    assert {near for _, near, _ in objective.evaluations} == {False, True}
    assert all(partial == (near and tolerance == LOOSE) for tolerance, near, partial in objective.evaluations)
    # exact evaluations follow approximate ones at the same point
    assert objective.reused == {False, True}


def test_maximize_with_approximations_solves_all_states_less_often_and_ends_at_the_same_point(problem, approximate):
    objective, result = approximate
    exact, expected = maximized(problem, reuses=False)
    # solves of a part of the states come in addition
    assert sum(all_states for _, all_states in objective.solves) < len(exact.solves)
    assert len(result.history) == len(expected.history)
    for one, other in zip(result.history, expected.history, strict=True):
        assert one.objective == pytest.approx(other.objective, rel=1e-5)
    learned, exact_model = (problem.model.with_parameters(each.parameters.model) for each in (result, expected))
    np.testing.assert_allclose(learned.blocked, exact_model.blocked, atol=1e-3)


def test_fit_in_32_bits_converges_to_their_precision_and_says_so():
    with jax.enable_x64(False):
        start, optimizer = ObstacleGrid(BLANK, jnp.full(25, -2.0)), LBFGS(tolerance=1e-9)
        result = fit(start, walks(BLANK), Behavior(BoltzmannAverage()), optimizer=optimizer)
    assert result.status is Status.CONVERGED
    assert result.converged
    assert "the precision of the objective in 32-bit numbers (see jax_enable_x64)" in result.message
    exact = fit(ObstacleGrid(BLANK, -2.0), walks(BLANK), Behavior(BoltzmannAverage()))
    assert exact.converged
    assert abs(result.final.objective - exact.final.objective) < 1e-4 * abs(exact.final.objective)


def test_fit_in_32_bits_with_many_nats_to_gain_is_not_converged():
    """The prior is 10⁸ standard deviations away, so that the objective has errors of millions of nats."""
    with jax.enable_x64(False):
        start = ObstacleGrid(BLANK, jnp.full(25, -2.0))
        result = fit(start, walks(BLANK), Behavior(BoltzmannAverage()), prior=Normal(-1.0, 1e-16))
    assert result.converged == bool(np.abs(result.model.parameters + 1).max() < 1e-3)


@pytest.mark.parametrize(("backup", "optimizer", "status", "advice"), [
    (BoltzmannAverage(), LBFGS(), Status.CONVERGED, ""),
    (BoltzmannAverage(), Adam(max_iterations=3), Status.MAX_ITERATIONS, "a larger max_iterations"),
    (HardMax(), LBFGS(), Status.NO_ASCENT_STEP, "a kink"),
])  # fmt: skip
def test_fit_status_has_advice(backup, optimizer, status, advice):
    result = fit(ObstacleGrid(BLANK, -2.0), walks(BLANK), Behavior(backup, 10.0), optimizer=optimizer)
    assert result.status is status
    assert result.message.startswith(status.value)
    assert f"the largest gradient is {result.final.gradient:.2g}" in result.message
    assert result.message.endswith(status.advice)
    assert advice in status.advice
