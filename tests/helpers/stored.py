"""Minari datasets as others make them, by Minari alone."""

import itertools
import warnings

import minari
import numpy as np
from gymnasium.spaces import Space
from minari.data_collector import EpisodeBuffer

_NUMBERS = itertools.count()


def fresh(name: str = "others/seen") -> str:
    """An id that is free."""
    return f"{name}-v{next(_NUMBERS)}"


def buffer(observations, actions, **other) -> EpisodeBuffer:
    """An episode that ended, and paid nothing."""
    moves = len(actions)
    ended = np.arange(moves) == moves - 1
    fields = {"rewards": np.zeros(moves), "terminations": ended, "truncations": ~ended & False, **other}
    return EpisodeBuffer(observations=observations, actions=actions, **fields)


def store(spaces: tuple[Space, Space], *episodes: EpisodeBuffer, metadata=(), data_format="hdf5") -> str:
    """The id of a dataset with these spaces (observations, actions), episodes, and metadata of episodes."""
    dataset = fresh()
    with warnings.catch_warnings():  # Minari warns of every author and environment that is missing.
        warnings.simplefilter("ignore", UserWarning)
        made = minari.create_dataset_from_buffers(
            dataset, list(episodes), observation_space=spaces[0], action_space=spaces[1], data_format=data_format
        )
    made.storage.update_episode_metadata(metadata, range(len(metadata)))
    return dataset
