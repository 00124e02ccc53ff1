"""Demonstrations from trajectories, and from walks in metres."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.drawn import walk_along
from sidestep.errors import InputError
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.tabular.demonstrations import Trajectory, gather, next_power_of_two, pad_to_power_of_two
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.tasks import reach

LINE = Grid.unknown(1, 4)
TASKS = [reach(LINE, 3), reach(LINE, 0, discount=0.5)]


def trajectory(states, actions, task=0) -> Trajectory:
    return Trajectory(np.array(states, dtype=np.int64), np.array(actions, dtype=np.int64), task)


def test_gather_of_two_trajectories_concatenates_their_moves():
    demos = gather([trajectory([1, 2, 2, 3], [3, 3, 3]), trajectory([1, 0], [2], task=1)], TASKS)
    assert len(demos) == 4
    assert demos.states.tolist() == [1, 2, 2, 1]
    assert demos.actions.tolist() == [3, 3, 3, 2]
    assert demos.next_states.tolist() == [2, 2, 3, 0]
    assert demos.task.tolist() == [0, 0, 0, 1]
    assert demos.trajectory.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(demos.tasks.discount, [0.95, 0.5])


GOOD = trajectory([1, 2], [3])


@pytest.mark.parametrize(("bad", "message"), [
    (trajectory([1], []), "moves and one state more, found 0 and 1"),
    (trajectory([1, 2], [3, 3]), "found 2 and 2"),
    (trajectory([1, 2], [3], task=2), "0…1, found 2"),
    (trajectory([1, 2], [3], task=-1), "0…1, found -1"),
    (trajectory([1, 4], [3]), "states in 0…3"),
    (trajectory([-1, 0], [3]), "states in 0…3"),
    (trajectory([1, 2], [-1]), "actions, at least 0, found -1"),
    (trajectory([2, 3, 2], [3, 2]), "after a terminal state"),
])  # fmt: skip
def test_gather_of_a_wrong_trajectory_raises_and_names_it(bad, message):
    with pytest.raises(InputError, match=rf"trajectory, row 2.*: .*{message}"):
        gather([GOOD, bad], TASKS)


def test_gather_of_nothing_raises():
    with pytest.raises(InputError, match="'trajectories': expected at least 1, found 0"):
        gather([], TASKS)
    with pytest.raises(InputError, match="'tasks': expected at least 1, found 0"):
        gather([GOOD], [])


def walks(*lines, goals=None):
    """Walks along lists of columns of `LINE`, at the centers of cells."""
    centers = [[(x + 0.5, 0.5) for x in line] for line in lines]
    return walk_along(*centers, goals=goals and [(x + 0.5, 0.5) for x in goals])


def test_demonstrations_from_walks_makes_one_task_for_each_goal():
    demos = demonstrations_from_walks(walks([0, 1, 2, 3], [3, 2, 1], [1, 2, 3]), LINE, discount=0.9)
    assert demos.states.tolist() == [0, 1, 2, 3, 2, 1, 2]
    assert demos.next_states.tolist() == [1, 2, 3, 2, 1, 2, 3]
    assert demos.actions.tolist() == [3, 3, 3, 2, 2, 3, 3]
    assert demos.trajectory.tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert [int(np.argmax(terminal)) for terminal in demos.tasks.terminal] == [1, 3]
    assert demos.task.tolist() == [1, 1, 1, 0, 0, 1, 1]
    np.testing.assert_allclose(demos.tasks.discount, 0.9)


def test_demonstrations_from_walks_past_the_goal_leaves_out_what_follows():
    """The first walk passes its goal and goes on, the second starts there."""
    demos = demonstrations_from_walks(walks([0, 1, 2, 3, 2], [1, 2], [3, 2], goals=[2, 1, 0]), LINE)
    assert demos.states.tolist() == [0, 1, 3]
    assert demos.next_states.tolist() == [1, 2, 2]
    assert demos.trajectory.tolist() == [0, 0, 1]
    assert [int(np.argmax(terminal)) for terminal in demos.tasks.terminal] == [0, 2]
    assert demos.task.tolist() == [1, 1, 0]


def test_demonstrations_from_walks_with_a_step_cost_charges_it():
    demos = demonstrations_from_walks(walks([0, 1]), LINE, discount=1.0, step_cost=2.0)
    np.testing.assert_allclose(demos.tasks.reward, np.full((1, 1, 4), -2.0))
    assert demos.tasks.discount.tolist() == [1.0]


def test_demonstrations_from_walks_of_wrong_arguments_raises():
    with pytest.raises(InputError, match="starts at its goal"):
        demonstrations_from_walks(walks([1, 2], goals=[1]), LINE)
    with pytest.raises(InputError, match="discount"):
        demonstrations_from_walks(walks([1, 2]), LINE, discount=0.0)
    wall = Grid(np.array([[Cell.FREE, Cell.FREE, Cell.OCCUPIED, Cell.FREE]]))
    with pytest.raises(InputError, match=r"row 2.*occupied"):
        demonstrations_from_walks(walks([0, 3]), wall)


def test_with_only_one_trajectory_sets_other_weights_to_0():
    demos = gather([trajectory([0, 1, 2], [3, 3]), trajectory([1, 2], [3])], TASKS)
    assert demos.weights.tolist() == [1, 1, 1]
    assert demos.with_only(np.array([False, True])).weights.tolist() == [0, 0, 1]


def test_pad_to_power_of_two_adds_moves_that_count_nothing_and_tasks_that_end_at_once():
    demos = gather([trajectory([1, 2, 2, 3], [3, 3, 3]), trajectory([2, 1, 0], [2, 2], task=1)], [*TASKS, TASKS[1]])
    padded = pad_to_power_of_two(demos)
    assert (len(demos), len(padded), len(padded.tasks.terminal)) == (5, 64, 8)
    assert padded.states.tolist() == [*demos.states.tolist(), *[1] * 59]
    assert padded.weights.tolist() == [1] * 5 + [0] * 59
    np.testing.assert_allclose(padded.tasks.discount, [0.95, 0.5, 0.5, *[0.95] * 5])
    assert padded.tasks.terminal[3:].all()


@pytest.mark.parametrize(("count", "expected"), [(1, 1), (2, 2), (3, 4), (16, 16), (17, 32)])
def test_next_power_of_two_rounds_up(count, expected):
    assert next_power_of_two(count) == expected


def test_with_only_keeps_the_weights_of_chosen_trajectories():
    walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), 0)
    demos = gather([walk, walk], [reach(Grid.unknown(1, 3), 2)])
    demos = dataclasses.replace(demos, weights=jnp.array([3.0, 0.5, 2.0, 2.0]))
    assert demos.with_only([True, False]).weights.tolist() == [3, 0.5, 0, 0]
