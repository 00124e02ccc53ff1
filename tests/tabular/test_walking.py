"""Roll-outs and simulated walks of corridors, where each move is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import TabularModel, true_model
from sidestep.tabular.planning import plan
from sidestep.tabular.roll_outs import RollOuts, roll_out
from sidestep.tabular.simulation import simulate
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.tasks import reach, task

ROW = Grid(np.zeros((1, 6), dtype=int))
WORLD, GOAL = true_model(ROW), reach(ROW, 5)
RIGHT = 3
SURE = Behavior(BoltzmannAverage(), 1e4)
TURNING = TabularModel(graph([[[1]], [[2]], [[0]]]), jnp.zeros((3, 1, 1)))
"""A ring of three states with one action."""
ENDLESS = task(np.zeros(3), 0.9, np.zeros(3, bool))


def test_roll_outs_count_moves_until_arrival_and_those_that_stayed():
    states = jnp.array([[0, 0, 1, 1, 2], [2, 1, 2, 2, 2], [0, 1, 0, 1, 0]])
    actions = jnp.array([[0, 1, 0, 1], [1, 0, -1, -1], [1, 0, 1, 0]])
    rolled = RollOuts(states, actions, jnp.array([True, True, False]))
    assert rolled.moves.tolist() == [4, 2, 4]
    assert rolled.failed.tolist() == [2, 0, 0]


def test_roll_out_of_a_policy_for_each_move_follows_it():
    policy = np.zeros((4, 6, 4))
    for move, action in enumerate((RIGHT, RIGHT, 2, RIGHT)):
        policy[move, :, action] = 1
    rolled = roll_out(jax.random.key(0), WORLD, jnp.asarray(policy), GOAL.terminal, [0, 2, 4], 4)
    assert rolled.states.tolist() == [[0, 1, 2, 1, 2], [2, 3, 4, 3, 4], [4, 5, 5, 5, 5]]
    assert rolled.actions.tolist() == [[RIGHT, RIGHT, 2, RIGHT]] * 2 + [[RIGHT, -1, -1, -1]]
    assert rolled.arrived.tolist() == [False, False, True]


def ones(*shape):
    return jnp.full((*shape, 4), 0.25)


@pytest.mark.parametrize(("policy", "terminal", "starts", "moves", "field"), [
    (ones(6), GOAL.terminal, [6], 2, "starts"),
    (ones(6), GOAL.terminal, [-1], 2, "starts"),
    (ones(6), GOAL.terminal, [0], 0, "max_moves"),
    (ones(5), GOAL.terminal[1:], [0], 2, "policy, terminal"),
    (ones(3, 6), GOAL.terminal, [0], 2, "policy"),
    (ones(6).at[3, 1].set(0.26), GOAL.terminal, [0], 2, "state 3, field 'policy'"),
    (ones(6).at[2, :2].set(jnp.array([-0.25, 0.75])), GOAL.terminal, [0], 2, "state 2, field 'policy'"),
])  # fmt: skip
def test_roll_out_of_wrong_arguments_raises(policy, terminal, starts, moves, field):
    with pytest.raises(InputError, match=field):
        roll_out(jax.random.key(0), WORLD, policy, terminal, starts, moves)


@pytest.mark.parametrize("moves", [1, 127, 128, 129, 260])
def test_simulate_of_an_endless_task_makes_as_many_moves_as_are_allowed(moves):
    walks = simulate(jax.random.key(0), TURNING, [ENDLESS], [[0, 1, 2]], max_moves=moves)
    for start, walk in enumerate(walks):
        assert walk.states.tolist() == [(start + move) % 3 for move in range(moves + 1)]
        assert walk.actions.tolist() == [0] * moves
        assert walk.truncated


def test_simulate_without_a_limit_stops_after_a_thousand_moves():
    with pytest.raises(InputError, match=r"task 0: an agent from state 1 had not arrived after 1000 moves"):
        simulate(jax.random.key(0), TURNING, [ENDLESS], [[1]])


def test_simulate_returns_walks_of_each_task_in_order():
    tasks = [GOAL, reach(ROW, 0), reach(ROW, 3)]
    walks = simulate(jax.random.key(0), WORLD, tasks, [[3, 5], [], [0]], SURE)
    assert [walk.task for walk in walks] == [0, 0, 2]
    assert [walk.states.tolist() for walk in walks] == [[3, 4, 5], [5], [0, 1, 2, 3]]
    assert [walk.actions.tolist() for walk in walks] == [[RIGHT] * 2, [], [RIGHT] * 3]
    assert not any(walk.truncated for walk in walks)


def test_simulate_of_persons_has_the_beta_of_each():
    """One person hardly prefers any action, the other one always takes the best."""
    agents = behavior_model(SURE, ["beta"], person=[0, 1])
    agents = agents.with_parameters(agents.parameters._replace(log_beta=jnp.array([-9.0, 9.0])))
    walks = simulate(jax.random.key(0), WORLD, [GOAL, GOAL], [[3] * 40, [3] * 40], agents, max_moves=2)
    arrived = np.array([[not walk.truncated for walk in walks if walk.task == person] for person in (0, 1)])
    assert arrived[1].all()
    assert arrived[0].mean() < 0.4  # two moves to the right have probability 1/16


def test_simulate_with_a_deadline_stops_there():
    options = SolveOptions(horizon=3, deadline=True)
    walks = simulate(jax.random.key(0), WORLD, [GOAL], [[0, 3, 4]], SURE, options=options)
    assert [len(walk.actions) for walk in walks] == [3, 2, 1]
    assert [walk.truncated for walk in walks] == [True, False, False]
    assert len(simulate(jax.random.key(0), WORLD, [GOAL], [[0]], SURE, 2, options=options)[0].actions) == 2
    assert simulate(jax.random.key(0), WORLD, [GOAL], [[3]], options=options)[0].states.tolist() == [3, 4, 5]


@pytest.mark.parametrize("agents", [None, Behavior(BoltzmannAverage(), 3.0)])
def test_plan_with_a_deadline_has_the_policies_of_plans_with_the_moves_that_are_left(agents):
    by_time = plan(WORLD, GOAL, agents, options=SolveOptions(horizon=3, deadline=True))
    assert by_time.policy.shape == (3, 6, 4)
    for move in range(3):
        left = plan(WORLD, GOAL, agents, options=SolveOptions(horizon=3 - move))
        np.testing.assert_allclose(by_time.policy[move, :5], left.policy[:5], rtol=1e-9)
        np.testing.assert_array_equal(by_time.intended[move, :5], left.intended[:5])


@pytest.mark.parametrize(("tasks", "starts", "field"), [
    ([GOAL], [[6]], r"starts\[0\]"),
    ([GOAL, GOAL], [[0], [-1]], r"starts\[1\]"),
    ([GOAL, GOAL], [[0]], "starts"),
])  # fmt: skip
def test_simulate_of_wrong_starts_raises(tasks, starts, field):
    with pytest.raises(InputError, match=field):
        simulate(jax.random.key(0), WORLD, tasks, starts)
