"""Environments that draw random numbers anywhere: probabilities are estimated, or the action is refused."""

import copy

import equinox as eqx
import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.spaces import Discrete

from sidestep.errors import InputError
from sidestep.io.enumeration import enumerate_env
from sidestep.io.episodes import collect


class Fork(gymnasium.Env):
    """One move from 1 to 0 or 2, where the episode ends; `flips` says whether the move goes the other way."""

    observation_space, action_space = Discrete(3), Discrete(2)

    def __init__(self, flips=lambda _: False):
        self.flips, self.place, self.tried = flips, 1, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 1
        return 1, {}

    def step(self, action):
        self.tried += 1
        self.place = 2 * int(action != bool(self.flips(self)))
        return self.place, 0.0, True, False, {}


class Flipping(gymnasium.ActionWrapper):
    """The action is the other one with probability .4, by a generator of the wrapper."""

    def __init__(self, env):
        super().__init__(env)
        self.rng = np.random.default_rng(0)

    def action(self, action):
        return 1 - action if self.rng.random() < 0.4 else action


OF_MODULE = np.random.default_rng(3)


def flips_by_closure():
    own = np.random.default_rng(2)
    return lambda _: own.random() < 0.4


def flipped_by_default():
    flips = flips_by_closure()
    return lambda action, flips=flips: action ^ flips(None)


def with_container(env):
    env.inner = {"all": [{"rng": np.random.default_rng(1)}]}
    return env


FLIPPING = {
    "wrapper": lambda: Flipping(Fork()),
    "container": lambda: with_container(Fork(lambda env: env.inner["all"][0]["rng"].random() < 0.4)),
    "closure": lambda: Fork(flips_by_closure()),
    "module": lambda: Fork(lambda _: OF_MODULE.random() < 0.4),
    "wrapped function": lambda: wrappers.TransformAction(Fork(), flipped_by_default(), Discrete(2)),
}


def place_of(env):
    return env.unwrapped.place


def set_place(env, place):
    env.unwrapped.place = place


@pytest.mark.parametrize("name", FLIPPING)
@pytest.mark.parametrize("settings", [{}, {"get_state": place_of, "set_state": set_place}], ids=["copies", "settings"])
def test_enumerate_env_estimates_what_generators_anywhere_decide(name, settings):
    world = enumerate_env(FLIPPING[name](), samples=400, **settings)
    successors, probabilities = np.asarray(world.model.graph.successors), np.asarray(world.model.probabilities())
    to_right = np.where(successors == world.labels.index(2), probabilities, 0).sum(axis=-1)[0]
    np.testing.assert_allclose(to_right, [0.4, 0.6], atol=4.5 * np.sqrt(0.4 * 0.6 / 400))


@pytest.mark.parametrize("name", [name for name in FLIPPING if name != "module"])
@pytest.mark.parametrize("settings", [{}, {"get_state": place_of, "set_state": set_place}], ids=["copies", "settings"])
def test_enumerate_env_without_samples_refuses_generators_anywhere(name, settings):
    with pytest.raises(InputError, match="state 1, action 0, field 'samples': the action draws random numbers"):
        enumerate_env(FLIPPING[name](), **settings)


def test_enumerate_env_of_a_state_with_its_generator_draws_other_numbers_in_each_try():
    """The state that is set has a copy of the generator, so without other seeds every try would be the same."""

    def set_state(env, state):
        env.rng = copy.deepcopy(state[1])
        set_place(env, state[0])

    world = enumerate_env(
        Flipping(Fork()),
        samples=400,
        get_state=lambda env: (place_of(env), copy.deepcopy(env.rng)),
        set_state=set_state,
    )
    found = np.sort(np.asarray(world.model.probabilities())[0], axis=-1)
    np.testing.assert_allclose(found, [[0.4, 0.6]] * 2, atol=4.5 * np.sqrt(0.4 * 0.6 / 400))


def test_enumerate_env_has_the_same_estimates_in_each_run():
    settings = {"get_state": place_of, "set_state": set_place}
    first, second = (enumerate_env(Flipping(Fork()), samples=20, **settings) for _ in range(2))
    assert eqx.tree_equal(first, second)


def test_enumerate_env_tries_each_action_as_often_as_samples_says():
    env = Fork()
    enumerate_env(env, samples=7, get_state=place_of, set_state=set_place)
    assert env.tried == 2 * 7


def test_enumerate_env_of_an_environment_of_gym_raises():
    old = Fork()
    vars(old)["step"] = lambda action: (action, 0.0, True, {})
    with pytest.raises(
        InputError, match=r"expected \(observation, reward, terminated, truncated, info\) of `step`, found 4"
    ):
        enumerate_env(old)
    vars(old)["reset"] = lambda **_: 1
    with pytest.raises(InputError, match=r"expected \(observation, info\) of `reset`, found 1 of them"):
        collect(old, enumerate_env(Fork()), lambda *_: 0, 1)
