"""Walks as Minari datasets: they come back, look like point mazes to others, and datasets of positions are walks."""

import re
import sys
from dataclasses import replace

import minari
import numpy as np
import pyarrow as pa
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from hypothesis import given

from helpers.drawn import assert_same_walks, walk_along, walk_tables
from helpers.stored import buffer, fresh, store
from sidestep.errors import InputError
from sidestep.io.walks import read_walks, walks_from_table, write_walks

pytestmark = pytest.mark.usefixtures("datasets")

PLANE = Box(-np.inf, np.inf, (2,), np.float64)
FORCE = Box(-1, 1, (2,))
MAZE = Dict({"observation": Box(-np.inf, np.inf, (4,)), "achieved_goal": PLANE, "desired_goal": PLANE})
LINE = np.array([[0.5, 0.5], [1.5, 0.5], [1.5, 1.5]])


@pytest.mark.slow
@given(walk_tables())
def test_write_walks_to_minari_is_read_back(table):
    walks, dataset = walks_from_table(table), "minari:" + fresh("ours/walks")
    write_walks(dataset, walks)
    assert_same_walks(read_walks(dataset), walks)


@pytest.mark.parametrize("labels", [["b", "b", "a", "a"], [7, 7, -2, -2], [0.5, 0.5, 0.25, 0.25]])
def test_write_walks_to_minari_keeps_labels_steps_and_metadata(labels):
    columns = {
        "t": [0.0, 0.5, 0.0, 2.0],
        "group": pa.array(["x", "y", "", "x"]).dictionary_encode(),
        "tries": pa.array([3, 1, 2, 0], pa.int8()),
        "seen": [True, False, True, True],
    }
    table = pa.table({"walk": labels, "step": [0, 3, 4, 9], "x": [0, 1, 0, 1], "y": [0, 0, 1, 1], **columns})
    walks, dataset = walks_from_table(table), "minari:" + fresh("ours/walks")
    write_walks(dataset, walks)
    read = read_walks(dataset)
    assert_same_walks(read, walks)
    assert read.steps.tolist() == [0, 3, 4, 9]


def test_write_walks_to_minari_is_a_point_maze():
    walks = walk_along(LINE, LINE[[0, 0, 1]], goals=[(1.5, 1.5), (9.0, 9.0)], failed={(1, 1): (0.5, 1.5)})
    dataset = fresh("ours/maze")
    write_walks(f"minari:{dataset}", walks)
    found = minari.load_dataset(dataset)
    first, second = found
    assert found.observation_space == Dict({"observation": PLANE, "achieved_goal": PLANE, "desired_goal": PLANE})
    assert found.observation_space.contains({name: seen[0] for name, seen in first.observations.items()})
    assert first.observations["achieved_goal"].tolist() == LINE.tolist()
    assert second.observations["desired_goal"].tolist() == [[9.0, 9.0]] * 3
    assert first.actions.tolist() == [[1, 0], [0, 1]]
    assert second.actions.tolist() == [[0, 1], [1, 0]]  # the first move failed
    assert [each.rewards.tolist() for each in found] == [[0, 1], [0, 0]]
    assert [each.terminations.tolist() for each in found] == [[False, True], [False, False]]
    assert [each.truncations.tolist() for each in found] == [[False, False], [False, True]]


def maze(positions=LINE, goals=(3.0, 2.0), **infos):
    """An episode in a point maze as others record it."""
    positions = np.asarray(positions, dtype=float)
    seen = {
        "observation": np.hstack([positions[:, :2], positions[:, :2]]).astype(np.float32),
        "achieved_goal": positions,
        "desired_goal": np.broadcast_to(goals, (len(positions), 2)),
    }
    return buffer(seen, np.zeros((len(positions) - 1, 2), np.float32), infos=infos)


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_read_walks_of_a_point_maze(data_format):
    episodes = maze(success=[False, False, True]), maze(LINE[:2], goals=(0.0, 1.0), success=[True, False])
    walks = read_walks("minari:" + store((MAZE, FORCE), *episodes, data_format=data_format))
    assert [walk.tolist() for walk in walks] == [LINE.tolist(), LINE[:2].tolist()]
    assert walks.goals.tolist() == [[3.0, 2.0], [0.0, 1.0]]
    assert walks.labels == [0, 1]
    assert walks.steps.tolist() == [0, 1, 2, 0, 1]
    assert np.isnan(walks.failed_moves).all()
    assert walks.metadata.to_pydict() == {"success": [False, False, True, True, False]}


def test_read_walks_leaves_out_infos_that_are_not_of_positions():
    """Vectors, other lengths, and what observations tell."""
    infos = {"force": LINE, "short": np.zeros(2), "x": np.ones(3), "more": {"left": np.ones(3)}, "left": np.ones(3)}
    walks = read_walks("minari:" + store((MAZE, FORCE), maze(**infos), maze()))
    assert walks.positions.tolist() == LINE.tolist() * 2
    assert walks.metadata.to_pydict() == {"left": [1.0, 1.0, 1.0, None, None, None]}


def test_read_walks_of_box_observations():
    """The first two numbers of a box are x and y; metadata tell the goal, or else the walk ends there."""
    box = Box(-np.inf, np.inf, (3,), np.float64)
    seen = np.hstack([LINE, np.full((3, 1), 7.0)])
    walk = buffer(seen, np.zeros((2, 2), np.float32))
    walks = read_walks("minari:" + store((box, FORCE), walk, walk, metadata=[{"goal": [4.0, 5.0]}]))
    assert walks.positions.tolist() == LINE.tolist() * 2
    assert walks.goals.tolist() == [[4.0, 5.0], [1.5, 1.5]]


def test_read_walks_by_minari_path(datasets, tmp_path, monkeypatch):
    dataset = store((MAZE, FORCE), maze())
    (datasets / dataset).rename(tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    for path in ("minari:./moved", f"minari:{tmp_path / 'moved'}"):
        assert len(read_walks(path)) == 1


def refused(dataset, message):
    with pytest.raises(InputError, match=f"^{re.escape(dataset)}{message}"):
        read_walks(f"minari:{dataset}")


@pytest.mark.parametrize(
    ("walk", "message"),
    [
        (maze(LINE * [[1], [np.nan], [1]]), "'achieved_goal': expected finite numbers, found .* at step 1"),
        (maze(LINE * [[1], [1], [np.inf]]), "'achieved_goal': expected finite numbers, found .* at step 2"),
        (maze(goals=(np.nan, 1)), r"'desired_goal': expected finite numbers, found \[nan, 1.0\] at step 0"),
        (maze(goals=[[3, 2], [3, 2], [3, 1]]), "'desired_goal': expected one goal, found another at step 2"),
    ],
)
def test_read_walks_of_bad_positions_raises(walk, message):
    refused(store((MAZE, FORCE), maze(), walk), f", episode 1, field {message}")


def test_read_walks_of_other_lengths_raises():
    walk = buffer({"achieved_goal": LINE, "desired_goal": LINE[:2]}, np.zeros((2, 2), np.float32))
    dataset = store((Dict({"achieved_goal": PLANE, "desired_goal": PLANE}), FORCE), walk)
    refused(dataset, ", episode 0, field 'desired_goal': expected 3 observations around 2 moves, found 2")


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (3, r"expected x and y in each of 1 rows, found shape \(1,\)"),
        ([3.0], r"expected x and y in each of 1 rows, found shape \(1, 1\)"),
        ("door", "expected numbers"),
        ([np.nan, 1.0], r"expected finite numbers, found \[nan, 1.0\]"),
    ],
)
def test_read_walks_of_bad_goals_raises(goal, message):
    walk = buffer(LINE, np.zeros((2, 2), np.float32))
    dataset = store((PLANE, FORCE), walk, walk, metadata=[{"goal": [1.0, 1.0]}, {"goal": goal}])
    refused(dataset, f", episode 1, field 'goal': {message}")


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (Discrete(4), r", field 'achieved_goal': expected a Box of at least two numbers x, y, found Discrete\(4\)"),
        (Box(0, 4, (1,)), ", field 'achieved_goal': expected a Box of at least two numbers x, y, found Box"),
        (Box(0, 4, (2, 2)), ", field 'achieved_goal': expected a Box of at least two numbers x, y, found Box"),
        (Dict({"seen": PLANE}), ", field 'observation_space': expected achieved_goal among .*, found Dict"),
        (Dict({"achieved_goal": PLANE, "desired_goal": Discrete(4)}), ", field 'desired_goal': .*found Discrete"),
    ],
)
def test_read_walks_without_positions_raises(space, message):
    seen = [space.sample() for _ in range(3)]
    stacked = {name: np.stack([each[name] for each in seen]) for name in seen[0]} if isinstance(space, Dict) else seen
    refused(store((space, FORCE), buffer(stacked, np.zeros((2, 2), np.float32))), message)


def test_read_walks_with_one_label_twice_raises():
    dataset = store((MAZE, FORCE), maze(), maze(), metadata=[{"walk": "a"}, {"walk": "a"}])
    refused(dataset, r", field 'walk': expected different walks, found \['a'\] more than once")


def test_read_walks_of_mixed_infos_raises():
    dataset = store((MAZE, FORCE), maze(mood=np.arange(3)), maze(mood=["a", "b", "c"]))
    refused(dataset, ", field 'infos': expected infos of the same kind in all episodes")


def test_read_walks_of_an_empty_or_missing_dataset_raises():
    refused(store((MAZE, FORCE)), ": expected at least one episode, found none")
    refused("nowhere/walks-v0", ": there is no such dataset here")


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (pa.array([[1], [2], [3]]), ", field 'extra': expected numbers or text, found list"),
        (pa.array([0, 1, 2], pa.timestamp("s")), ", field 'extra': expected numbers or text, found timestamp"),
        (pa.array([1, None, 3]), ", row 2, field 'extra': a Minari dataset has no empty cells"),
        (pa.array(["a", "b", None]), ", row 3, field 'extra': a Minari dataset has no empty cells"),
    ],
)
def test_write_walks_of_unrepresentable_columns_raises_and_leaves_nothing(datasets, column, message):
    walks = replace(walk_along(LINE), metadata=pa.table({"extra": column}))
    with pytest.raises(InputError, match=f"^lost/walks-v0{message}"):
        write_walks("minari:lost/walks-v0", walks)
    assert not (datasets / "lost").exists()


def test_write_walks_without_walks_raises():
    with pytest.raises(InputError, match=r"^lost/walks-v0: expected at least one walk, found none"):
        write_walks("minari:lost/walks-v0", walk_along(LINE).select(np.array([False])))


def test_write_walks_that_hdf5_refuses_leaves_nothing(datasets):
    walks = replace(walk_along(LINE), metadata=pa.table({"extra": ["a", "b\0", "c"]}))
    with pytest.raises(InputError, match=r"^lost/walks-v0: the dataset cannot be written: ValueError"):
        write_walks("minari:lost/walks-v0", walks)
    assert not list(datasets.glob("lost/*")) + list(datasets.glob("lost/.*"))


def test_walks_without_minari_raise_with_advice(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    message = r"^a-v0: .*Minari is not installed.*pip install 'sidestep\[minari\]'"
    with pytest.raises(InputError, match=message):
        read_walks("minari:a-v0")
    with pytest.raises(InputError, match=message):
        write_walks("minari:a-v0", walk_along(LINE))
