"""Demonstrations in discrete worlds as Minari datasets, and datasets of discrete spaces as demonstrations.

Observations are states, and actions are numbered as in the model; `sidestep.io.minari.tasks` says what the metadata
tell of tasks. A move (s, a, s′) pays R(s, a), and γ times the final reward of s′ where s′ is terminal: then the return
Σ γ^t r_t of an episode is what the task pays, and the rewards of a Gymnasium environment are its own on average.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from sidestep.errors import InputError
from sidestep.io.minari.datasets import Dataset, Episode, read_dataset, require_minari, write_dataset
from sidestep.io.minari.tasks import described, goals, pursued, size_of
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import Task

_NO_ENDS: Mapping[int, int] = {}


def write_demonstrations(
    dataset: str,
    demonstrations: Demonstrations[Task],
    world: Grid | Graph,
    *,
    ends: Mapping[int, int] = _NO_ENDS,
) -> None:
    """Write demonstrations, with the tasks they pursue, as a local Minari dataset, whole or not at all.

    - `dataset`: a free id, such as `"office/people-v0"`.
    - `ends`: `Environment.ends` of a Gymnasium environment whose ends have states of their own: they are written as the
      environment's states.

    Raises `InputError` for an id that is malformed or taken, demonstrations in another world, and for trajectories that
    do not go on where they stopped.

    >>> write_demonstrations("office/people-v0", demonstrations, grid)  # doctest: +SKIP
    """
    require_minari(dataset)
    from gymnasium.spaces import Discrete

    states, actions = size_of(world)
    found = demonstrations.tasks.terminal.shape[-1]
    if found != states or np.asarray(demonstrations.actions).max() >= actions:
        message = f"expected demonstrations in a world of {states} states and {actions} actions, found {found} states"
        raise InputError(f"{message} and action {np.asarray(demonstrations.actions).max()}", field="demonstrations")
    tasks = described(demonstrations.tasks)
    episodes = list(_episodes(demonstrations, states, actions, {own: state for state, own in ends.items()}))
    told = [{**episode.metadata, **_told_of(tasks[episode.metadata["task"]])} for episode in episodes]
    episodes = [episode._replace(metadata=metadata) for episode, metadata in zip(episodes, told, strict=True)]
    write_dataset(dataset, Dataset(Discrete(states - len(ends)), Discrete(actions), {"tasks": tasks}, episodes))


def read_demonstrations(
    dataset: str | Path,
    world: Grid | Graph,
    *,
    task: Task | None = None,
    discount: float | None = None,
    step_cost: float | None = None,
    ends: Mapping[int, int] = _NO_ENDS,
) -> Demonstrations[Task]:
    """Demonstrations from a local Minari dataset whose observations and actions are whole numbers.

    - `dataset`: its id, or the path of one that lies elsewhere.
    - `task`: what all episodes pursue; by default what their metadata tell.
    - `discount`: of episodes whose metadata tell a goal and no discount. `step_cost`: as in `reach`, of episodes whose
      metadata tell no more than goal and discount.
    - `ends`: as in `write_demonstrations`.

    Raises `InputError` for a dataset that is not there, broken or empty, or has other spaces than the world, and,
    naming the episode and the field, for lengths that do not fit, states and actions outside the spaces, an episode
    that goes on after a terminal state, and a task that is missing or not of this world.

    >>> demonstrations = read_demonstrations("office/people-v0", grid)  # doctest: +SKIP
    """
    states, actions = size_of(world)

    def check_spaces(observed: object, done: object) -> None:
        _check_space(observed, states - len(ends), dataset, "observation_space")
        _check_space(done, actions, dataset, "action_space")

    found = read_dataset(dataset, check_spaces)
    if task is None:
        tasks, own = pursued(found, dataset, world, discount, step_cost)
    elif task.terminal.shape == (states,):
        tasks, own = [task], [0] * len(found.episodes)
    else:
        raise InputError(f"expected one task of {states} states, found {task.terminal.shape}", field="task")
    walked = [
        _trajectory(episode, states - len(ends), actions, ends)._replace(task=index)
        for episode, index in zip(found.episodes, own, strict=True)
    ]
    try:
        return gather(walked, tasks)
    except InputError as error:
        raise error.of(dataset if error.row is None else found.episodes[error.row - 1].source) from error


def _episodes(
    demonstrations: Demonstrations[Task], states: int, actions: int, origin: Mapping[int, int]
) -> Iterator[Episode]:
    """The episode of each trajectory; `origin` has the environment's state for each end with a state of its own."""
    before, after = np.asarray(demonstrations.states), np.asarray(demonstrations.next_states)
    done, task = np.asarray(demonstrations.actions), np.asarray(demonstrations.task)
    rewards = _rewards(demonstrations, states, actions)
    ended = np.asarray(demonstrations.tasks.terminal)[task, after]
    trajectory = np.asarray(demonstrations.trajectory)
    for moves in np.split(np.arange(len(trajectory)), np.flatnonzero(np.diff(trajectory)) + 1):
        first, last = moves[0], moves[-1]
        if (after[moves[:-1]] != before[moves[1:]]).any() or (task[moves] != task[first]).any():
            message = "expected moves that each start where the last one led, towards one task"
            raise InputError(message, source="trajectory", row=int(trajectory[first]) + 1)
        end = origin.get(int(after[last]), int(after[last]))
        path = np.append(before[moves], end).astype(np.int64)
        metadata = {"task": int(task[first])}
        yield Episode(path, done[moves].astype(np.int64), rewards[moves], bool(ended[last]), {}, metadata)


def _rewards(demonstrations: Demonstrations[Task], states: int, actions: int) -> Float[np.ndarray, " moves"]:
    """What each move pays: R(s, a), and γ times the final reward where it ends the task."""
    tasks, task = demonstrations.tasks, np.asarray(demonstrations.task)
    number, after = len(tasks.discount), np.asarray(demonstrations.next_states)
    acting = np.broadcast_to(np.asarray(tasks.reward, dtype=np.float64), (number, states, actions))
    final = np.broadcast_to(np.asarray(tasks.terminal_reward, dtype=np.float64), (number, states))
    paid = acting[task, np.asarray(demonstrations.states), np.asarray(demonstrations.actions)]
    ending = np.asarray(tasks.terminal)[task, after] * final[task, after]
    return paid + np.asarray(tasks.discount, dtype=np.float64)[task] * ending


def _told_of(entry: Mapping) -> dict:
    """What an episode's metadata tell of its task."""
    own = goals(entry)
    return {"discount": entry["discount"]} | ({"goal": own[0] if len(own) == 1 else own} if own else {})


def _trajectory(episode: Episode, states: int, actions: int, ends: Mapping[int, int]) -> Trajectory:
    moves = len(episode.rewards)
    path = _within(episode.observations, moves + 1, states, episode.source, "observations")
    done = _within(episode.actions, moves, actions, episode.source, "actions")
    if episode.terminated:
        path[-1] = ends.get(int(path[-1]), int(path[-1]))
    return Trajectory(path, done, 0)


def _within(values: object, length: int, count: int, source: str, field: str) -> Int[np.ndarray, " length"]:
    """Whole numbers in 0…count − 1, one for each move or observation."""
    numbers = np.asarray(values)
    if numbers.shape != (length,) or numbers.dtype.kind not in "iu":
        message = f"expected {length} whole numbers, found {numbers.dtype} of shape {numbers.shape}"
        raise InputError(message, source=source, field=field)
    outside = (numbers < 0) | (numbers >= count)
    if outside.any():
        step = int(np.argmax(outside))
        message = f"expected a whole number in 0…{count - 1}, found {numbers[step]} at step {step}"
        raise InputError(message, source=source, field=field)
    return numbers.astype(np.int64)


def _check_space(space: object, count: int, dataset: str | Path, field: str) -> None:
    from gymnasium.spaces import Discrete

    if not (isinstance(space, Discrete) and space.n == count and space.start == 0):
        raise InputError(f"expected Discrete({count}), as the world is, found {space}", source=dataset, field=field)
