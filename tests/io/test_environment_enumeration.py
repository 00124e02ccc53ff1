"""Environments without a table: all their states are found, and they have the values of a table written by hand."""

import copy
import random as python_random
from typing import Any

import equinox as eqx
import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete

from sidestep.errors import InputError
from sidestep.io.enumeration import enumerate_env
from sidestep.io.episodes import collect
from sidestep.io.gymnasium import from_gymnasium
from sidestep.tabular.demonstrations import gather
from sidestep.tabular.planning import plan

TAXI = max(name for name in gymnasium.registry if name.startswith("Taxi-"))
CELLS, KEY, DOOR, LIMIT = 5, 3, 0, 60


class Corridor(gymnasium.Env):
    """A corridor with a key in cell 3 and a door in cell 0: left, right, pick up. Opening the door pays 1 and ends.

    `slips` is the probability that a step fails, `counts` whether the reward falls with the number of steps.
    """

    observation_space = Dict({"cell": Discrete(CELLS), "carries": Box(0, 1, (1,), np.int64)})

    def __init__(self, slips=0.0, counts=False, first_action=0):
        self.slips, self.counts, self.steps, self.cell, self.carries = slips, counts, 0, 1, False
        self.first_action = first_action
        self.action_space = Discrete(3, start=first_action)

    def _seen(self):
        return {"cell": self.cell, "carries": np.array([self.carries], np.int64)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.cell, self.carries = 0, 1, False
        return self._seen(), {}

    def fails(self):
        return self.slips > 0 and self.np_random.uniform() < self.slips

    def step(self, action):
        action = action - self.first_action
        assert action in (0, 1, 2)
        self.steps += 1
        opens = action == 0 and self.cell == DOOR and self.carries
        if action == 2:
            self.carries |= self.cell == KEY
        elif not opens and not self.fails():
            self.cell = min(max(self.cell + 2 * action - 1, 0), CELLS - 1)
        reward = 1.0 - 0.01 * self.steps * self.counts if opens else -0.1
        return self._seen(), reward, bool(opens), self.steps >= LIMIT, {}


class Ladder(gymnasium.Env):
    """From rung 0, up, down to 0, or stay. Going up from rung 19 ends, and pays `pay` of the number of steps."""

    observation_space, action_space = Discrete(21), Discrete(3)

    def __init__(self, pay, top=20):
        self.pay, self.top, self.rung, self.steps = pay, top, 0, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.rung = self.steps = 0
        return self.rung, {}

    def step(self, action):
        assert self.rung < 20, "the episode is over"
        self.steps += 1
        self.rung = (self.rung + 1, 0, self.rung)[action]
        ends = self.rung == self.top
        return self.rung, self.pay(self.steps) if ends else 0.0, ends, False, {}


class Round(Ladder):
    """A ladder of three rungs; an episode ends, and pays 1, by going down to rung 0, where it starts."""

    def step(self, action):
        rung, *_ = super().step(0 if action == 0 and self.rung < 2 else 1)
        return rung, float(rung == 0), rung == 0, False, {}


def corridor_values(discount, slips=0.0):
    """V[carries, cell] by value iteration."""
    values, cells = np.zeros((2, CELLS)), np.arange(CELLS)
    for _ in range(500):
        left, right = values[:, np.maximum(cells - 1, 0)], values[:, np.minimum(cells + 1, CELLS - 1)]
        q = [-0.1 + discount * ((1 - slips) * each + slips * values) for each in (left, right)]
        q[0][1, DOOR] = 1.0
        picks = values.copy()
        picks[0, KEY] = values[1, KEY]
        values = np.maximum(np.maximum(*q), -0.1 + discount * picks)
    return values


def labelled(world, solution):
    """V[carries, cell] by the labels of an enumerated corridor."""
    values = np.full((2, CELLS), np.nan)
    labels: Any = world.labels
    for state, ((_, (carries,)), (_, cell)) in enumerate(labels):
        values[carries, cell] = solution.values[state]
    return values


def test_enumerate_env_of_a_corridor_has_its_values():
    """The time limit of three steps is nothing that the states know of."""
    env = wrappers.TimeLimit(Corridor(), 3)
    world = enumerate_env(env, 0.9)
    assert len(world.labels) == 2 * CELLS
    assert world.labels[0] == (("carries", (0,)), ("cell", 1))
    assert world.samples is None
    assert world.ends == {world.labels.index((("carries", (1,)), ("cell", 0))): 2 * CELLS}
    found = labelled(world, plan(world.model, world.task).solution)
    np.testing.assert_allclose(found, corridor_values(0.9), atol=1e-7)


def test_enumerate_env_with_settings_equals_that_with_copies():
    env, key = Corridor(), lambda env, _: (env.carries, env.cell)
    taken = {"get_state": lambda env: (env.cell, env.carries), "key": key}
    world = enumerate_env(
        env, 0.9, set_state=lambda env, state: vars(env).update(cell=state[0], carries=state[1]), **taken
    )
    assert eqx.tree_equal(world, enumerate_env(Corridor(), 0.9, key=key))
    with pytest.raises(InputError, match=r"'get_state, set_state': expected both of get_state and set_state"):
        enumerate_env(env, **taken)


def test_enumerate_env_leaves_the_environment_as_it_is():
    env = Corridor()
    env.reset(seed=3)
    env.step(1)
    draws = copy.deepcopy(env.np_random)
    enumerate_env(env)
    assert (env.cell, env.steps, env.np_random.uniform()) == (2, 1, draws.uniform())


@pytest.mark.slow
def test_enumerate_env_of_a_random_environment_estimates_probabilities():
    slips, tries = 0.3, 400
    with pytest.raises(InputError, match=r"action 0, field 'samples': the action draws random numbers"):
        enumerate_env(Corridor(slips))
    world = enumerate_env(Corridor(slips), 0.9, samples=tries)
    assert world.samples == tries
    assert len(world.labels) == 2 * CELLS
    probabilities, width = np.asarray(world.model.probabilities()), world.model.graph.successors.shape[-1]
    assert width == 2
    staying = np.asarray(world.model.graph.successors) == np.arange(world.model.graph.states)[:, None, None]
    stays = (probabilities * staying).sum(axis=-1)
    labels: Any = world.labels
    moves = [i for i, (_, cell) in enumerate(labels) if cell[1] not in (0, CELLS - 1)]
    tried = stays[moves][:, :2]
    np.testing.assert_allclose(tried, slips, atol=4.5 * np.sqrt(slips * (1 - slips) / tries))
    assert tried.mean() == pytest.approx(slips, abs=4.5 * np.sqrt(slips * (1 - slips) / tries / tried.size))
    assert (stays[moves][:, 2] == 1).sum() == len(moves) - 1  # picking up the key where it lies changes the state


@pytest.mark.parametrize(
    "generator",
    [python_random.Random(1), np.random.RandomState(1), np.random.default_rng(1)],
    ids=["Python", "RandomState", "Generator"],
)
def test_enumerate_env_sees_generators_that_the_environment_holds(generator):
    class Own(Corridor):
        def __init__(self):
            super().__init__()
            self.inner = {"generator": [generator]}

        def fails(self):
            own = self.inner["generator"][0]
            return (own.random() if hasattr(own, "random") else own.random_sample()) < 0.5

    with pytest.raises(InputError, match="the action draws random numbers"):
        enumerate_env(Own())
    world = enumerate_env(Own(), samples=20)
    right = np.asarray(world.model.probabilities())[0, 1]
    assert 0 < right[0] < 1


@pytest.mark.parametrize(("reward", "found"), [(None, "None"), ("1.5", "'1.5'"), ([0.0, 1.0], r"\[0.0, 1.0\]")])
def test_enumerate_env_of_a_reward_that_is_no_number_raises_with_state_and_action(reward, found):
    with pytest.raises(
        InputError, match=rf"^state 19, action 0, field 'reward': expected a finite number, found {found}"
    ):
        enumerate_env(Ladder(lambda _: reward))


def test_enumerate_env_of_a_reward_that_is_a_truth_value_pays_1():
    world = enumerate_env(Ladder(lambda _: np.True_), 0.9)
    assert plan(world.model, world.task).solution.values[0] == pytest.approx(0.9**19)


def test_enumerate_env_with_a_key_that_leaves_something_out_raises():
    message = "expected a key that tells all that decides what follows, found"
    with pytest.raises(InputError, match=rf"state 0, action 0: {message} \(1, -0.1, False\) and then \(1, 1.0, True\)"):
        enumerate_env(Corridor(), key=lambda env, _: env.cell)
    with pytest.raises(InputError, match=message):
        enumerate_env(Corridor(counts=True))
    with pytest.raises(InputError, match="'limit': expected at most 30 states, found more"):
        enumerate_env(Corridor(), key=lambda env, _: (env.steps, env.cell), limit=30)
    unhashable: Any = lambda env, _: [env.cell]  # noqa: E731
    with pytest.raises(InputError, match="'key': expected a number, text or tuple that tells states apart, found list"):
        enumerate_env(Corridor(), key=unhashable)


def test_enumerate_env_of_what_only_a_second_try_sees_raises():
    """No random walk comes up to the last rung, but staying on it counts a step."""
    same = enumerate_env(Ladder(lambda _: 1.0), 0.9)
    assert plan(same.model, same.task).solution.values[0] == pytest.approx(0.9**19)
    with pytest.raises(
        InputError, match=r"^state 19, action 0: expected a key.*found \(20, 20.0, True\) and then \(20, 21"
    ):
        enumerate_env(Ladder(float))


def test_enumerate_env_of_episodes_that_end_where_they_start_separates_the_end():
    world = enumerate_env(Round(float, top=-1), 0.9)
    assert (world.labels, world.ends) == ((0, 1, 2), {0: 3})
    np.testing.assert_allclose(plan(world.model, world.task).solution.values, [1.0, 1.0, 1.0, 0.0])


def test_enumerate_env_of_as_many_states_as_the_limit_finds_them():
    assert len(enumerate_env(Corridor(), limit=2 * CELLS).labels) == 2 * CELLS
    with pytest.raises(InputError, match="'limit': expected at most 9 states, found more"):
        enumerate_env(Corridor(), limit=2 * CELLS - 1)


def test_enumerate_env_pays_what_wrappers_pay():
    wrapped = wrappers.TransformReward(Corridor(counts=True), lambda reward: float(float(reward) > 0))
    world = enumerate_env(wrapped, 0.9)
    first = plan(world.model, world.task).solution.values[0]
    assert first == pytest.approx(0.9**6)  # two steps to the key, one to pick it up, three to the door


@pytest.mark.parametrize(
    ("env", "options", "message"),
    [
        (gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="sync"), {}, "found a vector of them"),
        (gymnasium.make("Pendulum-v1"), {}, "'action_space': expected Discrete actions, found Box"),
        (Corridor(), {"samples": 0}, "'samples': expected at least 1, found 0"),
        (Corridor(), {"limit": 0}, "'limit': expected at least 1, found 0"),
        (Corridor(), {"seeds": ()}, "'seeds': expected at least 1, found 0"),
        (Corridor(), {"discount": 0.0}, "'discount': expected a finite number above 0"),
        (gymnasium.make("Blackjack-v1"), {}, r"action 1, field 'samples': the action draws random numbers"),
    ],
)
def test_enumerate_env_of_what_it_cannot_enumerate_raises(env, options, message):
    with pytest.raises(InputError, match=message):
        enumerate_env(env, **options)


def test_enumerate_env_of_several_agents_and_several_actions_raises():
    env = Corridor()
    env.action_space = MultiDiscrete([2, 2])
    with pytest.raises(InputError, match="'action_space': expected Discrete actions, found MultiDiscrete"):
        enumerate_env(env)
    vars(env)["possible_agents"] = ["first", "second"]
    with pytest.raises(InputError, match="found one of several agents"):
        enumerate_env(env)


def test_enumerate_env_that_cannot_be_copied_raises_with_advice():
    env = Corridor()
    vars(env)["window"] = (each for each in ())
    with pytest.raises(InputError, match="cannot be copied; pass get_state and set_state: cannot pickle 'generator'"):
        enumerate_env(env)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [("FrozenLake-v1", {"is_slippery": False}), ("CliffWalking-v1", {}), (TAXI, {})],
)
def test_enumerate_env_of_a_table_has_the_values_of_the_table(name, options):
    """All of them draw a random number in each step, although each outcome is sure."""
    env = gymnasium.make(name, **options)
    of_table = from_gymnasium(env, 0.9)
    world = enumerate_env(
        env,
        0.9,
        get_state=lambda env: env.unwrapped.s,
        set_state=lambda env, state: setattr(env.unwrapped, "s", state),
        samples=1,
        seeds=range(30),
    )
    assert len(set(world.labels)) == len(world.labels) >= of_table.own_states - 100
    expected, values = (np.asarray(plan(each.model, each.task).solution.values) for each in (of_table, world))
    acting = [state for state in range(len(world.labels)) if not world.task.terminal[state]]
    assert len(acting) > len(world.labels) / 2
    numbers = np.array(world.labels, dtype=int)[acting]
    np.testing.assert_allclose(values[acting], expected[numbers], atol=1e-6)


def best(world):
    policy = np.asarray(plan(world.model, world.task).policy)
    return lambda state, _: int(policy[state].argmax())


def test_collect_in_an_enumerated_environment_follows_its_policy():
    env = wrappers.TimeLimit(Corridor(first_action=4), 4)
    world = enumerate_env(env, 0.9)
    (walk,) = collect(env, world, best(world), 1)
    assert [world.labels[state] for state in walk.states][2:4] == [
        (("carries", (0,)), ("cell", 3)),
        (("carries", (1,)), ("cell", 3)),
    ]
    assert walk.actions.tolist() == [1, 1, 2, 0]
    assert walk.truncated is True
    gather([walk], [world.task])


@pytest.mark.parametrize(("limit", "truncated"), [(19, True), (20, False), (21, False)])
def test_collect_is_truncated_where_the_time_limit_comes_before_the_end(limit, truncated):
    """A ladder of 20 rungs ends with its 20th step; where that is the limit too, the task has ended."""
    world = enumerate_env(Ladder(lambda _: 1.0), 0.9)
    env = wrappers.TimeLimit(Ladder(lambda _: 1.0), limit)
    (walk,) = collect(env, world, lambda *_: 0, 1)
    assert len(walk.actions) == min(limit, 20)
    assert walk.truncated is truncated


@pytest.mark.parametrize("reward", [np.nan, np.inf])
@pytest.mark.parametrize("samples", [None, 3])
def test_enumerate_env_of_a_reward_that_is_not_finite_raises_with_state_and_action(reward, samples):
    with pytest.raises(InputError, match=r"^state 19, action 0, field 'reward': expected a finite number, found"):
        enumerate_env(Ladder(lambda _: reward), samples=samples)


def test_collect_of_a_state_that_was_not_enumerated_raises():
    taxi = gymnasium.make(TAXI)
    settings = {
        "get_state": lambda env: env.unwrapped.s,
        "set_state": lambda env, state: setattr(env.unwrapped, "s", state),
    }
    world = enumerate_env(taxi, samples=1, seeds=(0,), **settings)
    with pytest.raises(InputError, match=r"^episode 1, move 0: expected a state that was enumerated, found"):
        collect(taxi, world, lambda _, random: int(random.integers(6)), 20)
