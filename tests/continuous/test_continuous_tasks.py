"""Tasks in continuous worlds: what they pay, where they end, what a policy sees of them, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.continuous.tasks import Hold, QuadraticTask, Reach, check_tasks, reach, stack, table_tasks, task_at
from sidestep.errors import InputError
from sidestep.tabular.tasks import stack_tasks, task


def vector(*numbers):
    return jnp.asarray(numbers, float)


def hold(goal, discount=0.9):
    return Hold(goal=jnp.asarray(goal, float), discount=jnp.asarray(discount))


REGULATE = QuadraticTask(vector(1, -1), jnp.asarray([[2.0, 0.5], [0.5, 1.0]]), jnp.asarray([[0.3]]), jnp.asarray(0.9))
TABLES = [
    task(np.array([[-1.0, -2.0], [-3.0, -4.0], [0.0, 0.0]]), 0.9, np.array([False, False, True])),
    task(np.array([5.0, 0.0, 0.0]), 0.8, np.array([True, False, False])),
]


# Reaching a goal


@pytest.mark.parametrize(("step_cost", "pays", "costs"), [(None, 1, 0), (2.0, 0, 2)])
def test_either_the_goal_pays_or_steps_cost(step_cost, pays, costs):
    goal = reach((1.0, 2.0), 0.5, discount=0.95, step_cost=step_cost)
    assert float(goal.reward(vector(0, 0), vector(1, 1))) == -costs
    assert float(goal.terminal_reward(vector(1, 2))) == pays
    assert float(goal.discount) == 0.95


def test_a_goal_is_reached_within_its_radius():
    """The border counts, and speeds (all components beyond the goal's) do not."""
    goal = reach((1.0, 2.0), 0.5)
    places = jnp.asarray([[1.0, 2.0, 9.0], [1.5, 2.0, 0.0], [1.4, 2.4, 0.0], [0.0, 2.0, 0.0]])
    assert jax.vmap(goal.terminal)(places).tolist() == [True, True, False, False]


def test_of_a_goal_one_sees_the_way():
    np.testing.assert_array_equal(reach((1.0, 2.0), 0.5).features(vector(3, 5, 7)), [3, 5, 7, 1, 2, -2, -3])


# Staying near one


def test_away_from_the_goal_costs_are_quadratic():
    state, action = np.array([2.0, 1.0]), np.array([3.0])
    expected = -(2 * 1**2 + 2 * 0.5 * 1 * 2 + 1 * 2**2) - 0.3 * 3**2
    assert float(REGULATE.reward(jnp.asarray(state), jnp.asarray(action))) == pytest.approx(expected)
    assert float(REGULATE.reward(vector(1, -1), vector(0))) == 0
    np.testing.assert_array_equal(REGULATE.features(vector(2, 1)), [1, 2])


@pytest.mark.parametrize("endless", [REGULATE, hold(0.0)])
def test_some_tasks_never_end(endless):
    assert not bool(endless.terminal(vector(1, -1)))
    assert float(endless.terminal_reward(vector(1, -1))) == 0
    assert endless.smooth
    assert not Reach.smooth


# Holding a pendulum


def test_a_pendulum_pays_for_its_angle_either_way_round():
    at = hold(np.pi - 0.1)
    for angle in (np.pi + 0.1, -np.pi + 0.1, 5 * np.pi + 0.1):
        assert float(at.reward(vector(angle, 0), vector(0))) == pytest.approx(-(0.2**2))
    assert float(at.reward(vector(np.pi - 0.1, 3), vector(2))) == pytest.approx(-0.1 * 9 - 0.001 * 4)


def test_features_of_a_pendulum_do_not_tell_turns_apart():
    at = hold(0.5)
    seen = at.features(vector(1.5, -2))
    np.testing.assert_allclose(seen, [np.cos(1), np.sin(1), -2, np.cos(0.5), np.sin(0.5)])
    np.testing.assert_allclose(at.features(vector(1.5 + 2 * np.pi, -2)), seen, atol=1e-12)


# Tables


def test_tables_say_the_same_as_functions():
    tables = table_tasks(stack_tasks(TABLES), 3, 2)
    for index, table in enumerate(TABLES):
        one = task_at(tables, index)
        for state in range(3):
            found = [float(one.reward(jnp.asarray(state), jnp.asarray(action))) for action in range(2)]
            np.testing.assert_array_equal(found, np.broadcast_to(table.reward, (3, 2))[state])
            assert float(one.terminal_reward(jnp.asarray(state))) == np.broadcast_to(table.terminal_reward, 3)[state]
            assert bool(one.terminal(jnp.asarray(state))) == bool(table.terminal[state])
            features = np.zeros(6)
            features[3 * index + state] = 1
            np.testing.assert_array_equal(one.features(jnp.asarray(state)), features)
        assert float(one.discount) == float(table.discount)


# Several tasks


def test_stacked_tasks_can_be_had_one_by_one():
    goals = [reach((float(x), 0.0), 0.5 + x, step_cost=1.0) for x in range(3)]
    stacked = stack(goals)
    assert stacked.goal.shape == (3, 2)
    for index, goal in enumerate(goals):
        assert all(map(np.array_equal, jax.tree.leaves(task_at(stacked, index)), jax.tree.leaves(goal)))
    np.testing.assert_array_equal(task_at(stacked, jnp.asarray([2, 0])).radius, [2.5, 0.5])


@pytest.mark.parametrize("tasks", [[], [hold(0.0), REGULATE], [reach((1.0,), 1.0), reach((1.0, 2.0), 1.0)]])
def test_only_tasks_of_a_kind_can_be_stacked(tasks):
    with pytest.raises(InputError, match="field 'tasks': expected at least one task, all of a kind"):
        stack(tasks)


# Refusals


@pytest.mark.parametrize(("settings", "match"), [
    ({"radius": 0.0}, "'radius': expected a finite number above 0, found 0"),
    ({"radius": np.nan}, "'radius': expected a finite number above 0, found nan"),
    ({"step_cost": -1.0}, "'step_cost': expected a finite number above 0, found -1"),
    ({"step_cost": np.inf}, "'step_cost': expected a finite number above 0, found inf"),
    ({"goal": (0.0, np.nan)}, "'goal': expected finite numbers"),
    ({"discount": 0.0}, "'discount': expected a number above 0 and at most 1, found 0"),
    ({"discount": 1.1}, "'discount': expected a number above 0 and at most 1, found 1.1"),
    ({"discount": np.nan}, "'discount': expected a number above 0 and at most 1, found nan"),
    ({"discount": 1.0}, "'discount': a goal that pays 1 needs a discount below 1"),
])  # fmt: skip
def test_goals_refuse(settings, match):
    with pytest.raises(InputError, match=match):
        reach(**{"goal": (0.0, 0.0), "radius": 1.0, **settings})


def test_without_a_discount_steps_must_cost():
    assert float(reach((0.0,), 1.0, discount=1.0, step_cost=1.0).discount) == 1


@pytest.mark.parametrize(("goal", "discount", "match"), [
    (np.nan, 0.9, "'tasks': expected finite numbers"),
    (0.0, 0.0, "'discount': expected a number above 0"),
    (0.0, 1.5, "'discount': expected a number above 0 and at most 1, found 1.5"),
])  # fmt: skip
def test_any_task_is_checked_before_it_is_used(goal, discount, match):
    with pytest.raises(InputError, match=match):
        check_tasks(stack([hold(0.0), hold(goal, discount)]))
    check_tasks(stack([hold(0.0), hold(1.0, 1.0)]))
