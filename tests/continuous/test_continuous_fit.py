"""Fits in continuous worlds, beside closed forms and independent estimates."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

import sidestep as ss
import sidestep.continuous as sc
from helpers.drift_fits import (
    AGENTS,
    BOTH,
    CHOICES,
    DEMONSTRATIONS,
    FOLLOWING,
    INITIAL,
    LONG,
    MOVES,
    NOISE,
    PLANNER,
    POLICY,
    PRIOR,
    SHORT,
    STATES,
    TRUTH,
    WAYS,
    demonstrations_of,
    fitted,
    learn,
    log_policy,
)
from helpers.families import Drift, LaplaceDrift, vector


def test_fit_dynamics_transitions_alone_give_least_squares():
    seen = np.column_stack([STATES, WAYS[CHOICES]])
    following = seen @ [0.7, 0.5] + 0.3 * np.random.default_rng(0).normal(size=MOVES)
    expected = np.linalg.lstsq(seen, following, rcond=None)[0]
    begin = sc.LinearGaussian(jnp.zeros((1, 1)), jnp.zeros((1, 1)), vector(0.3))
    result = sc.fit_dynamics(
        begin, demonstrations_of(STATES, CHOICES, following), *AGENTS,
        prior=ss.Normal(0.0, 5e5), terms=("transitions",),
        schedule=sc.Schedule(iterations=300, batch_size=MOVES, learning_rate=0.05),
    )  # fmt: skip
    learned = [float(result.dynamics.parameters[name][0, 0]) for name in ("state", "action")]
    np.testing.assert_allclose(learned, expected, atol=1e-6)
    assert result.history[0].transitions == pytest.approx(norm.logpdf(following, 0, 0.3).sum())
    assert {progress.actions for progress in result.history} == {0}
    assert (result.converged, result.verification.policy_gap, result.verification.samples) == (True, 0, 0)


@pytest.mark.slow
def test_fit_dynamics_actions_alone_give_the_maximum_likelihood():
    """The tolerance allows for the noise of rollouts."""

    def loss(drift):
        return -log_policy(drift, STATES)[np.arange(MOVES), CHOICES].sum() + drift**2 / 100

    result = learn(terms=("actions",), schedule=LONG)
    learned, best = float(result.dynamics.parameters[0]), minimize_scalar(loss)
    assert learned == pytest.approx(best.x, abs=0.1)  # pyright: ignore[reportAttributeAccessIssue]
    assert abs(learned - TRUTH) < 0.25
    assert {progress.transitions for progress in result.history} == {0}
    assert result.history[0].prior == pytest.approx(-(0.5**2) / 100)


@pytest.mark.slow
def test_fit_dynamics_vector_actions_give_the_true_drift():
    """With R(s, a) = −s² − a² the policy is normal, by Riccati's equation."""
    beta, discount, count = 4.0, 0.6, 300
    task = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.eye(1), jnp.asarray(discount))
    curve = 1.0  # V(s) = −curve s² − 2 tilt s, whatever else
    for _ in range(100):
        curve = 1 + discount * curve / (1 + discount * curve)
    steepness = 1 + discount * curve
    tilt = discount * curve * TRUTH / (steepness - discount)
    random = np.random.default_rng(2)
    states, spread = random.uniform(-2, 2, count), 1 / np.sqrt(2 * beta * steepness)
    means = -discount * (curve * (states + TRUTH) + tilt) / steepness
    actions = means + spread * random.normal(size=count)
    demos = demonstrations_of(states, actions[:, None], states + actions + TRUTH, (task,))
    result = sc.fit_dynamics(
        INITIAL, demos, ss.Behavior(ss.LogSumExp(), beta),
        sc.gaussian_policy(jax.random.key(0), 1, demos.states, depth=0, spread=0.3),
        sc.Planner(horizon=8, batch_size=16, samples=2, candidates=8, learning_rate=0.03, critic_width=4),
        prior=PRIOR, terms=("actions",), estimator="pathwise",
        schedule=sc.Schedule(iterations=200, policy_warmup=60, batch_size=30, learning_rate=0.02),
    )  # fmt: skip
    assert result.converged
    assert float(result.dynamics.parameters[0]) == pytest.approx(TRUTH, abs=0.1)
    likelihood = norm.logpdf(actions, means, spread).sum() / count
    learned = np.mean([progress.actions for progress in result.history[-30:]]) / count
    assert learned == pytest.approx(likelihood, abs=0.1)


@pytest.mark.slow
def test_fit_dynamics_policy_warmup_plans_for_the_first_model():
    """Without the actions' term there is no policy to plan."""
    by_both, by_transitions = fitted()[0], BOTH(terms=("transitions",))
    # before each verification, the policy has as many steps as a quarter of the iterations
    assert by_both.planner_state.policy_moments[0].count - (2 + 16) in (4, 8, 12, 16)
    assert by_transitions.planner_state.policy_moments[0].count == 0


def test_fit_dynamics_objective_is_the_sum_of_its_terms():
    result, _ = fitted()
    for progress in result.history:
        assert progress.actions < 0
        assert progress.transitions < 0
        assert progress.objective == pytest.approx(progress.actions + progress.transitions + progress.prior)
        assert progress.gradient > 0
    assert abs(float(result.dynamics.parameters[0]) - TRUTH) < 0.25


def test_fit_dynamics_batches_of_a_laplace_family_give_the_median():
    """The batch log-likelihood is scaled up to all moves."""
    result = sc.fit_dynamics(
        LaplaceDrift(vector(0.1)), DEMONSTRATIONS, *AGENTS,
        prior=PRIOR, terms=("transitions",), schedule=sc.Schedule(iterations=150, batch_size=30, learning_rate=0.02),
    )  # fmt: skip
    drifts = FOLLOWING - STATES - WAYS[CHOICES]
    assert float(result.dynamics.parameters[0]) == pytest.approx(np.median(drifts), abs=0.05)
    scaled = np.mean([progress.transitions for progress in result.history[-50:]])
    learned = np.abs(drifts - float(result.dynamics.parameters[0]))
    assert scaled == pytest.approx(-learned.sum() - MOVES * np.log(2), rel=0.02)


def test_fit_dynamics_of_some_walks_ends_where_the_fit_of_these_alone_does():
    """A move of weight 0 may even be impossible."""
    some = np.arange(MOVES) % 3 == 0
    alone = demonstrations_of(STATES[some], CHOICES[some], FOLLOWING[some])
    far = demonstrations_of(STATES, CHOICES, np.where(some, FOLLOWING, 1e200)).with_only(some)
    far = replace(far, person=jnp.zeros(MOVES, int))
    fits = [
        sc.fit_dynamics(INITIAL, demos, *AGENTS, prior=PRIOR, terms=("transitions",), schedule=SHORT)
        for demos in (alone, DEMONSTRATIONS.with_only(some), far)
    ]
    for each in fits[1:]:
        assert each.converged
        np.testing.assert_allclose(each.dynamics.parameters, fits[0].dynamics.parameters, rtol=1e-6)
        np.testing.assert_allclose(each.verification.covariance, fits[0].verification.covariance, rtol=1e-6)


# Diagnostics


def test_fit_dynamics_newton_steps_end_at_the_maximum_of_transitions():
    """The objective is quadratic in θ, so that one step is exact."""
    result = learn(terms=("transitions",), schedule=SHORT)
    precision = MOVES / NOISE**2 + 1 / 50
    mode = np.sum(FOLLOWING - STATES - WAYS[CHOICES]) / NOISE**2 / precision
    np.testing.assert_allclose(result.dynamics.parameters, [mode], atol=1e-9)
    np.testing.assert_allclose(result.verification.covariance, [[1 / precision]])
    assert (result.verification.noise, result.verification.samples, result.converged) == (0, 0, True)


@pytest.mark.slow
def test_verification_gradient_agrees_with_the_likelihood_within_its_standard_error():
    result = learn(terms=("actions",), schedule=replace(LONG, iterations=20))
    at, step, found = float(result.dynamics.parameters[0]), 1e-4, result.verification
    ends = [
        log_policy(each, STATES)[np.arange(MOVES), CHOICES].sum() - each**2 / 100 for each in (at - step, at + step)
    ]
    error = found.gradient[0] - (ends[1] - ends[0]) / (2 * step)
    assert abs(error) < 3 * found.standard_errors[0]
    assert found.standard_errors[0] * np.sqrt(found.covariance[0, 0]) == pytest.approx(found.noise)
    assert found.noise <= result.problem.schedule.noise_tolerance


def test_fit_dynamics_reports_are_its_history():
    result, reports = fitted()
    assert [progress for progress, _ in reports] == list(result.history)
    assert [progress.iteration for progress in result.history] == list(range(16))


def test_fit_dynamics_large_policy_gap_is_not_converged():
    result, _ = fitted()
    assert result.verification.policy_gap > 0.1
    assert not result.converged
    assert f"the policy gap is {result.verification.policy_gap:.2g} (tolerance 0.1)" in result.message


def test_fit_dynamics_few_iterations_are_not_converged():
    """Newton steps of at most two standard deviations do not lead to a maximum that is a hundred away."""
    begin = Drift(vector(-4.0), vector(NOISE))
    schedule = sc.Schedule(2, batch_size=MOVES, learning_rate=0.01)
    result = sc.fit_dynamics(begin, DEMONSTRATIONS, *AGENTS, prior=PRIOR, terms=("transitions",), schedule=schedule)
    away = (np.mean(FOLLOWING - STATES - WAYS[CHOICES]) - float(result.dynamics.parameters[0])) * MOVES**0.5 / NOISE
    assert result.verification.distance == pytest.approx(away, rel=1e-3)
    assert not result.converged
    assert f"the maximum is {result.verification.distance:.2g} posterior standard deviations away" in result.message


class SechDrift(LaplaceDrift):
    """A drift with steps of a density in proportion to sech(s′ − s − a − θ)."""

    def log_prob(self, state, action, next_state):
        away = (next_state - state - action - self.parameters).sum()
        return -jnp.logaddexp(away, -away)


def test_fit_dynamics_newton_step_too_far_is_taken_back():
    """Two away from a single move, Newton's step ends far beyond the maximum; half of it ends near."""
    demos = demonstrations_of(np.zeros(1), np.ones(1, int), np.zeros(1))
    schedule = sc.Schedule(2, batch_size=1, learning_rate=1e-6)
    prior = ss.Normal(0.0, 1e6)
    result = sc.fit_dynamics(
        SechDrift(vector(2.0)), demos, *AGENTS, prior=prior, terms=("transitions",), schedule=schedule
    )
    at = float(result.dynamics.parameters[0])
    assert result.verification.distance == pytest.approx(abs(np.sinh(at)), abs=1e-3)
    assert abs(at) < 0.6
    assert result.converged


@pytest.mark.slow
def test_fit_dynamics_noise_above_its_tolerance_is_not_converged():
    schedule = sc.Schedule(16, policy_warmup=0, batch_size=30, distance_tolerance=0.01, verification_samples=8)
    result = learn(terms=("actions",), schedule=schedule)
    assert result.verification.noise > schedule.noise_tolerance
    assert not result.converged


@pytest.mark.slow
@pytest.mark.parametrize(("horizon", "short"), [(2, True), (30, False)])
def test_fit_dynamics_horizon_before_the_goal_is_seen(horizon, short):
    """Agents are four to six moves away from their goal."""
    task, states = sc.reach_region((5.0,), 0.6, discount=0.9, step_cost=1.0), np.linspace(-1, 1, 20)
    demos = demonstrations_of(states, np.full(20, 2), states + 1, (task,))
    policy = sc.finite_policy(jax.random.key(0), POLICY.actions, sc.task_features(
        sc.task_at(demos.tasks, demos.task), demos.states), width=8)  # fmt: skip
    schedule = sc.Schedule(4, policy_warmup=60, batch_size=20, learning_rate=1e-3, verification_samples=8)
    planner = sc.Planner(horizon=horizon, samples=2, learning_rate=0.05, critic_width=8)
    soft = ss.Behavior(ss.LogSumExp(), 2.0)
    known = Drift(vector(0.0), vector(NOISE))
    result = sc.fit_dynamics(known, demos, soft, policy, planner, terms=("actions",), schedule=schedule)
    assert (result.verification.unfinished > 0.1) == short
    assert ("do not end their task within it" in result.message) == short
    assert not (short and result.converged)


@pytest.mark.slow
def test_fit_dynamics_horizon_with_values_beyond_it_is_not_converged():
    """Agents look two moves ahead, and what follows would change their choices."""
    result = sc.fit_dynamics(
        INITIAL, DEMONSTRATIONS, ss.Behavior(ss.LogSumExp(), 1.5), POLICY, PLANNER,
        prior=PRIOR, terms=("actions",), schedule=replace(LONG, policy_gap_tolerance=0.02),
    )  # fmt: skip
    assert result.verification.beyond_horizon > 0.02
    assert "the horizon is too short: values at its end would move the policy by" in result.message
    assert not result.converged


@pytest.mark.slow
def test_fit_dynamics_of_one_move_sees_the_values_after_it():
    """Rewards are paid in the next state: one move looks at none, and its choices would change with them."""
    schedule = sc.Schedule(4, policy_warmup=40, batch_size=MOVES, learning_rate=1e-3, verification_samples=8)
    soft, myopic = ss.Behavior(ss.LogSumExp(), 1.5), sc.Planner(horizon=1, samples=2, critic_width=4)
    settings = {"prior": PRIOR, "terms": ("actions",), "schedule": schedule}
    result = sc.fit_dynamics(INITIAL, DEMONSTRATIONS, soft, POLICY, myopic, **settings)
    # β γ Q differs between actions by the squares of where they lead
    expected = log_policy(-0.5, STATES) - log_policy(-0.5, STATES).mean(axis=1, keepdims=True)
    assert result.verification.beyond_horizon == pytest.approx(np.mean(expected**2) / 2, rel=0.2)
    assert "the horizon is too short: values at its end would move the policy by" in result.message
    assert not result.converged


def test_fit_dynamics_repeats_by_seed():
    again, other = BOTH(), fitted(1)[0]
    assert again.history == fitted()[0].history
    np.testing.assert_array_equal(again.dynamics.parameters, fitted()[0].dynamics.parameters)
    assert other.history[0] != again.history[0]
    assert not np.array_equal(other.dynamics.parameters, again.dynamics.parameters)
