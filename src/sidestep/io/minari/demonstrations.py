"""Demonstrations in discrete worlds as Minari datasets, and datasets of discrete spaces as demonstrations.

Observations are states, and actions are numbered as in the model; `sidestep.io.minari.tasks` describes the metadata of
tasks. The reward of a move (s, a, s′) is R(s, a), plus γ times the terminal reward of s′ if s′ is terminal. The return
Σ γ^t r_t of an episode is then that of the task, and the rewards are on average those of the Gymnasium environment.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from sidestep.errors import InputError, check
from sidestep.io.minari.datasets import Dataset, Episode, read_dataset, require_minari, write_dataset
from sidestep.io.minari.tasks import best_terminal_states, describe_tasks, tasks_of_episodes, world_size
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import Task

_NO_ENDS: Mapping[int, int] = {}


def write_demonstrations(
    dataset: str, demonstrations: Demonstrations[Task], world: Grid | Graph, *, ends: Mapping[int, int] = _NO_ENDS
) -> None:
    """Write demonstrations and their tasks as a local Minari dataset atomically.

    Args:
        dataset: a new id, such as `"office/walks-v0"`.
        demonstrations: in `world`.
        world: gives the numbers of states and actions.
        ends: `Environment.ends` of a Gymnasium environment with separate states for ends of episodes; they are written
            as the environment's states.

    Raises:
        InputError: for an id that is malformed or exists already, demonstrations in another world, and for moves of a
            trajectory that do not start where the move before has ended.

    Example:
        >>> write_demonstrations("office/walks-v0", demonstrations, grid)  # doctest: +SKIP
    """
    require_minari(dataset)
    from gymnasium.spaces import Discrete

    states, actions = world_size(world)
    own_states, last_action = demonstrations.tasks.terminal.shape[-1], np.asarray(demonstrations.actions).max()
    if own_states != states or last_action >= actions:
        expected = f"expected demonstrations in a world of {states} states and {actions} actions"
        message = f"{expected}, found {own_states} states and action {last_action}"
        raise InputError(message, field="demonstrations")
    tasks = describe_tasks(demonstrations.tasks)
    episodes = list(_episodes(demonstrations, tasks, (states, actions), ends))
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
    """Return the demonstrations in a local Minari dataset with whole numbers as observations and actions.

    Args:
        dataset: its id, or its path.
        world: gives the numbers of states and actions.
        task: of all episodes; by default the task in the metadata of each.
        discount: of episodes that have a goal but no discount in their metadata.
        step_cost: of episodes that have only goal and discount in their metadata, as in `reach`.
        ends: as in `write_demonstrations`.

    Raises:
        InputError: for a dataset that does not exist, is broken or empty, or has other spaces than the world, and,
            naming the episode and the field, for lengths that do not fit, states and actions outside the spaces, an
            episode that continues after a terminal state, and a task that is missing or not of this world.

    Example:
        >>> demonstrations = read_demonstrations("office/walks-v0", grid)  # doctest: +SKIP
    """
    states, actions = world_size(world)

    def check_spaces(observation_space: object, action_space: object) -> None:
        _check_space(observation_space, states - len(ends), dataset, "observation_space")
        _check_space(action_space, actions, dataset, "action_space")

    stored = read_dataset(dataset, check_spaces)
    if task is None:
        tasks, indices = tasks_of_episodes(stored, dataset, world, discount, step_cost)
    elif task.terminal.shape == (states,):
        tasks, indices = [task], [0] * len(stored.episodes)
    else:
        raise InputError(f"expected one task of {states} states, found {task.terminal.shape}", field="task")
    trajectories = [
        _trajectory(episode, index, states - len(ends), actions, ends)
        for episode, index in zip(stored.episodes, indices, strict=True)
    ]
    try:
        return gather(trajectories, tasks)
    except InputError as error:
        raise error.of(dataset if error.row is None else stored.episodes[error.row - 1].source) from error


def _episodes(
    demonstrations: Demonstrations[Task], tasks: list[dict], size: tuple[int, int], ends: Mapping[int, int]
) -> Iterator[Episode]:
    """Yield the episode of each trajectory; `tasks` describes each task, `size` counts states and actions."""
    origin = {own: state for state, own in ends.items()}
    before, after = np.asarray(demonstrations.states), np.asarray(demonstrations.next_states)
    acted, task = np.asarray(demonstrations.actions), np.asarray(demonstrations.task)
    rewards = _rewards(demonstrations, *size)
    ended = np.asarray(demonstrations.tasks.terminal)[task, after]
    trajectory = np.asarray(demonstrations.trajectory)
    for moves in np.split(np.arange(len(trajectory)), np.flatnonzero(np.diff(trajectory)) + 1):
        first, last = moves[0], moves[-1]
        if (after[moves[:-1]] != before[moves[1:]]).any() or (task[moves] != task[first]).any():
            message = "expected moves that each start where the one before ended, and one task"
            raise InputError(message, source="trajectory", row=int(trajectory[first]) + 1)
        end = origin.get(int(after[last]), int(after[last]))
        path = np.append(before[moves], end).astype(np.int64)
        entry = tasks[task[first]]
        goals = best_terminal_states(entry)
        metadata = {"task": int(task[first]), "discount": entry["discount"]}
        metadata |= {"goal": goals[0] if len(goals) == 1 else goals} if goals else {}
        yield Episode(path, acted[moves].astype(np.int64), rewards[moves], bool(ended[last]), {}, metadata)


def _rewards(demonstrations: Demonstrations[Task], states: int, actions: int) -> Float[np.ndarray, " moves"]:
    """Return the reward of each move: R(s, a), plus γ times the terminal reward if the move ends the task."""
    tasks, task = demonstrations.tasks, np.asarray(demonstrations.task)
    number, after = len(tasks.discount), np.asarray(demonstrations.next_states)
    reward = np.broadcast_to(np.asarray(tasks.reward, dtype=np.float64), (number, states, actions))
    terminal_reward = np.broadcast_to(np.asarray(tasks.terminal_reward, dtype=np.float64), (number, states))
    paid = reward[task, np.asarray(demonstrations.states), np.asarray(demonstrations.actions)]
    at_end = np.asarray(tasks.terminal)[task, after] * terminal_reward[task, after]
    return paid + np.asarray(tasks.discount, dtype=np.float64)[task] * at_end


def _trajectory(episode: Episode, task: int, states: int, actions: int, ends: Mapping[int, int]) -> Trajectory:
    moves = len(episode.rewards)
    path = _within(episode.observations, moves + 1, states, episode.source, "observations")
    acted = _within(episode.actions, moves, actions, episode.source, "actions")
    if episode.terminated:
        path[-1] = ends.get(int(path[-1]), int(path[-1]))
    return Trajectory(path, acted, task)


def _within(values: object, length: int, count: int, source: str, field: str) -> Int[np.ndarray, " length"]:
    """Return whole numbers in 0…count − 1, one for each move or observation."""
    numbers = np.asarray(values)
    message = f"expected {length} whole numbers, found {numbers.dtype} of shape {numbers.shape}"
    check(numbers.shape == (length,) and numbers.dtype.kind in "iu", message, source=source, field=field)
    outside = (numbers < 0) | (numbers >= count)
    if outside.any():
        step = int(np.argmax(outside))
        message = f"expected a whole number in 0…{count - 1}, found {numbers[step]} at step {step}"
        raise InputError(message, source=source, field=field)
    return numbers.astype(np.int64)


def _check_space(space: object, count: int, dataset: str | Path, field: str) -> None:
    from gymnasium.spaces import Discrete

    fits = isinstance(space, Discrete) and space.n == count and space.start == 0
    check(fits, f"expected Discrete({count}), as the world has, found {space}", source=dataset, field=field)
