"""Demonstrations from trajectories, and from walks in metres."""

import numpy as np
import pyarrow as pa
import pytest

from sidestep.errors import InputError
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.walks import walks_from_table
from sidestep.tabular.demonstrations import Trajectory, gather, next_power_of_two, pad_to_power_of_two
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.tasks import reach

LINE = Grid.unknown(1, 4)
TASKS = [reach(LINE, 3), reach(LINE, 0, discount=0.5)]


def trajectory(states, actions, task=0) -> Trajectory:
    return Trajectory(np.array(states, dtype=np.int64), np.array(actions, dtype=np.int64), task)


def test_moves_lie_one_after_another():
    found = gather([trajectory([1, 2, 2, 3], [3, 3, 3]), trajectory([1, 0], [2], task=1)], TASKS)
    assert len(found) == 4
    assert found.states.tolist() == [1, 2, 2, 1]
    assert found.actions.tolist() == [3, 3, 3, 2]
    assert found.next_states.tolist() == [2, 2, 3, 0]
    assert found.task.tolist() == [0, 0, 0, 1]
    assert found.trajectory.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(found.tasks.discount, [0.95, 0.5])


GOOD = trajectory([1, 2], [3])


@pytest.mark.parametrize(("bad", "message"), [
    (trajectory([1], []), "moves and one state more, found 0 and 1"),
    (trajectory([1, 2], [3, 3]), "found 2 and 2"),
    (trajectory([1, 2], [3], task=2), "task in 0…1, found 2"),
    (trajectory([1, 2], [3], task=-1), "task in 0…1, found -1"),
    (trajectory([1, 4], [3]), "states in 0…3"),
    (trajectory([-1, 0], [3]), "states in 0…3"),
    (trajectory([1, 2], [-1]), ""),
    (trajectory([2, 3, 2], [3, 2]), "after a terminal state"),
])  # fmt: skip
def test_gather_names_the_trajectory_that_it_refuses(bad, message):
    with pytest.raises(InputError, match=rf"trajectory, row 2: .*{message}"):
        gather([GOOD, bad], TASKS)


def test_gather_wants_trajectories():
    with pytest.raises(InputError, match="at least one trajectory"):
        gather([], TASKS)
    with pytest.raises(InputError, match="at least one task"):
        gather([GOOD], [])


def walks(*lines, goals=None):
    """Walks along lists of columns of `LINE`, at the centres of cells."""
    xs = [x + 0.5 for line in lines for x in line]
    table = {
        "walk": [walk for walk, line in enumerate(lines) for _ in line],
        "step": [step for line in lines for step in range(len(line))],
        "x": xs,
        "y": [0.5] * len(xs),
    }
    if goals:
        table["goal_x"] = [goals[walk] + 0.5 for walk in table["walk"]]
        table["goal_y"] = [0.5] * len(xs)
    return walks_from_table(pa.table(table))


def test_one_task_for_every_goal():
    found = demonstrations_from_walks(walks([0, 1, 2, 3], [3, 2, 1], [1, 2, 3]), LINE, discount=0.9)
    assert found.states.tolist() == [0, 1, 2, 3, 2, 1, 2]
    assert found.next_states.tolist() == [1, 2, 3, 2, 1, 2, 3]
    assert found.actions.tolist() == [3, 3, 3, 2, 2, 3, 3]
    assert found.trajectory.tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert [int(np.argmax(terminal)) for terminal in found.tasks.terminal] == [1, 3]
    assert found.task.tolist() == [1, 1, 1, 0, 0, 1, 1]
    np.testing.assert_allclose(found.tasks.discount, 0.9)


def test_what_follows_the_goal_is_left_out():
    """The first walk passes its goal and goes on, the second starts there."""
    found = demonstrations_from_walks(walks([0, 1, 2, 3, 2], [1, 2], [3, 2], goals=[2, 1, 0]), LINE)
    assert found.states.tolist() == [0, 1, 3]
    assert found.next_states.tolist() == [1, 2, 2]
    assert found.trajectory.tolist() == [0, 0, 1]
    assert [int(np.argmax(terminal)) for terminal in found.tasks.terminal] == [0, 2]
    assert found.task.tolist() == [1, 1, 0]


def test_the_form_of_the_task_is_that_of_reach():
    found = demonstrations_from_walks(walks([0, 1]), LINE, discount=1.0, step_cost=2.0)
    np.testing.assert_allclose(found.tasks.reward, np.full((1, 1, 4), -2.0))
    assert found.tasks.discount.tolist() == [1.0]


def test_refusals():
    with pytest.raises(InputError, match="starts at its goal"):
        demonstrations_from_walks(walks([1, 2], goals=[1]), LINE)
    with pytest.raises(InputError, match="discount"):
        demonstrations_from_walks(walks([1, 2]), LINE, discount=0.0)
    wall = Grid(np.array([[Cell.FREE, Cell.FREE, Cell.OCCUPIED, Cell.FREE]]))
    with pytest.raises(InputError, match=r"row 2.*occupied"):
        demonstrations_from_walks(walks([0, 3]), wall)


def test_moves_count_once_or_by_their_weight():
    found = gather([trajectory([0, 1, 2], [3, 3]), trajectory([1, 2], [3])], TASKS)
    assert found.weights.tolist() == [1, 1, 1]
    assert found.with_only(np.array([False, True])).weights.tolist() == [0, 0, 1]


def test_pad_to_power_of_two_adds_moves_that_count_nothing_and_tasks_that_end_at_once():
    found = gather([trajectory([1, 2, 2, 3], [3, 3, 3]), trajectory([2, 1, 0], [2, 2], task=1)], [*TASKS, TASKS[1]])
    padded = pad_to_power_of_two(found)
    assert (len(found), len(padded), len(padded.tasks.terminal)) == (5, 64, 8)
    assert padded.states.tolist() == [*found.states.tolist(), *[1] * 59]
    assert padded.weights.tolist() == [1] * 5 + [0] * 59
    np.testing.assert_allclose(padded.tasks.discount, [0.95, 0.5, 0.5, *[0.95] * 5])
    assert padded.tasks.terminal[3:].all()


@pytest.mark.parametrize(("count", "expected"), [(1, 1), (2, 2), (3, 4), (16, 16), (17, 32)])
def test_rounded_up(count, expected):
    assert next_power_of_two(count) == expected
