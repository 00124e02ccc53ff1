"""Verification and information of fits: tolerances at their boundaries, and figures beside the halves of rollouts."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.families import Drift, vector
from sidestep.continuous.halves import gather_halves
from sidestep.continuous.information import RolloutInformation
from sidestep.continuous.likelihood import FitProblem
from sidestep.continuous.verification import Verification, verify
from sidestep.inference.decomposition import whole
from sidestep.inference.normal_posterior import Laplace

SCHEDULE = sc.Schedule(distance_tolerance=0.5, policy_gap_tolerance=0.125)
GOOD = Verification(
    gradient=np.zeros(1), standard_errors=np.zeros(1), covariance=np.eye(1), step=np.zeros(1),
    distance=0.5, noise=0.25, policy_gap=0.125, beyond_horizon=0.125, unfinished=0.1, samples=8,
)  # fmt: skip
TOO_LARGE = {"distance": 0.51, "noise": 0.26, "policy_gap": 0.13, "beyond_horizon": 0.13, "unfinished": 0.11}


def test_passes_figures_at_their_tolerances_pass():
    assert GOOD.passes(SCHEDULE)
    assert GOOD._replace(policy_gap=-0.125, beyond_horizon=-0.125).passes(SCHEDULE)


@pytest.mark.parametrize("name", TOO_LARGE)
def test_passes_one_figure_above_its_tolerance_does_not_pass(name):
    assert not GOOD._replace(**{name: TOO_LARGE[name]}).passes(SCHEDULE)
    if name in {"policy_gap", "beyond_horizon"}:
        assert not GOOD._replace(**{name: -TOO_LARGE[name]}).passes(SCHEDULE)


@pytest.mark.parametrize("name", TOO_LARGE)
def test_message_speaks_of_the_horizon_where_it_is_too_short(name):
    text, long = GOOD._replace(**{name: TOO_LARGE[name]}).message(SCHEDULE), GOOD.message(SCHEDULE)
    assert (
        "the maximum is 0.5 posterior standard deviations away (tolerance 0.5), with noise of 0.25 (tolerance" in long
    )
    assert "horizon" not in long
    assert ("values at its end would move the policy by 0.13" in text) == (name == "beyond_horizon")
    assert ("0.11 of the rollouts do not end their task within it" in text) == (name == "unfinished")


# Two numbers are learned, a drift on each of two axes; agents move along one of them and look two moves ahead.
WAYS = jnp.asarray([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
COUNT, NOISE = 12, 0.4


@cache
def problem(terms, samples=16):
    random = np.random.default_rng(0)
    states, choices = random.uniform(-1, 1, (COUNT, 2)), random.integers(0, 3, COUNT)
    task = sc.QuadraticTask(jnp.zeros(2), jnp.eye(2), jnp.zeros((2, 2)), jnp.asarray(0.9))
    following = states + WAYS[choices] + NOISE * random.normal(size=(COUNT, 2))
    moves = zip(np.stack([states, following], axis=1), choices, strict=True)
    demos = sc.gather_trajectories([ss.Trajectory(places, action[None], 0) for places, action in moves], [task])
    policy = sc.finite_policy(jax.random.key(1), WAYS, demos.states, width=4, depth=1)
    agent = sc.Agent(Drift(vector(0.2, -0.1), vector(NOISE, NOISE)), policy, ss.Behavior(ss.LogSumExp(), 1.5))
    planner, schedule = sc.Planner(horizon=2, critic_width=4), sc.Schedule(2, verification_samples=samples)
    return FitProblem(agent, demos, ss.Normal(0.0, 2.0), planner, schedule, terms, "pathwise")


@cache
def planner_state(terms):
    own = problem(terms)
    demos = own.demonstrations
    return own.planner.initialize(jax.random.key(2), own.agent, sc.task_at(demos.tasks, demos.task), demos.states)


def verified(terms, noise, samples=16):
    own = problem(terms, samples)
    return verify(own, own.agent.dynamics, planner_state(terms), jax.random.key(3), noise=noise)


def exact_parts(terms):
    """The gradient and the information of the prior, and of the transitions if they count."""
    own = problem(terms)
    at, demos = np.asarray(own.agent.dynamics.parameters), own.demonstrations
    away = np.asarray(demos.next_states - demos.states - WAYS[demos.actions]) - at
    counts = "transitions" in terms
    return counts * away.sum(axis=0) / NOISE**2 - at / 2, (counts * COUNT / NOISE**2 + 0.5) * np.eye(2)


def test_verify_transitions_alone_is_exact():
    gradient, information = exact_parts(("transitions",))
    found = verified(("transitions",), 0.0)
    np.testing.assert_allclose(found.gradient, gradient, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=1e-9)
    distance = np.sqrt(gradient @ np.linalg.solve(information, gradient) / 2)
    assert found.distance == pytest.approx(distance)
    np.testing.assert_allclose(found.step, np.linalg.solve(information, gradient) * min(1, 2 / distance), rtol=1e-9)
    assert (found.noise, found.policy_gap, found.beyond_horizon, found.unfinished, found.samples) == (0, 0, 0, 0, 0)
    np.testing.assert_array_equal(found.standard_errors, 0)


@pytest.mark.parametrize("terms", [("actions",), ("actions", "transitions")])
def test_verify_figures_are_those_of_the_halves_of_all_rounds(terms):
    own, state, key = problem(terms), planner_state(terms), jax.random.key(3)
    rounds = [
        list(gather_halves(own, own.agent.dynamics, state, 8, jax.random.fold_in(key, index))) for index in range(2)
    ]
    assert [len(each) for each in rounds] == [1, 1]
    halves = [each[0] for each in rounds]
    gradient, information = exact_parts(terms)
    gradient = gradient + np.mean([each.scores.mean(axis=0).sum(axis=0) for each in halves], axis=0)
    of_actions = np.mean([np.einsum("mcp,mcq->pq", *each.factors) for each in halves], axis=0)
    information = information + (of_actions + of_actions.T) / 2
    differences = np.concatenate([(each.scores[0] - each.scores[1]) / 4 for each in halves])
    covariance = np.linalg.inv(information)
    squared, of_noise = gradient @ covariance @ gradient / 2, np.trace(covariance @ differences.T @ differences) / 2

    found = verified(terms, 0.0)
    assert found.samples == 16
    np.testing.assert_allclose(found.gradient, gradient, rtol=1e-9)
    np.testing.assert_allclose(found.standard_errors, np.sqrt((differences**2).sum(axis=0)), rtol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-9)
    np.testing.assert_allclose(found.step, covariance @ gradient * min(1, 2 / np.sqrt(squared)), rtol=1e-9)
    assert found.distance == pytest.approx(np.sqrt(max(squared - of_noise, 0)))
    assert found.noise == pytest.approx(np.sqrt(of_noise))
    figures = [[np.mean(each.policy_gaps), np.mean(each.beyond_horizon), np.mean(each.unfinished)] for each in halves]
    np.testing.assert_allclose([found.policy_gap, found.beyond_horizon, found.unfinished], np.mean(figures, axis=0))


def test_verify_takes_no_more_rollouts_than_the_noise_asks_for():
    first = verified(("actions",), np.inf)
    assert first.samples == 8
    assert verified(("actions",), first.noise, 32).samples == 8
    assert verified(("actions",), 0.999 * first.noise, 32).samples > 8
    assert verified(("actions",), 0.0, 32).samples == 32
    assert verified(("actions",), 0.0, 31).samples == 24


@cache
def of_halves(terms):
    """Halves of eight rollouts, and the information by the same rollouts."""
    own, state = problem(terms), planner_state(terms)
    (halves,) = gather_halves(own, own.agent.dynamics, state, 8, jax.random.key(5))
    return halves, RolloutInformation(own, own.agent.dynamics, state, samples=8, seed=5, message="as it is")


@pytest.mark.parametrize("terms", [("actions",), ("actions", "transitions")])
def test_rollout_information_is_that_of_its_halves_and_of_what_is_exact(terms):
    halves, found = of_halves(terms)
    gradient, information = exact_parts(terms)
    of_actions = np.einsum("mcp,mcq->pq", *halves.factors)
    vectors = np.array([[1.0, 0.0], [0.3, -2.0], [0.0, 1.0]])
    np.testing.assert_allclose(found.gradient, gradient + halves.scores.mean(axis=0).sum(axis=0), rtol=1e-9)
    products = vectors @ (information + (of_actions + of_actions.T) / 2)
    np.testing.assert_allclose(found.products(vectors), products, rtol=1e-9)
    np.testing.assert_allclose(found.of_prior(vectors), vectors / 2, rtol=1e-9)
    assert (found.message, found.size) == ("as it is", 2)


def test_simulation_is_what_the_halves_differ_by():
    halves, found = of_halves(("actions",))
    normal = Laplace(found.parameters, *whole(found))
    covariance = np.linalg.inv(found.dense())
    first, second = (np.asarray(part) @ covariance for part in halves.factors)
    change = np.sum(first**2 - second**2, axis=1) / 2
    by_move = np.asarray(halves.scores[0] - halves.scores[1]) / 2
    errors, squared = found.simulation(normal)
    assert errors == pytest.approx(max(np.sqrt(np.sum(change**2, axis=0)) / np.diag(covariance) / 2), rel=1e-6)
    assert squared == pytest.approx(np.sum(by_move * (by_move @ covariance)), rel=1e-6)


def test_rollout_information_of_one_rollout_is_refused():
    own = problem(("actions",))
    with pytest.raises(ss.InputError, match="'samples': expected at least 2, found 1"):
        RolloutInformation(own, own.agent.dynamics, planner_state(("actions",)), samples=1)


def test_rollout_information_of_the_boltzmann_average_is_refused():
    own, average = problem(("actions",)), ss.Behavior(ss.BoltzmannAverage(), 1.5)
    other = eqx.tree_at(lambda own: own.agent.behavior, own, average)
    with pytest.raises(ss.InputError, match="'behavior': expected another backup"):
        RolloutInformation(other, own.agent.dynamics, planner_state(("actions",)), samples=8)
    of_transitions = eqx.tree_at(lambda own: own.agent.behavior, problem(("transitions",)), average)
    found = RolloutInformation(of_transitions, own.agent.dynamics, planner_state(("transitions",)), samples=8)
    np.testing.assert_allclose(found.products(np.eye(2)), exact_parts(("transitions",))[1], rtol=1e-9)
