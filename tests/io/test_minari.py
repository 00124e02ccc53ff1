"""Demonstrations as Minari datasets: they come back, others can read them, and what others wrote is read or refused."""

import gc
import json
import os
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import gymnasium
import jax.numpy as jnp
import minari
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Text, Tuple
from hypothesis import given
from hypothesis import strategies as st
from minari.namespace import list_local_namespaces

from helpers.stored import buffer, fresh, store
from sidestep.errors import InputError
from sidestep.inference.fit import fit
from sidestep.inference.priors import Normal
from sidestep.io.episodes import collect
from sidestep.io.gymnasium import from_gymnasium, slippery
from sidestep.io.minari.demonstrations import read_demonstrations, write_demonstrations
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import Graph, graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.planning import plan
from sidestep.tabular.tasks import Task, reach, stack_tasks, with_outcome_reward
from sidestep.tabular.tasks import task as task_of_states

pytestmark = pytest.mark.usefixtures("datasets")

DISCOUNT = 0.97
SPACES = Discrete(6), Discrete(4)
GRID = Grid.unknown(2, 3)


def complete(states, actions):
    """A graph in which every action may lead anywhere."""
    successors = np.broadcast_to(np.arange(states), (states, actions, states))
    return Graph(jnp.asarray(successors, jnp.int32), jnp.ones((1, 1)))


sizes = st.tuples(st.integers(2, 3), st.integers(1, 2), st.integers(1, 2), st.integers(1, 3), st.integers(0, 2**32))
"""How many states, actions, tasks and walks there are, and the seed of all else."""


def pursuits(states, actions, tasks, walks, seed):
    """A graph, and weighted walks towards tasks on it, of which rewards have full and short axes."""
    random = np.random.default_rng(seed)

    def table(*shape):
        return jnp.asarray(random.normal(size=[random.choice([1, size]) for size in shape]))

    wanted, walked = [], []
    for _ in range(tasks):
        terminal = jnp.asarray(np.arange(states) >= random.integers(1, states + 1))  # at times there is none
        of_outcomes = table(states, actions, states) if random.integers(2) else None
        discount = jnp.asarray(random.uniform(0.1, 1.0))
        wanted.append(Task(table(states, actions), table(states), terminal, discount, of_outcomes))
    for task in random.integers(tasks, size=walks):
        moves = random.integers(1, 5)
        acting = np.flatnonzero(~np.asarray(wanted[task].terminal))
        path = np.append(random.choice(acting, moves), random.integers(states))
        truncated = bool(random.integers(2))
        walked.append(Trajectory(path, random.integers(actions, size=moves), int(task), truncated))
    gathered = gather(walked, wanted)
    if random.integers(2):
        gathered = replace(gathered, weights=jnp.asarray(random.uniform(size=len(gathered))))
    if random.integers(2):
        person = random.integers(3, size=walks)[np.asarray(gathered.trajectory)]
        gathered = replace(gathered, person=jnp.asarray(person, jnp.int32))
    return complete(states, actions), gathered


@pytest.mark.slow
@given(sizes)
def test_write_demonstrations_is_read_back_bit_by_bit(size):
    world, demonstrations = pursuits(*size)
    dataset = fresh("ours/back")
    write_demonstrations(dataset, demonstrations, world)
    assert eqx.tree_equal(read_demonstrations(dataset, world), demonstrations)


@pytest.mark.slow
@given(sizes)
def test_write_demonstrations_returns_are_those_of_the_tasks(size):
    """Σ γ^t r_t of an episode: R of every move, and the final reward one move after the last."""
    world, demonstrations = pursuits(*size)
    dataset, tasks = fresh("ours/paid"), demonstrations.tasks
    write_demonstrations(dataset, demonstrations, world)
    trajectory = np.asarray(demonstrations.trajectory)
    for episode, path in zip(minari.load_dataset(dataset), demonstrations.paths(), strict=True):
        own = np.flatnonzero(trajectory == episode.id)
        task = int(demonstrations.task[own[0]])
        discount, final = float(tasks.discount[task]), tasks.terminal_reward[task]
        reward = np.broadcast_to(tasks.reward[task], (world.states, world.actions))[..., None]
        reward = reward + (0 if tasks.outcome_reward is None else np.asarray(tasks.outcome_reward[task]))
        reward = np.broadcast_to(reward, (world.states, world.actions, world.states))
        expected = 0.0
        for t, (state, action) in enumerate(zip(path, np.asarray(demonstrations.actions)[own], strict=False)):
            expected += discount**t * reward[state, action, path[t + 1]]
        arrived = bool(tasks.terminal[task, path[-1]])
        expected += arrived * discount ** len(own) * final[min(path[-1], len(final) - 1)]
        found = (discount ** np.arange(len(own)) * episode.rewards).sum()
        np.testing.assert_allclose(found, expected, atol=1e-12)
        assert episode.terminations.tolist() == [False] * (len(own) - 1) + [arrived]
        assert episode.truncations.tolist() == [False] * (len(own) - 1) + [not arrived]


def towards(*goals, discount=0.95):
    """One walk from cell 0 along the top of the grid towards each goal, each of a task of its own."""
    walks = [Trajectory(np.array([0, 1, 2]), np.array([3, 3]), index) for index in range(len(goals))]
    return gather(walks, [reach(GRID, goal, discount=discount) for goal in goals])


def test_write_demonstrations_is_readable_by_minari():
    dataset = fresh("ours/seen")
    write_demonstrations(dataset, towards(2, 5), GRID)
    found = minari.load_dataset(dataset)
    assert (found.observation_space, found.action_space) == SPACES
    assert dataset in minari.list_local_datasets()
    assert "ours" in list_local_namespaces()
    assert [episode.observations.tolist() for episode in found] == [[0, 1, 2]] * 2
    assert [episode.actions.tolist() for episode in found] == [[3, 3]] * 2
    told = list(found.storage.get_episode_metadata([0, 1]))
    assert [(each["goal"], each["discount"], each["task"]) for each in told] == [(2, 0.95, 0), (5, 0.95, 1)]


def test_demonstrations_in_a_dataset_keep_which_walks_were_truncated():
    """Neither arrives. Datasets that others write tell only which episodes did not end."""
    walks = [Trajectory(np.array([0, 1, 2]), np.array([3, 3]), 0, truncated) for truncated in (True, False)]
    dataset = fresh("ours/cut")
    write_demonstrations(dataset, gather(walks, [reach(GRID, 5)]), GRID)
    assert read_demonstrations(dataset, GRID).truncated.tolist() == [True, True, False, False]
    flags = {"terminations": np.array([False]), "truncations": np.array([True])}
    theirs = store(SPACES, buffer([0, 1], [3]), buffer([0, 1], [3], **flags))
    assert read_demonstrations(theirs, GRID, task=reach(GRID, 1)).truncated.tolist() == [False, True]


# A frozen lake


def lake_policy(world, behavior):
    return np.asarray(plan(world.model, world.task, behavior).policy)


def test_fit_of_stored_demonstrations_is_the_same():
    env, behavior = gymnasium.make("FrozenLake-v1"), Behavior(BoltzmannAverage(), 30.0)
    world = from_gymnasium(env, DISCOUNT)
    policy = lake_policy(world, behavior)
    walked = collect(env, world, lambda state, random: random.choice(4, p=policy[state]), 50, seed=0)
    demonstrations, dataset = gather(walked, [world.task]), fresh("lake/people")
    write_demonstrations(dataset, demonstrations, world.model.graph)
    again = read_demonstrations(dataset, world.model.graph)
    first, second = (
        fit(slippery(world, -3.0), each, behavior, prior=Normal(0.0, 5.0)) for each in (demonstrations, again)
    )
    assert first.final.objective == second.final.objective
    assert first.converged


def record(env, act, episodes):
    """The id of a dataset that Minari's own collector recorded."""
    dataset = fresh("others/collected")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that nobody tells the author
        warnings.simplefilter("ignore", ResourceWarning)  # that temporary folders are left to the collection of garbage
        collector = minari.DataCollector(env)
        for seed in range(episodes):
            state, _ = collector.reset(seed=seed)
            over = False
            while not over:
                state, _, terminated, truncated, _ = collector.step(act(int(state)))
                over = terminated or truncated
        collector.create_dataset(dataset)
        del collector
        gc.collect()
    return dataset


@pytest.mark.slow
def test_read_demonstrations_of_collected_episodes_keeps_rewards():
    env = gymnasium.make("FrozenLake-v1", max_episode_steps=30)
    world, draw = from_gymnasium(env, DISCOUNT), np.random.default_rng(0)
    policy = lake_policy(world, Behavior(BoltzmannAverage(), 30.0))
    dataset = record(env, lambda state: int(draw.choice(4, p=policy[state])), 20)
    demonstrations = read_demonstrations(dataset, world.model.graph, task=world.task)
    again = fresh("ours/again")
    write_demonstrations(again, demonstrations, world.model.graph)
    ours, recorded = minari.load_dataset(again), minari.load_dataset(dataset)
    assert {float(episode.rewards.sum()) for episode in recorded} == {0.0, 1.0}
    assert any(episode.truncations[-1] for episode in recorded)
    for expected, found in zip(recorded, ours, strict=True):
        for field in ("observations", "actions", "rewards", "terminations"):
            np.testing.assert_allclose(getattr(found, field), getattr(expected, field), atol=1e-12)
    (told,) = ours.storage.get_episode_metadata([0])
    assert told["goal"] == 15  # the present, though holes end the task too


@pytest.mark.slow
def test_read_demonstrations_maps_separate_ends():
    name = max(name for name in gymnasium.registry if name.startswith("Taxi-"))
    env = gymnasium.make(name)
    world = from_gymnasium(env, DISCOUNT)
    best = lake_policy(world, Behavior(BoltzmannAverage(), 30.0)).argmax(axis=1)
    dataset = record(env, lambda state: int(best[state]), 5)
    demonstrations = read_demonstrations(dataset, world.model.graph, task=world.task, ends=world.ends)
    assert {int(path[-1]) for path in demonstrations.paths()} <= set(world.ends.values())
    again = fresh("ours/trips")
    write_demonstrations(again, demonstrations, world.model.graph, ends=world.ends)
    ours, recorded = minari.load_dataset(again), minari.load_dataset(dataset)
    assert ours.observation_space == recorded.observation_space == Discrete(500)
    for expected, found in zip(recorded, ours, strict=True):
        np.testing.assert_array_equal(found.observations, expected.observations)
        np.testing.assert_allclose(found.rewards, expected.rewards, atol=1e-9)
    assert eqx.tree_equal(read_demonstrations(again, world.model.graph, ends=world.ends), demonstrations)
    state = min(world.ends)
    flags = {"terminations": np.array([False]), "truncations": np.array([True])}
    cut = store((Discrete(500), Discrete(6)), buffer([state, state], [0], **flags))
    (path,) = read_demonstrations(cut, world.model.graph, task=world.task, ends=world.ends).paths()
    assert path.tolist() == [state, state]  # time was up there, and nothing ended


# What others wrote

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


def refused(dataset, message, world=GRID, **arguments):
    """Reading a dataset raises an error that begins with the dataset, and then says this."""
    with pytest.raises(InputError, match=f"^{re.escape(str(dataset))}{message}"):
        read_demonstrations(dataset, world, **arguments)


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


def two_persons():
    """Two walks in a table, of persons 1 and 0."""
    table = {"walk": [0, 0, 1, 1], "state": [0, 1, 1, 2], "action": [3, None, 3, None], "who": [1, 1, 0, 0]}
    return Demonstrations.from_table(table, reach(GRID, 2), subject="who")


def test_write_demonstrations_keeps_persons():
    dataset, demonstrations = fresh("ours/persons"), two_persons()
    write_demonstrations(dataset, demonstrations, GRID)
    read = read_demonstrations(dataset, GRID)
    assert read.persons is not None
    assert read.persons.tolist() == [1, 0]
    assert eqx.tree_equal(read, demonstrations)


def test_write_demonstrations_of_a_walk_of_two_persons_raises():
    walk = gather([Trajectory(np.array([0, 1, 2]), np.array([3, 3]), 0)], [reach(GRID, 2)])
    message = "trajectory, row 1: expected moves that .*, of one task and one person"
    with pytest.raises(InputError, match=message):
        write_demonstrations(fresh("ours/persons"), replace(walk, person=jnp.array([0, 1])), GRID)


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


def test_write_demonstrations_of_several_outcomes_has_their_mean():
    """Action 0 leads from state 0 to 1 with reward 2 or 6, or stays with reward 1."""
    world = graph([[[1, 0, 1]], [[1, 1, 1]]])
    task = with_outcome_reward(reach(world, 1, discount=0.5), np.array([[[2.0, 1.0, 6.0]], [[0.0, 0.0, 0.0]]]))
    dataset = fresh("ours/mean")
    write_demonstrations(dataset, gather([Trajectory(np.array([0, 0, 1]), np.array([0, 0]), 0)], [task]), world)
    (episode,) = minari.load_dataset(dataset)
    assert episode.rewards.tolist() == [1.0, 4.0 + 0.5 * 1.0]  # γ times the terminal reward
    other = gather([Trajectory(np.array([0, 0, 1]), np.array([0, 0]), 0)], [task])
    with pytest.raises(InputError, match="trajectory, row 1: expected moves that the world has"):
        write_demonstrations(fresh("ours/mean"), other, graph([[[1, 1, 1]], [[1, 1, 1]]]))


def test_write_demonstrations_has_as_goal_what_pays_most_on_arrival():
    """State 1 pays 1 a move after arrival, γ = ½; arriving in 2 pays .7, and staying in 1, where all has ended, 9."""
    world = graph([[[1], [2]], [[1], [1]], [[2], [2]]])
    rewards = np.array([[[0.0], [0.7]], [[9.0], [9.0]], [[0.0], [0.0]]])
    task = with_outcome_reward(task_of_states(np.array([0.0, 1.0, 0.0]), 0.5, np.array([False, True, True])), rewards)
    dataset = fresh("ours/goal")
    write_demonstrations(dataset, gather([Trajectory(np.array([0, 2]), np.array([1]), 0)], [task]), world)
    (stored,) = minari.load_dataset(dataset).storage.get_episode_metadata([0])
    assert stored["goal"] == 2


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


# Writing


@pytest.mark.parametrize("dataset", ["office", "office/../walks-v0", "/walks-v0", "", "a b-v0", "walks-v", "x//y-v0"])
def test_write_demonstrations_to_a_malformed_id_raises(dataset):
    with pytest.raises(InputError, match=f"^{re.escape(dataset)}: expected an id with a version"):
        write_demonstrations(dataset, towards(2), GRID)


def test_write_demonstrations_keeps_an_existing_dataset():
    dataset = fresh("ours/kept")
    write_demonstrations(dataset, towards(2), GRID)
    with pytest.raises(InputError, match=f"{dataset}: exists already: expected a new name"):
        write_demonstrations(dataset, towards(5), GRID)
    found = read_demonstrations(dataset, GRID)
    assert found.visited_state_goals()[:, 1].tolist() == [2, 2, 2]


def test_write_demonstrations_of_another_world_raises():
    message = "expected demonstrations in a world of 9 states and 4 actions, found 6 states and action 3"
    with pytest.raises(InputError, match=message):
        write_demonstrations(fresh(), towards(2), Grid.unknown(3, 3))
    with pytest.raises(InputError, match="6 states and 2 actions, found 6 states and action 3"):
        write_demonstrations(fresh(), towards(2), complete(6, 2))


def test_write_demonstrations_with_gaps_raises_and_leaves_nothing(datasets):
    walks = towards(2, 5)
    gap = eqx.tree_at(lambda each: each.next_states, walks, jnp.asarray([1, 2, 4, 2]))
    turn = eqx.tree_at(lambda each: each.task, walks, jnp.asarray([0, 0, 0, 1]))
    message = "trajectory, row 2: expected moves that each start where the one before ended, of one task and one person"
    for broken in (gap, turn):
        with pytest.raises(InputError, match=message):
            write_demonstrations(fresh("gaps/gap"), broken, GRID)
    assert not (datasets / "gaps").exists()


def test_demonstrations_without_minari_raise_with_advice(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    for call in (lambda: read_demonstrations("a-v0", GRID), lambda: write_demonstrations("a-v0", towards(2), GRID)):
        with pytest.raises(InputError, match=r"^a-v0: .*Minari is not installed.*pip install 'sidestep\[minari\]'"):
            call()
