"""Fits: the objective that they maximize, where they end, and what they refuse."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from helpers.walled import BLANK, PATHS, WALL, follow, objective, walks
from sidestep.errors import ImproperTask, InputError, NotConverged
from sidestep.inference.fit import Fit, fit
from sidestep.inference.optimizers import LBFGS, Adam
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach

pytestmark = pytest.mark.slow

PAYING, COSTLY = (0.95, None), (1.0, 1.0)
"""Rewards: discount and step cost."""
ADAM, FIXED_POLICY = Adam(max_iterations=200), SolveOptions("fixed_policy")

# name: (reward, backup, β, settings of the likelihood, settings of the fit)
CASES = {
    "Boltzmann": (PAYING, BoltzmannAverage(), 10.0, {}, {}),
    "log-sum-exp": (COSTLY, LogSumExp(), 2.0, {}, {}),
    "hard max": (PAYING, HardMax(), 10.0, {}, {}),
    "horizon 12": (PAYING, BoltzmannAverage(), 10.0, {"options": SolveOptions(horizon=12)}, {}),
    "actions": (PAYING, BoltzmannAverage(), 10.0, {"terms": ("actions",)}, {}),
    "transitions": (PAYING, BoltzmannAverage(), 10.0, {"terms": ("transitions",)}, {}),
    "Adam": (PAYING, BoltzmannAverage(), 10.0, {}, {"optimizer": ADAM}),
    "fixed policy": (PAYING, BoltzmannAverage(), 10.0, {}, {"optimizer": ADAM, "options": FIXED_POLICY}),
}
SMOOTH = ["Boltzmann", "log-sum-exp", "horizon 12", "actions", "transitions"]
LINE_SEARCH = [*SMOOTH, "hard max"]
BOTH = [name for name in CASES if name not in ("actions", "transitions")]
MODEL = ObstacleGrid(BLANK, -2.0)


@cache
def fitted(name: str) -> Fit[ObstacleGrid]:
    reward, backup, beta, of_likelihood, of_fit = CASES[name]
    return fit(MODEL, walks(BLANK, *reward), Behavior(backup, beta), **of_likelihood, **of_fit)


@cache
def objective_of(name: str):
    reward, backup, beta, of_likelihood, _ = CASES[name]
    demonstrations, behavior = walks(BLANK, *reward), Behavior(backup, beta)
    return jax.jit(lambda theta: objective(MODEL, demonstrations, behavior, theta, **of_likelihood))


@pytest.mark.parametrize("name", CASES)
def test_fit_history_has_the_objective_and_its_parts(name):
    result = fitted(name)
    assert [progress.iteration for progress in result.history] == list(range(len(result.history)))
    for progress in result.history:
        assert progress.objective == pytest.approx(progress.actions + progress.transitions + progress.prior, rel=1e-12)
    start, final = result.history[0], result.final
    assert start.prior == 0
    assert start.objective == pytest.approx(float(objective_of(name)(jnp.full(25, -2.0))), rel=1e-9)
    assert final.objective == pytest.approx(float(objective_of(name)(result.model.parameters)), rel=1e-9)
    assert final.prior == pytest.approx(-float(jnp.sum((result.model.parameters + 2) ** 2) / 4), rel=1e-12)
    assert final.objective > start.objective


@pytest.mark.parametrize("name", LINE_SEARCH)
def test_fit_with_lbfgs_increases_the_objective_at_every_iteration(name):
    objective = np.array([progress.objective for progress in fitted(name).history])
    # the values of hundreds of moves are each known to the solver's tolerance, and no better is their sum
    assert (np.diff(objective) > -1e-7).all()


@pytest.mark.parametrize("name", SMOOTH)
def test_fit_ends_at_a_maximum(name):
    result, maximized = fitted(name), objective_of(name)
    assert result.converged
    assert result.message.startswith("converged")
    best, width, far = np.asarray(result.model.parameters), 1e-3, 0.05
    for change in np.eye(25):
        slope = (maximized(best + width * change) - maximized(best - width * change)) / (2 * width)
        assert abs(slope) < 1e-3  # the tolerance of the fit is 1e-4
        assert maximized(best + far * change) < maximized(best) > maximized(best - far * change)


@pytest.mark.parametrize("name", BOTH)
def test_fit_finds_the_wall_that_no_path_touches(name):
    blocked = np.asarray(fitted(name).model.blocked)
    assert blocked[WALL].min() > 0.5
    assert blocked[WALL].min() > blocked[~WALL].max() + 0.2


@pytest.mark.parametrize("name", CASES)
def test_fit_converged_iff_the_gradient_is_small(name):
    """The hard max has kinks: no step increases the objective although the gradient is far from zero."""
    result = fitted(name)
    tolerance = CASES[name][4].get("optimizer", LBFGS()).tolerance
    assert result.converged == (result.final.gradient <= tolerance) == (name != "hard max")
    assert f"{result.final.gradient:.2g}" in result.message
    assert result.task_converged.all()
    assert result.task_converged.shape == result.sweeps.shape == result.residual.shape == (3,)
    assert (result.residual <= 1e-10).all()


def test_fit_with_adam_ends_where_lbfgs_does():
    one, other = fitted("Boltzmann"), fitted("Adam")
    assert other.final.objective == pytest.approx(one.final.objective, abs=1e-3)
    np.testing.assert_allclose(other.model.blocked, one.model.blocked, atol=5e-3)


def test_fit_of_one_term_ignores_the_other():
    actions, transitions, both = (fitted(name) for name in ("actions", "transitions", "Boltzmann"))
    assert all(progress.transitions == 0 for progress in actions.history)
    assert all(progress.actions == 0 for progress in transitions.history)
    assert all(progress.actions < 0 and progress.transitions < 0 for progress in both.history)
    walked = np.zeros(25, dtype=bool)
    for _, start, moves in PATHS:
        walked[follow(start, moves)[0][1:]] = True
    walked = walked.reshape(5, 5)
    prior = 1 / (1 + np.exp(2))
    learned = np.asarray(transitions.model.blocked)
    assert (learned[walked] < prior - 0.01).all()
    np.testing.assert_allclose(learned[~walked], prior, rtol=1e-12)
    assert np.asarray(actions.model.blocked)[walked].mean() > np.asarray(both.model.blocked)[walked].mean()


@pytest.mark.parametrize(("failures", "prior"), [
    (0, Normal(-2.0, 2.0)),
    (7, Normal(0.5, 0.5)),
    (3, Normal(0.0, 1e9)),
    (3, Normal(jnp.array([1.0, -3.0, 0.0]), jnp.array([2.0, 0.5, 4.5]))),
])  # fmt: skip
def test_fit_of_transitions_of_one_cell_is_a_bernoulli_trial(failures, prior):
    """(failures)(1 − p) − (successes) p = (θ − b)/σ² at the optimum; cells without moves stay at the prior."""
    trials, grid = 8, Grid.unknown(1, 3)
    attempts = [Trajectory(np.array([0, 0 if index < failures else 1]), np.array([3]), 0) for index in range(trials)]
    result = fit(
        ObstacleGrid(grid, -1.0),
        gather(attempts, [reach(grid, 2)]),
        Behavior(BoltzmannAverage()),
        prior=prior,
        terms=("transitions",),
        optimizer=LBFGS(tolerance=1e-10),
    )
    mean, variance = np.broadcast_to(prior.mean, 3), np.broadcast_to(prior.variance, 3)

    def slope(theta):
        probability = 1 / (1 + np.exp(-theta))
        return failures - trials * probability - (theta - mean[1]) / variance[1]

    theta = result.model.parameters
    assert float(theta[1]) == pytest.approx(brentq(slope, -30, 30, xtol=1e-14), abs=1e-6)
    if variance[1] < 1e9:
        np.testing.assert_allclose(theta[jnp.array([0, 2])], mean[[0, 2]], atol=1e-6)
    else:
        assert float(jax.nn.sigmoid(theta[1])) == pytest.approx(3 / 8, abs=1e-6)


def test_fit_keeps_known_cells():
    known = np.full((5, 5), Cell.UNKNOWN, dtype=int)
    known[0, 2], known[4, :] = Cell.OCCUPIED, Cell.FREE
    grid = Grid(known)
    result = fit(ObstacleGrid(grid, -2.0), walks(grid, *PAYING), Behavior(BoltzmannAverage()))
    blocked = np.asarray(result.model.blocked)
    assert blocked[0, 2] == 1
    assert (blocked[4] == 0).all()
    assert ((blocked > 0) & (blocked < 1))[known == Cell.UNKNOWN].all()
    np.testing.assert_array_equal(np.asarray(result.model.parameters)[known.reshape(-1) != Cell.UNKNOWN], -2.0)
    assert blocked[1:4, 2].min() > 0.5


def test_fit_follows_a_narrow_prior_of_a_cell():
    narrow = jnp.full(25, 2.0).at[7].set(5e-7).at[13].set(5e-7)
    prior = Normal(jnp.full(25, -2.0).at[13].set(1.5), narrow)
    result = fit(MODEL, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()), prior=prior)
    np.testing.assert_allclose(result.model.parameters[jnp.array([7, 13])], [-2.0, 1.5], atol=1e-3)
    assert float(fitted("Boltzmann").model.parameters[7]) > 1


def test_fit_of_a_tabular_model_learns_an_avoided_transition():
    """Five states in a line; a step leads one further, a jump two, and either may fail.

    Agents jump, but never from state 0 although the goal is two jumps away.
    """
    step, jump = np.minimum(np.arange(5) + 1, 4), np.minimum(np.arange(5) + 2, 4)
    staying = np.broadcast_to(np.arange(5)[:, None], (5, 2))
    world = graph(np.stack([np.stack([step, jump], axis=1), staying], axis=2))
    paths = [([0, 1, 3, 4], [0, 1, 0]), ([2, 4], [1])]
    demos = gather([Trajectory(np.array(path), np.array(moves), 0) for path, moves in paths * 20], [reach(world, 4)])
    often_works = jnp.array([2.0, 0.0])
    model = TabularModel(world, jnp.broadcast_to(often_works, (5, 2, 2)))
    result = fit(model, demos, Behavior(BoltzmannAverage()), prior=Normal(often_works, 2.0))
    assert result.converged
    works, beforehand = np.asarray(result.model.probabilities())[..., 0], 1 / (1 + np.exp(-2))
    assert works[0, 1] < 0.3
    assert min(works[0, 0], works[1, 1], works[3, 0], works[2, 1]) > beforehand
    assert works[4] == pytest.approx(beforehand, abs=1e-6)  # no actions at the goal


@pytest.mark.parametrize(("settings", "message"), [
    ({"options": FIXED_POLICY}, r"'gradient'.*Adam\(\)"),
    ({"terms": ()}, "'terms'"),
    ({"resume": True}, "'resume'"),
])  # fmt: skip
def test_fit_refuses_arguments_that_exclude_each_other(settings, message):
    with pytest.raises(InputError, match=message):
        fit(MODEL, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()), **settings)


def test_fit_refuses_tasks_without_values():
    """Each of four actions is worth log(4)/β = 1.39 with log-sum-exp, more than it costs."""
    with pytest.raises(ImproperTask, match="an endless path is worth more"):
        fit(MODEL, walks(BLANK, *COSTLY), Behavior(LogSumExp(), 1.0))


def test_fit_raises_if_solves_do_not_converge():
    behavior, demonstrations = Behavior(BoltzmannAverage()), walks(BLANK, *PAYING)
    with pytest.raises(NotConverged, match=r"task\(s\) \[0, 1, 2\]"):
        fit(MODEL, demonstrations, behavior, options=SolveOptions(solver=Jacobi(max_sweeps=2)))
    enough = int(eqx.filter_jit(solve)(MODEL, demonstrations.tasks, behavior).sweeps.max())
    few = SolveOptions(solver=Jacobi(max_sweeps=enough))
    with pytest.raises(NotConverged, match="stopped converging at iteration"):
        # steps so long that warm starts do not help
        fit(MODEL, demonstrations, behavior, options=few, optimizer=Adam(learning_rate=3.0))


def test_fit_with_lbfgs_stays_where_solves_converge():
    """The solves converge near the start only; the line search does not leave this region."""
    behavior, demonstrations = Behavior(BoltzmannAverage()), walks(BLANK, *PAYING)
    enough = 2 + int(eqx.filter_jit(solve)(MODEL, demonstrations.tasks, behavior).sweeps.max())
    result = fit(MODEL, demonstrations, behavior, options=SolveOptions(solver=Jacobi(max_sweeps=enough)))
    assert result.task_converged.all()
    assert (np.diff([progress.objective for progress in result.history]) > 0).all()
    assert not result.converged
    assert result.final.objective < fitted("Boltzmann").final.objective


def test_fit_refuses_visited_states_that_cannot_reach_their_goal():
    known = np.full((5, 5), Cell.UNKNOWN, dtype=int)
    known[:, 2] = Cell.OCCUPIED
    walled_off = gather(
        [Trajectory(*follow(4, "D"), 0), Trajectory(*follow(0, "D"), 0)],
        [reach(BLANK, 14, discount=1.0, step_cost=1.0)],
    )
    with pytest.raises(InputError, match="trajectory 2: state 0 is visited, but the goal cannot be reached"):
        fit(ObstacleGrid(Grid(known), -2.0), walled_off, Behavior(BoltzmannAverage()))


def test_fit_twice_is_the_same_bit_for_bit():
    again = fit(MODEL, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()))
    assert again.history == fitted("Boltzmann").history
    np.testing.assert_array_equal(again.model.parameters, fitted("Boltzmann").model.parameters)


@pytest.mark.parametrize("whole", [True, False])
def test_fit_in_32_bits_finds_the_same_map(whole):
    """With 32 bits for all numbers, or for the model only."""
    with jax.enable_x64(not whole):
        model = ObstacleGrid(BLANK, jnp.full(25, -2.0, jnp.float32))
        result = fit(model, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()))
        assert result.model.parameters.dtype == result.residual.dtype == jnp.float32
        blocked = np.asarray(result.model.blocked)
    assert result.task_converged.all()
    np.testing.assert_allclose(blocked, fitted("Boltzmann").model.blocked, atol=0.01)
