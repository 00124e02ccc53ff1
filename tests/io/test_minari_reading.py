"""Datasets that others wrote with Minari: they are read, or refused with episode and field."""

import json
import os
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Text, Tuple

from helpers.stored import GRID, SPACES, buffer, fresh, refused, store, towards
from sidestep.errors import InputError
from sidestep.io.minari.demonstrations import read_demonstrations, write_demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import reach, stack_tasks

pytestmark = pytest.mark.usefixtures("datasets")

WALK = buffer(np.array([0, 1, 2]), np.array([3, 3]))


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_read_demonstrations_makes_tasks_of_goals_and_discounts(data_format):
    told = [{"goal": 2, "discount": 0.9}, {"goal": 5, "discount": 0.9}, {"goal": 2, "discount": 0.9}]
    dataset = store(SPACES, WALK, WALK, WALK, metadata=told, data_format=data_format)
    found = read_demonstrations(dataset, GRID, step_cost=1.0)
    assert found.task.tolist() == [0, 0, 1, 1, 0, 0]
    assert found.states.tolist() == [0, 1] * 3
    assert found.actions.tolist() == [3, 3] * 3
    expected = stack_tasks([reach(GRID, goal, discount=0.9, step_cost=1.0) for goal in (2, 5)])
    assert eqx.tree_equal(found.tasks, expected)


def test_read_demonstrations_uses_arguments_for_missing_metadata():
    dataset = store(SPACES, WALK, WALK, metadata=[{"goal": 2}, {"goal": 2, "discount": 0.5}])
    found = read_demonstrations(dataset, GRID, discount=0.9)
    np.testing.assert_allclose(found.tasks.discount, [0.9, 0.5])
    bare = store(SPACES, WALK)
    own = reach(GRID, 5)
    assert eqx.tree_equal(read_demonstrations(bare, GRID, task=own).tasks, stack_tasks([own]))


def test_read_demonstrations_by_path(datasets, tmp_path, monkeypatch):
    dataset = store(SPACES, WALK, metadata=[{"goal": 2, "discount": 0.9}])
    os.rename(datasets / dataset, tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path / "moved", Path("moved") / "data", "./moved", str(tmp_path / "moved")):
        assert len(read_demonstrations(path, GRID)) == 2
    with pytest.raises(InputError, match=r"^moved: there is no such dataset here"):
        read_demonstrations("moved", GRID)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"discount": 0.9}, "field 'goal': neither the episode nor an argument has it"),
        ({"goal": 2}, "field 'discount': neither the episode nor an argument has it"),
        ({"goal": 6, "discount": 0.9}, r"field 'goal': expected a state in 0…5, found 6"),
        ({"goal": -1, "discount": 0.9}, r"field 'goal': expected a state in 0…5, found -1"),
        ({"goal": 2.5, "discount": 0.9}, r"field 'goal': expected a whole number, found 2.5"),
        ({"goal": "door", "discount": 0.9}, "field 'goal': expected a number, found 'door'"),
        ({"goal": [2, 5], "discount": 0.9}, "field 'goal': expected a number, found array"),
        ({"goal": float("nan"), "discount": 0.9}, "field 'goal': expected a whole number, found nan"),
        ({"goal": 2, "discount": 0.0}, "field 'discount': expected a finite number above 0 and at most 1, found 0.0"),
        ({"goal": 2, "discount": 1.5}, "field 'discount': expected a finite number above 0 and at most 1, found 1.5"),
        (
            {"goal": 2, "discount": float("nan")},
            "field 'discount': expected a finite number above 0 and at most 1, found nan",
        ),
        ({"goal": 2, "discount": 1.0}, "field 'discount': a goal that pays 1 needs a discount below 1"),
        (
            {"goal": 1, "discount": 0.9},
            "field 'states': expected a trajectory that ends in the first terminal state, found one",
        ),
    ],
)
def test_read_demonstrations_of_bad_metadata_raises(told, message):
    dataset = store(SPACES, WALK, WALK, metadata=[{"goal": 2, "discount": 0.9}, told])
    refused(dataset, f", episode 1, {message}")


@pytest.mark.parametrize(
    ("walk", "message"),
    [
        (buffer([0, 1], [3, 3]), "field 'observations': expected 3 observations around 2 moves, found 2"),
        (buffer([0, 1, 2], [3, 3], rewards=[0.0]), "field 'observations': expected 2 observations around 1 moves"),
        (buffer([0, 1, 2], [3], rewards=[0.0, 0.0]), r"field 'actions': expected 2 whole numbers, .* \(1,\)"),
        (buffer(np.array([[0], [1], [2]]), [3, 3]), r"field 'observations': expected 3 whole numbers, .* \(3, 1\)"),
        (buffer([0, 1.5, 2], [3, 3]), "field 'observations': expected 3 whole numbers, found float64"),
        (buffer([0, 1, 2], [3, np.nan]), "field 'actions': expected 2 whole numbers, found float64"),
        (buffer([0, 6, 2], [3, 3]), "field 'observations': expected a whole number in 0…5, found 6 at step 1"),
        (buffer([0, 1, -1], [3, 3]), "field 'observations': expected a whole number in 0…5, found -1 at step 2"),
        (buffer([0, 1, 2], [3, 4]), "field 'actions': expected a whole number in 0…3, found 4 at step 1"),
    ],
)
def test_read_demonstrations_of_bad_episodes_raises(walk, message):
    told = {"goal": 2, "discount": 0.9}
    dataset = store(SPACES, WALK, walk, metadata=[told, told])
    refused(dataset, f", episode 1, {message}")


def test_read_demonstrations_of_an_episode_without_moves_raises():
    nothing = buffer([0], [], rewards=np.zeros(0), terminations=np.zeros(0, bool), truncations=np.zeros(0, bool))
    dataset = store(SPACES, WALK, nothing, data_format="arrow")
    refused(dataset, ", episode 1, field 'rewards': expected at least one move, found none", task=reach(GRID, 2))


def test_read_demonstrations_of_an_empty_dataset_raises():
    refused(store(SPACES), ": expected at least one episode, found none")


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        ((Discrete(7), Discrete(4)), r", field 'observation_space': expected Discrete\(6\).*found Discrete\(7\)"),
        ((Discrete(5, start=1), Discrete(4)), r", field 'observation_space': .*found Discrete\(5, start=1\)"),
        ((Box(0, 5, (1,)), Discrete(4)), r", field 'observation_space': .*found Box.*; pass `state_of`"),
        ((Discrete(6), Discrete(8)), r", field 'action_space': expected Discrete\(4\).*found Discrete\(8\)"),
    ],
)
def test_read_demonstrations_of_other_spaces_raises(spaces, message):
    seen = np.zeros((3, 1), np.float32) if isinstance(spaces[0], Box) else [1, 2, 3]
    refused(store(spaces, buffer(seen, [3, 3])), message, task=reach(GRID, 5))


BABY = Dict({"direction": Discrete(4), "image": Box(0, 9, (2, 2, 3), np.uint8), "mission": Text(9)})
"""The observations of published datasets of MiniGrid and BabyAI."""


def test_read_demonstrations_of_shifted_spaces_shifts_states_and_actions():
    dataset = store((Discrete(6, start=5), Discrete(4, start=-2)), buffer([5, 6, 10], [1, -2]))
    demonstrations = read_demonstrations(dataset, GRID, task=reach(GRID, 5))
    assert [path.tolist() for path in demonstrations.paths()] == [[0, 1, 5]]
    assert demonstrations.actions.tolist() == [3, 0]
    outside = store((Discrete(6, start=5), Discrete(4)), buffer([5, 4, 10], [3, 3]))
    message = "expected a whole number in 5…10, found 4 at step 1"
    refused(outside, f", episode 0, field 'observations': {message}", task=reach(GRID, 5))


def test_read_demonstrations_of_dicts_needs_the_state_of_an_observation():
    images = np.arange(3 * 12, dtype=np.uint8).reshape(3, 2, 2, 3) % 9
    seen = {"direction": np.array([1, 2, 3]), "image": images, "mission": ["go", "go", "go"]}
    dataset = store((BABY, Discrete(4)), buffer(seen, [3, 3]))
    advice = "expected Discrete\\(6\\), as the world has, found Dict.*; pass `state_of` for other observations"
    refused(dataset, f", field 'observation_space': {advice}", task=reach(GRID, 5))

    def state_of(observation):
        assert observation["mission"] == "go"
        np.testing.assert_array_equal(observation["image"], images[observation["direction"] - 1])
        return int(observation["direction"]) - 1

    demonstrations = read_demonstrations(dataset, GRID, task=reach(GRID, 5), state_of=state_of)
    assert [path.tolist() for path in demonstrations.paths()] == [[0, 1, 2]]
    for wrong, message in ((lambda _: 6, "in 0…5, found 6 at step 0"), (lambda _: 0.5, "numbers, found float64")):
        refused(dataset, f", episode 0, field 'observations': .*{message}", task=reach(GRID, 5), state_of=wrong)
    refused(dataset, ", episode 0, field 'goal': neither the episode nor an argument has it", state_of=state_of)


def test_read_demonstrations_of_tuples_passes_tuples():
    cards = Tuple((Discrete(3), Discrete(2)))
    dataset = store((cards, Discrete(4)), buffer((np.array([0, 0, 2]), np.array([0, 1, 1])), [3, 3]))
    read = read_demonstrations(dataset, GRID, task=reach(GRID, 5), state_of=lambda seen: int(2 * seen[0] + seen[1]))
    assert [path.tolist() for path in read.paths()] == [[0, 1, 5]]
    short = store((cards, Discrete(4)), buffer((np.array([0, 0, 2]), np.array([0, 1])), [3, 3]))
    message = ", episode 0, field '1': expected 3 observations around 2 moves, found 2"
    refused(short, message, task=reach(GRID, 5), state_of=lambda _: 0)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([1.0, 1.0], r"expected 3 numbers, found float64 of shape \(2,\)"),
        ([1.0, -1.0, 1.0], "expected finite numbers of at least 0"),
        ([1.0, np.nan, 1.0], "expected finite numbers of at least 0"),
    ],
)
def test_read_demonstrations_of_bad_weights_raises(weights, message):
    dataset = store(SPACES, buffer([0, 1, 2], [3, 3], infos={"move_weight": np.array(weights)}))
    refused(dataset, f", episode 0, field 'move_weight': {message}", task=reach(GRID, 2))


@pytest.mark.parametrize(
    ("persons", "message"),
    [
        ([{"walk_person": 0}, {}], "episode 1, field 'walk_person': expected a person in all episodes or in none"),
        ([{"walk_person": 0}, {"walk_person": -1}], "episode 1, field 'walk_person': expected at least 0, found -1"),
        ([{"walk_person": 0.5}, {"walk_person": 1}], "episode 0, field 'walk_person': expected a whole number"),
        (
            [{"walk_person": "ann"}, {"walk_person": 1}],
            "episode 0, field 'walk_person': expected a number, found 'ann'",
        ),
    ],
)
def test_read_demonstrations_of_bad_persons_raises(persons, message):
    dataset = store(SPACES, *[buffer([0, 1, 2], [3, 3])] * 2, metadata=persons)
    refused(dataset, f", {message}", task=reach(GRID, 2))


def test_read_demonstrations_with_a_task_of_another_world_raises():
    with pytest.raises(InputError, match=r"'task': expected one task of 6 states, found \(9,\)"):
        read_demonstrations(store(SPACES, WALK), GRID, task=reach(Grid.unknown(3, 3), 2))


def test_read_demonstrations_of_no_dataset_raises(datasets, tmp_path):
    refused("nowhere/walks-v0", ": there is no such dataset here: expected one that `minari list local` shows")
    refused(tmp_path, ": there is no such dataset here")
    broken = store(SPACES, WALK)
    (datasets / broken / "data" / "main_data.hdf5").write_bytes(b"no HDF5")
    refused(broken, ": the dataset cannot be read: OSError")
    (datasets / broken / "data" / "metadata.json").write_text("{")
    refused(broken, ": the dataset cannot be read: JSONDecodeError")


def set_in_task(**values):
    return lambda metadata: metadata["tasks"][1].update(values)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda metadata: metadata.update(tasks=[]), ", field 'tasks': expected a list of tasks"),
        (lambda metadata: metadata.update(tasks=3), ", field 'tasks': expected a list of tasks"),
        (lambda metadata: metadata["tasks"].pop(), ", episode 1, field 'task': expected a task in 0…0, found 1"),
        (lambda metadata: metadata["tasks"][1].pop("reward"), ", task 1: expected discount, terminal"),
        (set_in_task(discount=1.5), ", task 1, field 'discount': expected a finite number above 0 and at most 1"),
        (set_in_task(discount="high"), ", task 1, field 'discount': expected a number, found 'high'"),
        (set_in_task(discount=0.5), ", episode 1, field 'discount': expected 0.5 as in task 1, found 0.95"),
        (set_in_task(terminal=[4]), r", episode 1, field 'goal': expected \[4\] as in task 1, found 5"),
        (set_in_task(terminal=[6]), ", task 1, field 'terminal': expected a list of states in 0…5"),
        (set_in_task(terminal=[0.5]), ", task 1, field 'terminal': expected a list of states in 0…5"),
        (set_in_task(reward=[[0.0, 1.0]]), r", task 1, field 'reward': .*\(6, 4\), found shape \(1, 2\)"),
        (set_in_task(reward=[[float("nan")]]), ", task 1, field 'reward': expected finite numbers"),
        (set_in_task(reward=[[0], [0, 1]]), ", task 1, field 'reward': expected a table of numbers"),
        (
            set_in_task(outcome_reward=[[[1.0] * 3]]),
            r", task 1, field 'outcome_reward': .*\(6, 4, 2\), found shape \(1, 1, 3\)",
        ),
        (set_in_task(terminal_reward=[[1.0]]), r", task 1, field 'terminal_reward': .*\(6,\), found shape \(1, 1\)"),
    ],
)
def test_read_demonstrations_of_bad_tasks_raises(datasets, edit, message):
    dataset = fresh("ours/spoiled")
    write_demonstrations(dataset, towards(2, 5), GRID)
    path = datasets / dataset / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    edit(metadata)
    path.write_text(json.dumps(metadata))
    refused(dataset, message)
