"""Eq. 11 by roll-outs beside exact gradients: dynamic programming in a table, moments in a linear-Gaussian world."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from helpers.small_worlds import (
    ACTIONS,
    GAIN,
    OFFSET,
    PLACES,
    SPREAD,
    STATES,
    TASKS,
    WHICH,
    Linear,
    entropies,
    exact_values,
    linear,
    peoples_policy,
    policy_table,
    table,
    with_logits,
)
from sidestep.continuous.critic import Critic
from sidestep.continuous.dynamics import LinearGaussian
from sidestep.continuous.estimators import check_estimator, surprised, value_gradient
from sidestep.continuous.policies import FinitePolicy, Scaled
from sidestep.continuous.rollouts import roll_outs, said, spread_over
from sidestep.continuous.tasks import task_at
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp

pytestmark = pytest.mark.usefixtures("unoptimised")

BETA, HORIZON = 2.0, 5
TABLE, LINEAR = table(), linear()
SOFT = Behavior(LogSumExp(), BETA)
PEOPLE = {"log-sum-exp": SOFT, "Boltzmann": Behavior(BoltzmannAverage(), BETA)}
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(len(PLACES), ACTIONS)))
COUNTS = (10, 100, 1000, 10000)
EACH = 10  # roll-outs an option and estimate
MANY = 600  # estimates, everywhere as many: each number is compiled for


class Tried(NamedTuple):
    """What is tried: places, the task of each, and its options."""

    states: jax.Array
    which: jax.Array
    choices: jax.Array


EVERYWHERE = Tried(PLACES, WHICH, jnp.broadcast_to(jnp.arange(ACTIONS), WEIGHTS.shape))


@eqx.filter_jit
def estimates(world, behavior, keys, tried, level, tilt, critic=None, estimator="score", horizon=HORIZON):
    """Independent estimates of Σ (level + tilt · Q) ∇Q, in rows; each is of `EACH` roll-outs an option."""
    tasks = task_at(world.tasks, tried.which)
    given = {"horizon": horizon, "samples": EACH, "critic": critic, "estimator": estimator}

    def one(key):
        args = world.dynamics, world.policy, tasks, behavior, key, tried.states, tried.choices
        return ravel_pytree(value_gradient(*args, lambda q: level + tilt * q, **given)[0])[0]

    return jax.lax.map(one, keys, batch_size=50)


def drawn(seed, count, world, behavior, tried, level, tilt=0.0, **given):
    """So many of them, in a plain array."""
    keys = jax.random.split(jax.random.key(seed), count)
    # numbers would be compiled into functions of their own
    return np.asarray(estimates(world, behavior, keys, tried, level, jnp.asarray(tilt), **given))


def standard_error(found):
    return found.std(axis=0, ddof=1) / np.sqrt(len(found))


def assert_agrees(found, exact, precision, uncertain=0.0):
    """Within three standard errors in every component, and these are small beside the largest component."""
    error = np.hypot(standard_error(found), uncertain)
    assert error.max() < precision * np.abs(exact).max()
    # on what is done in a terminal state nothing depends, and not even noise is left
    np.testing.assert_array_less(np.abs(found.mean(axis=0) - exact), 3 * error + 1e-12)


def assert_falls_as_root(found, exact):
    """The root-mean-square error of means over N roll-outs falls as 1/√N, for N over three decades."""
    errors = []
    for count in COUNTS:
        means = found.reshape(-1, count // EACH, found.shape[-1]).mean(axis=1)
        errors.append(np.sqrt(((means - exact) ** 2).mean()))
    slope, _ = np.polyfit(np.log(COUNTS), np.log(errors), 1)
    assert slope == pytest.approx(-0.5, abs=0.1)


def critic_of(values) -> Critic:
    """A critic with a guess of its own for every task and state of the table world, however many moves are left."""
    count = TASKS * STATES + 1
    guess = eqx.nn.Linear(count, 1, use_bias=False, key=jax.random.key(0))
    guess = eqx.tree_at(lambda layer: layer.weight, guess, jnp.append(values, 0)[None])
    return Critic(Scaled(guess, jnp.zeros(count), jnp.ones(count)), jnp.zeros(()), jnp.ones(()))


def exact_table(name, world, function=jnp.sum):
    """V of some people's policy, and the gradient of a function of its Q[places, options].

    That is automatic differentiation of dynamic programming.
    """
    pi = policy_table(world.policy)
    bonus = entropies(pi) / BETA if name == "log-sum-exp" else 0.0

    def total(parameters):
        values, q = exact_values(world, parameters, pi, HORIZON, bonus)
        return function(q[WHICH, PLACES]), values

    gradient, values = jax.jit(jax.grad(total, has_aux=True))(world.dynamics.parameters)
    return values, np.asarray(gradient).ravel()


@pytest.fixture(scope="module", params=PEOPLE)
def in_table(request):
    """For some people, the exact Σ weights · ∇Q, and estimates of it.

    They have no critic, one that knows what every state is worth, and one that is wrong in every one.
    """
    values, exact = exact_table(request.param, TABLE, lambda q: jnp.sum(WEIGHTS * q))
    wrong = 2 + jnp.asarray(np.random.default_rng(2).normal(size=values.shape))
    critics = {"no": None, "a good": critic_of(values), "a wrong": critic_of(wrong)}
    people = PEOPLE[request.param]
    return exact, {
        name: drawn(3, MANY, TABLE, people, EVERYWHERE, WEIGHTS, critic=critic) for name, critic in critics.items()
    }


@pytest.mark.parametrize("critic", ["no", "a good", "a wrong"])
def test_score_estimates_are_the_exact_gradient_in_a_table_whatever_the_critic(in_table, critic):
    exact, found = in_table
    assert_agrees(found[critic], exact, precision=0.03)


def test_a_good_critic_makes_score_estimates_of_people_s_own_policy_less_noisy():
    pi = policy_table(TABLE.policy)
    for _ in range(4):  # nearly to π ∝ exp βQ^π
        _, q = exact_values(TABLE, TABLE.dynamics.parameters, pi, HORIZON, entropies(pi) / BETA)
        pi = jax.nn.softmax(BETA * q)
    world = TABLE._replace(policy=with_logits(jnp.log(pi)))
    values, _ = exact_table("log-sum-exp", world)
    guessing, knowing = (
        drawn(4, MANY, world, SOFT, EVERYWHERE, WEIGHTS, critic=critic) for critic in (None, critic_of(values))
    )
    assert knowing.var(axis=0).sum() < 0.5 * guessing.var(axis=0).sum()


def test_a_critic_that_knows_all_takes_the_noise_off_roll_outs():
    pi = peoples_policy(TABLE, SOFT)
    values, q = exact_values(TABLE, TABLE.dynamics.parameters, pi, 40, entropies(pi) / BETA)
    policy, tasks = with_logits(jnp.log(pi)), task_at(TABLE.tasks, WHICH)

    @eqx.filter_jit
    def seen(critic):
        rolled = roll_outs(TABLE.dynamics, policy, tasks, SOFT, jax.random.key(0), PLACES, 40, EVERYWHERE.choices, 20)
        known = surprised(TABLE.dynamics, policy, tasks, rolled, critic)
        discount = spread_over(tasks, rolled).discount
        return [said(each, discount)[..., 0] for each in (rolled, known)]

    plain, known = seen(critic_of(values))
    assert plain.std(axis=-1).max() > 0.1
    np.testing.assert_allclose(known, np.broadcast_to(q[WHICH, PLACES][..., None], known.shape), atol=1e-3)


def test_the_noise_of_weights_is_not_that_of_the_gradients_they_weigh():
    values, exact = exact_table("log-sum-exp", TABLE, lambda q: 0.5 * jnp.sum(q**2))
    found = drawn(5, MANY, TABLE, SOFT, EVERYWHERE, jnp.zeros_like(WEIGHTS), tilt=1.0, critic=critic_of(values))
    assert_agrees(found, exact, precision=0.03)


def test_the_error_of_score_estimates_falls_as_the_root_of_the_roll_outs():
    one = Tried(PLACES[:1], WHICH[:1], jnp.ones((1, 1), int))
    _, exact = exact_table("log-sum-exp", TABLE, lambda q: q[0, 1])
    assert_falls_as_root(drawn(6, 4000, TABLE, SOFT, one, jnp.ones((1, 1))), exact)


AROUND = Tried(jnp.asarray([[1.0, 0.5], [-0.5, -1.0]]), jnp.arange(2), jnp.asarray([[[0.5], [-1.0]], [[0.0], [1.5]]]))
SHARES = jnp.asarray([[1.0, -0.5], [0.3, 0.8]])


def wrong_critic() -> Critic:
    """A critic for the linear world, of whom it cannot be said that it follows anything."""
    network = eqx.nn.MLP(3, 1, 8, 1, jnp.tanh, key=jax.random.key(5))
    return Critic(Scaled(network, jnp.zeros(3), jnp.ones(3)), jnp.asarray(0.5), jnp.asarray(2.0))


def expected_cost(mean, covariance, weight):
    """E[xᵀ weight x]."""
    return mean @ weight @ mean + jnp.trace(weight @ covariance)


def value_by_moments(parameters, task, state, action):
    """Q but for the bonuses, by the mean and the covariance of the states to come."""
    shaking, moving = SPREAD**2 * jnp.eye(1), jnp.diag(LINEAR.dynamics.noise**2)
    a, b = parameters["state"], parameters["action"]
    mean, covariance = a @ state + b @ action, moving
    value = task.reward(state, action)
    for power in range(1, HORIZON):
        acting, shaken = GAIN @ (mean - task.goal) + OFFSET, GAIN @ covariance @ GAIN.T + shaking
        cost = expected_cost(mean - task.goal, covariance, task.state_cost)
        value = value - task.discount**power * (cost + expected_cost(acting, shaken, task.action_cost))
        closed = a + b @ GAIN
        mean, covariance = a @ mean + b @ acting, closed @ covariance @ closed.T + b @ shaking @ b.T + moving
    return value


def exact_linear(value, inputs, shares):
    """The gradient of Σ shares · Q, for Q a function of θ, a task, a place and an input."""

    def total(parameters):
        values = jax.vmap(jax.vmap(value, (None, None, None, 0)), (None, 0, 0, 0))
        return jnp.sum(shares * values(parameters, LINEAR.tasks, AROUND.states, inputs))

    return np.asarray(ravel_pytree(jax.jit(jax.grad(total))(LINEAR.dynamics.parameters))[0])


@pytest.fixture(scope="module")
def closed_form():
    return exact_linear(value_by_moments, AROUND.choices, SHARES)


@pytest.fixture(scope="module")
def along_paths():
    return drawn(7, 4000, LINEAR, SOFT, AROUND, SHARES, estimator="pathwise")


def test_pathwise_estimates_are_the_closed_form_in_a_linear_world(along_paths, closed_form):
    assert_agrees(along_paths, closed_form, precision=0.005)


def test_the_error_of_pathwise_estimates_falls_as_the_root_of_the_roll_outs(along_paths, closed_form):
    assert_falls_as_root(along_paths, closed_form)


@pytest.mark.parametrize("critic", [None, wrong_critic()], ids=["no critic", "a wrong critic"])
def test_score_estimates_are_the_closed_form_in_a_linear_world_and_noisier(along_paths, closed_form, critic):
    scores = drawn(8, MANY, LINEAR, SOFT, AROUND, SHARES, critic=critic)
    assert_agrees(scores, closed_form, precision=0.1)
    assert (scores.var(axis=0) > 10 * along_paths.var(axis=0)).all()


PUSHES = jnp.asarray([[-1.0], [0.2], [1.0]])
MOVES = 3
PUSHED = AROUND._replace(choices=jnp.broadcast_to(jnp.arange(len(PUSHES)), (2, len(PUSHES))))
PARTS = jnp.asarray([[1.0, -0.5, 0.2], [0.3, 0.8, -1.0]])


def choosing(noise) -> Linear:
    """The linear world with so much noise, and people who choose from three actions."""
    network = eqx.nn.Linear(2, len(PUSHES), key=jax.random.key(1))
    network = Scaled(jax.tree.map(lambda leaf: 3.0 * leaf, network), jnp.zeros(2), jnp.ones(2))
    state, action = LINEAR.dynamics.parameters["state"], LINEAR.dynamics.parameters["action"]
    return Linear(LinearGaussian(state, action, jnp.full(2, noise)), LINEAR.tasks, FinitePolicy(network, PUSHES))


def value_by_all_paths(policy):
    """Q as the sum over all that may be chosen, in a world without noise."""

    def value(parameters, task, state, action, moves=MOVES):
        now = task.reward(state, action)
        if moves == 1:
            return now
        after = parameters["state"] @ state + parameters["action"] @ action
        log_probs = policy.log_probs(task.features(after))
        to_come = [value(parameters, task, after, push, moves - 1) for push in PUSHES]
        return now + task.discount * jnp.exp(log_probs) @ (jnp.stack(to_come) - log_probs / BETA)

    return value


@pytest.mark.parametrize("critic", [None, wrong_critic()], ids=["no critic", "a wrong critic"])
def test_pathwise_estimates_see_that_choices_from_a_finite_set_jump(critic):
    world = choosing(noise=1e-3)
    exact = exact_linear(value_by_all_paths(world.policy), PUSHES[PUSHED.choices], PARTS)
    found = drawn(9, MANY, world, SOFT, PUSHED, PARTS, estimator="pathwise", horizon=MOVES, critic=critic)
    assert_agrees(found, exact, precision=0.03)


def test_pathwise_and_score_estimates_agree_on_choices_from_a_finite_set():
    world = choosing(noise=0.3)
    along_paths, scores = (
        drawn(10, MANY, world, SOFT, PUSHED, PARTS, estimator=estimator, horizon=MOVES)
        for estimator in ("pathwise", "score")
    )
    assert_agrees(along_paths, scores.mean(axis=0), precision=0.1, uncertain=standard_error(scores))


def short_gradient(**given):
    """An estimate in the table, of two moves and roll-outs unless another number is given."""
    tasks, key = task_at(TABLE.tasks, WHICH), jax.random.key(0)
    arguments = TABLE.dynamics, TABLE.policy, tasks, SOFT, key, PLACES, EVERYWHERE.choices, jnp.ones_like
    return value_gradient(*arguments, **{"horizon": 2, "samples": 2, **given})


def test_estimators_that_would_be_biased_are_refused():
    for dynamics, tasks in ((TABLE.dynamics, LINEAR.tasks), (LINEAR.dynamics, TABLE.tasks)):
        check_estimator("score", dynamics, tasks)
        with pytest.raises(InputError, match=r"jump.*expected 'score'"):
            check_estimator("pathwise", dynamics, tasks)
    check_estimator("pathwise", LINEAR.dynamics, LINEAR.tasks)
    with pytest.raises(InputError, match="jump"):
        short_gradient(estimator="pathwise")


@pytest.mark.parametrize(("setting", "value"), [("horizon", 0), ("samples", 0)])
def test_roll_outs_that_are_none_are_refused(setting, value):
    with pytest.raises(InputError, match=f"{setting}.*at least 1, found {value}"):
        short_gradient(**{setting: value})
