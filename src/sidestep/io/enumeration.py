"""States of a Gymnasium environment without a table, found by trying every action in each.

The search is breadth first, from the states that `reset` gives. Every state is a copy of the environment that can be
stepped, and a *key*, which tells states apart. Without `samples`, every action must have one outcome, and one that
draws random numbers is refused. With `samples`, every action is tried that many times, each time with other random
numbers; the fractions estimate the probabilities of its outcomes.

A key must tell all that decides what follows. Where it leaves something out (how many steps were taken, what is out of
sight), the same state may have different outcomes. So in environments without randomness each state that is reached
again is tried again, once, and must do the same; and so must all states along a random walk.
"""

import copy
import gc
import pickle
import random
import reprlib
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable, Sequence
from functools import partial
from math import isfinite, nan
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from sidestep.errors import (
    InputError,
    check,
    check_count,
    check_function,
    describe,
    input_errors,
    to_count,
    to_list,
)
from sidestep.io import environments
from sidestep.io.environments import Environment, Outcome, check_runs, environment_of, numbers_of
from sidestep.io.keys import Key, key_of, observation_key
from sidestep.tabular.tasks import check_discount

GetState = Callable[[Any], Any]
"""Returns the state of an environment, as something that `SetState` takes and that later steps do not change."""
SetState = Callable[[Any, Any], object]
"""Sets the state of an environment."""
_WALK = 2_000
"""The smallest number of steps of the random walk that is checked."""
_GENERATORS = np.random.Generator, np.random.RandomState, random.Random
_ENDS = *_GENERATORS, type, ModuleType, FunctionType
"""What the search for generators does not look into as it does into objects and containers."""


def enumerate_env(
    env: Any,
    discount: float = 0.99,
    *,
    key: Key = observation_key,
    get_state: GetState | None = None,
    set_state: SetState | None = None,
    samples: int | None = None,
    seeds: Sequence[int] = (0,),
    limit: int = 10_000,
) -> Environment:
    """Return the model and the task of an environment without a table, by trying every action in each state.

    Args:
        env: A Gymnasium environment with finitely many states and `Discrete` actions. Wrappers count: a wrapped reward
            is paid. Time limits count as truncation: they end nothing.
        discount: γ in (0, 1].
        key: The key of the present state; by default the observation, which must then tell all that decides what
            follows.
        get_state: Returns the state of the environment; by default `copy.deepcopy` of all of it stands for its state.
        set_state: Sets it.
        samples: The number of tries of each action, at least 1; probabilities are the fractions of tries, with a
            standard error of √(p(1 − p)/samples), and outcomes that no try had are missing. None refuses actions that
            draw random numbers, and tries the others once or twice.
        seeds: Of the resets that give the first states.
        limit: The largest number of states.

    Returns:
        With the keys of all states in `labels`; state 0 is that of the first reset. A copy of `env` takes the steps;
        with `set_state` it is `env` itself, which has to be reset before it is used again.

    Raises:
        InputError: For an environment of several agents or with other actions, more states than `limit`, an action
            that draws random numbers (without `samples`), a reward that is not finite, a key that leaves out what
            decides what follows, and seeds or functions that are none.

    Notes:
        Random numbers are looked for in NumPy's and Python's generators that the environment and its wrappers hold, in
        attributes, containers and closures. Each try gives them other seeds, so that results are the same in each run.
        Those of the whole process (`np.random.seed`) are not seen: they go on from try to try.

    Example:
        >>> import gymnasium
        >>> made = enumerate_env(
        ...     gymnasium.make("FrozenLake-v1", is_slippery=False),
        ...     get_state=lambda env: env.unwrapped.s,
        ...     set_state=lambda env, state: setattr(env.unwrapped, "s", state),
        ...     samples=1,  # the lake draws a random number even where it has no use for one
        ... )
        >>> made.labels[:5], made.model.graph.states
        ((0, 4, 1, 8, 5), 16)
    """
    check_discount(discount)
    check_runs(env)
    check_count(limit, 1, "limit")
    if samples is not None:
        check_count(samples, 1, "samples")
    own_seeds = [to_count(seed, f"seeds[{place}]", 0) for place, seed in enumerate(to_list(seeds, object, "seeds"))]
    check_function(key, "key")
    for function, field in ((get_state, "get_state"), (set_state, "set_state")):
        if function is not None:
            check_function(function, field)
    both = (get_state is None) == (set_state is None)
    check(both, "expected both of get_state and set_state, or neither", field="get_state, set_state")
    actions = numbers_of(getattr(env, "action_space", None))
    message = f"expected Discrete actions, found {getattr(env, 'action_space', None)}"
    if actions is None:
        raise InputError(message, source=env, field="action_space")
    states = _copies() if get_state is None or set_state is None else _settings(env, get_state, set_state)
    starts = [_start(states, states.begin(env), key, seed) for seed in own_seeds]
    step = _stepper(states, key, actions[0])
    attempt = _attempts(states, step, actions[0], samples)
    rows, numbers = _explore(starts, attempt, actions[1], 2 if samples is None else 1, limit)
    if samples is None:
        walker = states.begin(env)
        begin = [partial(_start, states, walker, key, seed) for seed in own_seeds]
        _check_walk(begin, lambda label, state, action: step(label, states.proceed(state), action), rows, numbers)
    first = {numbers[label] for label, _ in starts}
    return environment_of(rows, actions[1], discount, first)._replace(labels=tuple(numbers), samples=samples)


class _States(NamedTuple):
    """How states are kept.

    Attributes:
        begin: Returns an environment to reset.
        take: Returns the state of an environment.
        resume: Returns an environment in a state, and its generators; the state can be resumed again.
        proceed: Returns an environment in a state that is not resumed again.
    """

    begin: Callable[[Any], Any]
    take: Callable[[Any], Any]
    resume: Callable[[Any], tuple[Any, list[Any]]]
    proceed: Callable[[Any], Any]


class _Step(NamedTuple):
    """What followed an action: key of the state, reward, whether the episode ended or was truncated, and the state."""

    label: Hashable
    reward: float
    ends: bool
    truncated: bool
    state: Any


def _copies() -> _States:
    """Return states that are copies of the environment."""

    def copied(env: Any) -> tuple[Any, list[Any]]:
        # after `deepcopy`, the values of the memo are the copies of all objects that the environment holds
        copies: dict[int, Any] = {}
        advice = "the environment cannot be copied; pass get_state and set_state"
        with input_errors(advice, TypeError, NotImplementedError, copy.Error, source=env):
            made = copy.deepcopy(env, copies)
        return made, [*_generators_held_by(made), *_generators(copies.values())]

    return _States(lambda env: copied(env)[0], lambda env: env, copied, lambda env: env)


def _settings(env: Any, get_state: GetState, set_state: SetState) -> _States:
    """Return states that are set in the one environment there is."""

    def resume(state: Any) -> tuple[Any, list[Any]]:
        set_state(env, state)
        return env, _generators_held_by(env)

    return _States(lambda env: env, get_state, resume, lambda state: resume(state)[0])


def _generators(values: Iterable[Any]) -> list[Any]:
    # the operating system's numbers have no state to compare or to set
    own = (each for each in values if isinstance(each, _GENERATORS))
    return [each for each in own if not isinstance(each, random.SystemRandom)]


def _generators_held_by(env: Any) -> list[Any]:
    """Return the generators that an environment holds, however deep in attributes, containers and closures."""
    seen: dict[int, Any] = {}
    generators: list[Any] = []
    waiting = [env]
    while waiting:
        fresh = {key: each for key, each in zip(map(id, waiting), waiting, strict=True) if key not in seen}
        seen |= fresh
        # by type, as there may be thousands of objects, and every try looks at each
        ends = {kind for kind in set(map(type, fresh.values())) if issubclass(kind, _ENDS)}
        last = [each for each in fresh.values() if type(each) in ends]
        generators += _generators(last)
        inner = [each for each in fresh.values() if type(each) not in ends]
        # of a function its closure and defaults only: its globals hold all of its module
        functions = [each for each in last if isinstance(each, FunctionType)]
        inner += [part for each in functions for part in (each.__closure__, each.__defaults__, each.__kwdefaults__)]
        # what the garbage collector does not track, such as numbers and texts, holds nothing
        waiting = list(filter(gc.is_tracked, gc.get_referents(*inner)))
    return generators


def _start(states: _States, env: Any, key: Key, seed: int) -> tuple[Hashable, Any]:
    """Return the key and the state after a reset."""
    observation = environments.reset(env, seed)
    return key_of(key, env, observation), states.take(env)


def _stepper(states: _States, key: Key, first_action: int) -> Callable[[Hashable, Any, int], _Step]:
    """Return the function from a key, an environment in its state and an action to what follows."""

    def step(label: Hashable, env: Any, action: int) -> _Step:
        observation, reward, ends, truncated = environments.step(env, action + first_action)
        number = _as_number(reward)
        if not isfinite(number):
            message = f"expected a finite number, found {describe(reward)}"
            raise InputError(message, source=_place(label, action + first_action), field="reward")
        return _Step(key_of(key, env, observation), number, ends, truncated, states.take(env))

    return step


def _attempts(
    states: _States, step: Callable[[Hashable, Any, int], _Step], first_action: int, samples: int | None
) -> Callable[[Hashable, Any, int], list[_Step]]:
    """Return the function from a key, a state and an action to what follows, once or in every sample."""
    seeds = np.random.default_rng(0)

    def attempt(label: Hashable, state: Any, action: int) -> list[_Step]:
        if samples is None:
            env, generators = states.resume(state)
            before = pickle.dumps(generators)
            only = step(label, env, action)
            message = "the action draws random numbers: expected a number of tries to estimate probabilities from"
            source = _place(label, action + first_action)
            check(pickle.dumps(generators) == before, f"{message}, found none", source=source, field="samples")
            return [only]
        steps = []
        for _ in range(samples):
            env, generators = states.resume(state)
            for generator in generators:
                _seed(generator, int(seeds.integers(2**32)))
            steps.append(step(label, env, action))
        return steps

    return attempt


def _place(label: Hashable, action: int) -> str:
    return f"state {reprlib.repr(label)}, action {action}"


def _as_number(reward: Any) -> float:
    """Return a reward, or a truth value as 0 or 1; NaN for what is not a number."""
    try:
        return nan if isinstance(reward, str | bytes) else float(reward)
    except (TypeError, ValueError):
        return nan


def _seed(generator: Any, seed: int) -> None:
    if isinstance(generator, np.random.Generator):
        generator.bit_generator.state = type(generator.bit_generator)(seed).state
    else:
        generator.seed(seed)


def _explore(
    starts: Sequence[tuple[Hashable, Any]],
    attempt: Callable[[Hashable, Any, int], list[_Step]],
    actions: int,
    visits: int,
    limit: int,
) -> tuple[list[dict[int, list[Outcome]]], dict[Hashable, int]]:
    """Return the outcomes of every action of each state, and the number of each key; tries a state `visits` times."""
    numbers: dict[Hashable, int] = {}
    rows: dict[int, dict[int, list[Outcome]]] = {}
    arrivals: Counter[int] = Counter()
    waiting: deque[tuple[Hashable, Any]] = deque()

    def number_of(label: Hashable) -> int:
        message = f"expected at most {limit} states, found more; pass a coarser key or a larger limit"
        check(label in numbers or len(numbers) < limit, message, field="limit")
        return numbers.setdefault(label, len(numbers))

    def arrive(label: Hashable, state: Any) -> None:
        number = number_of(label)
        if arrivals[number] < visits:
            arrivals[number] += 1
            waiting.append((label, state))

    for label, state in starts:
        arrive(label, state)
    while waiting:
        label, state = waiting.popleft()
        row: dict[int, list[Outcome]] = {}
        for action in range(actions):
            steps = attempt(label, state, action)
            counts = Counter((number_of(each.label), each.reward, each.ends) for each in steps)
            row[action] = [Outcome(count / len(steps), *outcome) for outcome, count in counts.items()]
            for each in steps:
                if not each.ends:
                    arrive(each.label, each.state)
        if numbers[label] in rows:
            for action, (outcome, *_) in rows[numbers[label]].items():
                _check_same(label, action, outcome, row[action][0])
        rows.setdefault(numbers[label], row)
    return [rows.get(number, {}) for number in range(len(numbers))], numbers


def _check_walk(
    begin: Sequence[Callable[[], tuple[Hashable, Any]]],
    step: Callable[[Hashable, Any, int], _Step],
    rows: Sequence[dict[int, list[Outcome]]],
    numbers: dict[Hashable, int],
) -> None:
    """Raise `InputError` unless the states along a random walk do what `rows` says, without randomness."""
    draws, place = np.random.default_rng(0), None
    for _ in range(max(_WALK, 2 * sum(len(row) for row in rows))):
        label, state = begin[int(draws.integers(len(begin)))]() if place is None else place
        row = rows[numbers[label]]
        action = int(draws.integers(len(row)))
        done = step(label, state, action)
        _check_same(label, action, row[action][0], Outcome(1.0, numbers.get(done.label, -1), done.reward, done.ends))
        place = None if done.ends or done.truncated else (done.label, done.state)


def _check_same(label: Hashable, action: int, one: Outcome, other: Outcome) -> None:
    """Raise `InputError` unless an action did the same when it was tried again."""
    same = one[1::2] == other[1::2] and np.isclose(one.reward, other.reward)
    message = f"expected a key that tells all that decides what follows, found {one[1:]} and then {other[1:]}"
    check(same, f"{message} (state, reward, whether it ends)", source=_place(label, action))
