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
from jaxtyping import Bool, Float

from sidestep.errors import InputError, check, check_count
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.graph import graph
from sidestep.tabular.models import FIXED, IMPOSSIBLE, TabularModel, TiedModel
from sidestep.tabular.tasks import Task, check_discount


class Environment(NamedTuple):
    """The model and the task of an environment.

    Attributes:
        model: with the probabilities of the environment's table.
        task: with the rewards of the environment's table.
        ends: the separate states of ends, by the environment's state.
    """

    model: TabularModel
    task: Task
    ends: Mapping[int, int]


class _Outcome(NamedTuple):
    """An outcome of an action, as in Gymnasium's tables."""

    probability: float
    state: int
    reward: float
    ends: bool


_Table = list[list[list[_Outcome]]]
"""Outcomes by state and action, without those of probability 0."""


def from_gymnasium(env: Any, discount: float = 0.99) -> Environment:
    """Return the model and the task of an environment with a transition table.

    Args:
        env: a Gymnasium environment with `env.unwrapped.P`.
        discount: γ in (0, 1].

    Raises:
        InputError: for an environment without a table, a discount outside (0, 1], and a terminal state with different
            rewards after different actions.

    Example:
        >>> import gymnasium
        >>> from_gymnasium(gymnasium.make("FrozenLake-v1")).model.graph.states
        16
    """
    check_discount(discount)
    rows = getattr(env.unwrapped, "P", None)
    if rows is None:
        raise InputError("expected an environment with a transition table, `P`", source=env)
    table = [[[_Outcome(*each) for each in rows[s][a] if each[0] > 0] for a in rows[s]] for s in range(len(rows))]
    ends = _separate_ends(table)
    terminal = np.zeros(len(table), dtype=bool)
    width = max(1, *(len(outcomes) for row in table for outcomes in row))
    successors = np.tile(np.arange(len(table))[:, None, None], (1, len(table[0]), width))
    probabilities = np.zeros(successors.shape)
    for s, row in enumerate(table):
        for a, outcomes in enumerate(row):
            for k, outcome in enumerate(outcomes):
                successors[s, a, k], probabilities[s, a, k] = outcome.state, outcome.probability
                terminal[outcome.state] |= outcome.ends
    logits = jnp.log(jnp.asarray(np.where(probabilities > 0, probabilities, 1.0)))
    model = TabularModel(graph(successors), logits, jnp.asarray(probabilities > 0))
    return Environment(model, _task(table, terminal, discount), ends)


def _separate_ends(table: _Table) -> dict[int, int]:
    """Change a table so that ends have separate states where necessary; return these by the former states."""
    outcomes = [(s, outcome) for s, row in enumerate(table) for several in row for outcome in several]
    ending = {int(outcome.state) for _, outcome in outcomes if outcome.ends}
    passed = {int(outcome.state) for s, outcome in outcomes if not outcome.ends and s not in ending}
    ends = {state: len(table) + number for number, state in enumerate(sorted(ending & passed))}
    for several in (several for row in table for several in row):
        for number, outcome in enumerate(several):
            if outcome.ends:
                several[number] = outcome._replace(state=ends.get(int(outcome.state), outcome.state))
    table += [[[_Outcome(1.0, state, 0.0, True)]] * len(table[0]) for state in ends.values()]
    return ends


def _task(table: _Table, terminal: Bool[np.ndarray, " states"], discount: float) -> Task:
    acting = [(s, a, outcomes) for s, row in enumerate(table) if not terminal[s] for a, outcomes in enumerate(row)]
    reward = np.zeros((len(table), len(table[0])))
    final = np.full(len(table), np.nan)
    for s, a, outcomes in acting:
        continuing = [(outcome.probability, outcome.reward) for outcome in outcomes if not outcome.ends]
        if continuing:
            probabilities, rewards = np.array(continuing).T
            reward[s, a] = probabilities @ rewards / probabilities.sum()
            _set_terminal_rewards(final, outcomes, reward[s, a])
    final[np.isnan(final)] = 0.0
    for s, a, outcomes in acting:
        if all(outcome.ends for outcome in outcomes):
            reward[s, a] = outcomes[0].reward - final[outcomes[0].state]
            _set_terminal_rewards(final, outcomes, reward[s, a])
    return Task(jnp.asarray(reward), jnp.asarray(final / discount), jnp.asarray(terminal), jnp.asarray(float(discount)))


def _set_terminal_rewards(final: Float[np.ndarray, " states"], outcomes: list[_Outcome], reward: float) -> None:
    """Set the terminal rewards of the ends of an action: their rewards beyond `reward`."""
    for outcome in outcomes:
        if outcome.ends:
            beyond, known = outcome.reward - reward, final[outcome.state]
            message = f"ending in state {outcome.state} pays {beyond:g} beyond one action and {known:g} beyond another"
            check(np.isnan(known) or np.isclose(known, beyond), message)
            final[outcome.state] = beyond


def slippery(environment: Environment, logit: float = 0.0) -> TiedModel:
    """Return a model in which all actions slip with one probability: three outcomes, the middle one intended.

    Args:
        environment: with three outcomes per action, such as `FrozenLake-v1`.
        logit: θ, the one parameter of the model; P(slip) = 2 e^θ / (1 + 2 e^θ), see `slip_of`.

    Raises:
        InputError: for an environment with another number of outcomes.

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
    """Return P(slip) of a model from `slippery`; see there for an example."""
    odds = 2 * float(jnp.exp(model.parameters[0]))
    return odds / (1 + odds)


def collect(
    env: Any,
    world: Environment,
    act: Callable[[int, np.random.Generator], int],
    episodes: int,
    *,
    seed: int = 0,
    task: int = 0,
) -> list[Trajectory]:
    """Return episodes in a Gymnasium environment as trajectories; some may be truncated by a time limit.

    Args:
        env: the environment.
        world: `from_gymnasium(env)`.
        act: chooses an action in a state, with a random generator.
        episodes: the number of episodes, at least 1.
        seed: of the environment's first episode, and of the random generator.
        task: the index of the task of the trajectories.

    Raises:
        InputError: for a number of episodes below 1.

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
        states, actions, over = [int(state)], [], False
        while not over:
            actions.append(int(act(states[-1], random)))
            state, _, terminated, truncated, _ = env.step(actions[-1])
            states.append(world.ends.get(int(state), int(state)) if terminated else int(state))
            over = terminated or truncated
        trajectories.append(Trajectory(np.asarray(states), np.asarray(actions), task))
    return trajectories
