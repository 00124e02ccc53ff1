"""Environments with a table of transitions, as a model and a task; what readers of tables share.

In Gymnasium, episodes end by transitions: one may end in a state that another passes. In an MDP they end in *terminal
states*. A state in which an episode ends and which no episode passes is terminal. For one that episodes also pass (a
taxi with a passenger waiting at the destination), the end gets a separate state, after those of the environment.
Terminal states pay nothing: every outcome pays its own reward, R(s, a, s′).
"""

from collections.abc import Collection, Hashable, Mapping, Sequence
from operator import index
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.errors import InputError, check, describe
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.distributions import check_distribution
from sidestep.tabular.graph import graph
from sidestep.tabular.models import TabularModel
from sidestep.tabular.tasks import Task, task, with_outcome_reward


class Environment(NamedTuple):
    """The model and the task of an environment.

    Attributes:
        model: With the probabilities of the environment.
        task: With the rewards of the environment.
        ends: The separate states of ends, by the environment's state.
        labels: The key of each state of an enumerated environment, without the separate ends; empty where the
            environment numbers its states itself.
        samples: The number of tries of which the probabilities of random actions are fractions; None where they are
            exact.
    """

    model: TabularModel
    task: Task
    ends: Mapping[int, int]
    labels: tuple[Hashable, ...] = ()
    samples: int | None = None

    @property
    def own_states(self) -> int:
        """Return the number of states without the separate ends."""
        return self.model.graph.states - len(self.ends)


class Outcome(NamedTuple):
    """One outcome of an action.

    Attributes:
        probability: Above 0.
        state: The state that follows.
        reward: Of the outcome.
        ends: Whether the episode ends.
    """

    probability: float
    state: int
    reward: float
    ends: bool


Rows = Sequence[Mapping[int, Sequence[Outcome]]]
"""The outcomes of each action that can be taken, of each state in 0…states − 1."""


def environment_of(
    rows: Rows, actions: int, discount: float, starts: Collection[int] = (), first: tuple[int, int] = (0, 0)
) -> Environment:
    """Return the model and the task of a table of outcomes.

    Args:
        rows: The outcomes of every state and action.
        actions: Their number.
        discount: γ in (0, 1].
        starts: States in which an episode may start; they are never terminal.
        first: What the environment calls state 0 and action 0, for messages.

    Raises:
        InputError: For a state that is not terminal and has no action, and, with state and action, for probabilities
            that do not sum to 1.
    """
    ended = {each.state for row in rows for outcomes in row.values() for each in outcomes if each.ends}
    passed = _passed(rows, ended, starts)
    # a state needs a separate end if episodes also pass it
    ends = {state: len(rows) + index for index, state in enumerate(sorted(ended & passed))}
    terminal = np.array([*(state not in passed for state in range(len(rows))), *(True for _ in ends)])
    width = max([1, *(len(outcomes) for state in passed for outcomes in rows[state].values())])
    shape = len(terminal), actions, width
    probabilities, rewards = np.zeros(shape), np.zeros(shape)
    probabilities[..., 0] = 1.0
    successors = np.broadcast_to(np.arange(len(terminal))[:, None, None], shape).copy()
    available = np.broadcast_to(terminal[:, None], shape[:2]).copy()
    for state in sorted(passed):
        name = state + first[0]
        check(rows[state], "expected an action, found none, and no episode ends there", source=f"state {name}")
        for action, outcomes in rows[state].items():
            source = f"state {name}, action {action + first[1]}"
            check_distribution(np.array([each.probability for each in outcomes]), source=source)
            # padding repeats the first outcome, so that what is impossible pays nothing else than what is possible
            padded = [*outcomes, *[outcomes[0]._replace(probability=0.0)] * (width - len(outcomes))]
            place = state, action
            probabilities[place] = [each.probability for each in padded]
            successors[place] = [ends.get(each.state, each.state) if each.ends else each.state for each in padded]
            rewards[place], available[place] = [each.reward for each in padded], True
    same = (rewards == rewards[..., :1]).all()
    made = task(np.where(same, rewards[..., 0], 0.0), discount, terminal)
    made = made if same else with_outcome_reward(made, rewards)
    return Environment(model_of(probabilities, successors, available), made, ends)


def model_of(
    probabilities: Float[np.ndarray, "states actions outcomes"],
    successors: Int[np.ndarray, "states actions outcomes"],
    available: Bool[np.ndarray, "states actions"],
) -> TabularModel:
    """Return the model with these probabilities; outcomes of probability 0 are impossible.

    Args:
        probabilities: Of each outcome.
        successors: The state that each outcome leads to.
        available: Whether an action can be taken in a state.
    """
    possible = probabilities > 0
    logits = to_jax(np.log(np.where(possible, probabilities, 1.0)), jnp.result_type(float))
    return TabularModel(graph(successors, available), logits, to_jax(possible))


def check_single(env: Any) -> None:
    """Raise `InputError` for something else than one environment of one agent.

    Args:
        env: The environment.
    """
    several = any(hasattr(each, "possible_agents") for each in (env, getattr(env, "unwrapped", env)))
    message = "expected a Gymnasium environment of one agent, found one of several agents (PettingZoo)"
    check(not several, f"{message}; pass what one of them sees, with the others' actions fixed", field="env")
    message = "expected one environment, found a vector of them"
    check(not hasattr(env, "num_envs"), f"{message}; pass one, as `gymnasium.make` returns it", field="env")


def check_runs(env: Any) -> None:
    """Raise `InputError` for something else than one environment of one agent with `reset` and `step`.

    Args:
        env: The environment.
    """
    check_single(env)
    runs = all(callable(getattr(env, name, None)) for name in ("reset", "step"))
    check(runs, f"expected a Gymnasium environment with `reset` and `step`, found {describe(env)}", field="env")


def reset(env: Any, seed: int | None) -> Any:
    """Return the first observation of a new episode.

    Args:
        env: The environment.
        seed: Of its random numbers; None to go on with those it has.

    Raises:
        InputError: For an environment that does not return an observation and a dictionary.
    """
    return _parts(env.reset(seed=seed), ("observation", "info"), "reset")[0]


def step(env: Any, action: int) -> tuple[Any, Any, bool, bool]:
    """Return the observation and the reward after an action, and whether the episode has ended or is truncated.

    Args:
        env: The environment.
        action: As the environment numbers it.

    Raises:
        InputError: For an environment that returns something else, as the older ones of Gym do.
    """
    names = "observation", "reward", "terminated", "truncated", "info"
    observation, reward, terminated, truncated, _ = _parts(env.step(action), names, "step")
    return observation, reward, bool(terminated), bool(truncated)


def _parts(results: Any, names: tuple[str, ...], function: str) -> tuple[Any, ...]:
    """Return what a function of an environment has returned; raise `InputError` unless it has as many parts."""
    size = len(results) if isinstance(results, tuple) else 1
    message = f"expected ({', '.join(names)}) of `{function}`, found {size} of them"
    check(isinstance(results, tuple) and size == len(names), message, field="env")
    return results


def check_whole(value: Any, message: str, source: object) -> int:
    """Return a whole number as Python's own; raise `InputError` for anything else.

    Args:
        value: A whole number of any library, but no float.
        message: What was expected; what was found follows.
        source: The place, for the message.
    """
    try:
        return index(value)
    except TypeError as error:
        raise InputError(f"{message}, found {value!r}", source=source) from error


def numbers_of(space: Any) -> tuple[int, int] | None:
    """Return the first number and the count of a `Discrete` space; None for another one.

    Args:
        space: One of Gymnasium's spaces, or None.
    """
    return (int(space.start), int(space.n)) if type(space).__name__ == "Discrete" else None


def _passed(rows: Rows, ended: set[int], starts: Collection[int]) -> set[int]:
    """Return the states in which an episode goes on: those in which none ends, starts, and what follows these."""
    passed = {state for state in range(len(rows)) if state not in ended} | set(starts)
    waiting = list(passed)
    while waiting:
        outcomes = [each for row in rows[waiting.pop()].values() for each in row]
        after = {each.state for each in outcomes if not each.ends} - passed
        passed |= after
        waiting += after
    return passed
