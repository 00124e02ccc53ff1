"""Minari datasets as others make them, by Minari alone, and walks on a small grid to write."""

import itertools
import re
import warnings

import minari
import numpy as np
import pytest
from gymnasium.spaces import Discrete, Space
from minari.data_collector import EpisodeBuffer

from sidestep.errors import InputError
from sidestep.io.minari.demonstrations import read_demonstrations
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import reach

SPACES = Discrete(6), Discrete(4)
GRID = Grid.unknown(2, 3)
_NUMBERS = itertools.count()


def towards(*goals, discount=0.95):
    """One walk from cell 0 along the top of the grid towards each goal, each of a task of its own."""
    walks = [Trajectory(np.array([0, 1, 2]), np.array([3, 3]), index) for index in range(len(goals))]
    return gather(walks, [reach(GRID, goal, discount=discount) for goal in goals])


def refused(dataset, message, world=GRID, **arguments):
    """Reading a dataset raises an error that begins with the dataset, and then says this."""
    with pytest.raises(InputError, match=f"^{re.escape(str(dataset))}{message}"):
        read_demonstrations(dataset, world, **arguments)


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
