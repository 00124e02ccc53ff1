"""Tasks in continuous worlds: rewards, ends, features, and refusals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.small_worlds import table_tasks
from sidestep.continuous.tasks import check_tasks


def vector(*numbers):
    return jnp.asarray(numbers, float)


def pendulum_task(goal, discount=0.9):
    return sc.PendulumTask(goal=jnp.asarray(goal, float), discount=jnp.asarray(discount))


COST = jnp.asarray([[2.0, 0.5], [0.5, 1.0]])
QUADRATIC = sc.QuadraticTask(vector(1, -1), COST, jnp.asarray([[0.3]]), jnp.asarray(0.9))
TABLES = [
    ss.task(np.array([[-1.0, -2.0], [-3.0, -4.0], [0.0, 0.0]]), 0.9, np.array([False, False, True])),
    ss.task(np.array([5.0, 0.0, 0.0]), 0.8, np.array([True, False, False])),
]


# Reaching a goal


@pytest.mark.parametrize(("step_cost", "pays", "costs"), [(None, 1, 0), (2.0, 0, 2)])
def test_reach_region_pays_at_the_goal_or_costs_a_step(step_cost, pays, costs):
    goal = sc.reach_region((1.0, 2.0), 0.5, discount=0.95, step_cost=step_cost)
    assert float(goal.reward(vector(0, 0), vector(1, 1))) == -costs
    assert float(goal.terminal_reward(vector(1, 2))) == pays
    assert float(goal.discount) == 0.95


def test_reach_region_ends_within_its_radius():
    """The border counts; components beyond the goal's do not."""
    goal = sc.reach_region((1.0, 2.0), 0.5)
    places = jnp.asarray([[1.0, 2.0, 9.0], [1.5, 2.0, 0.0], [1.4, 2.4, 0.0], [0.0, 2.0, 0.0]])
    assert jax.vmap(goal.terminal)(places).tolist() == [True, True, False, False]


def test_reach_region_features_are_state_goal_and_difference():
    np.testing.assert_array_equal(sc.reach_region((1.0, 2.0), 0.5).features(vector(3, 5, 7)), [3, 5, 7, 1, 2, -2, -3])


# Quadratic costs


def test_quadratic_task_reward_and_features():
    state, action = np.array([2.0, 1.0]), np.array([3.0])
    expected = -(2 * 1**2 + 2 * 0.5 * 1 * 2 + 1 * 2**2) - 0.3 * 3**2
    assert float(QUADRATIC.reward(jnp.asarray(state), jnp.asarray(action))) == pytest.approx(expected)
    assert float(QUADRATIC.reward(vector(1, -1), vector(0))) == 0
    np.testing.assert_array_equal(QUADRATIC.features(vector(2, 1)), [1, 2])


@pytest.mark.parametrize("endless", [QUADRATIC, pendulum_task(0.0)])
def test_endless_task_never_ends_and_is_smooth(endless):
    assert not bool(endless.terminal(vector(1, -1)))
    assert float(endless.terminal_reward(vector(1, -1))) == 0
    assert endless.smooth
    assert not sc.ReachTask.smooth


# Holding a pendulum


def test_pendulum_task_reward_wraps_the_angle():
    at = pendulum_task(np.pi - 0.1)
    for angle in (np.pi + 0.1, -np.pi + 0.1, 5 * np.pi + 0.1):
        assert float(at.reward(vector(angle, 0), vector(0))) == pytest.approx(-(0.2**2))
    assert float(at.reward(vector(np.pi - 0.1, 3), vector(2))) == pytest.approx(-0.1 * 9 - 0.001 * 4)


def test_pendulum_task_features_are_periodic():
    at = pendulum_task(0.5)
    features = at.features(vector(1.5, -2))
    np.testing.assert_allclose(features, [np.cos(1), np.sin(1), -2, np.cos(0.5), np.sin(0.5)])
    np.testing.assert_allclose(at.features(vector(1.5 + 2 * np.pi, -2)), features, atol=1e-12)


# Tables


def test_table_tasks_agree_with_their_tables():
    tables = table_tasks(ss.stack_tasks(TABLES), 3, 2)
    for index, table in enumerate(TABLES):
        one = sc.task_at(tables, index)
        for state in range(3):
            rewards = [float(one.reward(jnp.asarray(state), jnp.asarray(action))) for action in range(2)]
            np.testing.assert_array_equal(rewards, np.broadcast_to(table.reward, (3, 2))[state])
            assert float(one.terminal_reward(jnp.asarray(state))) == np.broadcast_to(table.terminal_reward, 3)[state]
            assert bool(one.terminal(jnp.asarray(state))) == bool(table.terminal[state])
            features = np.zeros(6)
            features[3 * index + state] = 1
            np.testing.assert_array_equal(one.features(jnp.asarray(state)), features)
        assert float(one.discount) == float(table.discount)


# Several tasks


def test_batch_tasks_task_at_returns_each():
    goals = [sc.reach_region((float(x), 0.0), 0.5 + x, step_cost=1.0) for x in range(3)]
    batch = sc.batch_tasks(goals)
    assert batch.goal.shape == (3, 2)
    for index, goal in enumerate(goals):
        assert all(map(np.array_equal, jax.tree.leaves(sc.task_at(batch, index)), jax.tree.leaves(goal)))
    np.testing.assert_array_equal(sc.task_at(batch, jnp.asarray([2, 0])).radius, [2.5, 0.5])
    traced = jax.jit(lambda goal: sc.batch_tasks([eqx.tree_at(lambda task: task.goal, goals[0], goal)] * 2).goal)
    np.testing.assert_array_equal(traced(jnp.ones(2)), np.ones((2, 2)))


@pytest.mark.parametrize(
    "tasks", [[], [pendulum_task(0.0), QUADRATIC], [sc.reach_region((1.0,), 1.0), sc.reach_region((1.0, 2.0), 1.0)]]
)
def test_batch_tasks_of_different_kinds_are_refused(tasks):
    with pytest.raises(
        ss.InputError, match=r"field 'tasks': expected (at least 1, found 0|tasks of one kind and shape)"
    ):
        sc.batch_tasks(tasks)


# Refusals


@pytest.mark.parametrize(("settings", "match"), [
    ({"radius": 0.0}, "'radius': expected a finite number above 0, found 0"),
    ({"step_cost": -1.0}, "'step_cost': expected a finite number above 0, found -1"),
    ({"goal": (0.0, np.nan)}, "'goal': expected finite numbers"),
    ({"discount": 0.0}, "'discount': expected a finite number above 0 and at most 1, found 0"),
    ({"discount": 1.1}, "'discount': expected a finite number above 0 and at most 1, found 1.1"),
    ({"discount": 1.0}, "'discount': a goal that pays 1 needs a discount below 1"),
])  # fmt: skip
def test_reach_region_settings_out_of_range_are_refused(settings, match):
    with pytest.raises(ss.InputError, match=match):
        sc.reach_region(**{"goal": (0.0, 0.0), "radius": 1.0, **settings})


@pytest.mark.parametrize(("goal", "discount", "match"), [
    (np.nan, 0.9, "'tasks': expected finite numbers"),
    (0.0, 1.5, "'discount': expected a finite number above 0 and at most 1, found 1.5"),
])  # fmt: skip
def test_check_tasks_refuses_bad_numbers(goal, discount, match):
    tasks = sc.batch_tasks([pendulum_task(0.0)] * 2)
    numbers = vector(0.0, goal), vector(0.9, discount)
    with pytest.raises(ss.InputError, match=match):
        check_tasks(eqx.tree_at(lambda each: (each.goal, each.discount), tasks, numbers))
    check_tasks(sc.batch_tasks([pendulum_task(0.0), pendulum_task(1.0, 1.0)]))


def test_tasks_of_lists_and_numbers_are_those_of_arrays():
    made = sc.QuadraticTask([1, -1], [[2, 0], [0, 1]], [[0.5]], 0.9)
    expected = sc.QuadraticTask(vector(1, -1), jnp.diag(vector(2, 1)), jnp.asarray([[0.5]]), jnp.asarray(0.9))
    assert eqx.tree_equal(made, expected)


def test_tasks_made_under_jit_and_vmap_are_checked_by_shape():
    def reward(goal, discount):
        task = sc.QuadraticTask(goal, jnp.eye(2), jnp.eye(1), discount)
        return task.reward(jnp.zeros(2), jnp.ones(1))

    goals = jnp.asarray([[1.0, 2.0], [0.0, 3.0]])
    # costs of a goal g seen from 0, and of an action of 1
    assert jax.jit(jax.vmap(reward))(goals, jnp.full(2, 0.9)).tolist() == [-6.0, -10.0]
    with pytest.raises(ss.InputError, match=r"'state_cost': expected numbers of shape \(1, 1\), found shape \(2, 2\)"):
        jax.eval_shape(reward, jnp.zeros(1), jnp.asarray(0.9))
