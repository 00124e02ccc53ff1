"""Simulated agents in a known world: demonstrations to learn from where no real ones are at hand."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, Shaped

from sidestep._arguments import to_key, to_states
from sidestep.errors import InputError, check, check_instance, to_count, to_list
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.checks import check_model, check_persons
from sidestep.tabular.demonstrations import Trajectory, next_power_of_two
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.planning import plan
from sidestep.tabular.roll_outs import roll_out
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.tasks import Task

_CHUNK = 128
"""The number of moves that are rolled out before looking at which agents have arrived."""


def simulate(
    key: PRNGKeyArray,
    world: TransitionModel,
    tasks: Sequence[Task],
    starts: Sequence[Shaped[ArrayLike, "..."] | Sequence[int]],
    behavior: Behavior | BehaviorModel | None = None,
    max_moves: int | None = None,
    *,
    options: SolveOptions | None = None,
) -> list[Trajectory]:
    """Return trajectories of agents that know a world and pursue tasks in it.

    An agent acts until its task ends, or until `max_moves` if it is given: continuing tasks need it.

    Args:
        key: Of the random choices.
        world: The transition model that the agents plan with and that their moves follow.
        tasks: The tasks that are pursued.
        starts: For each task the states that its agents start in, one agent an entry.
        behavior: The agents'; None for the optimal policy, with ties broken at random. A `BehaviorModel`, such as that
            of a fit, has the discount, reward weights and costs of all agents, and the person of each task.
        max_moves: The number of moves after which an agent stops; its trajectory is then `truncated`. By default no
            agent stops before it arrives, and one that has not arrived after twice the number of states, and at least
            1000 moves, is an error.
        options: How the agents plan; by default `SolveOptions()`. With a deadline all agents stop there.

    Returns:
        The trajectories, those of the first task first. An agent that starts in a terminal state makes no move.

    Raises:
        InputError: For a start that is not a state, and without `max_moves` for an agent that does not arrive.
        ImproperTask: For a task that has no values.
        NotConverged: If the values of a task do not converge.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> [walk] = simulate(jax.random.key(0), true_model(grid), [reach(grid, 2)], [np.array([0])])
        >>> walk.states.tolist()
        [0, 1, 2]
        >>> [walk] = simulate(jax.random.key(0), true_model(grid), [reach(grid, 2)], [[0]], max_moves=1)
        >>> walk.states.tolist(), walk.truncated
        ([0, 1], True)
    """
    check_model(world)
    tasks, starts = to_list(tasks, Task, "tasks"), to_list(starts, object, "starts")
    check(len(starts) == len(tasks), f"expected as many as tasks, {len(tasks)}, found {len(starts)}", field="starts")
    limit = max(1000, 2 * world.graph.states) if max_moves is None else to_count(max_moves, "max_moves")
    check_persons(behavior, len(tasks))
    check_instance(options, (SolveOptions, type(None)), "options")
    options = SolveOptions() if options is None else options
    if options.deadline and options.horizon is not None:
        limit = min(limit, options.horizon)
    key, trajectories = to_key(key), []
    for index, (task, own) in enumerate(zip(tasks, starts, strict=True)):
        begin = to_states(own, world.graph.states, f"starts[{index}]")
        person = _person_of(behavior, index)
        policy = plan(world, task, behavior, person=person, options=options).policy
        if not len(begin):
            continue
        key, own_key = jax.random.split(key)
        states, actions, arrived = _followed(own_key, world, policy, np.asarray(task.terminal), begin, limit)
        if max_moves is None and not options.deadline and not arrived.all():
            raise InputError(
                f"an agent from state {int(begin[np.argmin(arrived)])} had not arrived after {limit} moves: "
                "expected a goal in reach, a larger β, a step cost with discount 1 for long ways, or `max_moves`",
                source=f"task {index}",
            )
        for own_states, own_actions, ended in zip(states, actions, arrived.tolist(), strict=True):
            taken = int((own_actions >= 0).sum())
            trajectories.append(Trajectory(own_states[: taken + 1], own_actions[:taken], index, not ended))
    return trajectories


def _person_of(behavior: Behavior | BehaviorModel | None, task: int) -> int | None:
    """Return the person of a task; None where persons are not distinguished."""
    person = behavior.person if isinstance(behavior, BehaviorModel) else None
    return None if person is None else int(np.asarray(person)[task])


def _followed(
    key: PRNGKeyArray,
    world: TransitionModel,
    policy: Float[Array, "*moves states actions"],
    terminal: Bool[np.ndarray, " states"],
    starts: Int[np.ndarray, " agents"],
    limit: int,
) -> tuple[Int[np.ndarray, "agents visits"], Int[np.ndarray, "agents moves"], Bool[np.ndarray, " agents"]]:
    """Return the states and actions of agents that follow a policy (−1 once they have arrived), and which arrived."""
    agents = len(starts)
    # with copies of agents up to a power of two, so that one compiled function serves many numbers of agents
    states = np.resize(starts, next_power_of_two(agents))[:, None]
    actions = np.zeros((len(states), 0), dtype=np.int64)
    while not terminal[states[:agents, -1]].all() and actions.shape[1] < limit:
        key, chunk_key = jax.random.split(key)
        moves, before = min(_CHUNK, limit - actions.shape[1]), actions.shape[1]
        own = policy if policy.ndim == 2 else policy[before : before + moves]
        rolled = roll_out(chunk_key, world, own, to_jax(terminal), states[:, -1], moves)
        states = np.concatenate([states, np.asarray(rolled.states)[:, 1:]], axis=1)
        actions = np.concatenate([actions, np.asarray(rolled.actions)], axis=1)
    return states[:agents], actions[:agents], terminal[states[:agents, -1]]
