"""Demonstrations from tables of several libraries, back to tables, sliced and joined."""

from decimal import Decimal
from typing import Any

import jax
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sidestep as ss
from sidestep.errors import InputError

LINE = ss.Grid.unknown(1, 4)
TASKS = [ss.reach(LINE, 3), ss.reach(LINE, 0, discount=0.5)]
WALKS = [([1, 2, 2, 3], [3, 3, 3], 0), ([1, 0], [2], 1), ([2, 3], [3], 0)]


def demonstrations() -> ss.Demonstrations:
    return ss.gather([ss.Trajectory(np.array(path), np.array(taken), task) for path, taken, task in WALKS], TASKS)


def assert_same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert left.dtype == right.dtype
        np.testing.assert_array_equal(left, right)


def rows_of_states() -> dict[str, list]:
    """A row for each state, without an action where a walk ends."""
    return {
        "walk": [name for name, (path, _, _) in zip("cab", WALKS, strict=True) for _ in path],
        "state": [state for path, _, _ in WALKS for state in path],
        "action": [action for _, taken, _ in WALKS for action in [*taken, None]],
        "task": [task for path, _, task in WALKS for _ in path],
    }


class Capsule:
    """A table of which only Arrow's interface is known."""

    def __init__(self, table):
        self.table = table

    def __arrow_c_stream__(self, requested_schema=None):
        return self.table.__arrow_c_stream__(requested_schema)


@pytest.mark.parametrize(
    "library",
    [dict, pd.DataFrame, pa.table, lambda columns: Capsule(pa.table(columns))],
    ids=["dict", "pd", "pa", "any"],
)
def test_from_table_of_a_row_for_each_state_is_what_gather_makes(library):
    table = library(rows_of_states())
    assert_same(ss.Demonstrations.from_table(table, TASKS, task="task"), demonstrations())


def test_from_table_with_steps_takes_rows_in_any_order():
    columns = rows_of_states()
    columns["time"] = columns["seen"] = list(range(len(columns["walk"])))
    shuffled = np.random.default_rng(0).permutation(len(columns["walk"]))
    frame = pd.DataFrame(columns).iloc[shuffled]
    read = ss.Demonstrations.from_table(frame, TASKS, task="task", step="time", weight="seen")
    paths = {tuple(path) for path in map(np.ndarray.tolist, read.paths())}
    assert paths == {tuple(path) for path, _, _ in WALKS}
    by_walk = dict(zip(pd.unique(frame["walk"]), map(np.ndarray.tolist, read.paths()), strict=True))
    assert by_walk["c"] == WALKS[0][0]
    begins = {"c": 0.0, "a": 4.0, "b": 6.0}  # the row, and so the weight, of the first move
    assert [float(read.weights[at]) for at in read.first_moves()] == [begins[name] for name in by_walk]


def test_from_table_with_labels_numbers_them():
    labels = ss.Labels(states=("home", "road", "shop", "work"), actions=tuple("nswe"), persons=("ben", "ann"))
    columns = {
        "who": ["ann", "ann", "ben"],
        "from": ["road", "shop", "road"],
        "to": ["shop", "work", "home"],
        "how": pd.Categorical(["e", "e", "w"]),
        "goal": [0, 0, 1],
        "n": [1.0, 0.5, 2.0],
    }
    table = pd.DataFrame(columns)
    names = {"state": "from", "next_state": "to", "action": "how", "walk": "who", "subject": "who", "task": "goal"}
    read = ss.Demonstrations.from_table(table, TASKS, **names, weight="n", labels=labels)
    assert read.states.tolist() == [1, 2, 1]
    assert read.next_states.tolist() == [2, 3, 0]
    assert read.actions.tolist() == [3, 3, 2]
    assert read.persons is not None
    assert read.persons.tolist() == [1, 0]
    assert read.weights.tolist() == [1.0, 0.5, 2.0]
    written = read.to_table(labels)
    assert written["state"].to_pylist() == ["road", "shop", "road"]
    assert written["subject"].to_pylist() == ["ann", "ann", "ben"]


@given(
    st.lists(st.tuples(st.lists(st.integers(0, 2), min_size=1, max_size=4), st.integers(0, 1)), min_size=1), st.data()
)
def test_to_table_and_from_table_are_inverse(walks, data):
    random = np.random.default_rng(data.draw(st.integers(0, 99)))
    path = lambda taken: np.append(random.integers(1, 3, len(taken)), random.integers(0, 4))  # noqa: E731
    shown = ss.gather([ss.Trajectory(path(taken), np.array(taken), task) for taken, task in walks], TASKS)
    person = random.integers(0, 3, shown.trajectories)[np.asarray(shown.trajectory)].astype(np.int32)
    changes = jax.numpy.asarray(person), jax.numpy.asarray(random.uniform(0, 2, len(shown)))
    shown = ss.Demonstrations(
        shown.states,
        shown.actions,
        shown.next_states,
        shown.task,
        shown.trajectory,
        shown.tasks,
        changes[1],
        changes[0],
        jax.numpy.asarray(random.random(shown.trajectories) < 0.5)[shown.trajectory],
    )
    columns: dict[str, Any] = {name: name for name in ("next_state", "step", "task", "subject", "weight", "truncated")}
    assert_same(ss.Demonstrations.from_table(shown.to_table(), shown.tasks, **columns), shown)


def changed(**columns):
    """The rows of `rows_of_states` with the cells of some columns changed, by their index."""
    table = rows_of_states()
    for name, cells in columns.items():
        table.setdefault(name, [None] * len(table["walk"]))
        for row, cell in cells.items():
            table[name][row] = cell
    return table


@pytest.mark.parametrize(("table", "options", "message"), [
    (changed(state={1: 4}), {}, r"table, row 2, field 'state': .*0…3, found 4"),
    (changed(state={1: -1}), {}, r"row 2, field 'state': .*found -1"),
    (changed(state={1: 2.5}), {}, r"row 2, field 'state': expected a whole number, found 2.5"),
    (changed(state={1: None}), {}, r"row 2, field 'state': expected a value, found an empty cell"),
    (changed(action={5: -2}), {}, r"row 6, field 'action': .*0 and above, found -2"),
    (changed(action={1: None}), {}, r"row 2, field 'action': .*only the last row"),
    (changed(action={3: 1}), {}, r"row 4, field 'action': the last row of a walk needs a next state"),
    (changed(action={4: None}), {}, r"row 5, field 'action': .*only the last row"),
    (changed(walk={5: "d"}), {}, r"row 6, field 'action': expected at least one move in a walk"),
    (changed(walk={5: None}), {}, r"row 6, field 'walk': expected a value"),
    (changed(task={1: 1}), {}, r"row 2, field 'task': expected the same value in all rows of a walk"),
    (changed(task={1: 2}), {}, r"row 2, field 'task': .*0…1, found 2"),
    (changed(state={1: 3}), {}, r"row 2, field 'state': the walk goes on after a terminal state"),
    (changed(to={0: 3}), {"next_state": "to"}, r"row 1, field 'to': expected the state of the walk's next row"),
    (changed(to={3: 3}), {"next_state": "to"}, r"row 4, field 'to|action': a row with a next state needs an action"),
    (changed(time=dict.fromkeys(range(8), 0)), {"step": "time"}, r"row 2, field 'time': .*same step"),
    (changed(time={0: "x"}), {"step": "time"}, r"field 'time': expected numbers or times, found string"),
    (changed(who={0: 1}), {"subject": "who"}, r"row 2, field 'who': expected a value"),
    (changed(w=dict.fromkeys(range(8), -1.0)), {"weight": "w"}, r"row 1, field 'w': .*at least 0"),
    (changed(w={0: 1.0}), {"weight": "w"}, r"row 2, field 'w': .*at least 0"),
    (changed(cut=dict.fromkeys(range(8), 0)), {"truncated": "cut"}, r"field 'cut': expected booleans, found int64"),
    (changed(cut={0: True}), {"truncated": "cut"}, r"row 2, field 'cut': expected a value, found an empty cell"),
    (
        changed(cut=dict.fromkeys(range(8), True) | {5: False}),
        {"truncated": "cut"},
        r"row 6, field 'cut': expected the same value in all rows of a walk",
    ),
    (rows_of_states(), {"state": "place"}, r"field 'place': the table has 0 such columns: expected one of walk"),
    (rows_of_states(), {"state": "walk"}, r"field 'walk': expected whole numbers \(or labels.*found string"),
    (rows_of_states(), {"labels": ss.Labels(states=(0, 1, 2))}, r"row 4, field 'state': .*labels 0, 1, 2, found 3"),
    (rows_of_states(), {"labels": ss.Labels(actions=(3, 3))}, r"labels, field 'action': .* appear once"),
    (
        changed(state={1: 6}),
        {"labels": ss.Labels(states=range(7))},
        r"row 2, field 'state': expected a label of one of 0…3, found 6, label 6",
    ),
    (
        changed(to={3: 9}, action={3: 3}),
        {"next_state": "to", "labels": ss.Labels(states=(*range(4), 9))},
        r"row 4, field 'to': expected a label of one of 0…3, found 9, label 4",
    ),
    (
        changed(task={1: 2}),
        {"labels": ss.Labels(tasks=range(3))},
        r"row 2, field 'task': expected a label of one of 0…1, found 2, label 2",
    ),
    (
        changed(state={row: [0] for row in range(8)}),
        {"labels": ss.Labels(states=range(4))},
        r"field 'state': expected texts or whole numbers, found list",
    ),
    ({name: [] for name in rows_of_states()}, {}, "table: expected at least one row"),
    (3, {}, "table: expected a table of pandas"),
])  # fmt: skip
def test_from_table_of_what_is_wrong_names_row_and_column(table, options, message):
    with pytest.raises(InputError, match=message):
        ss.Demonstrations.from_table(table, TASKS, **{"task": "task", **options})


def test_from_table_with_several_tasks_and_no_column_raises():
    with pytest.raises(InputError, match="several tasks"):
        ss.Demonstrations.from_table(rows_of_states(), TASKS)


def test_from_table_of_a_final_state_only_raises():
    with pytest.raises(InputError, match="row 1, field 'action': expected at least one move"):
        ss.Demonstrations.from_table({"walk": [0], "state": [1], "action": [None]}, TASKS[0])


def test_to_table_with_too_few_labels_raises():
    with pytest.raises(InputError, match="field 'action': expected 4 labels, found 1"):
        demonstrations().to_table(ss.Labels(actions=("n",)))


@pytest.mark.parametrize(("chosen", "walks"), [
    (slice(1, None), [1, 2]),
    (slice(None, None, -1), [2, 1, 0]),
    (np.array([True, False, True]), [0, 2]),
    ([2, 0, 2], [2, 0, 2]),
    (-1, [2]),
])  # fmt: skip
def test_slice_of_demonstrations_has_the_chosen_walks(chosen, walks):
    some = demonstrations()[chosen]
    assert [path.tolist() for path in some.paths()] == [WALKS[walk][0] for walk in walks]
    assert some.task.tolist() == [WALKS[walk][2] for walk in walks for _ in WALKS[walk][1]]
    assert some.trajectories == len(walks)
    assert len(some.tasks.terminal) == len(TASKS)


@pytest.mark.parametrize("chosen", [[], 3, [-4], [True], 1.0, [[0]], "all"], ids=str)
def test_slice_of_trajectories_that_do_not_exist_raises(chosen):
    with pytest.raises(InputError, match="field 'chosen'"):
        demonstrations()[chosen]


def test_demonstrations_are_not_iterable():
    with pytest.raises(TypeError, match="not iterable"):
        iter(demonstrations())  # pyright: ignore[reportArgumentType, reportCallIssue]


def test_join_of_slices_is_the_whole():
    whole = demonstrations()
    assert_same(ss.join([whole[:1], whole[1:2], whole[2:]]), whole)


def test_truncated_walks_stay_truncated_when_they_are_gathered_chosen_and_joined():
    cut = ss.Trajectory(np.array([1, 2, 1]), np.array([3, 2]), 0, truncated=True)
    whole = ss.Trajectory(np.array([2, 3]), np.array([3]), 0)
    shown = ss.gather([cut, whole], TASKS)
    assert shown.truncated.tolist() == [True, True, False]
    assert shown[[1, 0]].truncated.tolist() == [False, True, True]
    assert ss.join([shown[1:], shown]).truncated.tolist() == [False, True, True, False]
    assert ss.split_by_person(shown, [0, 1])[0].truncated.tolist() == [True, True, False]
    with pytest.raises(InputError, match=r"trajectory, row 1, field 'truncated': expected .*bool"):
        ss.gather([whole._replace(truncated="no")], TASKS)  # pyright: ignore[reportArgumentType]


def test_join_gives_equal_tasks_one_number_and_others_another():
    second = ss.gather([ss.Trajectory(np.array([2, 1]), np.array([2]), 0)], [TASKS[1]])
    third = ss.gather([ss.Trajectory(np.array([2, 1]), np.array([2]), 0)], [ss.reach(LINE, 0, discount=0.25)])
    joined = ss.join([demonstrations(), second, third])
    assert joined.task.tolist() == [0, 0, 0, 1, 0, 1, 2]
    assert joined.trajectory.tolist() == [0, 0, 0, 1, 2, 3, 4]
    np.testing.assert_array_equal(joined.tasks.discount, [0.95, 0.5, 0.25])


def test_join_of_different_worlds_raises():
    other = ss.gather([ss.Trajectory(np.array([0, 1]), np.array([3]), 0)], [ss.reach(ss.Grid.unknown(1, 2), 1)])
    with pytest.raises(InputError, match=r"number of states in all parts, found \[4, 2\]"):
        ss.join([demonstrations(), other])
    with pytest.raises(InputError, match="at least 1, found 0"):
        ss.join([])


def test_join_with_persons_in_some_parts_raises():
    table = {"walk": [0], "state": [1], "next_state": [2], "action": [3], "subject": [4]}
    known = ss.Demonstrations.from_table(table, TASKS[0], next_state="next_state", subject="subject")
    with pytest.raises(InputError, match="persons in all parts or in none"):
        ss.join([demonstrations(), known])
    both = ss.join([known, known])
    assert both.persons is not None
    assert both.persons.tolist() == [4, 4]


def test_from_table_with_a_step_left_out_raises_unless_the_next_state_is_known():
    task = ss.reach(ss.Grid.unknown(1, 4), 3)
    table = {"walk": [0, 0, 0], "state": [2, 0, 3], "action": [3, 3, None], "time": [2, 0, 3], "after": [3, 2, None]}
    with pytest.raises(InputError, match=r"row 2, field 'time': expected the next step .*, found a gap"):
        ss.Demonstrations.from_table(table, task, step="time")
    known = ss.Demonstrations.from_table(table, task, step="time", next_state="after")
    assert known.next_states.tolist() == [2, 3]
    in_seconds = table | {"time": [2.5, 0.0, 3.0]}
    assert ss.Demonstrations.from_table(in_seconds, task, step="time").next_states.tolist() == [2, 3]


@pytest.mark.parametrize("kind", [int, float, np.float32, np.uint8, Decimal], ids=lambda kind: kind.__name__)
def test_from_table_with_whole_steps_of_any_type_and_a_gap_raises(kind):
    task = ss.reach(ss.Grid.unknown(1, 4), 3)
    table = {"walk": [0, 0, 0], "state": [1, 2, 3], "action": [3, 3, None]}
    with pytest.raises(InputError, match=r"row 2, field 'time': expected the next step .*, found a gap"):
        ss.Demonstrations.from_table(table | {"time": [kind(each) for each in (0, 1, 3)]}, task, step="time")
    table["time"] = [kind(each) for each in (0, 1, 2)]
    assert ss.Demonstrations.from_table(table, task, step="time").next_states.tolist() == [2, 3]


@pytest.mark.parametrize(
    "times", [[0.0, 1.5, 3.0], pd.to_datetime(["2020-01-01", "2020-01-02", "2020-01-05"])], ids=["seconds", "dates"]
)
def test_from_table_with_times_takes_gaps(times):
    task = ss.reach(ss.Grid.unknown(1, 4), 3)
    table = {"walk": [0, 0, 0], "state": [1, 2, 3], "action": [3, 3, None], "time": times}
    assert ss.Demonstrations.from_table(table, task, step="time").next_states.tolist() == [2, 3]


def test_from_table_of_walks_with_steps_that_begin_anywhere_takes_them():
    task = ss.reach(ss.Grid.unknown(1, 4), 3)
    table = {"walk": [0, 1, 0, 1], "state": [2, 1, 3, 2], "action": [3, 3, None, None], "step": [7, 2, 8, 3]}
    assert ss.Demonstrations.from_table(table, task, step="step").next_states.tolist() == [3, 2]


def trials_of_two_persons() -> dict[str, list]:
    """Two trials of each person, numbered 1 and 2 anew, and the persons' rows mixed."""
    return {
        "trial": [1, 1, 1, 1, 2, 2, 2, 2, 1, 1],
        "who": ["b", "a", "b", "a", "b", "b", "a", "a", "b", "a"],
        "state": [0, 1, 1, 2, 2, 3, 2, 3, 2, 3],
        "action": [3, 3, 3, 3, 3, None, 3, None, None, None],
    }


def test_from_table_with_walks_of_several_columns_tells_them_apart():
    labels = ss.Labels(persons=("a", "b"))
    options = {"subject": "who", "labels": labels}
    read = ss.Demonstrations.from_table(trials_of_two_persons(), TASKS[0], walk=["who", "trial"], **options)
    assert [path.tolist() for path in read.paths()] == [[0, 1, 2], [1, 2, 3], [2, 3], [2, 3]]
    assert read.persons is not None
    assert read.persons.tolist() == [1, 0, 1, 0]
    turned = ss.Demonstrations.from_table(trials_of_two_persons(), TASKS[0], walk=("trial", "who"), **options)
    assert_same(read, turned)


@pytest.mark.parametrize("step", [None, "time"])
def test_from_table_with_a_walk_of_several_persons_names_the_columns(step):
    """Before anything else that is wrong with such walks."""
    table = trials_of_two_persons()
    table["time"] = [0, 0, 1, 1, 0, 1, 0, 1, 2, 2]
    labels = ss.Labels(persons=("a", "b"))
    message = r"row 2, field 'who': the walk has rows of several persons: expected walk=\['who', 'trial'\]"
    with pytest.raises(InputError, match=message):
        ss.Demonstrations.from_table(table, TASKS[0], walk="trial", step=step, subject="who", labels=labels)
    with pytest.raises(InputError, match=r"give `walk` several columns"):
        ss.Demonstrations.from_table(table, TASKS[0], walk="trial", step=step)
    with pytest.raises(InputError, match=r"expected walk=\['who'\]"):
        ss.Demonstrations.from_table(table, TASKS[0], walk=None, subject="who", labels=labels)


@pytest.mark.parametrize(("walk", "message"), [
    (["who", "trail"], "field 'trail': the table has 0 such columns"),
    ([], "field 'walk': expected at least 1, found 0"),
])  # fmt: skip
def test_from_table_with_wrong_columns_of_walks_raises(walk, message):
    with pytest.raises(InputError, match=message):
        ss.Demonstrations.from_table(trials_of_two_persons(), TASKS[0], walk=walk)


def test_from_table_with_an_empty_cell_in_a_column_of_walks_raises():
    table = trials_of_two_persons()
    table["who"][3] = None
    with pytest.raises(InputError, match="row 4, field 'trial, who': expected a value, found an empty cell"):
        ss.Demonstrations.from_table(table, TASKS[0], walk=["trial", "who"])
