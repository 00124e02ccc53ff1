"""Tasks: what they pay, where they end, and what they refuse."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.tabular.graph import graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.tasks import reach, stack_tasks, task

NAN = float("nan")
KNOWN = np.array([[Cell.FREE, Cell.OCCUPIED], [Cell.UNKNOWN, Cell.UNKNOWN]])
WORLD = graph(np.array([[[0], [1]], [[1], [0]]]))
TERMINAL = np.array([False, True])


def test_reach_without_a_step_cost_pays_at_the_goal():
    result = reach(Grid.unknown(2, 3), 4, discount=0.9)
    assert result.terminal.tolist() == [False] * 4 + [True, False]
    assert (np.broadcast_to(result.terminal_reward, 6) == 1).all()
    assert (result.reward == 0).all()
    assert float(result.discount) == 0.9


@pytest.mark.parametrize("connectivity", [4, 8])
def test_reach_with_a_step_cost_charges_by_length(connectivity):
    result = reach(Grid.unknown(2, 3, connectivity), 4, discount=1.0, step_cost=0.5)
    lengths = np.array([1, 1, 1, 1] + [np.sqrt(2)] * 4)[:connectivity]
    np.testing.assert_allclose(np.broadcast_to(result.reward, (6, connectivity))[0], -0.5 * lengths)
    assert (result.terminal_reward == 0).all()


@pytest.mark.slow
def test_reach_of_a_position_or_a_state_ends_there():
    grid = Grid(np.full((2, 3), -1), resolution=2.0, origin=(10.0, 20.0, 0.0))
    assert jnp.flatnonzero(reach(grid, (15.0, 21.0)).terminal).tolist() == [5]  # right column, bottom row
    assert jnp.flatnonzero(reach(WORLD, 1, discount=1.0, step_cost=1.0).terminal).tolist() == [1]


def test_task_of_rewards_by_state_or_action_keeps_them():
    per_state = task(np.array([-1.0, 5.0]), 0.9, TERMINAL)
    assert per_state.reward.tolist() == [[-1], [5]]
    assert per_state.terminal_reward.tolist() == [-1, 5]
    per_action = task(np.array([[-1.0, -2.0], [7.0, 8.0]]), 0.9, TERMINAL)
    assert per_action.reward.tolist() == [[-1, -2], [7, 8]]
    assert np.broadcast_to(per_action.terminal_reward, 2)[1] == 0


def test_stack_tasks_of_different_shapes_broadcasts():
    tasks = [reach(WORLD, 0), task(np.array([[-1.0, -2.0], [7.0, 8.0]]), 0.9, TERMINAL)]
    stacked = stack_tasks(tasks)
    assert stacked.reward.shape == (2, 2, 2)
    assert np.broadcast_to(stacked.terminal_reward, (2, 2)).tolist() == [[1, 1], [0, 0]]
    assert stacked.terminal.tolist() == [[True, False], [False, True]]
    np.testing.assert_allclose(stacked.discount, [0.95, 0.9])


@pytest.mark.parametrize(("make", "message"), [
    (lambda: reach(WORLD, 0, discount=0.0), "discount.*above 0"),
    (lambda: reach(WORLD, 0, discount=1.5), "discount.*at most 1"),
    (lambda: reach(WORLD, 0, discount=NAN), "discount"),
    (lambda: reach(WORLD, 0, discount=1.0), "discount.*below 1.*step cost"),
    (lambda: reach(WORLD, 0, step_cost=0.0), "step_cost.*above 0"),
    (lambda: reach(WORLD, 0, step_cost=NAN), "step_cost"),
    (lambda: reach(WORLD, 2), "goal.*0…1"),
    (lambda: reach(WORLD, -1), "goal.*0…1"),
    (lambda: reach(WORLD, (0.5, 0.5)), "goal.*state, not a position"),
    (lambda: reach(Grid(KNOWN), 1), "goal.*known obstacle"),
    (lambda: reach(Grid(KNOWN), (1.5, 1.5)), "goal.*known obstacle"),
    (lambda: reach(Grid(KNOWN), (2.5, 0.5)), "goal.*on the map, x in"),
    (lambda: reach(Grid(KNOWN), (NAN, 0.5)), "goal.*on the map, x in"),
    (lambda: reach(Grid(KNOWN), 4), "goal.*0…3"),
    (lambda: task(np.array([1.0, NAN]), 0.9, TERMINAL), "reward.*finite"),
    (lambda: task(np.array([1.0, 2.0]), 0.0, TERMINAL), "discount"),
    (lambda: task(np.ones(3), 0.9, TERMINAL), r"terminal.*\(3,\)"),
    (lambda: task(np.ones((2, 2, 2)), 0.9, TERMINAL), "reward.*world"),
    (lambda: task(np.ones(2), 0.9, TERMINAL.astype(int)), "terminal.*booleans"),
    (lambda: stack_tasks([]), "tasks.*at least 1"),
])  # fmt: skip
def test_tasks_of_wrong_arguments_raise(make, message):
    with pytest.raises(Exception, match=message) as caught:
        make()
    assert isinstance(caught.value, InputError) or "Type-check" in str(caught.value)
