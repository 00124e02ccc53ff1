"""Eq. 12 by rollouts: the policies of soft and optimal agents, in a table and in a linear-quadratic world."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.linalg import solve_discrete_are

import sidestep as ss
import sidestep.continuous as sc
from helpers import small_worlds
from helpers.small_worlds import ACTIONS, PLACES, STATES, TASKS, WHICH, entropies, exact_values, policy_table
from sidestep.continuous.policy_steps import minibatches

WORLD, BETA = small_worlds.table(), 1.5
SOFT, OPTIMAL = ss.Behavior(ss.LogSumExp(), BETA), ss.Behavior(ss.HardMax(), BETA)
BACKUPS = {"log-sum-exp": ss.LogSumExp(), "Boltzmann": ss.BoltzmannAverage(), "mellowmax": ss.Mellowmax()}
BEHAVIORS = {name: ss.Behavior(backup, BETA) for name, backup in BACKUPS.items()}
HERE = len(PLACES)  # as many as there are, so that every step tries each start once
PLANNER = sc.Planner(horizon=15, batch_size=HERE, samples=8, learning_rate=0.02, critic_rate=0.02, critic_width=8)
UNIFORM = small_worlds.table_policy(ACTIONS, TASKS * STATES)


def planned(behavior, policy=UNIFORM, planner=PLANNER, *, steps, **settings) -> sc.PolicyPlan:
    agent = sc.Agent(WORLD.dynamics, policy, behavior)
    return sc.plan_policy(agent, WORLD.tasks, PLACES, WHICH, planner, steps=steps, **settings)


def divergence(pi, other):
    """KL(π‖other) of every start, in nats."""
    return (pi * (np.log(pi) - np.log(other))).sum(axis=-1)[WHICH, PLACES]


@pytest.fixture(scope="module")
def initial() -> sc.PlannerState:
    """PlannerState at its start, from the uniform policy."""
    agent = sc.Agent(WORLD.dynamics, UNIFORM, SOFT)
    return PLANNER.initialize(jax.random.key(0), agent, sc.task_at(WORLD.tasks, WHICH), PLACES)


@pytest.fixture(scope="module")
def exact():
    """The policies of all soft agents."""
    return {name: np.asarray(small_worlds.exact_policy(WORLD, behavior)) for name, behavior in BEHAVIORS.items()}


@pytest.fixture(scope="module")
def plans(initial):
    """The plan of the first agent from a uniform policy, those of the others from the first's."""
    first = planned(SOFT, warm_start=initial, steps=150)
    others = {name: planned(BEHAVIORS[name], warm_start=first.planner_state, steps=75) for name in list(BEHAVIORS)[1:]}
    return {"log-sum-exp": first} | others


@pytest.mark.slow
@pytest.mark.parametrize("name", BEHAVIORS)
def test_plan_policy_soft_agent_converges_to_its_own_exact_policy(name, plans, exact):
    pi = np.asarray(policy_table(plans[name].policy))
    for other, policy in exact.items():
        if other == name:
            assert divergence(pi, policy).max() < 0.01
        else:
            assert divergence(pi, policy).max() > 0.03


@pytest.mark.slow
def test_plan_policy_optimal_agent_chooses_the_best_actions(initial):
    best = np.asarray(small_worlds.exact_policy(WORLD, OPTIMAL)).argmax(axis=-1)[WHICH, PLACES]
    pi = np.asarray(policy_table(planned(OPTIMAL, warm_start=initial, steps=150).policy))[WHICH, PLACES]
    assert (pi.argmax(axis=-1) == best).all()
    assert pi.max(axis=-1).min() > 0.9


@pytest.mark.slow
def test_plan_policy_critic_approaches_exact_values(plans, exact, initial):
    bonus = entropies(exact["log-sum-exp"]) / BETA
    values, _ = exact_values(WORLD, WORLD.dynamics.parameters, exact["log-sum-exp"], PLANNER.horizon, bonus)
    values = np.asarray(values[WHICH, PLACES])
    places = jnp.eye(TASKS * STATES)[WHICH * STATES + PLACES]
    critics = initial.critic, plans["log-sum-exp"].planner_state.critic
    before, after = (jax.vmap(critic, (0, None))(places, jnp.ones(())) for critic in critics)
    assert np.abs(after - values).mean() < 0.25 * np.abs(before - values).mean()


def optimal_control(task, dynamics):
    """Gain and standard deviations of maximum-entropy control: Riccati's equation with √γ A and √γ B."""
    a, b = (np.asarray(dynamics.parameters[name]) for name in ("state", "action"))
    c, d, discount = np.asarray(task.state_cost), np.asarray(task.action_cost), float(task.discount)
    costs = solve_discrete_are(np.sqrt(discount) * a, np.sqrt(discount) * b, c, d)
    curvature = d + discount * b.T @ costs @ b
    gain = -np.linalg.solve(curvature, discount * b.T @ costs @ a)
    return gain, np.sqrt(np.diag(np.linalg.inv(curvature)) / (2 * BETA))


@pytest.mark.slow
def test_plan_policy_gaussian_policy_matches_maximum_entropy_control():
    dynamics, tasks, _ = small_worlds.linear(goals=((0.0, 0.0),))
    starts = jax.random.normal(jax.random.key(1), (256, 2))
    planner = sc.Planner(12, 16, samples=2, candidates=16, critic_width=8, learning_rate=0.02, critic_rate=0.02)
    policy = sc.gaussian_policy(jax.random.key(2), 1, starts, depth=0)
    result = sc.plan_policy(sc.Agent(dynamics, policy, SOFT), tasks, starts, jnp.zeros(256, int), planner, steps=200)
    gain, spread = optimal_control(sc.task_at(tasks, 0), dynamics)
    mean, middle = result.policy.network, jnp.zeros(2)
    close = 0.05 * np.linalg.norm(gain)
    assert np.linalg.norm(jax.jit(jax.jacobian(mean))(middle) - gain) < close
    assert np.linalg.norm(mean(middle)) < close
    np.testing.assert_allclose(jnp.exp(result.policy.log_spread), spread, rtol=0.1)


PRECISE = sc.Planner(horizon=6, batch_size=HERE, samples=1000, critic_width=8)


def figures_of(behavior, pi, initial) -> sc.PlanProgress:
    """The figures of a policy, by many rollouts."""
    state = eqx.tree_at(lambda state: state.policy, initial, small_worlds.with_logits(jnp.log(pi)))
    return planned(behavior, planner=PRECISE, steps=1, warm_start=state).history[0]


@partial(jax.jit, static_argnames="optimal")
def exact_figures(pi, optimal):
    """Return, gradient, entropy and policy gap by dynamic programming.

    As in eq. 12, the sum over first choices is exact; what happens after each of them counts alike.
    """

    def values(logits):
        moving = jax.nn.softmax(logits)
        bonus = 0.0 if optimal else entropies(moving) / BETA
        _, q = exact_values(WORLD, WORLD.dynamics.parameters, moving, PRECISE.horizon, bonus)
        at_once = (moving * jax.lax.stop_gradient(q)).sum(axis=-1) + bonus
        return (at_once + q.mean(axis=-1))[WHICH, PLACES].mean(), q[WHICH, PLACES]

    slope, q = jax.grad(values, has_aux=True)(jnp.log(pi))
    earned, _ = exact_values(WORLD, WORLD.dynamics.parameters, pi, PRECISE.horizon)
    own, aim = pi[WHICH, PLACES], jax.nn.log_softmax(BETA * q)
    gains, far = q.max(axis=-1) - (own * q).sum(axis=-1), (own * (jnp.log(own) - aim)).sum(axis=-1)
    gap = (gains if optimal else far).mean()
    entropy = entropies(pi)[WHICH, PLACES].mean()
    return earned[WHICH, PLACES].mean(), jnp.linalg.norm(slope), entropy, gap


@pytest.mark.parametrize("behavior", [SOFT, OPTIMAL], ids=["log-sum-exp", "hard max"])
@pytest.mark.parametrize("policy", [UNIFORM, WORLD.policy], ids=["uniform", "another"])
def test_progress_figures_match_dynamic_programming(policy, behavior, initial):
    pi = policy_table(policy)
    figures = figures_of(behavior, pi, initial)
    expected_return, gradient, entropy, gap = map(float, exact_figures(pi, behavior is OPTIMAL))
    assert figures.iteration == 0
    assert figures.expected_return == pytest.approx(expected_return, abs=0.05)
    assert figures.gradient == pytest.approx(gradient, rel=0.05)
    assert figures.entropy == pytest.approx(entropy, rel=1e-9)
    assert figures.policy_gap == pytest.approx(gap, rel=0.1)


def test_policy_gap_exact_policy_is_near_0(initial, exact):
    at_first, at_last = (figures_of(SOFT, pi, initial) for pi in (policy_table(UNIFORM), exact["log-sum-exp"]))
    assert at_first.policy_gap > 0.1
    assert abs(at_last.policy_gap) < 0.01
    assert at_last.gradient < 0.15 * at_first.gradient


def test_plan_policy_warm_start_continues_the_former_plan(plans):
    former = plans["log-sum-exp"]
    again = planned(SOFT, warm_start=former.planner_state, steps=2)
    entropy = entropies(policy_table(former.policy))[WHICH, PLACES].mean()
    assert again.history[0].entropy == pytest.approx(float(entropy), rel=1e-9)
    for moments, each in (("policy_moments", 1), ("critic_moments", PLANNER.critic_steps)):
        counts = [getattr(plan.planner_state, moments)[0].count for plan in (former, again)]
        assert counts == [150 * each, 152 * each]
    before, after = (ravel_pytree(eqx.filter(plan.policy, eqx.is_inexact_array))[0] for plan in (former, again))
    assert 0 < np.abs(after - before).max() < 3 * PLANNER.learning_rate


def test_plan_policy_reports_every_step_and_repeats_by_seed(initial):
    seen = []
    first = planned(SOFT, warm_start=initial, steps=3, report=seen.append)
    assert tuple(seen) == first.history
    assert [figures.iteration for figures in seen] == [0, 1, 2]
    np.testing.assert_allclose(first.recent_progress(2)[1:], np.mean(seen[1:], axis=0)[1:], rtol=1e-12)
    assert first.recent_progress(2).iteration == 2
    assert eqx.tree_equal(first.planner_state, planned(SOFT, warm_start=initial, steps=3).planner_state)
    assert planned(SOFT, warm_start=initial, steps=3, seed=1).history[0] != first.history[0]


def test_initialize_critic_begins_at_the_mean_return(initial):
    pi = policy_table(UNIFORM)
    values = exact_values(WORLD, WORLD.dynamics.parameters, pi, PLANNER.horizon, entropies(pi) / BETA)[0]
    predictions = jax.vmap(initial.critic, (0, None))(jnp.eye(TASKS * STATES), jnp.ones(()))
    assert values.min() < initial.critic.center < values.max()
    assert np.abs(predictions - initial.critic.center).max() < 0.1 * initial.critic.spread


@pytest.mark.parametrize("name", ["horizon", "batch_size", "samples", "candidates", "critic_width", "critic_steps"])
def test_planner_refuses_counts_that_are_too_small(name):
    least = 2 if name == "samples" else 1
    with pytest.raises(ss.InputError, match=f"{name}.*at least {least}, found {least - 1}"):
        sc.Planner(**{"horizon": 2, name: least - 1})


@pytest.mark.parametrize(("name", "rate"), [("learning_rate", 0.0), ("critic_rate", float("nan"))])
def test_planner_refuses_rates_not_above_0(name, rate):
    with pytest.raises(ss.InputError, match=f"{name}.*finite number above 0"):
        sc.Planner(horizon=2, **{name: rate})


def test_plan_policy_refuses_bad_starts():
    agent, tasks = sc.Agent(WORLD.dynamics, UNIFORM, SOFT), WORLD.tasks

    def planned_from(states, which, steps=1):
        return sc.plan_policy(agent, tasks, states, which, PLANNER, steps=steps)

    with pytest.raises(ss.InputError, match=r"steps.*at least 1"):
        planned_from(PLACES, WHICH, steps=0)
    with pytest.raises(ss.InputError, match=r"states.*row 2.*finite"):
        planned_from(jnp.asarray([0.0, jnp.nan]), WHICH[:2])
    with pytest.raises(ss.InputError, match="expected one or more starts, found shape"):
        planned_from(PLACES[:0], WHICH[:0])
    with pytest.raises(ss.InputError, match=r"task.*0…1"):
        planned_from(PLACES[:2], jnp.asarray([0, 2]))
    with pytest.raises(ss.InputError, match=r"states.*row 2.*has not ended"):
        planned_from(PLACES.at[1].set(4), jnp.zeros_like(WHICH))
    with pytest.raises(ss.InputError, match="has not ended"):
        PLANNER.initialize(jax.random.key(0), agent, sc.task_at(tasks, 0 * WHICH), jnp.full_like(PLACES, 4))


def test_minibatches_hold_every_move_and_are_disjoint():
    shape = 6, 2, 3, 4
    entries = np.moveaxis(np.indices(shape), 0, -1)
    batches = np.asarray(minibatches(jnp.asarray(entries), count=4))
    assert batches.shape == (4, 36, 4)
    assert len(np.unique(batches.reshape(-1, 4), axis=0)) == np.prod(shape)
    for batch in batches:
        assert set(batch[:, 3]) == set(range(4))
    assert minibatches(jnp.ones((1, 1, 2, 1)), count=8).shape == (2, 1)


def test_fit_critic_with_horizon_1_keeps_the_critic(initial):
    planner = sc.Planner(horizon=1, batch_size=HERE, samples=2, critic_width=8)
    result = planned(SOFT, planner=planner, warm_start=initial, steps=3)
    assert result.planner_state.critic_moments[0].count == 0
    assert result.planner_state.policy_moments[0].count == 3


def test_plan_policy_figures_not_finite_raise(initial):
    nowhere = small_worlds.with_logits(jnp.nan * jnp.zeros((TASKS, STATES, ACTIONS)))
    broken = eqx.tree_at(lambda state: state.policy, initial, nowhere)
    with pytest.raises(ss.NotConverged, match="step 0"):
        planned(SOFT, warm_start=broken, steps=1)


def test_plan_policy_mellowmax_over_vectors_is_refused():
    dynamics, tasks, policy = small_worlds.linear()
    agent = sc.Agent(dynamics, policy, BEHAVIORS["mellowmax"])
    with pytest.raises(ss.InputError, match="mellowmax"):
        sc.plan_policy(agent, tasks, jnp.zeros((2, 2)), jnp.arange(2), PLANNER, steps=1)
