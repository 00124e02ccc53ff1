"""Minari datasets on this machine: read episode by episode, and written atomically.

A dataset has an id, `NAME-vVERSION` or `NAMESPACE/NAME-vVERSION`, under which Minari keeps it in the folder that
`MINARI_DATASETS_PATH` names (by default `~/.minari/datasets`). The name of a dataset elsewhere is its path: a `Path`,
or text that is not an id, such as `./office-v0`. Nothing is ever downloaded.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from sidestep._files import write_whole_folder
from sidestep.errors import InputError, SidestepError, check

Metadata = Mapping[str, Any]
"""Data about an episode or a dataset, by name."""
_ID = re.compile(r"(?:(?P<namespace>[-\w]+(?:/[-\w]+)*)/)?[-\w]+?(?P<version>-v\d+)?")


class Episode(NamedTuple):
    """One episode: observations, and the actions and rewards between them.

    Attributes:
        observations: An array, or several by name, with one row more than there are moves.
        actions: One per move.
        rewards: One per move.
        terminated: Whether the episode ended in a terminal state; otherwise it was truncated.
        infos: Other data of each observation.
        metadata: Other data of the whole episode.
        source: The dataset and Minari's number of the episode (the first is 0), for error messages.
    """

    observations: Any
    actions: Any
    rewards: Float[np.ndarray, " moves"]
    terminated: bool
    infos: Mapping[str, Any]
    metadata: Metadata
    source: str = ""


def require_minari(dataset: str | Path) -> None:
    """Raise `InputError` if the library Minari is not installed.

    Args:
        dataset: The name of the dataset, for the error.
    """
    message = "a Minari dataset, but Minari is not installed: expected pip install 'sidestep[minari]' to have run"
    check(find_spec("minari") is not None, message, source=dataset)


def read_dataset(dataset: str | Path, check_spaces: Callable[[Any, Any], None]) -> tuple[Metadata, list[Episode]]:
    """Return the metadata of a dataset on this machine, and its episodes, at least one.

    Args:
        dataset: Its id or its path.
        check_spaces: Is called with the spaces of observations and actions before any episode is read, and raises
            `InputError` for wrong ones (images would fill the memory).

    Raises:
        InputError: For a dataset that does not exist, is broken or empty, and for an episode without a move or with
            another number of observations than one more than its moves.
    """
    require_minari(dataset)
    with _input_errors(dataset, "read"):
        from minari import MinariDataset
        from minari.storage import get_dataset_path

        folder = get_dataset_path(dataset) if isinstance(dataset, str) and _ID.fullmatch(dataset) else Path(dataset)
        data = folder / "data" if (folder / "data").is_dir() else folder
        message = "there is no such dataset here: expected one that `minari list local` shows, or the path of one"
        check((data / "metadata.json").is_file(), message, source=dataset)
        opened = MinariDataset(data)
        check_spaces(opened.observation_space, opened.action_space)
        check(len(opened), "expected at least one episode, found none", source=dataset)
        stored = list(zip(opened, opened.storage.get_episode_metadata(opened.episode_indices), strict=True))
        return opened.storage.metadata, [_episode(dataset, episode, metadata) for episode, metadata in stored]


def write_dataset(dataset: str, spaces: tuple[Any, Any], episodes: Sequence[Episode], metadata: Metadata) -> None:
    """Write a dataset under an id atomically.

    Args:
        dataset: A new id with a version, such as `office/walks-v0`.
        spaces: Gymnasium's spaces of the observations and of the actions.
        episodes: At least one.
        metadata: Of the whole dataset.

    Raises:
        InputError: For an id that is malformed or exists already, and for data that Minari cannot store.
    """
    parts = _ID.fullmatch(dataset)
    if parts is None or parts["version"] is None:
        raise InputError("expected an id with a version, such as office/walks-v0", source=dataset)

    def fill(folder: Path) -> None:
        from minari import __version__
        from minari.dataset.minari_storage import MinariStorage

        storage = MinariStorage.new(folder / "data", *spaces)
        storage.update_metadata({"dataset_id": dataset, "minari_version": __version__, **metadata})
        storage.update_episodes([_buffer(episode) for episode in episodes])
        storage.update_episode_metadata([dict(episode.metadata) for episode in episodes])

    with _input_errors(dataset, "written"):
        from minari.namespace import create_namespace, list_local_namespaces
        from minari.storage import get_dataset_path

        write_whole_folder(get_dataset_path(dataset), fill)
        if parts["namespace"] is not None and parts["namespace"] not in list_local_namespaces():
            create_namespace(parts["namespace"])


def _buffer(episode: Episode) -> Any:
    """Return Minari's buffer of an episode, which is terminated or truncated at its last move."""
    from minari.data_collector import EpisodeBuffer

    last = np.arange(len(episode.rewards)) == len(episode.rewards) - 1
    fields = {name: getattr(episode, name) for name in ("observations", "actions", "rewards")}
    ends = {"terminations": last & episode.terminated, "truncations": last & (not episode.terminated)}
    return EpisodeBuffer(**fields, **ends, infos=dict(episode.infos))


def _episode(dataset: str | Path, stored: Any, metadata: Metadata) -> Episode:
    """Return an episode from one of Minari's; raise `InputError` for one without a move, or of other lengths."""
    source, moves, observations = f"{dataset}, episode {stored.id}", len(stored.rewards), stored.observations
    check(moves != 0, "expected at least one move, found none", source=source, field="rewards")
    for name, values in _arrays(observations, "observations"):
        message = f"expected {moves + 1} observations around {moves} moves, found {len(values)}"
        check(len(values) == moves + 1, message, source=source, field=name)
    terminated = bool(stored.terminations[-1:].any())
    return Episode(observations, stored.actions, stored.rewards, terminated, stored.infos or {}, metadata, source)


def _arrays(observations: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield the name and the values of each part of observations that are dicts or tuples."""
    if isinstance(observations, Mapping | tuple):
        parts = observations.items() if isinstance(observations, Mapping) else enumerate(observations)
        for part, values in parts:
            yield from _arrays(values, str(part))
    else:
        yield name, observations


@contextmanager
def _input_errors(dataset: str | Path, purpose: Literal["read", "written"]) -> Iterator[None]:
    """Turn all errors of Minari, its formats and their libraries (even assertions) into `InputError`."""
    try:
        yield
    except SidestepError:
        raise
    except Exception as error:
        raise InputError(f"the dataset cannot be {purpose}: {type(error).__name__}: {error}", source=dataset) from error
