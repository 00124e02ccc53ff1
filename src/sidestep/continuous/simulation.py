"""Simulated agents in a continuous world, with values from a lattice: demonstrations to learn from.

An agent plans with the dynamics that it believes in, exactly but for the lattice, and moves in the real ones. This
module imports neither rollouts nor policies, so that the data do not depend on the methods that learn from them.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from sidestep.continuous.dynamics import GaussianDynamics
from sidestep.continuous.lattice import Lattice, action_values, tabular_model, tabular_task
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import NotConverged, check, check_count
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.solve import SolveOptions, check_proper, solve


def simulate_trajectories(
    key: PRNGKeyArray,
    real: GaussianDynamics,
    believed: GaussianDynamics,
    tasks: Sequence[ContinuousTask],
    starts: Sequence[Float[np.ndarray, "agents dimensions"]],
    actions: Float[Array, "actions inputs"],
    behavior: Behavior,
    lattice: Lattice,
    moves: int,
    options: SolveOptions | None = None,
) -> list[Trajectory]:
    """Simulate agents that plan with the `believed` dynamics and move in the `real` ones.

    Args:
        key: draws everything random.
        real: the dynamics of the world.
        believed: the dynamics that agents plan with.
        tasks: the tasks to pursue.
        starts: for each task, the first states of its agents. Those where the task has ended give no trajectory.
        actions: the actions to choose from.
        behavior: the agents' backup and β.
        lattice: the points of the values.
        moves: the greatest length of a trajectory, 1 or more.
        options: of the solve for the values.

    Raises:
        InputError: starts or actions that are not finite or do not have the dynamics' width, different numbers of
            tasks and starts, or `moves` below 1.
        ImproperTask: a task with infinite values.
        NotConverged: values that did not converge.

    Example:
        >>> import sidestep as ss
        >>> import sidestep.continuous as sc
        >>> world = sc.LinearGaussian(jnp.eye(1), jnp.eye(1), jnp.full(1, 0.01))
        >>> task, steps = sc.reach_region((1.0,), 0.1, discount=0.9), jnp.array([[-0.5], [0.5]])
        >>> lattice, behavior = Lattice(jnp.full(1, -1.0), jnp.ones(1), (5,)), Behavior(ss.LogSumExp(), 50.0)
        >>> walks = simulate_trajectories(
        ...     jax.random.key(0), world, world, [task], [np.zeros((1, 1))], steps, behavior, lattice, moves=9
        ... )
        >>> walks[0].actions.tolist()
        [1, 1]
    """
    check_count(moves, 1, "moves")
    message = f"expected as many as tasks, found {len(starts)} for {len(tasks)}"
    check(0 < len(tasks) == len(starts), message, field="starts")
    width = real.example_action().shape
    message = f"expected rows of finite numbers of shape {width}, found {actions.shape}"
    check(np.isfinite(actions).all() and actions.shape[1:] == width, message, field="actions")
    model = tabular_model(believed, lattice, actions)
    trajectories = []
    for index, (task, own) in enumerate(zip(tasks, starts, strict=True)):
        fits = np.isfinite(own).all() and np.shape(own)[1:] == real.noise.shape
        check(fits, f"expected rows of {len(real.noise)} finite numbers", source=f"starts of task {index}")
        table = tabular_task(task, lattice, actions)
        check_proper(table, behavior, len(actions))
        solution = solve(model, table, behavior, options=options)
        if not solution.converged:
            raise NotConverged(f"values did not converge for task {index}: a finer lattice or a smaller β may help")
        keys = jax.random.split(jax.random.fold_in(key, index), len(own))
        world = _World(real, believed, task, behavior, lattice, solution.values, actions)
        parts = (np.asarray(part) for part in _simulate(world, jnp.asarray(own), keys, moves))
        for states, choices, acting in zip(*parts, strict=True):
            length = int(acting.sum())
            if length:
                trajectories.append(Trajectory(states[: length + 1], choices[:length], index))
    return trajectories


class _World(eqx.Module):
    real: GaussianDynamics
    believed: GaussianDynamics
    task: ContinuousTask
    behavior: Behavior
    lattice: Lattice
    values: Float[Array, " points"]
    actions: Float[Array, "actions inputs"]


@eqx.filter_jit
def _simulate(world: _World, starts: Array, keys: Key[Array, " agents"], moves: int) -> tuple[Array, Array, Array]:
    """Return states, choices, and whether the task had not ended, of every agent at every move."""

    def move(carry: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        state, over = carry
        choice_key, transition_key = jax.random.split(key)
        over = over | world.task.terminal(state)
        q = action_values(world.believed, world.lattice, world.task, world.values, state, world.actions)
        choice = jax.random.categorical(choice_key, world.behavior.log_policy(q))
        after = jnp.where(over, state, world.real.sample(transition_key, state, world.actions[choice]))
        return (after, over), (state, choice, ~over)

    def simulate(start: Array, key: PRNGKeyArray) -> tuple[Array, Array, Array]:
        begin = start, jnp.zeros((), bool)
        (last, _), (states, choices, acting) = jax.lax.scan(move, begin, jax.random.split(key, moves))
        return jnp.concatenate([states, last[None]]), choices, acting

    return jax.vmap(simulate)(starts, keys)
