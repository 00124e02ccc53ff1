"""People in a continuous world, whose values are found on a lattice: demonstrations to learn from.

They plan with the dynamics that they believe in, exactly but for the lattice, and move in the real ones. Nothing here
is shared with what learns from them: neither roll-outs nor policies.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from sidestep.continuous.dynamics import GaussianDynamics
from sidestep.continuous.lattice import Lattice, action_values, tabular, tabular_task
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import InputError, NotConverged, check_count
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.solve import check_proper, solve


def simulate(
    key: PRNGKeyArray,
    real: GaussianDynamics,
    mark_visited_free: GaussianDynamics,
    tasks: Sequence[ContinuousTask],
    starts: Sequence[Float[np.ndarray, "walkers dimensions"]],
    actions: Float[Array, "actions inputs"],
    behavior: Behavior,
    lattice: Lattice,
    moves: int,
) -> list[Trajectory]:
    """Walks of people who believe in `mark_visited_free` and move in `real`, at most so many `moves` long.

    - `tasks`, `starts`: for each task, where its walkers start; those who start at the end of their task do not walk.
    - `behavior`: how they choose. `lattice`: where their values are found.

    Raises `InputError` for starts or actions that are not finite or have another width than the dynamics', other
    numbers of tasks and starts, and `moves` below 1; `ImproperTask` for a task without values, `NotConverged` if
    these cannot be found.
    """
    check_count(moves, 1, "moves")
    if not tasks or len(tasks) != len(starts):
        raise InputError(f"expected as many as tasks, found {len(starts)} for {len(tasks)}", field="starts")
    width = real.example_action().shape
    if not np.isfinite(actions).all() or actions.shape[1:] != width:
        raise InputError(f"expected rows of finite numbers of shape {width}, found {actions.shape}", field="actions")
    model = tabular(mark_visited_free, lattice, actions)
    trajectories = []
    for index, (task, own) in enumerate(zip(tasks, starts, strict=True)):
        if not np.isfinite(own).all() or np.shape(own)[1:] != real.noise.shape:
            raise InputError(f"expected rows of {len(real.noise)} finite numbers", source=f"starts of task {index}")
        table = tabular_task(task, lattice, actions)
        check_proper(table, behavior, len(actions))
        solution = solve(model, table, behavior)
        if not solution.converged:
            raise NotConverged(f"values did not converge for task {index}: a finer lattice or a smaller β may help")
        keys = jax.random.split(jax.random.fold_in(key, index), len(own))
        world = _World(real, mark_visited_free, task, behavior, lattice, solution.values, actions)
        states, choices, going = (np.asarray(part) for part in _walked(world, jnp.asarray(own), keys, moves))
        for walker in range(len(own)):
            taken = int(going[walker].sum())
            if taken:
                trajectories.append(Trajectory(states[walker, : taken + 1], choices[walker, :taken], index))
    return trajectories


class _World(eqx.Module):
    """What walkers believe, want and meet."""

    real: GaussianDynamics
    mark_visited_free: GaussianDynamics
    task: ContinuousTask
    behavior: Behavior
    lattice: Lattice
    values: Float[Array, " points"]
    actions: Float[Array, "actions inputs"]


@eqx.filter_jit
def _walked(world: _World, starts: Array, keys: Key[Array, " walkers"], moves: int) -> tuple[Array, Array, Array]:
    """States, choices, and whether a walker was still going, of all walkers."""

    def move(carry: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        state, over = carry
        choosing, moving = jax.random.split(key)
        over = over | world.task.terminal(state)
        q = action_values(world.mark_visited_free, world.lattice, world.task, world.values, state, world.actions)
        choice = jax.random.categorical(choosing, world.behavior.log_policy(q))
        after = jnp.where(over, state, world.real.sample(moving, state, world.actions[choice]))
        return (after, over), (state, choice, ~over)

    def walk(start: Array, key: PRNGKeyArray) -> tuple[Array, Array, Array]:
        (last, _), passed = jax.lax.scan(move, (start, jnp.zeros((), bool)), jax.random.split(key, moves))
        return jnp.concatenate([passed[0], last[None]]), *passed[1:]

    return jax.vmap(walk)(starts, keys)
