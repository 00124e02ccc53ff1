"""Pointwise log-likelihoods, information criteria and ArviZ's, beside dense references and closed forms."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit, log_expit

import sidestep as ss
from helpers.problems import dense_tabular, plain_policy, plain_values
from sidestep.errors import InputError, NotConverged
from sidestep.inference.criteria import identified_parameters
from sidestep.tabular.behavior_model import BehaviorParameters

STATES, ACTIONS = 4, 3
RANDOM = np.random.default_rng(5)
SUCCESSORS = (np.arange(STATES)[:, None, None] + np.array([1, 2]) + np.zeros((1, ACTIONS, 1), int)) % STATES
REWARD = RANDOM.uniform(-1, 0, (2, STATES, ACTIONS))
ENDS = np.arange(STATES) == 3
TASKS = [ss.task(REWARD[0], 0.9, ENDS), ss.task(REWARD[1], 0.5, ENDS)]
WALKS = [([0, 1, 2, 3], [0, 1, 2], 0), ([1, 3], [2], 1), ([0, 2, 0, 1, 3], [2, 0, 0, 1], 1)]


def demonstrations() -> ss.Demonstrations:
    return ss.gather([ss.Trajectory(np.array(path), np.array(taken), task) for path, taken, task in WALKS], TASKS)


def fit_of_two_persons(**options) -> ss.Fit:
    """A fit that stopped early: at generic parameters, with a β of each task's person and a lapse."""
    model = ss.TabularModel(ss.graph(SUCCESSORS), jnp.asarray(RANDOM.normal(size=SUCCESSORS.shape)))
    start = ss.Behavior(ss.BoltzmannAverage(), 2.0, 0.1)
    unknown = ss.behavior_model(start, ["lapse"], person=np.array([1, 0]))
    return ss.fit(model, demonstrations(), unknown, optimizer=ss.LBFGS(max_iterations=2), **options)


def dense_terms(parameters: Any, path, taken, task):
    """log π and ln T of each move, by dense arrays and plain value iteration."""
    transitions = dense_tabular(np.asarray(parameters.model), SUCCESSORS)
    beta = np.exp(parameters.behavior.log_beta[1 - task])
    lapse = expit(parameters.behavior.logit_lapse)
    _, q = plain_values("Boltzmann", transitions, TASKS[task], beta, 300)
    policy = (1 - lapse) * plain_policy(q, beta) + lapse / ACTIONS
    states, actions = np.array(path), np.array(taken)
    return np.log(policy[states[:-1], actions]), np.log(transitions[states[:-1], actions, states[1:]])


def test_pointwise_log_likelihood_of_persons_is_the_dense_one():
    fit = fit_of_two_persons(tempering=0.5)
    each = ss.pointwise_log_likelihood(fit)
    learned: Any = ss.Parameters(fit.model.parameters, fit.behavior.parameters)
    assert len(np.unique(learned.behavior.log_beta)) == 2
    actions, transitions = zip(*(dense_terms(learned, *walk) for walk in WALKS), strict=True)
    np.testing.assert_allclose(each.actions, np.concatenate(actions), rtol=1e-8)
    np.testing.assert_allclose(each.transitions, np.concatenate(transitions), rtol=1e-8)
    np.testing.assert_allclose(0.5 * each.actions.sum(), fit.final.actions, rtol=1e-8)
    np.testing.assert_allclose(each.transitions.sum(), fit.final.transitions, rtol=1e-8)


def test_pointwise_log_likelihood_of_draws_has_that_of_each():
    fit = fit_of_two_persons()
    learned = ss.Parameters(fit.model.parameters, fit.behavior.parameters)
    steps = 0.3 * RANDOM.normal(size=(2, 3))
    draws: Any = jax.tree.map(lambda leaf: leaf + jnp.asarray(steps).reshape(2, 3, *[1] * leaf.ndim), learned)
    each = ss.pointwise_log_likelihood(fit, draws)
    assert each.actions.shape == each.transitions.shape == (2, 3, 8)
    for at in np.ndindex(2, 3):
        one = jax.tree.map(lambda leaf, at=at: leaf[at], draws)
        actions, transitions = zip(*(dense_terms(one, *walk) for walk in WALKS), strict=True)
        np.testing.assert_allclose(each.actions[at], np.concatenate(actions), rtol=1e-8)
        np.testing.assert_allclose(each.transitions[at], np.concatenate(transitions), rtol=1e-8)


@pytest.mark.parametrize(("terms", "missing"), [(("actions",), "transitions"), (("transitions",), "actions")])
def test_pointwise_log_likelihood_has_the_terms_of_the_fit(terms, missing):
    each = ss.pointwise_log_likelihood(fit_of_two_persons(terms=terms))
    assert not getattr(each, missing).any()
    assert getattr(each, terms[0]).all()


def test_units_are_weighted_sums_over_moves_that_count():
    each = ss.PointwiseLogLikelihood(
        actions=-np.array([[1.0, 2, 3, 4, 5], [2, 4, 6, 8, 10]]),
        transitions=np.zeros((2, 5)),
        trajectory=np.array([0, 0, 1, 2, 2]),
        weights=np.array([1.0, 0.5, 0, 1, 0]),
    )
    assert each.of("walk").tolist() == [[-2, -4], [-4, -8]]
    assert each.of("move").tolist() == [[-1, -1, -4], [-2, -2, -8]]
    assert each.numbers_of("walk").tolist() == [0, 2]
    assert each.numbers_of("move").tolist() == [0, 1, 3]


@pytest.mark.parametrize("change", [
    lambda parameters: parameters._replace(model=parameters.model[:, :1]),
    lambda parameters: parameters._replace(model=parameters.model[None]),
    lambda parameters: parameters._replace(behavior=parameters.behavior._replace(logit_lapse=None)),
])  # fmt: skip
def test_pointwise_log_likelihood_at_other_parameters_raises(change):
    fit = fit_of_two_persons()
    with pytest.raises(InputError, match="field 'parameters': expected draws"):
        ss.pointwise_log_likelihood(fit, change(ss.Parameters(fit.model.parameters, fit.behavior.parameters)))


def test_pointwise_log_likelihood_without_convergence_raises():
    fit = fit_of_coin()
    draws = ss.Parameters(jnp.array([[0.0], [np.nan]]), fit.behavior.parameters)
    with pytest.raises(NotConverged, match="values did not converge for 1 of 2 draws"):
        ss.pointwise_log_likelihood(fit, draws)


def coin() -> ss.TiedModel:
    """An action that succeeds with the unknown probability σ(θ), and otherwise stays."""
    return ss.TiedModel(ss.graph(np.array([[[1, 0]], [[1, 1]]])), np.array([[[0, ss.FIXED]], [[0, ss.FIXED]]]))


def walks_of_coin() -> ss.Demonstrations:
    """Walks with 0, 2 and 3 failures before success."""
    walks = [ss.Trajectory(np.repeat([0, 1], [n + 1, 1]), np.zeros(n + 1, int), 0) for n in (0, 2, 3)]
    return ss.gather(walks, [ss.task(np.array([-1.0, 0.0]), 0.9, np.array([False, True]))])


def fit_of_coin(variance=1e4, shown=None) -> ss.Fit:
    shown = walks_of_coin() if shown is None else shown
    return ss.fit(coin(), shown, ss.Behavior(ss.BoltzmannAverage()), prior=ss.Normal(0.0, variance))


@pytest.mark.parametrize(("unit", "n"), [("walk", 3), ("move", 8)])
def test_information_criteria_of_a_coin_are_those_of_a_geometric_distribution(unit, n):
    criteria = ss.information_criteria(fit_of_coin(), unit=unit)
    expected = 3 * np.log(3 / 8) + 5 * np.log(5 / 8)  # at the maximum of the likelihood, p = 3/8
    assert (criteria.parameters, criteria.observations) == (1, n)
    np.testing.assert_allclose(criteria.log_likelihood, expected, rtol=1e-6)
    np.testing.assert_allclose(criteria.aic, 2 - 2 * expected, rtol=1e-6)
    np.testing.assert_allclose(criteria.bic, np.log(n) - 2 * expected, rtol=1e-6)
    assert ss.information_criteria(fit_of_coin(), parameters=7).parameters == 7


@pytest.mark.parametrize("unit", ["walk", "move"])
def test_information_criteria_of_weight_two_are_those_of_all_walks_twice(unit):
    shown = walks_of_coin()
    double = eqx.tree_at(lambda each: each.weights, shown, 2 * shown.weights)
    weighted, joined = (
        ss.information_criteria(fit_of_coin(shown=each), unit=unit) for each in (double, ss.join([shown, shown]))
    )
    assert weighted.observations == joined.observations == {"walk": 6, "move": 16}[unit]
    np.testing.assert_allclose(weighted, joined, rtol=1e-6)


@pytest.mark.parametrize(("unit", "found"), [("walk", "0.3"), ("move", "0.8")])
def test_information_criteria_of_less_than_one_observation_raise(unit, found):
    shown = walks_of_coin()
    tenth = eqx.tree_at(lambda each: each.weights, shown, shown.weights / 10)
    message = rf"'weights': expected weights that sum to at least one {unit}, found {found}"
    with pytest.raises(InputError, match=message):
        ss.information_criteria(fit_of_coin(shown=tenth), unit=unit)


def test_weights_of_units_are_those_of_their_moves():
    weights = np.array([2.0, 2.0, 0.0, 0.5, 0.0, 1.0, 3.0])
    zeros = np.zeros(7)
    each = ss.PointwiseLogLikelihood(zeros, zeros, np.array([0, 0, 1, 2, 2, 3, 3]), weights)
    np.testing.assert_allclose(each.weights_of("walk"), [2.0, 0.5, (1 + 9) / (1 + 3)], rtol=1e-12)
    np.testing.assert_allclose(each.weights_of("move"), weights[weights > 0])


def test_information_criteria_without_a_full_likelihood_or_convergence_raise():
    with pytest.raises(InputError, match="field 'fit': expected a fit that converged"):
        ss.information_criteria(fit_of_two_persons())
    walk = ss.Trajectory(np.array([0, 1]), np.array([0]), 0)
    shown = ss.gather([walk], [ss.task(np.array([-1.0, 0.0]), 0.9, np.array([False, True]))])
    tempered = ss.fit(coin(), shown, ss.Behavior(ss.HardMax()), tempering=0.5)
    with pytest.raises(InputError, match="field 'tempering': expected a likelihood that counts in full"):
        ss.information_criteria(tempered)


def test_identified_parameters_are_those_that_change_the_likelihood():
    """Two outcomes have one parameter, two outcomes in the same state none, and the end of the task none."""
    both = fit_of_two_persons()
    assert both.model.parameters.size == 24
    assert identified_parameters(both) == 3 * 3 + 3  # 3 states with 3 actions, 2 β and a lapse
    only = fit_of_two_persons(terms=("transitions",))
    assert identified_parameters(only) == 6  # the distinct choices (0, 0), (0, 2), (1, 1), (1, 2), (2, 0), (2, 2)


def test_identified_parameters_of_a_fixed_model_are_those_of_behavior():
    graph = ss.graph(np.array([[[1], [0]], [[1], [0]], [[2], [2]]]))
    model = ss.TabularModel(graph, jnp.zeros((3, 2, 1)))
    walk = ss.Trajectory(np.array([0, 1, 0]), np.array([0, 1]), 0)
    shown = ss.gather([walk], [ss.task(np.array([[-1.0, -2], [-1, -2], [0, 0]]), 0.9, np.arange(3) == 2)])
    fit = ss.fit(model, shown, ss.behavior_model(ss.Behavior(ss.BoltzmannAverage(), 1.0), ["beta"]))
    assert identified_parameters(fit) == 1


def test_to_arviz_with_a_fit_has_what_waic_and_loo_need():
    fit = fit_of_coin(variance=2.0)
    theta = np.random.default_rng(0).normal(-0.4, 0.5, (2, 300, 1))
    numbers, divergent = ss.Parameters(jnp.zeros(1), fit.behavior.parameters), np.zeros((2, 300), bool)
    draws = ss.Draws(numbers._replace(model=jnp.asarray(theta)), numbers, numbers, divergent, np.ones((2, 300)))
    of_walks = log_expit(theta) + np.array([0, 2, 3]) * log_expit(-theta)
    pointwise_mean = np.log(np.exp(of_walks).mean(axis=(0, 1)))
    data: Any = draws.to_arviz(fit)
    assert data.log_likelihood["walk"].values.tolist() == [0, 1, 2]
    np.testing.assert_allclose(data.log_likelihood["walks"], of_walks, rtol=1e-8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its next version, and of few observations
        import arviz

        waic, loo = arviz.waic(data), arviz.loo(data)
    penalty = of_walks.var(axis=(0, 1))
    np.testing.assert_allclose(waic["elpd_waic"], (pointwise_mean - penalty).sum(), rtol=1e-6)
    np.testing.assert_allclose(loo["elpd_loo"], waic["elpd_waic"], atol=0.2)
    moves: Any = ss.laplace(fit).to_arviz(jax.random.key(0), 5, fit=fit, unit="move")
    assert moves.log_likelihood["moves"].shape == (1, 5, 8)


def draws_of_behavior(persons: int, states: int = 2) -> ss.Draws:
    """Draws of two chains, of one logit, a β of each person, and costs."""
    beta, costs = RANDOM.normal(size=(2, 5, persons)), RANDOM.normal(size=(2, 5, states))
    behavior = BehaviorParameters(log_beta=jnp.asarray(beta), cost_parameters=jnp.asarray(costs))
    numbers = ss.Parameters(jnp.zeros((2, 5, 1)), behavior)
    return ss.Draws(numbers, numbers, numbers, np.zeros((2, 5), bool), np.ones((2, 5)))


def test_to_arviz_with_labels_has_persons_and_states_by_name():
    labels = ss.Labels(states=("home", "work"), persons=("ann", "ben", "cem"))
    draws = draws_of_behavior(3)
    data: Any = draws.to_arviz(labels=labels)
    beta, costs = data.posterior["beta"], data.posterior["costs"]
    assert beta.dims == ("chain", "draw", "person")
    assert beta.person.values.tolist() == ["ann", "ben", "cem"]
    assert costs.state.values.tolist() == ["home", "work"]
    log_beta: Any = draws.parameters.behavior
    np.testing.assert_allclose(beta.sel(person="ben"), np.exp(log_beta.log_beta[..., 1]), rtol=1e-12)
    numbered: Any = draws.to_arviz()
    assert numbered.posterior["beta"].person.values.tolist() == [0, 1, 2]


def test_to_arviz_of_one_beta_has_no_names_of_several_persons():
    data: Any = draws_of_behavior(1).to_arviz(labels=ss.Labels(persons=("ann", "ben")))
    assert data.posterior["beta"].person.values.tolist() == [0]
    data = draws_of_behavior(1).to_arviz(labels=ss.Labels(persons=("ann",)))
    assert data.posterior["beta"].person.values.tolist() == ["ann"]


@pytest.mark.parametrize(("labels", "message"), [
    (ss.Labels(persons=("ann", "ben")), "labels, field 'persons': expected 3 labels, found 2"),
    (ss.Labels(states=("home",)), "labels, field 'states': expected 2 labels, found 1"),
])  # fmt: skip
def test_to_arviz_with_another_number_of_labels_raises(labels, message):
    with pytest.raises(InputError, match=message):
        draws_of_behavior(3).to_arviz(labels=labels)


def fit_of_known_dynamics(learn: tuple[str, ...]) -> ss.Fit:
    """A fit with nothing to learn in the model."""
    model = ss.tabular_model(ss.graph(SUCCESSORS), np.full(SUCCESSORS.shape, 0.5), known=True)
    return ss.fit(model, demonstrations(), ss.behavior_model(ss.Behavior("boltzmann", 2.0), learn), terms=("actions",))


@pytest.mark.parametrize("learn", [(), ("beta",)])
def test_pointwise_log_likelihood_of_known_dynamics_is_the_dense_one(learn):
    fit = fit_of_known_dynamics(learn)
    beta = float(fit.behavior.behavior_of().beta)
    transitions, expected = dense_tabular(np.zeros(SUCCESSORS.shape), SUCCESSORS), []
    for path, taken, task in WALKS:
        policy = plain_policy(plain_values("Boltzmann", transitions, TASKS[task], beta, 300)[1], beta)
        expected += np.log(policy[np.array(path[:-1]), np.array(taken)]).tolist()
    np.testing.assert_allclose(ss.pointwise_log_likelihood(fit).actions, expected, rtol=1e-8)


def test_information_criteria_and_cross_validation_of_known_dynamics_have_a_parameter():
    fit = fit_of_known_dynamics(("beta",))
    assert ss.information_criteria(fit).parameters == 1
    assert np.isfinite(ss.cross_validate(fit, folds=3).mean.estimate)


def test_laplace_of_a_fit_with_nothing_to_learn_raises():
    with pytest.raises(InputError, match="field 'fit': expected a fit of at least one parameter"):
        ss.laplace(fit_of_known_dynamics(()))
