"""Agents with a deadline: policies that depend on the number of moves that are left, beside a dense reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss

HORIZON, BETA, GAMMA = 5, 3.0, 0.9
SUCCESSORS = np.array([[[1, 0], [0, 0]], [[2, 0], [0, 1]], [[3, 1], [1, 2]], [[3, 3], [3, 3]]])
PROBABILITIES = np.array(
    [[[0.8, 0.2], [0.5, 0.5]], [[0.6, 0.4], [0.9, 0.1]], [[0.7, 0.3], [0.4, 0.6]], [[0.5, 0.5]] * 2]
)
MODEL = ss.tabular_model(ss.graph(SUCCESSORS), PROBABILITIES)
TASK = ss.task(np.array([-0.2, -0.1, -0.3, 2.0]), GAMMA, np.arange(4) == 3)
OPTIONS = ss.SolveOptions(horizon=HORIZON, deadline=True)
BEHAVIOR = ss.Behavior("logsumexp", BETA)


def policies_by_hand(model):
    """π[t, s, a] by backward induction: V of no move is 0, but for the terminal state."""
    transitions = jnp.einsum("sak,sakt->sat", model.probabilities(), np.eye(4)[SUCCESSORS])
    reward, values, result = jnp.asarray([-0.2, -0.1, -0.3, 2.0]), jnp.asarray([0.0, 0.0, 0.0, 2.0]), []
    for _ in range(HORIZON):
        q = reward[:, None] + GAMMA * transitions @ values
        result.append(jax.nn.softmax(BETA * q, axis=-1))
        values = jnp.where(np.arange(4) == 3, 2.0, jax.nn.logsumexp(BETA * q, axis=-1) / BETA)
    return jnp.stack(result[::-1])


def shown():
    walks = ss.simulate(jax.random.key(1), MODEL, [TASK, TASK], [[0] * 20, [1] * 20], BEHAVIOR, options=OPTIONS)
    return ss.gather(walks, [TASK, TASK])


def by_hand(parameters, demos):
    policies, lengths = policies_by_hand(MODEL.with_parameters(parameters)), np.bincount(np.asarray(demos.trajectory))
    times = np.concatenate([np.arange(length) for length in lengths])
    return jnp.log(policies[times, np.asarray(demos.states), np.asarray(demos.actions)])


def test_log_policies_with_a_deadline_equal_backward_induction():
    demos = shown()
    each = ss.log_policies(MODEL, demos, BEHAVIOR, options=OPTIONS)
    np.testing.assert_allclose(each, by_hand(MODEL.parameters, demos), rtol=1e-12)


def test_fit_with_a_deadline_has_the_gradient_of_backward_induction():
    """The objective and its gradient where a fit starts, which sums over distinct choices."""
    demos, start = shown(), MODEL.with_parameters(MODEL.parameters + 0.3)
    optimizer, prior = ss.LBFGS(max_iterations=0), ss.Normal(0.0, 1e6)
    fit = ss.fit(start, demos, BEHAVIOR, terms=("actions",), options=OPTIONS, optimizer=optimizer, prior=prior)
    value, gradient = jax.value_and_grad(lambda x: by_hand(x, demos).sum())(start.parameters)
    assert fit.final.actions == pytest.approx(float(value), rel=1e-10)
    expected = float(jnp.abs(gradient - start.parameters / 1e6).max())
    assert fit.final.gradient == pytest.approx(expected, rel=1e-6)


def test_simulate_with_a_deadline_stops_there_and_follows_its_policies():
    """The last move of an agent that has not arrived, state by state, has the probabilities of the last policy."""
    walks = ss.simulate(jax.random.key(2), MODEL, [TASK], [[0] * 4000], BEHAVIOR, options=OPTIONS)
    assert max(len(walk.actions) for walk in walks) == HORIZON
    assert all(walk.truncated == (walk.states[-1] != 3) for walk in walks)
    assert 0 < sum(walk.truncated for walk in walks) < len(walks)
    policies = np.asarray(policies_by_hand(MODEL))
    for time in (0, HORIZON - 1):
        for state in range(3):
            taken = [walk.actions[time] for walk in walks if len(walk.actions) > time and walk.states[time] == state]
            if len(taken) > 300:
                assert np.mean(taken) == pytest.approx(policies[time, state, 1], abs=4 * (0.25 / len(taken)) ** 0.5)


# a deadline of two moves: of state 0, the pay of 1 at once is the better one at the end, the way to 3 before that
PAY = ss.task(np.array([[0.0, 1.0], [3.0, 0.0], [0.0, 0.0]]), 1.0, np.arange(3) == 2)
CHOICE = ss.tabular_model(ss.graph([[[1], [0]], [[2], [1]], [[2], [2]]]), np.ones((3, 2, 1)))
TWO = ss.SolveOptions(horizon=2, deadline=True)


def test_plan_with_a_deadline_follows_the_policy_of_each_move():
    made = ss.plan(CHOICE, PAY, options=TWO)
    assert np.asarray(made.policy)[:, 0].tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert made.path_from(0).tolist() == [0, 1, 2]
    rolled = ss.roll_out(jax.random.key(0), CHOICE, made.policy, made.terminal, [0, 1], 2)
    assert rolled.states.tolist() == [[0, 1, 2], [1, 2, 2]]


def test_path_from_with_a_deadline_ends_there():
    """With one move left the plan stays for the pay; a state may repeat."""
    made = ss.plan(CHOICE, PAY, options=ss.SolveOptions(horizon=1, deadline=True))
    assert made.path_from(0).tolist() == [0, 0]


def test_log_likelihood_of_a_walk_beyond_the_deadline_raises():
    walk = ss.Trajectory(np.array([0] * 7), np.array([1] * 6), 0)
    with pytest.raises(ss.InputError, match=r"trajectory 0.*at most 5 moves by the deadline, found 6"):
        ss.log_likelihood(MODEL, ss.gather([walk], [TASK]), BEHAVIOR, options=OPTIONS)


def test_solve_options_with_a_deadline_without_horizon_raise():
    with pytest.raises(ss.InputError, match="expected a horizon with a deadline"):
        ss.SolveOptions(deadline=True)


def test_pointwise_log_likelihood_with_a_deadline_is_that_of_the_time_of_each_move():
    demos = shown()
    states, actions = np.asarray(demos.states), np.asarray(demos.actions)
    fit = ss.fit(MODEL, demos, BEHAVIOR, options=OPTIONS, optimizer=ss.LBFGS(max_iterations=0))
    each = ss.pointwise_log_likelihood(fit).actions
    expected = by_hand(MODEL.parameters, demos)
    np.testing.assert_allclose(each, expected, rtol=1e-10)
    # the same choice has several log-likelihoods
    assert len(np.unique(np.round(expected[(states == 0) & (actions == 0)], 6))) > 1


def test_information_criteria_with_a_deadline_need_the_number_of_parameters():
    known = ss.tabular_model(ss.graph(SUCCESSORS), PROBABILITIES, known=True)
    fit = ss.fit(known, shown(), ss.behavior_model(BEHAVIOR, ["beta"]), terms=("actions",), options=OPTIONS)
    with pytest.raises(ss.errors.InputError, match="field 'options': expected options without a deadline"):
        ss.information_criteria(fit)
    assert ss.information_criteria(fit, parameters=1).log_likelihood == pytest.approx(fit.final.actions, rel=1e-10)
