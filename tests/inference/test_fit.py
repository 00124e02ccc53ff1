"""Fits: what they climb, where they end, and what they refuse."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from helpers.walled import BLANK, GOALS, PATHS, REPEATS, WALL, follow, objective, walks
from sidestep.errors import ImproperTask, InputError, NotConverged
from sidestep.inference.fit import Fit, fit
from sidestep.inference.optimizers import LBFGS, Adam
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid, TabularModel
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach

PAYING, COSTLY = (0.95, None), (1.0, 1.0)
"""Rewards: discount and step cost."""
ASCENT = Adam(iterations=500)

# name: (reward, backup, β, settings of the likelihood, settings of the fit)
CASES = {
    "Boltzmann": (PAYING, BoltzmannAverage(), 10.0, {}, {}),
    "mellowmax": (PAYING, Mellowmax(), 10.0, {}, {}),
    "log-sum-exp": (COSTLY, LogSumExp(), 2.0, {}, {}),
    "hard max": (PAYING, HardMax(), 10.0, {}, {}),
    "horizon 12": (PAYING, BoltzmannAverage(), 10.0, {"options": SolveOptions(horizon=12)}, {}),
    "actions": (PAYING, BoltzmannAverage(), 10.0, {"terms": ("actions",)}, {}),
    "transitions": (PAYING, BoltzmannAverage(), 10.0, {"terms": ("transitions",)}, {}),
    "ascent": (PAYING, BoltzmannAverage(), 10.0, {}, {"optimizer": ASCENT}),
    "fixed policy": (
        PAYING,
        BoltzmannAverage(),
        10.0,
        {},
        {"optimizer": ASCENT, "options": SolveOptions("fixed_policy")},
    ),
    "log-sum-exp, fixed policy": (
        COSTLY,
        LogSumExp(),
        2.0,
        {},
        {"optimizer": ASCENT, "options": SolveOptions("fixed_policy")},
    ),
}
SMOOTH = ["Boltzmann", "mellowmax", "log-sum-exp", "horizon 12", "actions", "transitions"]
CLIMBING = [*SMOOTH, "hard max"]
BOTH = [name for name in CASES if name not in ("actions", "transitions")]
MODEL = ObstacleGrid(BLANK, -2.0)


@cache
def fitted(name: str) -> Fit[ObstacleGrid]:
    reward, backup, beta, of_likelihood, of_fit = CASES[name]
    return fit(MODEL, walks(BLANK, *reward), Behavior(backup, beta), **of_likelihood, **of_fit)


SAME = {"ascent": "Boltzmann", "fixed policy": "Boltzmann", "log-sum-exp, fixed policy": "log-sum-exp"}
"""Cases that climb the objective of another."""


def objective_of(name: str):
    return _objective_of(SAME.get(name, name))


@cache
def _objective_of(name: str):
    reward, backup, beta, of_likelihood, _ = CASES[name]
    demonstrations, people = walks(BLANK, *reward), Behavior(backup, beta)
    return jax.jit(lambda theta: objective(MODEL, demonstrations, people, theta, **of_likelihood))


@pytest.mark.parametrize("name", CASES)
def test_the_history_tells_the_objective_and_its_parts(name):
    found = fitted(name)
    assert [progress.iteration for progress in found.history] == list(range(len(found.history)))
    for progress in found.history:
        assert progress.objective == pytest.approx(progress.actions + progress.transitions + progress.prior, rel=1e-12)
    start, final = found.history[0], found.final
    assert start.prior == 0
    assert start.objective == pytest.approx(float(objective_of(name)(jnp.full(25, -2.0))), rel=1e-9)
    assert final.objective == pytest.approx(float(objective_of(name)(found.model.parameters)), rel=1e-9)
    assert final.prior == pytest.approx(-float(jnp.sum((found.model.parameters + 2) ** 2) / 4), rel=1e-12)
    assert final.objective > start.objective


@pytest.mark.parametrize("name", CLIMBING)
def test_lbfgs_rises_at_every_iteration(name):
    objective = np.array([progress.objective for progress in fitted(name).history])
    # the values of hundreds of moves are each known to the solver's tolerance, and no better is their sum
    assert (np.diff(objective) > -1e-7).all()
    assert objective[-1] > objective[0]


@pytest.mark.parametrize("name", SMOOTH)
def test_at_the_optimum_the_slope_is_zero_and_every_way_leads_down(name):
    found, climbed = fitted(name), objective_of(name)
    assert found.converged
    assert found.message.startswith("converged")
    best, width, far = found.model.parameters, 1e-3, 0.05
    for cell in range(25):
        change = jnp.zeros(25).at[cell].set(1.0)
        slope = (climbed(best + width * change) - climbed(best - width * change)) / (2 * width)
        assert abs(slope) < 1e-3  # the tolerance of the fit is 1e-4
        assert climbed(best + far * change) < climbed(best) > climbed(best - far * change)


@pytest.mark.parametrize("name", BOTH)
def test_the_wall_that_nobody_touched_is_found(name):
    blocked = np.asarray(fitted(name).model.blocked)
    assert blocked[WALL].min() > 0.5
    assert blocked[WALL].min() > blocked[~WALL].max() + 0.2


@pytest.mark.parametrize("name", CASES)
def test_a_fit_says_honestly_whether_it_converged(name):
    """The hard max has kinks: no step gains anything although the gradient is far from zero."""
    found = fitted(name)
    tolerance = CASES[name][4].get("optimizer", LBFGS()).tolerance
    assert found.converged == (found.final.gradient <= tolerance) == (name != "hard max")
    assert f"{found.final.gradient:.2g}" in found.message
    assert found.task_converged.all()
    assert found.task_converged.shape == found.sweeps.shape == found.residual.shape == (3,)
    assert (found.residual <= 1e-10).all()


@pytest.mark.parametrize(("one", "other"), [("Boltzmann", "ascent"), ("log-sum-exp", "log-sum-exp, fixed policy")])
def test_both_optimisers_end_at_the_same_place(one, other):
    """With the log-sum-exp the fixed-policy gradient is the exact one (eq. 9)."""
    one, other = fitted(one), fitted(other)
    assert other.final.objective == pytest.approx(one.final.objective, abs=1e-3)
    np.testing.assert_allclose(other.model.blocked, one.model.blocked, atol=5e-3)


def test_each_term_can_be_left_out():
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
    np.testing.assert_allclose(learned[~walked], prior, rtol=1e-12)  # and so nothing is found
    assert np.asarray(actions.model.blocked)[walked].mean() > np.asarray(both.model.blocked)[walked].mean()


@pytest.mark.parametrize(("failures", "prior"), [
    (0, Normal(-2.0, 4.0)),
    (2, Normal(-2.0, 4.0)),
    (7, Normal(0.5, 1.0)),
    (3, Normal(0.0, 1e9)),
    (3, Normal(jnp.array([1.0, -3.0, 0.0]), jnp.array([4.0, 1.0, 9.0]))),
])  # fmt: skip
def test_one_cell_and_its_transitions_alone_are_a_bernoulli_trial(failures, prior):
    """(failures)(1 − σ) − (successes) σ = 2 (θ − b)/a at the optimum; cells that nobody entered stay at the prior."""
    trials, grid = 8, Grid.unknown(1, 3)
    tried = [Trajectory(np.array([0, 0 if index < failures else 1]), np.array([3]), 0) for index in range(trials)]
    found = fit(
        ObstacleGrid(grid, -1.0),
        gather(tried, [reach(grid, 2)]),
        Behavior(BoltzmannAverage()),
        prior=prior,
        terms=("transitions",),
        optimizer=LBFGS(tolerance=1e-10),
    )
    mean, variance = np.broadcast_to(prior.mean, 3), np.broadcast_to(prior.variance, 3)

    def slope(theta):
        probability = 1 / (1 + np.exp(-theta))
        return failures - trials * probability - 2 * (theta - mean[1]) / variance[1]

    theta = found.model.parameters
    assert float(theta[1]) == pytest.approx(brentq(slope, -30, 30, xtol=1e-14), abs=1e-6)
    if variance[1] < 1e9:
        np.testing.assert_allclose(theta[jnp.array([0, 2])], mean[[0, 2]], atol=1e-6)
    else:
        assert float(jax.nn.sigmoid(theta[1])) == pytest.approx(3 / 8, abs=1e-6)


def test_known_cells_stay_what_they_are():
    known = np.full((5, 5), Cell.UNKNOWN, dtype=int)
    known[0, 2], known[4, :] = Cell.OCCUPIED, Cell.FREE
    grid = Grid(known)
    found = fit(ObstacleGrid(grid, -2.0), walks(grid, *PAYING), Behavior(BoltzmannAverage()))
    blocked = np.asarray(found.model.blocked)
    assert blocked[0, 2] == 1
    assert (blocked[4] == 0).all()
    assert ((blocked > 0) & (blocked < 1))[known == Cell.UNKNOWN].all()
    np.testing.assert_array_equal(np.asarray(found.model.parameters)[known.reshape(-1) != Cell.UNKNOWN], -2.0)
    assert blocked[1:4, 2].min() > 0.5


def test_a_sensor_that_is_sure_of_a_cell_outweighs_the_walks():
    sure = jnp.full(25, 4.0).at[7].set(1e-6).at[13].set(1e-6)
    prior = Normal(jnp.full(25, -2.0).at[13].set(1.5), sure)
    found = fit(MODEL, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()), prior=prior)
    np.testing.assert_allclose(found.model.parameters[jnp.array([7, 13])], [-2.0, 1.5], atol=1e-3)
    assert float(fitted("Boltzmann").model.parameters[7]) > 1


def test_a_model_that_knows_nothing_of_grids_learns_a_forbidden_transition():
    """Five states in a line; a step leads one further, a jump two, and either may fail.

    People jump, but never from state 0 although that would be the way in two moves.
    """
    step, jump = np.minimum(np.arange(5) + 1, 4), np.minimum(np.arange(5) + 2, 4)
    staying = np.broadcast_to(np.arange(5)[:, None], (5, 2))
    world = graph(np.stack([np.stack([step, jump], axis=1), staying], axis=2))
    ways = [([0, 1, 3, 4], [0, 1, 0]), ([2, 4], [1])]
    shown = gather([Trajectory(np.array(way), np.array(moves), 0) for way, moves in ways * 20], [reach(world, 4)])
    often_works = jnp.array([2.0, 0.0])
    model = TabularModel(world, jnp.broadcast_to(often_works, (5, 2, 2)))
    found = fit(model, shown, Behavior(BoltzmannAverage()), prior=Normal(often_works, 4.0))
    assert found.converged
    works, beforehand = np.asarray(found.model.probabilities())[..., 0], 1 / (1 + np.exp(-2))
    assert works[0, 1] < 0.3
    assert min(works[0, 0], works[1, 1], works[3, 0], works[2, 1]) > beforehand
    assert works[4] == pytest.approx(beforehand, abs=1e-6)  # nobody acts at the goal


@pytest.mark.parametrize(("settings", "message"), [
    ({"options": SolveOptions("fixed_policy")}, r"'gradient'.*Ascent\(\)"),
    ({"terms": ()}, "'terms'"),
    ({"resume": True}, "'resume'"),
])  # fmt: skip
def test_settings_that_do_not_go_together(settings, message):
    with pytest.raises(InputError, match=message):
        fit(MODEL, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()), **settings)


def test_tasks_without_values_are_refused():
    """Each of four actions is worth log(4)/β = 1.39 to a log-sum-exp walker, more than it costs."""
    with pytest.raises(ImproperTask, match="never wants to arrive"):
        fit(MODEL, walks(BLANK, *COSTLY), Behavior(LogSumExp(), 1.0))


def test_solves_that_stop_early_are_never_used():
    people, demonstrations = Behavior(BoltzmannAverage()), walks(BLANK, *PAYING)
    with pytest.raises(NotConverged, match=r"task\(s\) \[0, 1, 2\]"):
        fit(MODEL, demonstrations, people, options=SolveOptions(solver=Jacobi(max_sweeps=2)))
    enough = int(eqx.filter_jit(solve)(MODEL, demonstrations.tasks, people).sweeps.max())
    with pytest.raises(NotConverged, match="stopped converging at iteration"):
        # steps so long that starting from the last values does not help
        fit(
            MODEL,
            demonstrations,
            people,
            options=SolveOptions(solver=Jacobi(max_sweeps=enough)),
            optimizer=Adam(learning_rate=3.0),
        )


def test_lbfgs_never_ends_where_solves_stop_early():
    """The solves of this fit converge near its start only; the search turns back at that border."""
    people, demonstrations = Behavior(BoltzmannAverage()), walks(BLANK, *PAYING)
    enough = 2 + int(eqx.filter_jit(solve)(MODEL, demonstrations.tasks, people).sweeps.max())
    found = fit(MODEL, demonstrations, people, options=SolveOptions(solver=Jacobi(max_sweeps=enough)))
    assert found.task_converged.all()
    assert (np.diff([progress.objective for progress in found.history]) > 0).all()
    assert not found.converged
    assert found.final.objective < fitted("Boltzmann").final.objective


def test_visited_states_must_be_able_to_reach_their_goal():
    known = np.full((5, 5), Cell.UNKNOWN, dtype=int)
    known[:, 2] = Cell.OCCUPIED
    walled_off = gather(
        [Trajectory(*follow(4, "D"), 0), Trajectory(*follow(0, "D"), 0)],
        [reach(BLANK, 14, discount=1.0, step_cost=1.0)],
    )
    with pytest.raises(InputError, match="trajectory 2: state 0 is visited, but the goal cannot be reached"):
        fit(ObstacleGrid(Grid(known), -2.0), walled_off, Behavior(BoltzmannAverage()))


def test_the_same_fit_twice_is_the_same_to_the_last_bit():
    again = fit(MODEL, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()))
    assert again.history == fitted("Boltzmann").history
    np.testing.assert_array_equal(again.model.parameters, fitted("Boltzmann").model.parameters)


@pytest.mark.parametrize("everything", [True, False])
def test_32_bit_numbers_stay_so_and_find_the_same_map(everything):
    """All numbers of 32 bits, or only those of the model, which the others then follow."""
    with jax.enable_x64(not everything):
        model = ObstacleGrid(BLANK, jnp.full(25, -2.0, jnp.float32))
        found = fit(model, walks(BLANK, *PAYING), Behavior(BoltzmannAverage()))
        assert found.model.parameters.dtype == found.residual.dtype == jnp.float32
        blocked = np.asarray(found.model.blocked)
    assert found.task_converged.all()
    np.testing.assert_allclose(blocked, fitted("Boltzmann").model.blocked, atol=0.01)


def test_the_walks_are_what_the_tests_say():
    """No walk enters the wall, and each arrives by a shortest way."""
    for (task, start, moves), length in zip(PATHS, (12, 12, 12, 8, 9, 12, 12), strict=True):
        states, _ = follow(start, moves)
        assert not WALL.reshape(-1)[states].any()
        assert states[-1] == GOALS[task]
        assert len(moves) == length
    likelihood = log_likelihood(MODEL, walks(BLANK, *PAYING), Behavior(HardMax()), terms=("transitions",))
    entered = REPEATS * sum(len(moves) for _, _, moves in PATHS)
    assert float(likelihood.transitions) == pytest.approx(-entered * np.log1p(np.exp(-2)), rel=1e-12)
