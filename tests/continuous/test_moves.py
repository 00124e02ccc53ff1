"""Functions of every move: the same as one move after the other, and gradients added up in groups."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep.continuous as sc
from sidestep.continuous.moves import map_moves, sum_gradients

GOALS = np.random.default_rng(0).uniform(-1, 1, (40, 3, 1))
TASKS = sc.ReachTask(jnp.asarray(GOALS), *(jnp.asarray(np.full((40, 3), number)) for number in (0.5, 1.0, 0.0, 0.9)))


def some_moves(moves):
    """Whether each of 40 × 3 rollouts acts, which ends at different moves, and numbers for each move."""
    random = np.random.default_rng(1)
    acting = np.arange(moves) < random.integers(0, moves // 2, (40, 3, 1))
    return acting, random.normal(size=(*acting.shape, 2)), random.normal(size=acting.shape)


def product(weights, task, vector, number):
    return jnp.sum(jnp.sin(weights * vector)) * number + weights[0] * task.goal[0]


@pytest.mark.parametrize("moves", [4, 60])  # 480 moves are few, of 7200 many chunks are left out
def test_map_moves_is_0_without_an_action_and_the_function_elsewhere(moves):
    acting, vectors, numbers = some_moves(moves)
    weights = jnp.asarray([0.7, -1.2])

    def total(weights):
        def function(*move):
            return product(weights, *move)

        found = map_moves(function, TASKS, jnp.asarray(acting), (jnp.asarray(vectors), jnp.asarray(numbers)))
        return jnp.sum(found**2), found

    (_, found), slope = jax.jit(jax.value_and_grad(total, has_aux=True))(weights)
    expected = np.sin(np.asarray(weights) * vectors).sum(axis=-1) * numbers + 0.7 * GOALS
    expected = np.where(acting, expected, 0.0)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    by_weight = np.cos(np.asarray(weights) * vectors) * vectors * numbers[..., None]
    by_weight[..., 0] += GOALS
    by_hand = np.sum(2 * expected[..., None] * by_weight, axis=(0, 1, 2))
    np.testing.assert_allclose(slope, by_hand, rtol=1e-4)


@pytest.mark.parametrize("moves", [4, 60])
def test_sum_gradients_adds_up_groups_of_moves_with_an_action(moves):
    acting, vectors, numbers = some_moves(moves)
    groups = np.random.default_rng(2).integers(0, 5, acting.shape)
    weights = jnp.asarray([0.7, -1.2])
    arrays = jnp.asarray(vectors), jnp.asarray(numbers)
    found = sum_gradients(product, weights, TASKS, jnp.asarray(acting), arrays, jnp.asarray(groups), 6)
    by_weight = np.cos(np.asarray(weights) * vectors) * vectors * numbers[..., None]
    by_weight[..., 0] += GOALS
    expected = [by_weight[acting & (groups == group)].sum(axis=0) for group in range(6)]
    np.testing.assert_allclose(found, expected, atol=1e-4)
