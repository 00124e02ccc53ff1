"""Plans on worlds small enough to plan by hand, and rollouts of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import ImproperTask, InputError, NotConverged
from sidestep.tabular.backups import Behavior, HardMax, LogSumExp
from sidestep.tabular.behavior_model import behavior_model
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, TabularModel, true_model
from sidestep.tabular.planning import plan
from sidestep.tabular.roll_outs import roll_out
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.tasks import reach, task

OPEN = Grid(np.zeros((3, 3), dtype=int))
BEND = Grid(np.array([[0, 0, 0], [1, 1, 0], [0, 0, 0]]))
DIAGONAL = Grid(np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]]), connectivity=8)
SEPARATED = Grid(np.array([[0, 0, 1, 0]]))
UP, DOWN, LEFT, RIGHT = range(4)


@pytest.mark.parametrize("reward", [{"discount": 0.9}, {"discount": 1.0, "step_cost": 1.0}])
@pytest.mark.parametrize(("world", "start", "goal", "path"), [
    (BEND, 0, 6, [0, 1, 2, 5, 8, 7, 6]),
    (BEND, 6, 0, [6, 7, 8, 5, 2, 1, 0]),
    (OPEN, 3, 5, [3, 4, 5]),
    (OPEN, 4, 4, [4]),
    (DIAGONAL, 0, 5, [0, 1, 2, 5]),  # no corner is cut
    (Grid(np.zeros((3, 3), dtype=int), connectivity=8), 0, 8, [0, 4, 8]),
])  # fmt: skip
def test_path_from_start_equals_the_path_by_hand(world, start, goal, path, reward):
    made = plan(true_model(world), reach(world.forget(), goal, **reward))
    assert made.path_from(start).tolist() == path
    assert bool(made.solution.converged)


def test_plan_optimal_is_uniform_over_ties():
    policy = np.asarray(plan(true_model(OPEN), reach(OPEN, 0)).policy)
    expected = {8: [UP, LEFT], 4: [UP, LEFT], 5: [UP, LEFT], 1: [LEFT], 2: [LEFT], 6: [UP]}
    for state, actions in expected.items():
        np.testing.assert_allclose(policy[state], np.isin(range(4), actions) / len(actions), atol=1e-12)


@pytest.mark.parametrize(("costs", "expected"), [
    ([(0.1, 0.1), (20_000.0, 20_000.1)], [1.0, 0.0]),
    ([(0.2, 0.1), (20_000.0, 20_000.0)], [0.0, 1.0]),
    ([(0.1, 0.1), (20_000.1, 20_000.1)], [0.5, 0.5]),
    ([(0.1, 1000.3), (20_000.3, 19_000.1)], [0.5, 0.5]),
])  # fmt: skip
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_plan_optimal_tells_actions_apart_by_more_than_the_rounding_of_values(costs, expected, dtype):
    """Two ways to the end, each of two moves: what the first move costs, and what the second costs."""
    ways = graph([[[1], [2]], [[3], [3]], [[3], [3]], [[3], [3]]])
    first, second = -np.array(costs)
    reward = np.array([first, second[[0, 0]], second[[1, 1]], [0, 0]])
    model = TabularModel(ways, jnp.zeros((4, 2, 1), dtype))
    made = plan(model, task(reward, 1.0, np.arange(4) == 3))
    assert made.policy.dtype == dtype
    assert made.policy[0].tolist() == expected


def test_plan_with_a_behavior_follows_the_action_values():
    """A corridor of three cells, each blocked with p = 1/4, at γ = 1/2: V = g² and g for g = γ(1−p)/(1−γp) = 3/7."""
    grid, beta = Grid.unknown(1, 3), 2.0
    made = plan(ObstacleGrid(grid, -float(np.log(3))), reach(grid, 2, discount=0.5), Behavior(HardMax(), beta))
    stay, left, right = 3 / 14, 0.5 * (0.75 * 9 / 49 + 0.25 * 3 / 7), 3 / 7
    odds = np.exp(beta * np.array([stay, stay, left, right]))
    np.testing.assert_allclose(made.policy[1], odds / odds.sum(), rtol=1e-9)
    assert made.path_from(0).tolist() == [0, 1, 2]


def test_plan_on_a_learned_model_goes_around_probable_obstacles():
    """P(blocked) = .9 in the middle column but for the bottom cell: the path through costs more than around it."""
    logits = np.full((3, 3), -3.0)
    logits[:2, 1] = np.log(9)
    made = plan(ObstacleGrid(Grid.unknown(3, 3), logits.reshape(-1)), reach(OPEN, 2, discount=1.0, step_cost=1.0))
    assert made.path_from(0).tolist() == [0, 3, 6, 7, 8, 5, 2]
    logits[:2, 1] = 0.0  # probability ½ costs one move more: the path through is now the shorter
    made = plan(ObstacleGrid(Grid.unknown(3, 3), logits.reshape(-1)), reach(OPEN, 2, discount=1.0, step_cost=1.0))
    assert made.path_from(0).tolist() == [0, 1, 2]


@pytest.mark.slow
def test_plan_intended_is_the_most_probable_outcome_elsewhere():
    world = graph(np.array([[[0, 1, 2]], [[1, 1, 1]], [[2, 2, 2]]]))
    model = TabularModel(world, jnp.log(jnp.array([[[0.6, 0.1, 0.3]], [[1.0, 1.0, 1.0]], [[1.0, 1.0, 1.0]]])))
    made = plan(model, reach(world, 1))
    assert made.intended.tolist() == [2, 1, 2]  # state 2 leads nowhere else
    assert made.path_from(0).tolist() == [0, 2]


def test_path_from_where_the_goal_cannot_be_reached_ends_or_raises():
    path = plan(true_model(SEPARATED), reach(SEPARATED, 3)).path_from(0)
    assert 3 not in path
    assert len(set(path.tolist())) == len(path)
    with pytest.raises(InputError, match="'start': the goal cannot be reached from state 0"):
        plan(true_model(SEPARATED), reach(SEPARATED, 3, discount=1.0, step_cost=1.0)).path_from(0)


@pytest.mark.parametrize("start", [-1, 9])
def test_path_from_a_wrong_state_raises(start):
    with pytest.raises(InputError, match=r"'start': expected a state in 0…8"):
        plan(true_model(OPEN), reach(OPEN, 0)).path_from(start)


def test_plan_without_values_raises():
    with pytest.raises(ImproperTask):
        plan(true_model(OPEN), reach(OPEN, 0, discount=1.0, step_cost=0.1), Behavior(LogSumExp(), 1.0))
    with pytest.raises(NotConverged, match="sweep 1"):
        plan(true_model(OPEN), reach(OPEN, 0), options=SolveOptions(solver=Jacobi(max_sweeps=1)))


@pytest.mark.slow
def test_roll_out_against_an_unknown_wall_fails_until_the_last_move():
    corridor = Grid(np.array([[0, 0, 1, 0]]))
    made = plan(true_model(Grid(np.zeros((1, 4), dtype=int))), reach(corridor, 3))
    rollouts = roll_out(
        jax.random.key(0), true_model(corridor), made.policy, made.terminal, jnp.array([0, 1, 3]), max_moves=6
    )
    assert rollouts.states.tolist() == [[0, 1, 1, 1, 1, 1, 1], [1] * 7, [3] * 7]
    assert rollouts.actions.tolist() == [[RIGHT] * 6, [RIGHT] * 6, [-1] * 6]
    assert rollouts.failed.tolist() == [5, 6, 0]
    assert rollouts.moves.tolist() == [6, 6, 0]
    assert rollouts.arrived.tolist() == [False, False, True]


@pytest.mark.slow
def test_roll_out_at_a_terminal_state_ignores_the_policy():
    always_right = jnp.zeros((9, 4)).at[:, RIGHT].set(1.0)
    rollouts = roll_out(
        jax.random.key(0), true_model(OPEN), always_right, jnp.arange(9) == 1, jnp.array([0, 3]), max_moves=3
    )
    assert rollouts.states.tolist() == [[0, 1, 1, 1], [3, 4, 5, 5]]
    assert rollouts.actions.tolist() == [[RIGHT, -1, -1], [RIGHT] * 3]
    assert rollouts.moves.tolist() == [1, 3]
    assert rollouts.failed.tolist() == [0, 1]
    assert rollouts.arrived.tolist() == [True, False]


AGENTS = 4000
POLICY = np.array([[0.25, 0.75], [0.5, 0.5], [0.5, 0.5]])
CHANCES = np.array([[[0.2, 0.3, 0.5], [0.7, 0.3, 0.0]]])


def stochastic(seed):
    world = graph(np.broadcast_to(np.arange(3), (3, 2, 3)))
    with np.errstate(divide="ignore"):
        logits = np.log(np.broadcast_to(CHANCES, (3, 2, 3)))
    ends = jnp.array([False, True, True])
    starts = jnp.zeros(AGENTS, dtype=int)
    return roll_out(
        jax.random.key(seed), TabularModel(world, jnp.asarray(logits)), jnp.asarray(POLICY), ends, starts, max_moves=1
    )


def test_roll_out_of_many_agents_has_the_probabilities_as_frequencies():
    """Within four standard errors, actions and outcomes alike."""
    rollouts = stochastic(0)
    action, outcome = np.asarray(rollouts.actions)[:, 0], np.asarray(rollouts.states)[:, 1]
    for a in (0, 1):
        for k in (0, 1, 2):
            expected = POLICY[0, a] * CHANCES[0, a, k]
            error = 4 * np.sqrt(expected * (1 - expected) / AGENTS)
            assert abs(np.mean((action == a) & (outcome == k)) - expected) <= error, (a, k)


def test_roll_out_with_equal_keys_is_equal():
    np.testing.assert_array_equal(stochastic(1).states, stochastic(1).states)
    assert (stochastic(1).states != stochastic(2).states).any()


@pytest.mark.parametrize(("learn", "person"), [([], 0), ([], 7), (["lapse"], 7), (["beta"], 7)])
def test_plan_of_a_person_that_does_not_exist_raises(learn, person):
    agents = behavior_model(Behavior(HardMax(), 2.0), learn)
    assert plan(true_model(OPEN), reach(OPEN, 8), agents).path_from(7).tolist() == [7, 8]
    with pytest.raises(InputError, match="field 'person'"):
        plan(true_model(OPEN), reach(OPEN, 8), agents, person=person)


def test_roll_out_of_a_policy_with_an_action_that_is_not_available_raises():
    world = graph([[[1], [1]], [[2], [2]], [[2], [2]]], available=[[True, True], [True, False], [True, False]])
    model, key, ends = TabularModel(world, jnp.zeros((3, 2, 1))), jax.random.key(0), jnp.arange(3) == 2
    half = np.full((3, 2), 0.5)
    with pytest.raises(InputError, match=r"'policy': expected available .*, found action 1 in state 1"):
        roll_out(key, model, jnp.asarray(half), ends, [0], 2)
    half[1] = [1.0, 0.0]  # of the terminal state, the policy has no meaning
    assert roll_out(key, model, jnp.asarray(half), ends, [0], 2).states.tolist() == [[0, 1, 2]]
