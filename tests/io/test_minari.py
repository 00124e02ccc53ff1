"""Demonstrations as Minari datasets: they come back, and others can read them."""

import gc
import re
import sys
import warnings
from dataclasses import replace

import equinox as eqx
import gymnasium
import jax.numpy as jnp
import minari
import numpy as np
import pytest
from gymnasium.spaces import Discrete
from hypothesis import given
from hypothesis import strategies as st
from minari.namespace import list_local_namespaces

from helpers.stored import GRID, SPACES, buffer, fresh, store, towards
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
from sidestep.tabular.tasks import Task, reach, with_outcome_reward
from sidestep.tabular.tasks import task as task_of_states

pytestmark = pytest.mark.usefixtures("datasets")

DISCOUNT = 0.97


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


# Walks on a frozen lake


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


# Refused


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
