"""What rollouts say of demonstrated moves, in worlds without noise: each estimate has a closed form.

Agents on a line look two moves ahead: Q(s, a) = −s² − γ (s + a + θ)², whatever comes later.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector
from sidestep.continuous.halves import Halves, gather_halves
from sidestep.continuous.likelihood import FitProblem
from sidestep.continuous.planner import PlannerState
from sidestep.continuous.policies import ScaledNetwork

WAYS, DISCOUNT, BETA, DRIFT, VARIANCE, TINY = np.array([-1.0, 0.0, 1.0]), 0.9, 1.5, 0.3, 2.0, 1e-6
RANDOM = np.random.default_rng(0)
STATES = RANDOM.uniform(-1.5, 1.5, 7)
CHOICES = RANDOM.integers(0, 3, 7)
SLIPS = RANDOM.normal(size=7)
"""How many standard deviations each transition is away from its mean."""
TASK = sc.QuadraticTask(jnp.zeros(1), jnp.eye(1), jnp.zeros((1, 1)), jnp.asarray(DISCOUNT))
SOFT = ss.Behavior(ss.LogSumExp(), BETA)
FRACTION = jnp.asarray(1.0)


def problem_of(moves, actions, policy, *, terms=("actions",), behavior=SOFT, **settings) -> FitProblem:
    """Of the moves with these numbers; their transitions are a millionth off their means."""
    states, slips = STATES[moves], SLIPS[moves]
    displacement = WAYS[actions] if actions.ndim == 1 else actions[:, 0]
    places = np.stack([states, states + displacement + DRIFT + TINY * slips], axis=1)[..., None]
    pairs = zip(places, actions, strict=True)
    demos = sc.gather_trajectories([ss.Trajectory(both, action[None], 0) for both, action in pairs], [TASK])
    agent = sc.Agent(Drift(vector(DRIFT), vector(TINY)), policy, behavior)
    planner = sc.Planner(horizon=2, samples=2, critic_width=4, **{"candidates": 400, **settings})
    schedule = sc.Schedule(2, batch_size=4)
    return FitProblem(agent, demos, ss.Normal(0.0, VARIANCE), planner, schedule, terms, "pathwise")


def state_of(problem: FitProblem) -> PlannerState:
    demos = problem.demonstrations
    return problem.planner.initialize(
        jax.random.key(0), problem.agent, sc.task_at(demos.tasks, demos.task), demos.states
    )


def uniform_policy(features=1):
    examples = jnp.ones((2, features))
    policy = sc.finite_policy(jax.random.key(1), jnp.asarray(WAYS)[:, None], examples, width=4, depth=0)
    network: Any = policy.network.network
    layer = network.layers[0]
    return eqx.tree_at(
        lambda policy: tuple(getattr(policy.network.network.layers[0], name) for name in ("weight", "bias")),
        policy, (jnp.zeros_like(layer.weight), jnp.zeros_like(layer.bias)),
    )  # fmt: skip


@cache
def finite(terms=("actions",), moves=tuple(range(7))):
    own = problem_of(list(moves), CHOICES[list(moves)], uniform_policy(), terms=terms)
    return own, state_of(own)


ENDS = STATES[:, None] + WAYS + DRIFT  # where each action leads
Q = -(STATES[:, None] ** 2) - DISCOUNT * ENDS**2
PI = np.exp(BETA * Q) / np.exp(BETA * Q).sum(axis=1, keepdims=True)
SLOPES = -2 * DISCOUNT * ENDS
BEYOND = SLOPES - np.sum(PI * SLOPES, axis=1, keepdims=True)
SCORES = BETA * BEYOND[np.arange(7), CHOICES]


def halves_of(problem: FitProblem, state: PlannerState, samples: int) -> Halves:
    """Of all moves, which are one batch."""
    (halves,) = gather_halves(problem, problem.agent.dynamics, state, samples, jax.random.key(2))
    return halves


@cache
def finite_halves() -> Halves:
    return halves_of(*finite(), 4)


def test_gather_halves_without_noise_has_the_score_of_each_move():
    np.testing.assert_allclose(finite_halves().scores, np.broadcast_to(SCORES[:, None], (2, 7, 1)), atol=1e-4)


def test_gather_halves_without_noise_has_the_information_of_each_move():
    factors = finite_halves().factors
    expected = np.sqrt(PI) * BETA * BEYOND
    np.testing.assert_allclose(factors, np.broadcast_to(expected[..., None], (2, 7, 3, 1)), atol=1e-4)


def test_gather_halves_without_noise_has_the_divergence_from_the_agent():
    expected = np.log(1 / 3) - np.log(PI).mean(axis=1)
    np.testing.assert_allclose(finite_halves().policy_gaps, [expected], atol=1e-4)


def test_gather_halves_without_noise_has_what_the_critic_expects_at_the_end():
    """V = 2 s + 1: the second choice is the same for all candidates, and counts alike."""
    own, state = finite()
    linear = eqx.nn.Linear(2, 1, use_bias=False, key=jax.random.key(0))
    linear = eqx.tree_at(lambda layer: layer.weight, linear, jnp.asarray([[2.0, 0.0]]))
    critic = sc.Critic(ScaledNetwork(linear, jnp.zeros(2), jnp.ones(2)), jnp.ones(()), jnp.ones(()))
    (halves,) = gather_halves(own, own.agent.dynamics, replace(state, critic=critic), 4, jax.random.key(2))
    variance = np.sum(PI * WAYS**2, axis=1) - np.sum(PI * WAYS, axis=1) ** 2
    np.testing.assert_allclose(halves.beyond_horizon, [(BETA * DISCOUNT**2 * 2) ** 2 * variance / 2], atol=1e-4)
    np.testing.assert_array_equal(halves.unfinished, 0)  # the task has no end


def test_gather_halves_of_a_task_that_goes_on_has_the_discounted_share():
    """The agent of the first move is four moves away from its goal, that of the second one move."""
    task = sc.reach_region((4.0,), 0.5, discount=0.9, step_cost=1.0)
    places = np.array([[[0.0], [1.0]], [[2.9], [3.9]]])
    demos = sc.gather_trajectories([ss.Trajectory(each, np.array([2]), 0) for each in places], [task])
    agent = sc.Agent(Drift(vector(0.0), vector(0.01)), uniform_policy(3), SOFT)
    planner = sc.Planner(horizon=2, samples=2, critic_width=4)
    own = FitProblem(agent, demos, ss.Normal(0.0, VARIANCE), planner, sc.Schedule(2), ("actions",), "score")
    (halves,) = gather_halves(own, own.agent.dynamics, state_of(own), 64, jax.random.key(2))
    first, second = np.asarray(halves.unfinished)[0]
    assert first == pytest.approx(0.9**2)
    # from the second place a step forth ends the task, and after a step on the spot one of the three ways does
    going_on = -1 + 0.9 * (-1 + np.log(3) / BETA)
    odds = np.exp(BETA * np.array([going_on, going_on, -1]))
    assert second == pytest.approx(0.9**2 * (odds[0] + odds[1] * 2 / 3) / odds.sum(), abs=0.04)


def test_gather_halves_of_some_moves_at_a_time_has_each_move_once():
    """With 900 rollouts of three candidates, three moves fit into a batch."""
    own, state = finite()
    batches = list(gather_halves(own, own.agent.dynamics, state, 900, jax.random.key(2)))
    assert [each.scores.shape[1] for each in batches] == [3, 3, 1]
    scores = np.concatenate([each.scores for each in batches], axis=1)
    np.testing.assert_allclose(scores[0, :, 0], SCORES, atol=1e-4)
    for each in batches:
        assert {part.shape[1] for part in each} == {each.scores.shape[1]}


WEIGHTS = np.array([0.0, 1.0, 2.0, 0.5, 1.0, 3.0, 0.0])


def weighed(problem):
    return eqx.tree_at(lambda own: own.demonstrations.weights, problem, jnp.asarray(WEIGHTS))


def test_gather_halves_of_moves_with_weights_counts_them_as_often():
    own, state = finite()
    (halves,) = gather_halves(weighed(own), own.agent.dynamics, state, 4, jax.random.key(2))
    plain = finite_halves()
    np.testing.assert_allclose(halves.scores, WEIGHTS[:, None] * plain.scores)
    information = np.sum(halves.factors[0] * halves.factors[1], axis=(1, 2))
    np.testing.assert_allclose(information, WEIGHTS * np.sum(plain.factors[0] * plain.factors[1], axis=(1, 2)))
    np.testing.assert_allclose(halves.policy_gaps, WEIGHTS * plain.policy_gaps)


# The gradient of a batch


@eqx.filter_jit
def gradient(problem, state, key, parameters):
    return problem.objective_gradient(parameters, state, key, FRACTION)


@pytest.mark.parametrize("terms", [("actions",), ("transitions",), ("actions", "transitions")])
def test_objective_gradient_without_noise_is_exact(terms):
    """The batch has four of the moves, which are all the same."""
    own, state = finite(terms, (2,) * 7)
    _, slope, figures = gradient(own, state, jax.random.key(3), own.agent.dynamics.parameters)
    actions = 7 * np.log(PI[2, CHOICES[2]]) * ("actions" in terms)
    density = -0.5 * SLIPS[2] ** 2 - np.log(TINY) - 0.5 * np.log(2 * np.pi)
    transitions = 7 * density * ("transitions" in terms)
    prior = -0.5 * DRIFT**2 / VARIANCE
    expected = actions, transitions, prior
    np.testing.assert_allclose([figures.actions, figures.transitions, figures.prior], expected, rtol=1e-4)
    np.testing.assert_allclose(figures.objective, sum(expected), rtol=1e-4)
    rising = 7 * SCORES[2] * ("actions" in terms) - DRIFT / VARIANCE
    rising = rising + 7 * SLIPS[2] / TINY * ("transitions" in terms)
    np.testing.assert_allclose(slope, [-rising], rtol=1e-4)
    np.testing.assert_allclose(figures.gradient, abs(rising), rtol=1e-4)
    if "actions" in terms:
        np.testing.assert_allclose(figures.entropy, np.log(3), rtol=1e-9)
        np.testing.assert_allclose(figures.policy_gap, np.log(1 / 3) - np.log(PI[2]).mean(), rtol=1e-4)
        np.testing.assert_allclose(figures.expected_return, Q[2].mean(), rtol=1e-4)
    else:
        assert (figures.entropy, figures.policy_gap, figures.expected_return) == (0, 0, 0)


def test_objective_gradient_of_moves_with_weights_counts_them_as_often():
    """All moves are the same, and the batch has four of them: their mean weight is 1.5."""
    own, state = finite(("actions", "transitions"), (2,) * 7)
    plain, other = (
        gradient(each, state, jax.random.key(3), own.agent.dynamics.parameters)
        for each in (own, eqx.tree_at(lambda own: own.demonstrations.weights, own, jnp.full(7, 1.5)))
    )
    assert other[2].actions == pytest.approx(1.5 * float(plain[2].actions))
    assert other[2].transitions == pytest.approx(1.5 * float(plain[2].transitions))
    of_prior = DRIFT / VARIANCE
    np.testing.assert_allclose(other[1] - of_prior, 1.5 * (plain[1] - of_prior), rtol=1e-9)


def test_improve_policy_leads_towards_the_agent():
    own, state = finite(("actions",), (2,) * 7)

    @eqx.filter_jit
    def improved(state, key):
        return own.improve_policy(own.agent.dynamics.parameters, state, key, FRACTION)

    after = improved(state, jax.random.key(4))
    before, later = (np.exp(each.policy.log_probs(jnp.asarray(STATES[2:3]))) for each in (state, after))
    np.testing.assert_allclose(before, 1 / 3)
    assert np.sum(PI[2] * np.log(PI[2] / later)) < np.sum(PI[2] * np.log(PI[2] / before))


# Vectors of actions: the agent has π(a | s) ∝ exp −βγ(s + a + θ)², a normal distribution around −s − θ

VECTORS = RANDOM.normal(size=(7, 1))
VARIANCE_OF_ACTIONS = 1 / (2 * BETA * DISCOUNT)


@cache
def vectors():
    policy = sc.gaussian_policy(jax.random.key(1), 1, jnp.asarray(STATES)[:, None], depth=0, spread=1.2)
    own = problem_of(list(range(7)), VECTORS, policy)
    return own, state_of(own)


@cache
def vector_halves() -> Halves:
    return halves_of(*vectors(), 2)


def test_gather_halves_of_vectors_has_the_score_of_each_move():
    expected = -2 * BETA * DISCOUNT * (STATES + VECTORS[:, 0] + DRIFT)
    scores = np.asarray(vector_halves().scores)[..., 0]
    noise = np.abs(scores[0] - scores[1]) / 2
    assert noise.max() > 0
    np.testing.assert_allclose(scores.mean(axis=0), expected, atol=0.25)
    np.testing.assert_allclose((scores.mean(axis=0) - expected).mean(), 0, atol=0.08)


def test_gather_halves_of_vectors_has_the_information_of_each_move():
    factors = np.asarray(vector_halves().factors)[..., 0]
    assert factors.shape == (2, 7, 2 * 401)
    information = np.sum(factors[0] * factors[1], axis=1)
    np.testing.assert_allclose(information, (2 * BETA * DISCOUNT) ** 2 * VARIANCE_OF_ACTIONS, rtol=0.25)
    np.testing.assert_allclose(information.mean(), 2 * BETA * DISCOUNT, rtol=0.06)


def test_gather_halves_of_vectors_has_the_divergence_from_the_agent():
    """Of two normal distributions, of which the policy's has a mean near 0."""
    _, state = vectors()
    mean = np.asarray(jax.vmap(state.policy.network)(jnp.asarray(STATES)[:, None]))[:, 0] + STATES + DRIFT
    ratio = 1.2**2 / VARIANCE_OF_ACTIONS
    expected = 0.5 * (ratio + mean**2 / VARIANCE_OF_ACTIONS - 1 - np.log(ratio))
    np.testing.assert_allclose(np.asarray(vector_halves().policy_gaps)[0], expected, rtol=0.25)
