"""Demonstrations in discrete worlds as Minari datasets, and datasets of discrete spaces as demonstrations.

Observations are states, and actions are numbered as in the model; `Discrete` spaces that start at another number are
shifted to 0. The reward of a move (s, a, s′) is R(s, a) + R(s, a, s′), plus γ times the terminal reward of s′ if s′ is
terminal. The return Σ γ^t r_t of an episode is then that of the task. Where several outcomes of an action lead to s′,
R(s, a, s′) is their mean.

Complete tasks are in the metadata, so that a dataset suffices for learning. The metadata of the dataset have `tasks`,
one entry per task (`task_entries`). The metadata of each episode have `goal` (the terminal state that pays most on
arrival, or a list of several), `discount`, and `task`, the number of its entry. In a dataset without `tasks`, the task
of each episode is to reach its `goal` at its `discount`, as in `reach`. Weights other than 1 are in `infos`, as
`move_weight`, beside the observation after each move. Minari calls every episode truncated that is not terminated;
`walk_truncated` in the metadata of an episode says whether a limit of moves stopped the agent, and `walk_person`, where
persons are told apart, the number of its person.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.errors import InputError, check, check_instance, describe, to_number
from sidestep.io.minari import task_entries
from sidestep.io.minari.datasets import Episode, read_dataset, require_minari, write_dataset
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, flat_moves, gather
from sidestep.tabular.graph import Graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import Task, reach

StateOf = Callable[[Any], int]
"""Returns the state of an observation."""
_NO_ENDS: Mapping[int, int] = {}
_WEIGHT, _TRUNCATED, _PERSON = "move_weight", "walk_truncated", "walk_person"


def write_demonstrations(
    dataset: str, demonstrations: Demonstrations[Task], world: Grid | Graph, *, ends: Mapping[int, int] = _NO_ENDS
) -> None:
    """Write demonstrations and their tasks as a local Minari dataset atomically.

    Args:
        dataset: A new id, such as `"office/walks-v0"`.
        demonstrations: In `world`.
        world: Gives the numbers of states and actions.
        ends: `Environment.ends` of a Gymnasium environment with separate states for ends of episodes; they are written
            as the environment's states.

    Raises:
        InputError: For an id that is malformed or exists already, demonstrations in another world, and for moves of a
            trajectory that do not start where the move before has ended, or are of several tasks or persons.

    Example:
        >>> write_demonstrations("office/walks-v0", demonstrations, grid)  # doctest: +SKIP
    """
    require_minari(dataset)
    from gymnasium.spaces import Discrete

    states, actions = task_entries.world_size(world)
    check_instance(demonstrations, Demonstrations, "demonstrations")
    check_instance(demonstrations.tasks, Task, "demonstrations")
    _check_dataset(dataset, ends)
    moves = jax.tree.map(np.asarray, demonstrations)
    own_states, last_action = moves.tasks.terminal.shape[-1], moves.actions.max()
    message = f"expected demonstrations in a world of {states} states and {actions} actions"
    message += f", found {own_states} states and action {last_action}"
    check(own_states == states and last_action < actions, message, field="demonstrations")
    tasks = task_entries.entries_of(moves.tasks)
    spaces = Discrete(states - len(ends)), Discrete(actions)
    write_dataset(dataset, spaces, list(_episodes(moves, tasks, world, ends)), {"tasks": tasks})


def read_demonstrations(
    dataset: str | Path,
    world: Grid | Graph,
    *,
    task: Task | None = None,
    discount: float | None = None,
    step_cost: float | None = None,
    ends: Mapping[int, int] = _NO_ENDS,
    state_of: StateOf | None = None,
) -> Demonstrations[Task]:
    """Return the demonstrations in a local Minari dataset of `Discrete` actions, and observations that are states.

    Args:
        dataset: Its id, or its path.
        world: Gives the numbers of states and actions.
        task: Of all episodes; by default the task in the metadata of each.
        discount: Of episodes that have a goal but no discount in their metadata.
        step_cost: Of episodes that have only goal and discount in their metadata, as in `reach`.
        ends: As in `write_demonstrations`.
        state_of: Returns the state of an observation, for datasets of other observations than `Discrete` ones.

    Raises:
        InputError: For a dataset that does not exist, is broken or empty, or has other spaces than the world, and,
            naming the episode and the field, for lengths that do not fit, states and actions outside the spaces, an
            episode that continues after a terminal state, a task that is missing or not of this world, and persons of
            some episodes only.

    Example:
        >>> demonstrations = read_demonstrations("office/walks-v0", grid)  # doctest: +SKIP
    """
    states, actions = task_entries.world_size(world)
    _check_dataset(dataset, ends)
    check_instance(task, (Task, type(None)), "task")
    for value, field in ((discount, "discount"), (step_cost, "step_cost")):
        if value is not None:
            to_number(value, field, above=0)
    first: dict[str, int] = {}

    def check_spaces(*spaces: object) -> None:
        from gymnasium.spaces import Discrete

        counts = {"observation_space": states - len(ends), "action_space": actions}
        for space, (field, count) in zip(spaces, counts.items(), strict=True):
            is_seen = field == "observation_space"
            fits = (isinstance(space, Discrete) and space.n == count) or (is_seen and state_of is not None)
            advice = "; pass `state_of` for other observations" if is_seen else ""
            message = f"expected Discrete({count}), as the world has, found {space}{advice}"
            check(fits, message, source=dataset, field=field)
            first[field] = int(getattr(space, "start", 0))

    metadata, episodes = read_dataset(dataset, check_spaces)
    entries = metadata.get("tasks")
    if task is not None:
        message = f"expected one task of {states} states, found {task.terminal.shape}"
        check(task.terminal.shape == (states,), message, field="task")
        tasks, indices = [task], [0] * len(episodes)
    elif entries is not None:
        check(isinstance(entries, list) and entries, "expected a list of tasks", source=dataset, field="tasks")
        tasks = [task_entries.task_of(entry, world, f"{dataset}, task {index}") for index, entry in enumerate(entries)]
        indices = [_entry_of(episode, entries, world) for episode in episodes]
    else:
        tasks, indices = _tasks_of_goals(episodes, world, discount, step_cost)
    start = 0 if state_of is not None else first["observation_space"]
    seen = _Numbers(start, start + states - len(ends), "observations")
    acted = _Numbers(first["action_space"], first["action_space"] + actions, "actions")
    pairs = zip(episodes, indices, strict=True)
    trajectories = [_trajectory(episode, index, seen, acted, ends, state_of) for episode, index in pairs]
    try:
        gathered = gather(trajectories, tasks)
    except InputError as error:
        raise error.of(dataset if error.row is None else episodes[error.row - 1].source) from error
    weights = to_jax(np.concatenate([_weights(episode) for episode in episodes]))
    return replace(gathered, weights=weights, person=_persons(episodes))


class _Numbers(NamedTuple):
    """The numbers of states or actions in a dataset: the first, one past the last, and the field."""

    first: int
    end: int
    field: str


def _episodes(
    moves: Demonstrations[Task], tasks: list[dict], world: Grid | Graph, ends: Mapping[int, int]
) -> Iterator[Episode]:
    """Yield the episode of each trajectory; `moves` has NumPy's arrays, `tasks` describes each task."""
    origin = {own: state for state, own in ends.items()}
    rewards, weighted = _rewards(moves, world), (moves.weights != 1).any()
    goals = [task_entries.best_terminal_states(task, world) for task in tasks]
    for row, own in enumerate(np.split(np.arange(len(moves)), moves.first_moves()[1:]), start=1):
        before, after, task = moves.states[own], moves.next_states[own], moves.task[own]
        person = np.zeros(len(own), np.int64) if moves.person is None else moves.person[own]
        connected = (after[:-1] == before[1:]).all() and (task == task[0]).all() and (person == person[0]).all()
        message = "expected moves that each start where the one before ended, of one task and one person"
        check(connected, message, source="trajectory", row=row)
        index, last = int(task[0]), int(after[-1])
        path = np.append(before, origin.get(last, last)).astype(np.int64)
        acted = moves.actions[own].astype(np.int64)
        metadata = {"task": index, "discount": tasks[index]["discount"], _TRUNCATED: bool(moves.truncated[own[0]])}
        best = goals[index]
        metadata |= {"goal": best[0] if len(best) == 1 else best} if best else {}
        metadata |= {} if moves.person is None else {_PERSON: int(person[0])}
        infos = {_WEIGHT: np.append(0.0, moves.weights[own])} if weighted else {}
        yield Episode(path, acted, rewards[own], last in tasks[index]["terminal"], infos, metadata)


def _rewards(moves: Demonstrations[Task], world: Grid | Graph) -> Float[np.ndarray, " moves"]:
    """Return the reward of each move, with γ times the terminal reward if the move ends the task."""
    tasks, task, after = moves.tasks, moves.task, moves.next_states
    states, actions = task_entries.world_size(world)
    place = task, moves.states, moves.actions
    reward = np.broadcast_to(tasks.reward, (len(tasks.terminal), states, actions))[place].astype(np.float64)
    if tasks.outcome_reward is not None:
        successors = np.asarray(task_entries.graph_of(world).successors)
        paid = np.broadcast_to(tasks.outcome_reward, (len(tasks.terminal), *successors.shape))[place]
        same = successors[moves.states, moves.actions] == after[:, None]
        row = int(moves.trajectory[np.argmin(same.any(axis=1))]) + 1
        check(same.any(axis=1).all(), "expected moves that the world has", source="trajectory", row=row)
        reward += (paid * same).sum(axis=1) / same.sum(axis=1)
    terminal_reward = np.broadcast_to(tasks.terminal_reward, tasks.terminal.shape)[task, after]
    return reward + tasks.discount[task].astype(np.float64) * tasks.terminal[task, after] * terminal_reward


def _trajectory(
    episode: Episode, task: int, seen: _Numbers, acted: _Numbers, ends: Mapping[int, int], state_of: StateOf | None
) -> Trajectory:
    moves, observations = len(episode.rewards), episode.observations
    if state_of is not None:
        observations = [state_of(_at(observations, step)) for step in range(moves + 1)]
    path = _within(observations, moves + 1, seen, episode.source)
    if episode.terminated:
        path[-1] = ends.get(int(path[-1]), int(path[-1]))
    truncated: Any = episode.metadata.get(_TRUNCATED, not episode.terminated)
    check_instance(truncated, (bool, np.bool_), _TRUNCATED, source=episode.source)
    return Trajectory(path, _within(episode.actions, moves, acted, episode.source), task, bool(truncated))


def _at(observations: Any, step: int) -> Any:
    """Return one observation of several, in dicts and tuples as the space has them."""
    if isinstance(observations, Mapping):
        return {name: _at(values, step) for name, values in observations.items()}
    if isinstance(observations, tuple):
        return tuple(_at(values, step) for values in observations)
    return observations[step]


def _within(values: object, length: int, numbers: _Numbers, source: str) -> Int[np.ndarray, " length"]:
    """Return whole numbers, from 0 on, one for each move or observation."""
    array, (first, end, field) = np.asarray(values), numbers
    message = f"expected {length} whole numbers, found {array.dtype} of shape {array.shape}"
    check(array.shape == (length,) and array.dtype.kind in "iu", message, source=source, field=field)
    step = int(np.argmax((array < first) | (array >= end)))
    message = f"expected a whole number in {first}…{end - 1}, found {array[step]} at step {step}"
    check(first <= array[step] < end, message, source=source, field=field)
    return array.astype(np.int64) - first


def _weights(episode: Episode) -> Float[np.ndarray, " moves"]:
    """Return the weight of each move, by default 1."""
    moves = len(episode.rewards)
    weights = np.asarray(episode.infos.get(_WEIGHT, np.ones(moves + 1)))
    fits = weights.shape == (moves + 1,) and weights.dtype.kind in "iuf"
    message = f"expected {moves + 1} numbers, found {weights.dtype} of shape {weights.shape}"
    check(fits, message, source=episode.source, field=_WEIGHT)
    valid = (np.isfinite(weights) & (weights >= 0)).all()
    check(valid, "expected finite numbers of at least 0", source=episode.source, field=_WEIGHT)
    return weights[1:].astype(np.float64)


def _persons(episodes: Sequence[Episode]) -> Int[Array, " moves"] | None:
    """Return the person of each move; None where no episode has one."""
    if not any(_PERSON in episode.metadata for episode in episodes):
        return None
    persons = []
    for episode in episodes:
        message = "expected a person in all episodes or in none, found none"
        check(_PERSON in episode.metadata, message, source=episode.source, field=_PERSON)
        person = task_entries.whole_number_in(episode.metadata, _PERSON, episode.source)
        check(person >= 0, f"expected at least 0, found {person}", source=episode.source, field=_PERSON)
        persons.append(np.full(len(episode.rewards), person))
    return flat_moves(persons)


def _tasks_of_goals(
    episodes: Sequence[Episode], world: Grid | Graph, discount: float | None, step_cost: float | None
) -> tuple[list[Task], list[int]]:
    """Return the tasks of reaching the goals of episodes, and the index of each episode's task."""
    towards: dict[tuple[int, float], Task] = {}
    keys = []
    for episode in episodes:
        metadata = {"discount": discount} | dict(episode.metadata)
        key = (
            task_entries.whole_number_in(metadata, "goal", episode.source),
            task_entries.number_in(metadata, "discount", episode.source),
        )
        keys.append(key)
        try:
            towards[key] = towards.get(key) or reach(world, key[0], discount=key[1], step_cost=step_cost)
        except InputError as error:
            raise error.of(episode.source) from error
    return list(towards.values()), [list(towards).index(key) for key in keys]


def _entry_of(episode: Episode, entries: Sequence[Mapping[str, Any]], world: Grid | Graph) -> int:
    """Return the entry of an episode; goal and discount of its metadata, if any, must be those of the entry."""
    index = task_entries.whole_number_in(episode.metadata, "task", episode.source)
    message = f"expected a task in 0…{len(entries) - 1}, found {index}"
    check(0 <= index < len(entries), message, source=episode.source, field="task")
    entry = entries[index]
    for field, expected in (("goal", task_entries.best_terminal_states(entry, world)), ("discount", entry["discount"])):
        own = episode.metadata.get(field, expected)
        message = f"expected {expected} as in task {index}, found {own}"
        check(np.array_equal(np.atleast_1d(own), np.atleast_1d(expected)), message, source=episode.source, field=field)
    return index


def _check_dataset(dataset: object, ends: object) -> None:
    """Check the arguments of both functions that name the dataset and its terminal states."""
    message = f"expected the name of a dataset, found {describe(dataset)}"
    check(isinstance(dataset, str | Path), message, field="dataset")
    check_instance(ends, Mapping, "ends")
