"""Maximization: which evaluations are approximate, and why it stops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
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


@pytest.mark.parametrize("seed", [0, 3, 10])
def test_fit_in_32_bits_of_thousands_of_moves_converges_to_the_right_place(seed):
    """Two actions that end or stay, and the learned β: the last steps of the optimizer are rounding."""
    random = np.random.default_rng(seed + 100)
    chances, ends = random.dirichlet(np.ones(2), (2, 2)), np.array([False, True])
    reward = -random.uniform(0.5, 1.5, (2, 2)) * ~ends[:, None]
    with jax.enable_x64(False):
        made = ss.from_dense(chances, reward, discount=0.95, terminal=ends)
        agents = ss.Behavior(BoltzmannAverage(), 2.0)
        shown = ss.simulate(jax.random.key(seed), made.model, [made.task], [np.zeros(3000, int)], agents)
        start = ss.TabularModel(made.model.graph, jnp.zeros(made.model.probabilities().shape))
        learn = ss.behavior_model(agents, ["beta"])
        result = fit(start, ss.gather(shown, [made.task]), learn, prior=Normal(0.0, 10.0))
    assert result.converged, result.message
    np.testing.assert_allclose(result.model.probabilities()[0], chances[0], atol=0.03)
    assert float(result.behavior.behavior_of().beta) == pytest.approx(2.0, abs=0.3)


def test_fit_of_a_choice_that_may_lead_into_a_trap_is_refused_with_the_move():
    """State 0 leads to the goal 1 or to the trap 2; at γ = 1 the action that may lead there is worth −∞."""
    model = ss.tabular_model(ss.graph([[[1, 1], [1, 2]], [[1, 1]] * 2, [[2, 2]] * 2]), np.full((3, 2, 2), 0.5))
    task = ss.task(np.array([[-1.0, -1.0], [0.0, 0.0], [-1.0, -1.0]]), 1.0, [False, True, False])
    walks = [ss.Trajectory(np.array([0, 1]), np.array([action]), 0) for action in (0, 1)]
    message = r"trajectory 2: agents choose action 1 in state 0 with probability 0: its value is −∞.* a lapse"
    with pytest.raises(ss.InputError, match=message):
        fit(model, ss.gather(walks, [task]), Behavior(BoltzmannAverage(), 2.0))


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
