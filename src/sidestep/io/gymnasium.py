"""Gymnasium environments that tell their transition table: as models and tasks, and episodes collected in them.

`env.unwrapped.P[s][a]` lists (probability, next state, reward, whether the episode ends), as in `FrozenLake-v1`,
`CliffWalking-v1` and `Taxi`. A state in which an episode ends is terminal here. What ending there pays beyond the other
outcomes of the same action is the terminal state's final reward (over γ, for it is paid one move later); all else is
R(s, a). Outcomes of one action that pay differently without ending enter R(s, a) by their mean. Where an episode may
end in a state that may also be passed (of a taxi whose passenger waits at the destination), the end has a state of its
own, behind those of the environment.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from sidestep.errors import InputError, check_count
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.graph import graph
from sidestep.tabular.models import FIXED, IMPOSSIBLE, TabularModel, TiedModel
from sidestep.tabular.tasks import Task, check_discount


class Environment(NamedTuple):
    """An environment as the library sees it: the model of its table, and its task.

    - `ends`: the states of their own that ends have, by the environment's state.
    """

    model: TabularModel
    task: Task
    ends: Mapping[int, int]


class _Outcome(NamedTuple):
    """What an action may lead to, as Gymnasium's tables have it."""

    probability: float
    state: int
    reward: float
    ends: bool


_Table = list[list[list[_Outcome]]]
"""Outcomes by state and action; those that cannot happen are left out."""


def from_gymnasium(env: Any, discount: float = 0.99) -> Environment:
    """The model and the task of an environment that tells its transition table.

    Raises `InputError` for an environment without one, a discount outside (0, 1], and a terminal state that pays
    differently beside different actions.
    """
    check_discount(discount)
    found = getattr(env.unwrapped, "P", None)
    if found is None:
        raise InputError("expected an environment with a transition table, `P`", source=env)
    table = [[[_Outcome(*each) for each in found[s][a] if each[0] > 0] for a in found[s]] for s in range(len(found))]
    ends = _with_own_ends(table)
    terminal = np.zeros(len(table), dtype=bool)
    width = 1
    for row in table:
        for outcomes in row:
            width = max(width, len(outcomes))
            terminal[[outcome.state for outcome in outcomes if outcome.ends]] = True
    successors = np.tile(np.arange(len(table))[:, None, None], (1, len(table[0]), width))
    chances = np.zeros(successors.shape)
    for s, row in enumerate(table):
        for a, outcomes in enumerate(row):
            for k, outcome in enumerate(outcomes):
                successors[s, a, k], chances[s, a, k] = outcome.state, outcome.probability
    logits = jnp.log(jnp.asarray(np.where(chances > 0, chances, 1.0)))
    model = TabularModel(graph(successors), logits, jnp.asarray(chances > 0))
    return Environment(model, _task(table, terminal, discount), ends)


def _with_own_ends(table: _Table) -> dict[int, int]:
    """Gives ends a state of their own where they need one, in the table, and returns these by the former ones."""
    outcomes = [(s, outcome) for s, row in enumerate(table) for several in row for outcome in several]
    ending = {int(outcome.state) for _, outcome in outcomes if outcome.ends}
    passed = {int(outcome.state) for s, outcome in outcomes if not outcome.ends and s not in ending}
    own = {state: len(table) + number for number, state in enumerate(sorted(ending & passed))}
    for several in (several for row in table for several in row):
        for number, outcome in enumerate(several):
            if outcome.ends:
                several[number] = outcome._replace(state=own.get(int(outcome.state), outcome.state))
    table += [[[_Outcome(1.0, state, 0.0, True)]] * len(table[0]) for state in own.values()]
    return own


def _task(table: _Table, terminal: Bool[np.ndarray, " states"], discount: float) -> Task:
    acting = [(s, a, outcomes) for s, row in enumerate(table) if not terminal[s] for a, outcomes in enumerate(row)]
    reward = np.zeros((len(table), len(table[0])))
    final = np.full(len(table), np.nan)
    for s, a, outcomes in acting:
        going_on = [(outcome.probability, outcome.reward) for outcome in outcomes if not outcome.ends]
        if going_on:
            chances, paid = np.array(going_on).T
            reward[s, a] = chances @ paid / chances.sum()
            _pay_at_ends(final, outcomes, reward[s, a])
    final[np.isnan(final)] = 0.0
    for s, a, outcomes in acting:
        if all(outcome.ends for outcome in outcomes):
            reward[s, a] = outcomes[0].reward - final[outcomes[0].state]
            _pay_at_ends(final, outcomes, reward[s, a])
    return Task(jnp.asarray(reward), jnp.asarray(final / discount), jnp.asarray(terminal), jnp.asarray(float(discount)))


def _pay_at_ends(final: Float[np.ndarray, " states"], outcomes: list[_Outcome], reward: float) -> None:
    """Notes what terminal states pay beyond the reward of an action."""
    for outcome in outcomes:
        if outcome.ends:
            beyond, known = outcome.reward - reward, final[outcome.state]
            if not np.isnan(known) and not np.isclose(known, beyond):
                raise InputError(
                    f"ending in state {outcome.state} pays {beyond:g} beyond one action and {known:g} beyond another"
                )
            final[outcome.state] = beyond


def slippery(environment: Environment, logit: float = 0.0) -> TiedModel:
    """A model of an environment in which all actions slip alike: three outcomes, the middle one meant.

    Its one parameter θ is the logit of either side; P(slip) = 2 e^θ / (1 + 2 e^θ), see `slip_of`. Raises `InputError`
    for an environment whose actions have another number of outcomes.
    """
    possible = np.asarray(environment.model.possible)
    if possible.shape[-1] != 3:
        raise InputError(f"expected three outcomes an action, found {possible.shape[-1]}", field="environment")
    index = np.tile([0, FIXED, 0], (*possible.shape[:2], 1))
    alone = possible.sum(axis=-1) == 1
    index[alone] = np.where(possible[alone], FIXED, IMPOSSIBLE)
    return TiedModel(environment.model.graph, index, logit)


def slip_of(model: TiedModel) -> float:
    """P(slip) under a model from `slippery`."""
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
    """Episodes in a Gymnasium environment, as trajectories of a task.

    - `world`: what `from_gymnasium` made of it. `act`: an action for a state.
    - `seed`: of the environment's first episode, and of what `act` draws.

    Episodes that end because time is up are cut there.
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
