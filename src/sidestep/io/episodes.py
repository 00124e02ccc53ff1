"""Episodes in Gymnasium environments, as trajectories."""

import reprlib
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from sidestep.errors import check, check_count, check_function, check_instance, to_count
from sidestep.io import environments
from sidestep.io.environments import Environment, check_runs, check_whole, numbers_of
from sidestep.io.keys import Key, key_of, observation_key
from sidestep.tabular.demonstrations import Trajectory

Act = Callable[[int, np.random.Generator], Any]
"""Returns an action, a whole number from 0 on, in a state, with a random generator."""


def collect(
    env: Any,
    world: Environment,
    act: Act,
    episodes: int,
    *,
    seed: int = 0,
    task: int = 0,
    key: Key = observation_key,
) -> list[Trajectory]:
    """Return episodes in a Gymnasium environment as trajectories, `truncated` where a time limit stopped them.

    Args:
        env: The environment. Its observations are states, unless it was enumerated.
        world: `from_gymnasium(env)` or `enumerate_env(env)`.
        act: Chooses an action in a state, with a random generator. Both are numbers of `world`, from 0 on, where the
            spaces of `env` start at other numbers too.
        episodes: The number of episodes, at least 1.
        seed: Of the environment's first episode, and of the random generator.
        task: The index of the task of the trajectories.
        key: As in `enumerate_env`; only for an enumerated environment.

    Raises:
        InputError: For a number of episodes below 1, a seed or a task below 0, an environment of several agents or
            with other spaces than `world`, and, with episode and move, for an observation that is not a state of
            `world` and an action that is not a whole number or not available.

    Example:
        >>> import gymnasium
        >>> from sidestep.io.gymnasium import from_gymnasium
        >>> env = gymnasium.make("FrozenLake-v1")
        >>> len(collect(env, from_gymnasium(env), lambda state, random: int(random.integers(4)), episodes=3))
        3
    """
    check_count(episodes, 1, "episodes")
    check_runs(env)
    check_instance(world, Environment, "world")
    check_function(act, "act")
    check_function(key, "key")
    seed, task = to_count(seed, "seed", 0), to_count(task, "task", 0)
    state_of, first_action = _state_reader(env, world, key), _first_action(env, world)
    available = np.broadcast_to(np.asarray(world.model.graph.available), world.model.graph.successors.shape[:2])
    random, trajectories = np.random.default_rng(seed), []
    for episode in range(episodes):
        observation = environments.reset(env, seed if episode == 0 else None)
        states, actions, terminated, truncated = [state_of(observation, f"episode {episode}, move 0")], [], False, False
        while not (terminated or truncated):
            place = f"episode {episode}, move {len(actions)}"
            action = check_whole(act(states[-1], random), "expected a whole number as action", place)
            can = 0 <= action < available.shape[1] and available[states[-1], action]
            options = np.flatnonzero(available[states[-1]]).tolist()
            check(can, f"expected one of the actions {options} of state {states[-1]}, found {action}", source=place)
            actions.append(action)
            observation, _, terminated, truncated = environments.step(env, action + first_action)
            state = state_of(observation, place)
            states.append(world.ends.get(state, state) if terminated else state)
        stopped = truncated and not terminated
        trajectories.append(Trajectory(np.asarray(states), np.asarray(actions), task, stopped))
    return trajectories


def _state_reader(env: Any, world: Environment, key: Key) -> Callable[[Any, str], int]:
    """Return the function from an observation and a place, for messages, to the state of `world`."""
    if world.labels:
        numbers: dict[Hashable, int] = {label: state for state, label in enumerate(world.labels)}

        def enumerated(observation: Any, place: str) -> int:
            label = key_of(key, env, observation)
            message = f"expected a state that was enumerated, found {reprlib.repr(label)}; enumerate from more `seeds`"
            check(label in numbers, message, source=place)
            return numbers[label]

        return enumerated
    space, count = getattr(env, "observation_space", None), world.own_states
    first, own = numbers_of(space) or (0, count)
    kind = type(space).__name__
    message = f"expected observations that are states, Discrete({count}), found {space}"
    check(space is None or (kind == "Discrete" and own == count), message, source=env, field="observation_space")

    def numbered(observation: Any, place: str) -> int:
        state = check_whole(observation, "expected a whole number as observation", place) - first
        check(0 <= state < count, f"expected a state in {first}…{first + count - 1}, found {observation}", source=place)
        return state

    return numbered


def _first_action(env: Any, world: Environment) -> int:
    """Return the number that the environment gives to action 0; raise `InputError` for other actions than `world`'s."""
    space, count = getattr(env, "action_space", None), world.model.graph.actions
    first, own = numbers_of(space) or (0, -1)
    message = f"expected Discrete({count}), as the model has, found {space}"
    check(space is None or own == count, message, source=env, field="action_space")
    return first
