"""Tasks with rewards of outcomes, stacks of tasks, places, and which tasks have values, at the edges of each rule."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import ImproperTask, InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage, LogSumExp
from sidestep.tabular.checks import check_model, check_task
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.graph import Graph, graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import TabularModel
from sidestep.tabular.proper import check_proper
from sidestep.tabular.tasks import reach, stack_tasks, state_at, task, with_outcome_reward

WORLD = graph([[[1, 0], [2, 0]], [[2, 1], [0, 1]], [[2, 2], [2, 2]]])
ENDS = np.array([False, False, True])
OF_STATES = np.random.default_rng(0).normal(size=(3, 2, 3))


def test_task_of_rewards_by_next_state_has_that_of_each_outcome():
    made = task(OF_STATES, 0.9, ENDS, world=WORLD)
    for s in range(3):
        for a in range(2):
            for k, after in enumerate(np.asarray(WORLD.successors)[s, a]):
                assert made.outcome_reward is not None
                assert float(made.outcome_reward[s, a, k]) == OF_STATES[s, a, after]
    assert not made.reward.any()
    assert not made.terminal_reward.any()


@pytest.mark.parametrize(("reward", "world", "message"), [
    (OF_STATES, None, "expected `world`"),
    (OF_STATES[:, :1], WORLD, r"of shape \(3, 2, 3\)"),
    (np.zeros((0, 2)), None, "expected rewards, found shape"),
    (np.zeros((2, 2)), None, "terminal"),
    (np.full((3, 2), np.nan), None, "reward"),
])  # fmt: skip
def test_task_of_other_rewards_raises(reward, world, message):
    with pytest.raises(InputError, match=message):
        task(reward, 0.9, ENDS, world=world)


@pytest.mark.parametrize("discount", [0.0, -0.1, 1.0001, np.nan])
def test_task_of_a_discount_out_of_range_raises(discount):
    with pytest.raises(InputError, match="discount"):
        task(np.zeros(3), discount, ENDS)
    assert float(task(np.zeros(3), 1.0, ENDS).discount) == 1


def test_stack_of_tasks_with_and_without_rewards_of_outcomes_pays_each_its_own():
    plain, paid = task(np.ones((3, 2)), 0.9, ENDS), task(OF_STATES, 0.8, ENDS, world=WORLD)
    stacked = stack_tasks([plain, paid])
    assert stacked.outcome_reward is not None
    assert paid.outcome_reward is not None
    np.testing.assert_array_equal(stacked.outcome_reward[0], np.zeros((3, 2, 2)))
    np.testing.assert_array_equal(stacked.outcome_reward[1], paid.outcome_reward)
    np.testing.assert_array_equal(stacked.reward, [np.ones((3, 2)), np.zeros((3, 2))])
    np.testing.assert_allclose(stacked.discount, [0.9, 0.8])
    assert stack_tasks([plain, plain]).outcome_reward is None


def test_stack_of_no_tasks_of_stacks_and_of_other_worlds_raises():
    one = task(np.ones((3, 2)), 0.9, ENDS)
    for wrong, message in (
        ([], "tasks"),
        ([one, stack_tasks([one])], "found a stack of tasks at 1"),
        ([one, task(np.ones((2, 2)), 0.9, ENDS[1:])], r"found worlds of \[2, 3\] states"),
    ):
        with pytest.raises(InputError, match=message):
            stack_tasks(wrong)


ROOM = Grid(np.array([[0, -1, 1], [0, 0, 0]]), resolution=0.5, origin=(1.0, 2.0, 0.0))


@pytest.mark.parametrize(
    ("place", "state"), [(0, 0), (5, 5), (1, 1), ((1.1, 2.1), 3), ((2.4, 2.4), 5), ((1.1, 2.9), 0)]
)
def test_state_at_a_place_is_its_cell(place, state):
    assert state_at(ROOM, place, "goal") == state


@pytest.mark.parametrize(("world", "place", "message"), [
    (ROOM, 2, "known obstacle"),
    (ROOM, 6, "expected a state in 0…5, found 6"),
    (ROOM, -1, "expected a state in 0…5, found -1"),
    (ROOM, (0.9, 2.1), "on the map"),
    (ROOM, (1.1, 3.1), "on the map"),
    (ROOM, (2.4, 2.9), "known obstacle"),
    (WORLD, 3, "expected a state in 0…2"),
])  # fmt: skip
def test_state_at_other_places_raises(world, place, message):
    with pytest.raises(InputError, match=f"goal.*{message}"):
        state_at(world, place, "goal")


def test_reach_with_a_step_cost_needs_one_above_0_and_without_a_discount_below_1():
    for settings, field in (({"discount": 1.0}, "discount"), ({"step_cost": 0.0}, "step_cost")):
        with pytest.raises(InputError, match=field):
            reach(ROOM, 0, **settings)


def test_visited_state_goals_are_distinct_pairs_of_all_states():
    tasks = [reach(ROOM, goal) for goal in (5, 3)]
    walks = [
        Trajectory(np.array([0, 3, 4, 3, 4]), np.array([1, 3, 2, 3]), 0),
        Trajectory(np.array([4, 3]), np.array([2]), 1),
    ]
    pairs = gather(walks, tasks).visited_state_goals()
    assert pairs.tolist() == [[0, 5], [3, 3], [3, 5], [4, 3], [4, 5]]


# ---------------------------------------------------------------------------------------------------- proper tasks

AGENTS, SOFT = Behavior(BoltzmannAverage(), 2.0), Behavior(LogSumExp(), 2.0)
BONUS = np.log(2) / 2
"""What each of two actions is worth to a log-sum-exp agent with β = 2."""


def costs(cost, discount=1.0, ends=ENDS):
    return task(np.full((3, 2), 0.0 - cost), discount, ends)


@pytest.mark.parametrize(("made", "agents", "horizon"), [
    (costs(1e-9), AGENTS, None),
    (costs(BONUS + 1e-6), SOFT, None),
    (costs(0.0, 0.99), SOFT, None),
    (costs(-1.0, 0.99), AGENTS, None),
    (costs(0.0), AGENTS, 3),
    (costs(1.0, 0.9, np.zeros(3, bool)), AGENTS, None),
])  # fmt: skip
def test_check_proper_of_tasks_with_values_passes(made, agents, horizon):
    check_proper(made, agents, WORLD, horizon)


@pytest.mark.parametrize(("made", "agents", "message"), [
    (costs(0.0), AGENTS, "an action of state 0 is worth 0;"),
    (costs(BONUS - 1e-6), SOFT, "an endless path is worth more"),
    (costs(BONUS), SOFT, "an endless path is worth more"),
    (costs(1.0, 1.0, np.zeros(3, bool)), AGENTS, "needs a terminal state"),
    (task(np.array([[-1.0, -1.0], [-1.0, 2.0], [-1.0, -1.0]]), 1.0, ENDS), AGENTS, "state 1 is worth 2;"),
])  # fmt: skip
def test_check_proper_of_tasks_without_values_raises(made, agents, message):
    with pytest.raises(ImproperTask, match=message):
        check_proper(made, agents, WORLD)
    # in a stack behind one that has values
    with pytest.raises(ImproperTask, match=message):
        check_proper(stack_tasks([costs(1.0, 0.9), made]), agents, WORLD)


def test_check_proper_lets_actions_that_surely_end_the_task_pay():
    """The second action of state 0 and the first of state 1 lead to state 2 only in this world."""
    sure = graph([[[1, 0], [2, 2]], [[2, 2], [0, 1]], [[2, 2], [2, 2]]])
    pays = np.array([[-1.0, 5.0], [5.0, -1.0], [7.0, 7.0]])
    check_proper(task(pays, 1.0, ENDS), AGENTS, sure)
    with pytest.raises(ImproperTask, match="is worth 5"):
        check_proper(task(pays, 1.0, ENDS), AGENTS, WORLD)
    by_outcome = np.full((3, 2, 2), -1.0)
    by_outcome[0, 1, 0] = by_outcome[1, 0, 0] = 9.0  # those that lead to the end
    check_proper(with_outcome_reward(costs(0.0), jnp.asarray(by_outcome)), AGENTS, WORLD)
    by_outcome[1, 0, 1] = 0.0
    with pytest.raises(ImproperTask, match="an action of state 1 is worth 0;"):
        check_proper(with_outcome_reward(costs(0.0), jnp.asarray(by_outcome)), AGENTS, WORLD)


def test_check_proper_counts_available_actions_only():
    """One action has no bonus; what cannot be taken gains nothing."""
    single = graph(np.asarray(WORLD.successors), available=[[True, False], [True, False], [True, True]])
    gains = np.array([[-0.1, 9.0], [-0.1, 9.0], [0.0, 0.0]])
    check_proper(task(gains, 1.0, ENDS), SOFT, single)
    with pytest.raises(ImproperTask):
        check_proper(task(gains, 1.0, ENDS), SOFT, WORLD)


@pytest.mark.parametrize(("change", "message"), [
    ({"reward": np.array([[0.0, 0.0], [0.0, np.nan], [0.0, 0.0]])}, "'reward': .*found nan in state 1, action 1"),
    ({"reward": np.array([[np.inf]])}, "'reward': expected finite rewards, found inf$"),
    ({"terminal_reward": np.array([0.0, 0.0, np.nan])}, "'terminal_reward': .*found nan in state 2"),
    ({"outcome_reward": np.array([[[0.0, -np.inf]]])}, "'outcome_reward': .*found -inf in outcome 1"),
])  # fmt: skip
def test_task_made_by_hand_with_rewards_that_are_not_finite_raises_where_it_is_used(change, message):
    made = replace(costs(1.0, 0.9), **{name: jnp.asarray(numbers) for name, numbers in change.items()})
    with pytest.raises(InputError, match=rf"^task, field {message}"):
        check_task(made, WORLD)
    with pytest.raises(InputError, match=r"^tasks, field"):
        check_task(stack_tasks([costs(1.0, 0.9), made]), WORLD, "tasks")


def test_task_made_by_hand_may_have_any_terminal_reward_where_it_goes_on():
    made = replace(costs(1.0, 0.9), terminal_reward=jnp.asarray(np.where(ENDS, 1.0, np.nan)))
    check_task(made, WORLD)


def test_graph_made_by_hand_without_an_action_where_the_task_goes_on_raises():
    arrays = WORLD.successors, WORLD.lengths
    check_task(costs(1.0, 0.9), Graph(*arrays, jnp.asarray(np.array([[True, False], [True, True], [False, False]]))))
    stuck = Graph(*arrays, jnp.asarray(np.array([[True, False], [False, False], [False, False]])))
    with pytest.raises(InputError, match=r"'available': expected an available action .*, found none in state 1"):
        check_task(costs(1.0, 0.9), stuck)
    with pytest.raises(InputError, match="found none in state 1"):
        check_task(stack_tasks([costs(1.0, 0.9)] * 2), stuck)


@pytest.mark.parametrize("field", ["available", "lengths"])
def test_graph_made_by_hand_with_a_table_of_another_shape_raises(field):
    world = eqx.tree_at(lambda each: getattr(each, field), WORLD, jnp.ones((2, 2), getattr(WORLD, field).dtype))
    with pytest.raises(InputError, match=rf"'graph': expected a table `{field}` of shape .*, found"):
        check_model(TabularModel(world, jnp.zeros(WORLD.successors.shape)))
