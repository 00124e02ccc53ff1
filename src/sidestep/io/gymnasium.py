"""Gymnasium environments with a transition table, as models and tasks.

`env.unwrapped.P[s][a]` lists (probability, next state, reward, whether the episode ends), as in `FrozenLake-v1`,
`CliffWalking-v1` and `Taxi-v4`. States and actions are the keys of the table; an action that a state lacks is not
available there. Spaces that start at another number than 0 are shifted to it. `sidestep.io.environments` says which
states are terminal. The reward of an outcome is R(s, a, s′), whatever the other outcomes pay.
"""

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import jax.numpy as jnp
import numpy as np

from sidestep.errors import InputError, check, check_instance, describe
from sidestep.io.environments import Environment, Outcome, check_single, check_whole, environment_of, numbers_of
from sidestep.tabular.models import FIXED, IMPOSSIBLE, TiedModel
from sidestep.tabular.tasks import check_discount

_HARMLESS = {
    *("OrderEnforcing", "PassiveEnvChecker", "TimeLimit", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering"),
    *("RenderCollection", "DataCollector"),
}
"""The wrappers of Gymnasium and Minari that change no transition; a time limit truncates episodes, it ends none."""


def from_gymnasium(env: Any, discount: float = 0.99) -> Environment:
    """Return the model and the task of an environment with a transition table.

    Args:
        env: A Gymnasium environment with `env.unwrapped.P`.
        discount: γ in (0, 1].

    Returns:
        With the table's probabilities and rewards. State s is the table's, less the start of the observation space,
        and so are actions. Time limits count as truncation: they are in neither.

    Raises:
        InputError: For an environment without a table, of several agents, or under a wrapper that may change rewards,
            observations or actions, a table that is malformed, probabilities that do not sum to 1, and a discount
            outside (0, 1].

    Example:
        >>> import gymnasium
        >>> from_gymnasium(gymnasium.make("FrozenLake-v1")).model.graph.states
        16
    """
    check_discount(discount)
    check_single(env)
    own = getattr(env, "unwrapped", env)
    table: Any = getattr(own, "P", None)
    advice = "`enumerate_env` needs none"
    message = f"expected an environment with a transition table `P`, found {describe(env)} without one; {advice}"
    check(table is not None, message, field="env")
    _check_wrappers(env)
    message = "found a taxi with fickle passengers: its destination changes in ways that its table lacks"
    check(not getattr(own, "fickle_passenger", False), message, source=env)
    states, actions = (numbers_of(getattr(own, name, None)) for name in ("observation_space", "action_space"))
    first, count = states or (0, len(table) if hasattr(table, "__len__") else 0)
    rows = _entries(table, first, "a dict or list of states", "P")
    message = (
        f"expected a row for each of the states {first}…{first + count - 1}, found {_difference(rows, first, count)}"
    )
    check(count and rows.keys() == set(range(first, first + count)), message, field="P")
    first_action = actions[0] if actions else 0
    tables = [
        _entries(rows[state], first_action, "a dict or list of actions", f"state {state}")
        for state in range(first, first + count)
    ]
    last_action = sum(actions) - 1 if actions else max((action for row in tables for action in row), default=-1)
    check(last_action >= first_action, "expected at least one action, found none", field="P")
    read: list[dict[int, list[Outcome]]] = []
    for state, row in enumerate(tables, start=first):
        wrong = [action for action in row if not first_action <= action <= last_action]
        message = f"expected actions in {first_action}…{last_action}, found {wrong}"
        check(not wrong, message, source=f"state {state}")
        read.append({a - first_action: _outcomes(each, (first, count), state, a) for a, each in row.items()})
    chance = np.asarray(getattr(own, "initial_state_distrib", ()))
    starts = np.flatnonzero(chance > 0).tolist() if chance.shape == (count,) else []
    return environment_of(read, last_action - first_action + 1, discount, starts, (first, first_action))


def _difference(rows: Mapping[int, Any], first: int, count: int) -> str:
    """Return which states a table lacks, or has beyond those there are."""
    missing = sorted(set(range(first, first + count)) - rows.keys())[:3]
    return f"none for {missing}" if missing else f"also {sorted(rows.keys() - set(range(first, first + count)))[:3]}"


def _check_wrappers(env: Any) -> None:
    """Raise `InputError` for a wrapper that may change what the table says."""
    layer = env
    while layer is not getattr(layer, "unwrapped", layer):
        kind = type(layer)
        harmless = kind.__name__ in _HARMLESS and kind.__module__.split(".")[0] in ("gymnasium", "gym", "minari")
        message = f"found the wrapper {kind.__name__}, which may change rewards, observations or actions"
        check(harmless, f"{message}: the table lacks that; pass the environment without it", source=env)
        layer = layer.env


def _entries(table: Any, first: int, kind: str, source: str) -> dict[int, Any]:
    """Return the entries of a dict by whole numbers, or of a list, by number."""
    if isinstance(table, Mapping):
        message = "expected whole numbers as keys"
        return {check_whole(key, message, source): each for key, each in table.items()}
    is_list = isinstance(table, Sequence | np.ndarray) and not isinstance(table, str)
    check(is_list, f"expected {kind}, found {type(table).__name__}", source=source)
    return dict(enumerate(table, start=first))


def _outcomes(entries: Any, states: tuple[int, int], state: int, action: int) -> list[Outcome]:
    """Return the outcomes of an action that have a probability other than 0."""
    source, kind = f"state {state}, action {action}", "expected (probability, next state, reward, whether it ends)"
    is_list = isinstance(entries, Sequence) and not isinstance(entries, str)
    check(is_list, f"expected a list of outcomes, found {type(entries).__name__}", source=source)
    outcomes = []
    for entry in entries:
        fits = isinstance(entry, Sequence) and not isinstance(entry, str) and len(entry) == 4
        check(fits, f"{kind}, found {entry!r}", source=source)
        probability, after, reward, ends = entry
        numbers = [_number(each, f"{kind}, found {entry!r}", source) for each in (probability, after, reward, ends)]
        if numbers[0] == 0:
            continue
        first, count = states
        inside = numbers[1].is_integer() and first <= numbers[1] < first + count
        check(inside, f"expected a next state in {first}…{first + count - 1}, found {after}", source=source)
        check(np.isfinite(numbers[2]), f"expected a finite reward, found {reward}", source=source)
        check(numbers[3] in (0, 1), f"expected whether the episode ends, found {ends!r}", source=source)
        outcomes.append(Outcome(numbers[0], int(numbers[1]) - first, numbers[2], numbers[3] == 1))
    return outcomes


def _number(value: Any, message: str, source: str) -> float:
    """Return a number, or a truth value as 0 or 1; raise `InputError` for anything else."""
    if not isinstance(value, Real | np.bool_):
        raise InputError(message, source=source)
    return float(value)


def slippery(environment: Environment, logit: float = 0.0) -> TiedModel:
    """Return a model in which all actions slip with one probability: three outcomes, the middle one intended.

    Args:
        environment: With three outcomes per action, such as `FrozenLake-v1`.
        logit: θ, the one parameter of the model; P(slip) = 2 e^θ / (1 + 2 e^θ), see `slip_of`.

    Raises:
        InputError: For something else than an environment, and one with another number of outcomes.

    Example:
        >>> import gymnasium
        >>> slip_of(slippery(from_gymnasium(gymnasium.make("FrozenLake-v1"))))  # doctest: +ELLIPSIS
        0.6666...
    """
    check_instance(environment, Environment, "environment")
    possible = np.asarray(environment.model.possible)
    message = f"expected three outcomes an action, found {possible.shape[-1]}"
    check(possible.shape[-1] == 3, message, field="environment")
    index = np.tile([0, FIXED, 0], (*possible.shape[:2], 1))
    certain = possible.sum(axis=-1) == 1
    message = "expected one or three outcomes of every action, found two"
    check((certain | possible.all(axis=-1)).all(), message, field="environment")
    index[certain] = np.where(possible[certain], FIXED, IMPOSSIBLE)
    return TiedModel(environment.model.graph, index, logit)


def slip_of(model: TiedModel) -> float:
    """Return P(slip) of a model from `slippery`.

    Args:
        model: A model from `slippery`.

    Raises:
        InputError: For another model.

    Example:
        >>> import gymnasium
        >>> slip_of(slippery(from_gymnasium(gymnasium.make("FrozenLake-v1")), logit=0.0))  # doctest: +ELLIPSIS
        0.6666...
    """
    check_instance(model, TiedModel, "model")
    count = len(model.parameters)
    check(count == 1, f"expected a model from `slippery`, with one parameter, found {count}", field="model")
    odds = 2 * float(jnp.exp(model.parameters[0]))
    return odds / (1 + odds)
