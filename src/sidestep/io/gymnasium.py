"""Gymnasium environments with a transition table: as models and tasks, and episodes collected in them.

`env.unwrapped.P[s][a]` lists (probability, next state, reward, whether the episode ends), as in `FrozenLake-v1`,
`CliffWalking-v1` and `Taxi`. A state in which an episode ends is terminal. The terminal reward is the reward of ending
there beyond that of the other outcomes of the same action (divided by γ, because it is received one move later); the
rest is R(s, a). If outcomes of one action have different rewards without ending, R(s, a) has their mean. If an episode
may either end in a state or continue there (a taxi with a passenger waiting at the destination), the end gets a
separate state, after those of the environment.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sidestep.errors import InputError, check, check_count
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.graph import graph
from sidestep.tabular.models import FIXED, IMPOSSIBLE, TabularModel, TiedModel
from sidestep.tabular.tasks import Task, check_discount

Act = Callable[[int, np.random.Generator], int]
"""Returns an action in a state, with a random generator."""


class Environment(NamedTuple):
    """The model and the task of an environment.

    Attributes:
        model: With the probabilities of the environment's table.
        task: With the rewards of the environment's table.
        ends: The separate states of ends, by the environment's state.
    """

    model: TabularModel
    task: Task
    ends: Mapping[int, int]


def from_gymnasium(env: Any, discount: float = 0.99) -> Environment:
    """Return the model and the task of an environment with a transition table.

    Args:
        env: A Gymnasium environment with `env.unwrapped.P`.
        discount: γ in (0, 1].

    Raises:
        InputError: For an environment without a table, a discount outside (0, 1], and a terminal state with different
            rewards after different actions.

    Example:
        >>> import gymnasium
        >>> from_gymnasium(gymnasium.make("FrozenLake-v1")).model.graph.states
        16
    """
    check_discount(discount)
    rows = getattr(env.unwrapped, "P", None)
    check(rows is not None, "expected an environment with a transition table, `P`", source=env)
    probabilities, successors, rewards, ending, ends = _outcomes(rows)
    terminal = np.isin(np.arange(len(successors)), successors[ending])
    continuing = np.where(ending, 0.0, probabilities)
    total = continuing.sum(axis=-1)
    reward = (continuing * rewards).sum(axis=-1) / np.where(total > 0, total, 1.0)
    # the terminal reward is what ending pays beyond the other outcomes; where there are none, the action pays the rest
    paid = ending & ~terminal[:, None, None]
    beside_others = paid & (total > 0)[..., None]
    final = np.zeros(len(successors))
    final[successors[beside_others]] = (rewards - reward[..., None])[beside_others]
    reward = np.where(total > 0, reward, rewards[..., 0] - final[successors[..., 0]])
    beyond, known = rewards - reward[..., None], final[successors]
    for place in np.argwhere(paid & ~np.isclose(known, beyond))[:1].tolist():
        one, other, state = (float(each[*place]) for each in (known, beyond, successors))
        raise InputError(f"ending in state {state:g} pays {one:g} beyond one action and {other:g} beyond another")
    reward[terminal] = 0.0
    logits = jnp.log(jnp.asarray(np.where(probabilities > 0, probabilities, 1.0)))
    task = Task(jnp.asarray(reward), jnp.asarray(final / discount), jnp.asarray(terminal), jnp.asarray(float(discount)))
    return Environment(TabularModel(graph(successors), logits, jnp.asarray(probabilities > 0)), task, ends)


def _outcomes(rows: Any) -> tuple[Any, ...]:
    """Return probability, next state, reward and whether the episode ends, of each outcome; and the separate ends."""
    table = [[[each for each in rows[s][a] if each[0] > 0] for a in rows[s]] for s in range(len(rows))]
    outcomes = [(s, *each) for s, row in enumerate(table) for action in row for each in action]
    # a state needs a separate end if episodes also pass it
    ended = {int(after) for _, _, after, _, ends in outcomes if ends}
    passed = {int(after) for s, _, after, _, ends in outcomes if not ends and s not in ended}
    separate = {state: len(table) + index for index, state in enumerate(sorted(ended & passed))}
    table += [[[(1.0, end, 0.0, False)]] * len(table[0]) for end in separate.values()]
    width = max(1, *(len(action) for row in table for action in row))
    padded = [[each + [(0.0, s, 0.0, False)] * (width - len(each)) for each in row] for s, row in enumerate(table)]
    probabilities, states, rewards, ending = np.moveaxis(np.array(padded, dtype=np.float64), -1, 0)
    successors, ending = states.astype(np.int64), ending > 0
    for state, end in separate.items():
        successors[ending & (successors == state)] = end
    return probabilities, successors, rewards, ending, separate


def slippery(environment: Environment, logit: float = 0.0) -> TiedModel:
    """Return a model in which all actions slip with one probability: three outcomes, the middle one intended.

    Args:
        environment: With three outcomes per action, such as `FrozenLake-v1`.
        logit: θ, the one parameter of the model; P(slip) = 2 e^θ / (1 + 2 e^θ), see `slip_of`.

    Raises:
        InputError: For an environment with another number of outcomes.

    Example:
        >>> import gymnasium
        >>> slip_of(slippery(from_gymnasium(gymnasium.make("FrozenLake-v1"))))  # doctest: +ELLIPSIS
        0.6666...
    """
    possible = np.asarray(environment.model.possible)
    message = f"expected three outcomes an action, found {possible.shape[-1]}"
    check(possible.shape[-1] == 3, message, field="environment")
    index = np.tile([0, FIXED, 0], (*possible.shape[:2], 1))
    certain = possible.sum(axis=-1) == 1
    index[certain] = np.where(possible[certain], FIXED, IMPOSSIBLE)
    return TiedModel(environment.model.graph, index, logit)


def slip_of(model: TiedModel) -> float:
    """Return P(slip) of a model from `slippery`.

    Args:
        model: A model from `slippery`.

    Example:
        >>> import gymnasium
        >>> slip_of(slippery(from_gymnasium(gymnasium.make("FrozenLake-v1")), logit=0.0))  # doctest: +ELLIPSIS
        0.6666...
    """
    odds = 2 * float(jnp.exp(model.parameters[0]))
    return odds / (1 + odds)


def collect(env: Any, world: Environment, act: Act, episodes: int, *, seed: int = 0, task: int = 0) -> list[Trajectory]:
    """Return episodes in a Gymnasium environment as trajectories; some may be truncated by a time limit.

    Args:
        env: The environment.
        world: `from_gymnasium(env)`.
        act: Chooses an action in a state, with a random generator.
        episodes: The number of episodes, at least 1.
        seed: Of the environment's first episode, and of the random generator.
        task: The index of the task of the trajectories.

    Raises:
        InputError: For a number of episodes below 1.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("FrozenLake-v1")
        >>> len(collect(env, from_gymnasium(env), lambda state, random: int(random.integers(4)), episodes=3))
        3
    """
    check_count(episodes, 1, "episodes")
    random, trajectories = np.random.default_rng(seed), []
    for episode in range(episodes):
        state, _ = env.reset(seed=seed if episode == 0 else None)
        states, actions, terminated, truncated = [int(state)], [], False, False
        while not (terminated or truncated):
            actions.append(int(act(states[-1], random)))
            state, _, terminated, truncated, _ = env.step(actions[-1])
            states.append(world.ends.get(int(state), int(state)) if terminated else int(state))
        trajectories.append(Trajectory(np.asarray(states), np.asarray(actions), task))
    return trajectories
