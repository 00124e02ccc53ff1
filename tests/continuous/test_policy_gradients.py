"""Eq. 12 by roll-outs: the policies of soft and optimal people, in a table and in a linear-quadratic world."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.linalg import solve_discrete_are

from helpers.small_worlds import (
    ACTIONS,
    PLACES,
    STATES,
    TASKS,
    WHICH,
    entropies,
    exact_values,
    linear,
    peoples_policy,
    policy_table,
    table,
    with_logits,
)
from sidestep.continuous.planner import Planner, Planning, PlanProgress, check_planner, dealt
from sidestep.continuous.planning import Plan, plan
from sidestep.continuous.policies import gaussian_policy, table_policy
from sidestep.continuous.tasks import task_at
from sidestep.errors import InputError, NotConverged
from sidestep.tabular.backups import Behavior, BoltzmannAverage, HardMax, LogSumExp, Mellowmax

pytestmark = pytest.mark.usefixtures("unoptimised")

WORLD, BETA = table(), 1.5
SOFT, OPTIMAL = Behavior(LogSumExp(), BETA), Behavior(HardMax(), BETA)
PEOPLE = {
    "log-sum-exp": SOFT,
    "Boltzmann": Behavior(BoltzmannAverage(), BETA),
    "mellowmax": Behavior(Mellowmax(), BETA),
}
HERE = len(PLACES)  # as many places as there are, so that every step tries each of them once
PLANNER = Planner(horizon=15, places=HERE, samples=8, learning_rate=0.02, critic_rate=0.02, critic_width=8)
UNIFORM = table_policy(ACTIONS, TASKS * STATES)


def planned(behavior, policy=UNIFORM, planner=PLANNER, *, steps, **given) -> Plan:
    return plan(WORLD.dynamics, WORLD.tasks, behavior, policy, PLACES, WHICH, planner, steps=steps, **given)


def divergence(pi, other):
    """KL(π‖other) of every place, in nats."""
    return (pi * (np.log(pi) - np.log(other))).sum(axis=-1)[WHICH, PLACES]


@pytest.fixture(scope="module")
def begun() -> Planning:
    """Planning at its start, from the uniform policy."""
    return PLANNER.begin(jax.random.key(0), WORLD.dynamics, UNIFORM, task_at(WORLD.tasks, WHICH), SOFT, PLACES)


@pytest.fixture(scope="module")
def exact():
    """The policies of all soft people."""
    return {name: np.asarray(peoples_policy(WORLD, behavior)) for name, behavior in PEOPLE.items()}


@pytest.fixture(scope="module")
def found(begun):
    """What is found for them: for the first from a uniform policy, for the others from what the first do."""
    first = planned(SOFT, warm=begun, steps=300)
    others = {name: planned(PEOPLE[name], warm=first.planning, steps=100) for name in list(PEOPLE)[1:]}
    return {"log-sum-exp": first} | others


@pytest.mark.parametrize("name", PEOPLE)
def test_people_s_own_policy_is_found_and_no_other_people_s(name, found, exact):
    pi = np.asarray(policy_table(found[name].policy))
    for other, policy in exact.items():
        if other == name:
            assert divergence(pi, policy).max() < 0.01
        else:
            assert divergence(pi, policy).max() > 0.03


def test_optimal_people_choose_the_best_actions(begun):
    best = np.asarray(peoples_policy(WORLD, OPTIMAL)).argmax(axis=-1)[WHICH, PLACES]
    pi = np.asarray(policy_table(planned(OPTIMAL, warm=begun, steps=150).policy))[WHICH, PLACES]
    assert (pi.argmax(axis=-1) == best).all()
    assert pi.max(axis=-1).min() > 0.9


def test_the_critic_comes_to_know_what_states_are_worth(found, exact, begun):
    bonus = entropies(exact["log-sum-exp"]) / BETA
    values, _ = exact_values(WORLD, WORLD.dynamics.parameters, exact["log-sum-exp"], PLANNER.horizon, bonus)
    values = np.asarray(values[WHICH, PLACES])
    places = jnp.eye(TASKS * STATES)[WHICH * STATES + PLACES]
    before, after = (
        jax.vmap(planning.critic, (0, None))(places, jnp.ones(()))
        for planning in (begun, found["log-sum-exp"].planning)
    )
    assert np.abs(after - values).mean() < 0.25 * np.abs(before - values).mean()


def optimal_control(task, dynamics):
    """Gain and standard deviations of maximum-entropy control: Riccati's equation with √γ A and √γ B."""
    a, b = (np.asarray(dynamics.parameters[name]) for name in ("state", "action"))
    c, d, discount = np.asarray(task.state_cost), np.asarray(task.action_cost), float(task.discount)
    costs = solve_discrete_are(np.sqrt(discount) * a, np.sqrt(discount) * b, c, d)
    curvature = d + discount * b.T @ costs @ b
    gain = -np.linalg.solve(curvature, discount * b.T @ costs @ a)
    return gain, np.sqrt(np.diag(np.linalg.inv(curvature)) / (2 * BETA))


def test_a_gaussian_policy_becomes_that_of_maximum_entropy_control():
    dynamics, tasks, _ = linear(goals=((0.0, 0.0),))
    starts = jax.random.normal(jax.random.key(1), (256, 2))
    planner = Planner(
        horizon=12, places=16, samples=2, options=16, critic_width=8, learning_rate=0.015, critic_rate=0.02
    )
    blank = gaussian_policy(jax.random.key(2), 1, starts, depth=0)
    made = plan(dynamics, tasks, SOFT, blank, starts, jnp.zeros(256, int), planner, steps=250)
    gain, spread = optimal_control(task_at(tasks, 0), dynamics)
    mean, middle = made.policy.network, jnp.zeros(2)
    close = 0.05 * np.linalg.norm(gain)
    assert np.linalg.norm(jax.jacobian(mean)(middle) - gain) < close
    assert np.linalg.norm(mean(middle)) < close
    np.testing.assert_allclose(jnp.exp(made.policy.log_spread), spread, rtol=0.1)


LOOK = Planner(horizon=6, places=HERE, samples=1000, critic_width=8)


def looked(behavior, pi, begun) -> PlanProgress:
    """The figures of a policy, by many roll-outs."""
    planning = eqx.tree_at(lambda planning: planning.policy, begun, with_logits(jnp.log(pi)))
    return planned(behavior, planner=LOOK, steps=1, warm=planning).history[0]


@partial(jax.jit, static_argnames="optimal")
def by_programme(pi, optimal):
    """Return, gradient, entropy and lag by dynamic programming.

    As in eq. 12, the sum over first choices is exact; what happens after each of them counts alike.
    """

    def values(logits):
        moving = jax.nn.softmax(logits)
        bonus = 0.0 if optimal else entropies(moving) / BETA
        _, q = exact_values(WORLD, WORLD.dynamics.parameters, moving, LOOK.horizon, bonus)
        at_once = (moving * jax.lax.stop_gradient(q)).sum(axis=-1) + bonus
        return (at_once + q.mean(axis=-1))[WHICH, PLACES].mean(), q[WHICH, PLACES]

    slope, q = jax.grad(values, has_aux=True)(jnp.log(pi))
    earned, _ = exact_values(WORLD, WORLD.dynamics.parameters, pi, LOOK.horizon)
    own, aim = pi[WHICH, PLACES], jax.nn.log_softmax(BETA * q)
    gains, far = q.max(axis=-1) - (own * q).sum(axis=-1), (own * (jnp.log(own) - aim)).sum(axis=-1)
    lag = (gains if optimal else far).mean()
    entropy = entropies(pi)[WHICH, PLACES].mean()
    return earned[WHICH, PLACES].mean(), jnp.linalg.norm(slope), entropy, lag


@pytest.mark.parametrize("behavior", [SOFT, OPTIMAL], ids=["log-sum-exp", "hard max"])
@pytest.mark.parametrize("policy", [UNIFORM, WORLD.policy], ids=["uniform", "another"])
def test_figures_are_those_of_dynamic_programming(policy, behavior, begun):
    figures = looked(behavior, policy_table(policy), begun)
    earned, gradient, entropy, lag = (float(part) for part in by_programme(policy_table(policy), behavior is OPTIMAL))
    assert figures.iteration == 0
    assert figures.expected_return == pytest.approx(earned, abs=0.05)
    assert figures.gradient == pytest.approx(gradient, rel=0.05)
    assert figures.entropy == pytest.approx(entropy, rel=1e-9)
    assert figures.lag == pytest.approx(lag, rel=0.1)


def test_a_policy_that_has_been_found_lags_no_more(begun, exact):
    at_first, at_last = (looked(SOFT, pi, begun) for pi in (policy_table(UNIFORM), exact["log-sum-exp"]))
    assert at_first.lag > 0.1
    assert abs(at_last.lag) < 0.01
    assert at_last.gradient < 0.15 * at_first.gradient


def test_a_warm_start_begins_where_the_former_plan_ended(found):
    former = found["log-sum-exp"]
    again = planned(SOFT, warm=former.planning, steps=2)
    entropy = entropies(policy_table(former.policy))[WHICH, PLACES].mean()
    assert again.history[0].entropy == pytest.approx(float(entropy), rel=1e-9)
    for moments, each in (("policy_moments", 1), ("critic_moments", PLANNER.critic_steps)):
        counts = [getattr(plan.planning, moments)[0].count for plan in (former, again)]
        assert counts == [300 * each, 302 * each]
    before, after = (ravel_pytree(eqx.filter(plan.policy, eqx.is_inexact_array))[0] for plan in (former, again))
    assert 0 < np.abs(after - before).max() < 3 * PLANNER.learning_rate


def test_every_step_is_reported_and_the_same_seed_gives_the_same_steps(begun):
    seen = []
    first = planned(SOFT, warm=begun, steps=3, report=seen.append)
    assert tuple(seen) == first.history
    assert [figures.iteration for figures in seen] == [0, 1, 2]
    np.testing.assert_allclose(first.lately(2)[1:], np.mean(seen[1:], axis=0)[1:], rtol=1e-12)
    assert first.lately(2).iteration == 2
    assert eqx.tree_equal(first.planning, planned(SOFT, warm=begun, steps=3).planning)
    assert planned(SOFT, warm=begun, steps=3, seed=1).history[0] != first.history[0]


def test_critics_begin_at_the_mean_of_what_is_to_come(begun):
    pi = policy_table(UNIFORM)
    values = exact_values(WORLD, WORLD.dynamics.parameters, pi, PLANNER.horizon, entropies(pi) / BETA)[0]
    guesses = jax.vmap(begun.critic, (0, None))(jnp.eye(TASKS * STATES), jnp.ones(()))
    assert values.min() < begun.critic.centre < values.max()
    assert np.abs(guesses - begun.critic.centre).max() < 0.1 * begun.critic.spread


@pytest.mark.parametrize(
    ("name", "value", "least"),
    [
        ("horizon", 0, 1),
        ("places", 0, 1),
        ("samples", 1, 2),
        ("options", 0, 1),
        ("critic_width", 0, 1),
        ("critic_steps", 0, 1),
    ],
)
def test_settings_that_are_too_small_are_refused(name, value, least, begun):
    planner = Planner(**{"horizon": 2, name: value})
    with pytest.raises(InputError, match=f"{name}.*at least {least}, found {value}"):
        check_planner(planner)
    with pytest.raises(InputError, match=name):
        planned(SOFT, planner=planner, steps=1, warm=begun)


@pytest.mark.parametrize("name", ["learning_rate", "critic_rate"])
@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_rates_that_are_not_above_0_are_refused(name, rate):
    with pytest.raises(InputError, match=f"{name}.*finite number above 0"):
        check_planner(Planner(horizon=2, **{name: rate}))


def test_what_cannot_be_planned_for_is_refused():
    world, tasks = WORLD.dynamics, WORLD.tasks

    def planned_from(states, which, steps=1):
        return plan(world, tasks, SOFT, UNIFORM, states, which, PLANNER, steps=steps)

    with pytest.raises(InputError, match=r"steps.*at least 1"):
        planned_from(PLACES, WHICH, steps=0)
    with pytest.raises(InputError, match=r"states.*row 2.*finite"):
        planned_from(jnp.asarray([0.0, jnp.nan]), WHICH[:2])
    with pytest.raises(InputError, match="found 0 and 0"):
        planned_from(PLACES[:0], WHICH[:0])
    with pytest.raises(InputError, match=r"task.*0…1"):
        planned_from(PLACES[:2], jnp.asarray([0, 2]))
    with pytest.raises(InputError, match=r"states.*row 2.*has not ended"):
        planned_from(jnp.asarray([0, 4]), jnp.zeros(2, int))
    with pytest.raises(InputError, match="has not ended"):
        PLANNER.begin(jax.random.key(0), world, UNIFORM, task_at(tasks, jnp.zeros(2, int)), SOFT, jnp.asarray([4, 4]))


def test_parts_of_a_deal_differ_by_places_and_hold_every_move():
    places, options, samples, moves = 6, 2, 3, 4
    shape = places, options, samples, moves
    cards = np.moveaxis(np.indices(shape), 0, -1)
    hands = np.asarray(dealt(jnp.asarray(cards), parts=4))
    assert hands.shape == (4, 36, 4)
    assert len(np.unique(hands.reshape(-1, 4), axis=0)) == np.prod(shape)
    for hand in hands:
        assert set(hand[:, 3]) == set(range(moves))
    assert dealt(jnp.ones((1, 1, 2, 1)), parts=8).shape == (2, 1)


def test_with_nothing_to_come_a_critic_stays_as_it_is():
    planner = Planner(horizon=1, places=HERE, samples=2, critic_width=8)
    made = planned(SOFT, planner=planner, steps=3)
    assert made.planning.critic_moments[0].count == 0
    assert made.planning.policy_moments[0].count == 3


def test_figures_that_are_not_finite_are_an_error(begun):
    nowhere = with_logits(jnp.nan * jnp.zeros((TASKS, STATES, ACTIONS)))
    broken = eqx.tree_at(lambda planning: planning.policy, begun, nowhere)
    with pytest.raises(NotConverged, match="step 0"):
        planned(SOFT, warm=broken, steps=1)


def test_mellowmax_people_need_actions_that_can_be_counted():
    dynamics, tasks, policy = linear()
    with pytest.raises(InputError, match="mellowmax"):
        plan(dynamics, tasks, PEOPLE["mellowmax"], policy, jnp.zeros((2, 2)), jnp.arange(2), PLANNER, steps=1)
