"""Laplace's approximation: closed forms, differences of the gradient, Lanczos beside the whole, bad input."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from helpers.problems import generic_task, random_problem
from helpers.spread import demonstrations
from helpers.walled import BLANK
from sidestep.errors import InputError
from sidestep.inference.fit import Fit, fit
from sidestep.inference.laplace import laplace
from sidestep.inference.natural_scale import natural_scale
from sidestep.inference.objective import Parameters
from sidestep.inference.optimizers import LBFGS, Adam
from sidestep.inference.priors import Normal
from sidestep.inference.tabular_information import TabularInformation
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import graph, straight_moves
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import FIXED, ObstacleGrid, SlipperyGrid, TabularModel, TiedModel, TransitionModel
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.tasks import reach, task

VARIANCE, SUCCESSES, FAILURES = 4.0, 7, 3
BEHAVIOR = Behavior(BoltzmannAverage(), 5.0)
COIN = TiedModel(graph(np.array([[[1, 0]], [[1, 1]]])), np.array([[[0, FIXED]], [[0, FIXED]]]))
"""A state whose only action leads to the end with the probability σ(θ)."""
TWO_LOGITS = TabularModel(graph(np.array([[[1, 0]], [[1, 1]]])), jnp.zeros((2, 1, 2)))
"""The same, with a logit for each outcome, of which only differences count."""


def tosses():
    states = np.repeat([0, 1], [FAILURES + 1, 1])
    walks = [Trajectory(states, np.zeros(FAILURES + 1, int), task=0)]
    walks += [Trajectory(np.array([0, 1]), np.array([0]), task=0)] * (SUCCESSES - 1)
    return gather(walks, [task(np.array([-1.0, 0.0]), 0.9, np.array([False, True]))])


def fit_of_coin(variance=VARIANCE, model: TransitionModel = COIN) -> Fit:
    return fit(model, tosses(), BEHAVIOR, prior=Normal(0.0, variance), terms=("transitions",))


@cache
def fit_of_maze() -> Fit:
    """A fit of 25 logits, β, a lapse, the discount and a weight."""
    features = np.linspace(-1, 1, 25)[:, None, None]
    learned = behavior_model(BEHAVIOR, ["beta", "lapse", "discount"], discount=0.9, features=features)
    return fit(ObstacleGrid(BLANK, -2.0), demonstrations(), learned, prior=Normal(-1.0, 1.5))


def parameters_of(result: Fit) -> Parameters:
    return Parameters(result.model.parameters, result.behavior.parameters)


def test_laplace_of_a_coin_has_the_information_of_a_binomial():
    result = fit_of_coin()
    p = 1 / (1 + np.exp(-float(result.model.parameters[0])))
    information = (SUCCESSES + FAILURES) * p * (1 - p) + 1 / VARIANCE
    normal = laplace(result)
    np.testing.assert_allclose(normal.standard_errors.model, [information**-0.5], rtol=1e-9)
    np.testing.assert_allclose(normal.covariance, [[1 / information]], rtol=1e-9)
    error = normal.error_of(lambda parameters: jax.nn.sigmoid(parameters.model[0]))
    np.testing.assert_allclose(error, p * (1 - p) * information**-0.5, rtol=1e-9)


def fit_of_slips() -> Fit:
    """A fit of 25 logits of cells, and of slips on two terrains."""
    terrain = np.arange(25).reshape(5, 5) % 2
    return fit(SlipperyGrid(BLANK, -2.0, -1.0, terrain), demonstrations(), BEHAVIOR, prior=Normal(-1.0, 1.5))


def fit_of_tastes() -> Fit:
    """A fit of 25 logits, the costs of 25 states, two weights, and β of two persons."""
    features = np.random.default_rng(0).normal(scale=0.1, size=(25, 4, 2))
    person, aimed_at = np.array([0, 1, 0, 1, 1]), straight_moves(BLANK)
    agents = Behavior(LogSumExp(), 5.0)
    learned = behavior_model(agents, ["beta"], person=person, features=features, aimed_at=aimed_at)
    return fit(ObstacleGrid(BLANK, -2.0), demonstrations(), learned, prior=Normal(-1.0, 1.5))


def fit_of_table() -> Fit:
    """A fit of the logits of every outcome of seven states."""
    problem = random_problem()
    task = generic_task(problem, 0.9)
    walks = simulate(jax.random.key(0), problem.model, [task], [np.repeat(np.arange(1, 7), 5)], BEHAVIOR)
    return fit(problem.model, gather(walks, [task]), BEHAVIOR, prior=Normal(0.0, VARIANCE))


FITS = {"behavior": fit_of_maze, "slips": fit_of_slips, "tastes": fit_of_tastes, "table": fit_of_table}


@pytest.mark.slow
@pytest.mark.parametrize("learned", FITS)
def test_laplace_has_the_information_of_differences_of_gradients(learned):
    result = FITS[learned]()
    information = TabularInformation(result.problem, parameters_of(result))
    flat, unravel = ravel_pytree(information.parameters)
    objective, starts = information.objective, information.starts
    dense = information.dense()
    scale, step, columns = np.diag(dense) ** -0.5, 1e-3, []
    for direction in np.diag(step * scale):
        ends = (unravel(flat + by * direction) for by in (1, -1))
        up, down = (ravel_pytree(objective.evaluate(end, starts)[0].gradient)[0] for end in ends)
        columns.append((up - down) / (2 * step))
    expected = np.array(columns) * scale
    np.testing.assert_allclose(scale[:, None] * dense * scale, expected, atol=1e-5)
    errors = scale * np.sqrt(np.diag(np.linalg.inv(expected)))
    np.testing.assert_allclose(ravel_pytree(laplace(result).standard_errors)[0], errors, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("rank", [3, 20])
def test_laplace_of_low_rank_has_the_largest_parts_and_bounds_the_others(rank):
    result = fit_of_maze()
    whole, low = laplace(result).covariance, laplace(result, dense=0, rank=rank)
    parts = np.linalg.eigvalsh(low.scale[:, None] * np.linalg.inv(whole) * low.scale)
    largest = np.sort(np.abs(parts - 1))[::-1][:rank]
    np.testing.assert_allclose(np.sort(np.abs(low.eigenvalues - 1))[::-1], largest, rtol=1e-5)
    np.testing.assert_allclose(low.neglected, largest[-1], rtol=1e-5)
    assert np.abs(np.diag(low.covariance) / np.diag(whole) - 1).max() <= low.neglected


def test_laplace_of_low_rank_is_that_of_the_whole_where_nothing_is_neglected():
    grid = Grid.unknown(1, 9)  # of which three cells are entered
    walk = Trajectory(np.arange(4), np.array([3, 3, 3]), task=0)
    shown = gather([walk], [reach(grid, 3)])
    result = fit(ObstacleGrid(grid), shown, BEHAVIOR, prior=Normal(0.0, VARIANCE), terms=("transitions",))
    whole, low = laplace(result), laplace(result, dense=0, rank=5)
    assert low.neglected < 1e-9
    np.testing.assert_allclose(low.covariance, whole.covariance, atol=1e-9)
    np.testing.assert_allclose(low.standard_errors.model, whole.standard_errors.model, rtol=1e-9)


@pytest.mark.slow
def test_interval_keeps_beta_and_lapse_in_their_ranges():
    normal = laplace(fit_of_maze())
    lower, upper = normal.interval(0.9999)
    wider = zip(jax.tree.leaves(lower), jax.tree.leaves(upper), strict=True)
    assert all((np.asarray(low) < np.asarray(high)).all() for low, high in wider)
    assert lower.beta is not None
    assert lower.lapse is not None
    assert upper.lapse is not None
    assert float(lower.beta[0]) > 0
    assert 0 < float(lower.lapse) < float(upper.lapse) < 1


@pytest.mark.slow
def test_interval_of_beta_is_that_of_its_logarithm():
    normal = laplace(fit_of_maze())
    mode, error = (np.asarray(each.behavior.log_beta) for each in (normal.parameters, normal.standard_errors))
    lower, upper = (np.asarray(each.beta) for each in normal.interval(0.95))
    np.testing.assert_allclose(np.log(lower), mode - 1.959964 * error, rtol=1e-6)
    np.testing.assert_allclose(np.log(upper), mode + 1.959964 * error, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(normal.natural_errors.beta), np.exp(mode) * error)


@pytest.mark.slow
def test_sample_has_the_covariance():
    normal = laplace(fit_of_maze())
    draws = jax.vmap(lambda each: ravel_pytree(each)[0])(normal.sample(jax.random.key(0), 20_000))
    whitened = np.linalg.solve(np.linalg.cholesky(normal.covariance), np.asarray(draws - draws.mean(axis=0)).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(draws.shape[1]), atol=0.05)


@pytest.mark.slow
def test_summary_has_what_was_learned_of_behavior_with_standard_errors():
    result = fit_of_maze()
    normal, learned = laplace(result), result.summary()["learned_behavior"]
    natural, errors = natural_scale(normal.parameters), normal.natural_errors
    assert list(learned) == ["beta", "lapse", "discount"]
    for name, numbers in learned.items():
        np.testing.assert_allclose(numbers["estimate"], np.ravel(getattr(natural, name))[0])
        np.testing.assert_allclose(numbers["standard_error"], np.ravel(getattr(errors, name))[0])


def test_summary_without_learned_behavior_has_no_standard_errors():
    assert "learned_behavior" not in fit_of_coin().summary()


def test_learned_behavior_where_the_posterior_is_not_normal_has_no_standard_error():
    known = behavior_model(Behavior(BoltzmannAverage(), 5.0, 1e-9), ["lapse"])
    result = fit(COIN, tosses(), known, terms=("transitions",))
    [(name, (estimate, error))] = result.learned_behavior.items()
    assert (name, error) == ("lapse", None)
    np.testing.assert_allclose(estimate, 1e-9)
    with pytest.raises(InputError, match="'lapse': expected one between its bounds"):
        laplace(result)


def test_laplace_of_a_direction_that_nothing_determines_names_it():
    with pytest.raises(InputError, match=r"do not determine the direction .*model\[\d, 0, \d\]"):
        laplace(fit_of_coin(variance=1e12, model=TWO_LOGITS))


def test_laplace_of_a_fit_that_has_not_converged_raises():
    early = fit(
        COIN, tosses(), BEHAVIOR, prior=Normal(9.0, VARIANCE), terms=("transitions",), optimizer=LBFGS(max_iterations=0)
    )
    with pytest.raises(InputError, match=r"standard errors from it \(stopped at max_iterations"):
        laplace(early)


def test_laplace_of_the_fixed_policy_gradient_raises():
    options = SolveOptions(gradient="fixed_policy")
    result = fit(COIN, tosses(), BEHAVIOR, options=options, optimizer=Adam())
    with pytest.raises(InputError, match=r"'gradient': .*no second derivatives"):
        laplace(result)


@pytest.mark.parametrize(
    ("call", "field"), [(lambda n: n.interval(1.0), "level"), (lambda n: n.sample(jax.random.key(0), 0), "n")]
)
def test_laplace_with_wrong_numbers_raises(call, field):
    with pytest.raises(InputError, match=f"'{field}'"):
        call(laplace(fit_of_coin()))
