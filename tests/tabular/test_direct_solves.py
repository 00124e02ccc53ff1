"""Solves where sweeps are slow: discounts near 1, and many moves to the end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.problems import BACKUPS, plain_backup
from sidestep.tabular.backups import Behavior, HardMax
from sidestep.tabular.graph import graph
from sidestep.tabular.models import TransitionModel, tabular_model
from sidestep.tabular.solve import SolveOptions, solve
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import Task, task

STATES, ACTIONS, BETA = 12, 3, 2.0
ENDLESS = np.zeros(STATES, bool)


def endless_world(dtype: type[np.floating] = np.float64) -> tuple[TransitionModel, np.ndarray, np.ndarray]:
    """A model without an end, its transitions as T[s, a, s'], and R(s, a)."""
    rng = np.random.default_rng(0)
    successors = np.stack([[rng.choice(STATES, 3, replace=False) for _ in range(ACTIONS)] for _ in range(STATES)])
    probabilities = rng.dirichlet(np.ones(3), (STATES, ACTIONS)).astype(dtype)
    transitions = np.einsum("sak,sakt->sat", probabilities, np.eye(STATES)[successors])
    return tabular_model(graph(successors), probabilities), transitions, rng.normal(size=(STATES, ACTIONS))


def fixed_point(backup: str, transitions: np.ndarray, reward, discount: float):
    """V by Newton's method on V = B(R + γ T V) itself, and (I - W)⁻¹, W = ∂B/∂V."""

    def backed_up(values):
        return plain_backup(backup, reward + discount * transitions @ values, BETA)

    values, inverse = jnp.zeros(STATES), jnp.eye(STATES)
    for _ in range(30):
        inverse = jnp.linalg.inv(jnp.eye(STATES) - jax.jacfwd(backed_up)(values))
        values = values + inverse @ (backed_up(values) - values)
    return values, inverse


@pytest.mark.parametrize("backup", BACKUPS)
@pytest.mark.parametrize(("discount", "within"), [(0.999, 1e-5), (1 - 1e-6, 3e-4)])
def test_solve_at_discounts_near_one_equals_newtons_method(backup, discount, within):
    """The values, the bound of their error, and the gradient, which is the adjoint at the weights.

    Values of 10⁶ have errors of up to 10, so their differences, on which the gradient depends, have fewer digits.
    """
    model, transitions, reward = endless_world()
    values, inverse = fixed_point(backup, transitions, jnp.asarray(reward), discount)
    behavior, weights = Behavior(BACKUPS[backup], BETA), jnp.asarray(np.random.default_rng(1).normal(size=STATES))

    def total(reward):
        solution = solve(model, Task(*of_reward(reward)), behavior)
        return weights @ solution.values, solution

    def of_reward(reward):
        return reward, jnp.zeros(1), jnp.asarray(ENDLESS), jnp.asarray(discount)

    (_, solution), slope = jax.value_and_grad(total, has_aux=True)(jnp.asarray(reward))
    assert bool(solution.converged)
    off = jnp.abs(solution.values - values).max()
    assert off <= solution.error
    assert solution.error <= 1e-5 * jnp.abs(values).max()
    np.testing.assert_allclose(solution.values, values, rtol=1e-5)
    q = jnp.asarray(reward) + discount * transitions @ values
    by_q = jax.vmap(jax.grad(lambda q: plain_backup(backup, q[None], BETA)[0]))(q)
    expected = np.asarray((inverse.T @ weights)[:, None] * by_q)
    np.testing.assert_allclose(np.asarray(slope), expected, rtol=within, atol=within * np.abs(expected).max())


def test_solve_with_a_dear_way_beside_a_long_one_does_not_say_that_it_converged_at_the_wrong_one():
    """State 0 ends at a cost of 1.2 · 2/p, or goes to state 1, which ends with probability p or returns."""
    count, chance = 500, 1e-5
    successors, probabilities = np.zeros((count, 2, 2), int), np.zeros((count, 2, 2))
    rewards = -np.ones((count, 2))
    probabilities[..., 0] = 1
    successors[0], successors[1], successors[2] = [[2, 2], [1, 1]], [[2, 0], [2, 0]], 2
    rewards[0, 0], probabilities[1] = -2.4 / chance, [chance, 1 - chance]
    successors[3:] = np.maximum(np.arange(3, count) - 1, 0)[:, None, None]
    successors[3] = 0
    shorter = task(rewards, 1.0, np.arange(count) == 2)
    for dtype, within in ((np.float32, 0.05), (np.float64, 1e-5)):
        model = tabular_model(graph(successors), probabilities.astype(dtype))
        solution = solve(model, shorter, Behavior(HardMax()))
        off = abs(float(solution.values[0]) + 2 / chance) * chance / 2
        assert off <= within or not bool(solution.converged)
        assert off * 2 / chance <= float(solution.error) * (1 + 1e-9) + 1e-3


@pytest.mark.parametrize(("dtype", "within"), [(np.float64, 1e-9), (np.float32, 2e-4)])
@pytest.mark.parametrize("count", [101, 451])
def test_solve_of_a_random_walk_equals_its_expected_number_of_moves(count, dtype, within):
    """From i, with the end at 0 and the far end at n reflecting, i (2n - i) moves are expected.

    By default the smaller one is solved by Jacobi iteration, the larger one by Gauss–Seidel sweeps.
    """
    states = np.arange(count)
    last = len(states) - 1
    successors = np.stack([np.maximum(states - 1, 0), np.minimum(states + 1, last)], axis=-1)[:, None]
    probabilities = np.full((len(states), 1, 2), 0.5, dtype)
    successors[last], probabilities[last] = (last - 1, last), (1, 0)
    walk = task(np.full((len(states), 1), -1.0), 1.0, states == 0)
    solution = solve(tabular_model(graph(successors), probabilities), walk, Behavior(HardMax()))
    assert bool(solution.converged) or (dtype == np.float32 and count > 101)
    expected = -states * (2.0 * last - states)
    off = np.abs(np.asarray(solution.values, np.float64) - expected).max()
    assert off <= within * last**2
    assert off <= float(solution.error)


def test_solve_in_32_bits_says_where_they_do_not_suffice():
    model, _, reward = endless_world(np.float32)
    solution = solve(model, task(reward, 1 - 1e-7, ENDLESS), Behavior(HardMax()))
    assert solution.values.dtype == np.float32
    assert not bool(solution.converged)
    assert solution.error > 0.1 * jnp.abs(solution.values).max()


def test_jacobi_stops_at_the_most_sweeps_and_says_so():
    model, _, reward = endless_world()
    options = SolveOptions(solver=Jacobi(max_sweeps=50))
    solution = solve(model, task(reward, 0.999, ENDLESS), Behavior(HardMax()), options=options)
    assert int(solution.sweeps) == 50
    assert not bool(solution.converged)
