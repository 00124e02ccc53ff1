"""Demonstrations in continuous worlds: of simulated agents with values from a lattice, or from trajectories at hand.

An agent plans with the dynamics that it believes in, exactly but for the lattice, and moves in the real ones. This
module imports neither rollouts nor policies, so that the data do not depend on the methods that learn from them.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arguments import to_finite, to_key
from sidestep.continuous.dynamics import Dynamics, GaussianDynamics
from sidestep.continuous.lattice import LatticePlanner
from sidestep.continuous.tasks import ContinuousTask, batch_tasks, check_tasks, has_ended
from sidestep.errors import InputError, NotConverged, check, check_count, check_instance, describe, to_count, to_list
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.demonstrations import Demonstrations, Trajectory
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solve import SolveOptions, solve


def simulate_trajectories(
    key: PRNGKeyArray,
    agent: LatticePlanner,
    real: GaussianDynamics,
    tasks: Sequence[ContinuousTask],
    starts: Sequence[Float[np.ndarray, "agents dimensions"]],
    moves: int,
    options: SolveOptions | None = None,
) -> list[Trajectory]:
    """Simulate agents that plan with the dynamics that they believe in, and move in the `real` ones.

    Args:
        key: Draws everything random.
        agent: How each of the agents plans.
        real: The dynamics of the world.
        tasks: The tasks to pursue.
        starts: For each task, the first states of its agents. Those where the task has ended give no trajectory.
        moves: The greatest length of a trajectory, 1 or more.
        options: The options of the solve for the values.

    Returns:
        The trajectories in the order of tasks and starts.

    Raises:
        InputError: For starts or actions that are not finite or do not have the dynamics' width, starts beyond the
            lattice, different numbers of tasks and starts, or `moves` below 1.
        ImproperTask: For a task with infinite values.
        NotConverged: For values that did not converge.

    Example:
        >>> import sidestep as ss, sidestep.continuous as sc
        >>> world = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.01))
        >>> task, steps = sc.reach_region((1.0,), 0.1, discount=0.9), jnp.array([[-0.5], [0.5]])
        >>> lattice = sc.Lattice(jnp.full(1, -1.0), jnp.ones(1), (5,))
        >>> agent = sc.LatticePlanner(world, steps, ss.Behavior(ss.LogSumExp(), 50.0), lattice)
        >>> walks = simulate_trajectories(jax.random.key(0), agent, world, [task], [np.zeros((1, 1))], moves=9)
        >>> walks[0].actions.tolist()
        [1, 1]
    """
    check_count(moves, 1, "moves")
    key, tasks, starts = to_key(key), to_list(tasks, ContinuousTask, "tasks"), to_list(starts, object, "starts")
    check_instance(agent, LatticePlanner, "agent")
    check_instance(real, GaussianDynamics, "real")
    message = f"expected as many as tasks, found {len(starts)} for {len(tasks)}"
    check(len(tasks) == len(starts), message, field="starts")
    actions, width = agent.actions, real.example_action().shape
    message = f"expected rows of finite numbers of shape {width}, found {actions.shape}"
    check(np.isfinite(actions).all() and actions.shape[1:] == width, message, field="actions")
    model, trajectories = agent.tabular_model(), []
    first_states = [to_finite(own, f"starts[{i}]", ("agents", len(real.noise))) for i, own in enumerate(starts)]
    for index, own in enumerate(first_states):
        agent.lattice.check_inside(own, f"starts[{index}]")
    for index, (task, own) in enumerate(zip(tasks, first_states, strict=True)):
        table = agent.tabular_task(task)
        check_proper(table, agent.behavior, model.graph)
        solution = solve(model, table, agent.behavior, options=options)
        if not solution.converged:
            raise NotConverged(f"values did not converge for task {index}: a finer lattice or a smaller β may help")
        parts = _simulate(agent, real, task, solution.values, to_jax(own), jax.random.fold_in(key, index), moves)
        goes_on = ~jax.vmap(task.terminal)(parts[0][:, -1])  # agents stay where their task ends
        for states, choices, acting, stopped in zip(*map(np.asarray, (*parts, goes_on)), strict=True):
            length = int(acting.sum())
            if length:
                trajectories.append(Trajectory(states[: length + 1], choices[:length], index, bool(stopped)))
    return trajectories


def gather_trajectories(trajectories: Sequence[Trajectory], tasks: Sequence[ContinuousTask]) -> Demonstrations:
    """Return the demonstrations of trajectories in a continuous world.

    Args:
        trajectories: States of shape (moves + 1, …), actions of shape (moves, …), and the index of a task.
        tasks: All of one kind.

    Returns:
        A record with an entry for every move.

    Raises:
        InputError: For no or an empty trajectory, lengths or shapes that do not fit, numbers that are not finite, a
            task that does not exist, or a trajectory that goes on after its task has ended.

    Example:
        >>> import sidestep.continuous as sc
        >>> walk = Trajectory(np.array([[0.0], [0.5], [1.0]]), np.array([1, 1]), task=0)
        >>> len(gather_trajectories([walk], [sc.reach_region((1.0,), 0.1)]))
        2
    """
    batched = batch_tasks(tasks)
    check_tasks(batched)
    trajectories = to_list(trajectories, Trajectory, "trajectories")
    checked = [_checked(trajectory, trajectories[0], len(tasks), row) for row, trajectory in enumerate(trajectories, 1)]
    states, actions, *of_each = zip(*checked, strict=True)
    leaving, taken, following = (
        to_jax(np.concatenate(part))
        for part in ([each[:-1] for each in states], actions, [each[1:] for each in states])
    )
    lengths = [len(each) for each in actions]
    task, truncated, trajectory = (
        np.repeat(each, lengths) for each in (*of_each, np.arange(len(lengths), dtype=np.int32))
    )
    demonstrations = Demonstrations(
        leaving,
        taken,
        following,
        to_jax(task.astype(np.int32)),
        to_jax(trajectory),
        batched,
        truncated=to_jax(truncated),
    )
    ended = np.asarray(has_ended(batched, demonstrations.task, demonstrations.states))
    row = int(trajectory[ended.argmax()]) + 1
    state = demonstrations.states[int(ended.argmax())]
    message = f"expected no moves after a terminal state of its task, found one from {state}"
    check(not ended.any(), message, source="trajectory", row=row)
    return demonstrations


def _checked(trajectory: Trajectory, first: Trajectory, tasks: int, row: int) -> Trajectory:
    """Return a trajectory with arrays and numbers; refuse one with other shapes than the first."""
    try:
        states, actions = (_numbers(trajectory, name) for name in ("states", "actions"))
        task = to_count(trajectory.task, "task", 0, tasks - 1)
        check_instance(trajectory.truncated, (bool, np.bool_), "truncated")
    except InputError as error:
        raise InputError(error.message, source="trajectory", row=row, field=error.field) from error
    shape, action = np.shape(first.states)[1:], np.shape(first.actions)[1:]
    expect = partial(check, source="trajectory", row=row)
    fits = len(states) == len(actions) + 1 > 1 and states.shape[1:] == shape
    expect(fits, f"expected moves and one state of shape {shape} more, found {len(actions)} and {states.shape}")
    expect(
        actions.shape[1:] == action, f"expected actions of shape {action}, found {actions.shape[1:]}", field="actions"
    )
    return Trajectory(states, actions, task, bool(trajectory.truncated))


def _numbers(trajectory: Trajectory, name: str) -> np.ndarray:
    """Return states or actions as finite numbers; whole ones stay whole."""
    value = getattr(trajectory, name)
    array = np.asarray(to_finite(value, name))
    whole = np.asarray(value)
    array = whole if whole.dtype.kind in "iu" else array
    check(array.ndim > 0, f"expected an entry for each move, found {describe(value)}", field=name)
    return array


@eqx.filter_jit
def _simulate(
    agent: LatticePlanner, real: Dynamics, task: ContinuousTask, values: Array, starts: Array, key: Array, moves: int
) -> tuple[Array, Array, Array]:
    """Return states, choices, and whether the task had not ended, of every agent at every move."""

    def move(carry: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        state, over = carry
        choice_key, transition_key = jax.random.split(key)
        over = over | task.terminal(state)
        choice = jax.random.categorical(choice_key, agent.behavior.log_policy(agent.action_values(task, values, state)))
        after = jnp.where(over, state, real.sample(transition_key, state, agent.actions[choice]))
        return (after, over), (state, choice, ~over)

    def simulate(start: Array, key: PRNGKeyArray) -> tuple[Array, Array, Array]:
        keys = jax.random.split(key, moves)
        (last, _), (states, choices, acting) = jax.lax.scan(move, (start, jnp.zeros((), bool)), keys)
        return jnp.concatenate([states, last[None]]), choices, acting

    return jax.vmap(simulate)(starts, jax.random.split(key, len(starts)))
