"""Keys: what tells the states of an environment apart where they have no numbers."""

from collections.abc import Callable, Hashable, Mapping
from typing import Any

import numpy as np

from sidestep.errors import InputError

Key = Callable[[Any, Any], Hashable]
"""Returns the key of the present state of an environment, from `env.unwrapped` and the observation."""


def observation_key(env: Any, observation: Any) -> Hashable:
    """Return the observation as nested tuples, numbers and text: states that look the same are the same.

    Args:
        env: Not used.
        observation: A number, text, an array, or a dict or sequence of these.

    Example:
        >>> observation_key(None, {"direction": 0, "image": np.array([[1, 2]])})
        (('direction', 0), ('image', ((1, 2),)))
    """
    if isinstance(observation, Mapping):
        return tuple((name, observation_key(env, observation[name])) for name in sorted(observation))
    if isinstance(observation, np.ndarray | np.generic):
        return observation_key(env, observation.tolist())
    if isinstance(observation, list | tuple):
        return tuple(observation_key(env, each) for each in observation)
    return observation


def key_of(key: Key, env: Any, observation: Any) -> Hashable:
    """Return the key of the present state of an environment; raise `InputError` for one that cannot be compared.

    Args:
        key: The function.
        env: The environment; the function gets `env.unwrapped`.
        observation: Of the present state.
    """
    label = key(getattr(env, "unwrapped", env), observation)
    try:
        hash(label)
    except TypeError as error:
        message = f"expected a number, text or tuple that tells states apart, found {type(label).__name__}"
        raise InputError(message, field="key") from error
    return label
