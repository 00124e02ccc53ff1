"""Fits of models of which a part is known, or all, and of models with tight priors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss

SUCCESSORS = np.array([[[1, 2], [1, 2]], [[3, 0], [3, 0]], [[3, 0], [3, 0]], [[3, 3], [3, 3]]])
PROBABILITIES = np.array(
    [[[0.7, 0.3], [0.2, 0.8]], [[0.9, 0.1], [0.5, 0.5]], [[0.3, 0.7], [0.6, 0.4]], [[1.0, 0.0], [1.0, 0.0]]]
)
WORLD = ss.graph(SUCCESSORS)
GOAL = ss.task(np.outer(np.arange(4) != 3, [-1.0, -1.2]), 1.0, np.arange(4) == 3)
BETA = 2.0
LEARN_BETA = ss.behavior_model(ss.Behavior("boltzmann", 1.0), ["beta"])


@pytest.fixture(scope="module")
def shown():
    truth = ss.tabular_model(WORLD, PROBABILITIES)
    walks = ss.simulate(jax.random.key(0), truth, [GOAL], [np.zeros(300, int)], ss.Behavior("boltzmann", BETA))
    return ss.gather(walks, [GOAL])


def test_tabular_model_has_the_probabilities_it_was_made_of():
    np.testing.assert_allclose(ss.tabular_model(WORLD, PROBABILITIES).probabilities(), PROBABILITIES, atol=1e-15)
    np.testing.assert_allclose(ss.tabular_model(WORLD, PROBABILITIES, True).probabilities(), PROBABILITIES, atol=1e-15)


def test_tabular_model_with_known_actions_has_parameters_for_the_others():
    known = np.ones((4, 2), bool)
    known[0, 1] = known[2, 0] = False
    model = ss.tabular_model(WORLD, PROBABILITIES, known)
    moved = model.with_parameters(jnp.log(jnp.asarray([[0.4, 0.6], [0.1, 0.9]])))
    expected = PROBABILITIES.copy()
    expected[0, 1], expected[2, 0] = [0.4, 0.6], [0.1, 0.9]
    np.testing.assert_allclose(moved.probabilities(), expected, atol=1e-15)


def test_tied_model_with_a_fixed_logit_has_its_odds():
    """Outcome 0 has the logit log 3, outcome 1 the learned one, here log 2: odds of 3 to 2."""
    index = np.tile([ss.FIXED, 0], (4, 2, 1))
    model = ss.TiedModel(WORLD, index, np.log(2.0), fixed=np.log(3.0))
    np.testing.assert_allclose(model.probabilities(), np.tile([0.6, 0.4], (4, 2, 1)), rtol=1e-12)


def test_fit_with_all_known_learns_the_behavior_only(shown):
    fit = ss.fit(ss.tabular_model(WORLD, PROBABILITIES, known=True), shown, LEARN_BETA)
    assert fit.converged
    estimate, error = fit.learned_behavior["beta"]
    assert error is not None
    assert abs(np.log(estimate) - np.log(BETA)) < 3 * error / estimate
    np.testing.assert_allclose(fit.model.probabilities(), PROBABILITIES, atol=1e-15)


def test_fit_with_nothing_to_learn_converges_at_once(shown):
    model, behavior = ss.tabular_model(WORLD, PROBABILITIES, known=True), ss.Behavior("boltzmann", BETA)
    fit = ss.fit(model, shown, behavior)
    assert fit.converged
    assert len(fit.history) == 1
    expected = ss.log_likelihood(model, shown, behavior)
    assert fit.final.objective == pytest.approx(float(expected.total), rel=1e-12)


def test_fit_of_one_unknown_action_has_the_maximum_of_its_posterior(shown):
    """Transitions alone: the mode of two binomial logits under normal priors, by a grid."""
    known = np.ones((4, 2), bool)
    known[2, 0] = False
    model = ss.tabular_model(WORLD, PROBABILITIES, known)
    fit = ss.fit(model, shown, ss.Behavior("boltzmann", BETA), terms=("transitions",), prior=ss.Normal(0.0, 2.0))
    states, actions, after = (np.asarray(part) for part in (shown.states, shown.actions, shown.next_states))
    at = (states == 2) & (actions == 0)
    arrived, back = int((after[at] == 3).sum()), int((after[at] == 0).sum())
    half = np.linspace(-3, 3, 600_001)  # by symmetry the two logits are opposite: ±half
    log_odds = 2 * half
    objective = -arrived * np.log1p(np.exp(-log_odds)) - back * np.log1p(np.exp(log_odds)) - 2 * half**2 / 4
    best = half[np.argmax(objective)]
    np.testing.assert_allclose(fit.model.parameters, [[best, -best]], atol=2e-5)


@pytest.mark.parametrize("variance", [1e-8, 1e-4, 1.0])
def test_fit_with_a_prior_of_any_width_converges_to_the_same_beta_as_with_its_mean_known(shown, variance):
    """As the prior narrows, the model is its mean, and β is as if that were known."""
    even = np.full(SUCCESSORS.shape, 0.5)
    fit = ss.fit(ss.TabularModel(WORLD, jnp.zeros(SUCCESSORS.shape)), shown, LEARN_BETA, prior=ss.Normal(0.0, variance))
    assert fit.converged
    if variance == 1e-8:
        known = ss.fit(ss.tabular_model(WORLD, even, known=True), shown, LEARN_BETA)
        beta = known.learned_behavior["beta"].estimate
        assert fit.learned_behavior["beta"].estimate == pytest.approx(beta, rel=1e-4)
