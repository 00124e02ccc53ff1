"""Functions of every move of many rollouts, at the cost of those moves in which an action was taken.

Most rollouts end before their horizon does. Moves with an action are put first, and dealt out to chunks; a chunk
without any is skipped. All moves of a chunk are rows of one matrix, so that networks multiply matrices.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sidestep._typing import Tree
from sidestep.continuous.tasks import ContinuousTask

_CHUNK = 1024
"""The moves of a chunk."""
_FEW = 4 * _CHUNK
"""The most moves that are not dealt out to chunks."""


class _Chunks(NamedTuple):
    """The indices of all moves in chunks, those with an action first; whether a chunk has any; where each move is."""

    indices: Int[Array, "chunks size"]
    used: Bool[Array, " chunks"]
    places: Int[Array, " moves"]


def map_moves(
    function: Callable[..., Tree], task: ContinuousTask, acting: Bool[Array, "*batch moves"], arrays: tuple[Array, ...]
) -> Tree:
    """Return function(task, …) at every move with an action, and 0 at the others.

    Args:
        function: Of the task, and of an entry of each array.
        task: The task of each rollout.
        acting: Whether an action was taken.
        arrays: Arrays with all axes of `acting`.
    """
    rows, at = _rows(function, task, acting, arrays)
    chunks = _deal(acting, task)
    if chunks is None:
        return jax.tree.map(
            lambda leaf: leaf.reshape(*acting.shape, *leaf.shape[1:]), rows(at(jnp.arange(acting.size)))
        )
    shapes = jax.eval_shape(lambda: rows(at(chunks.indices[0])))

    def none() -> Tree:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def step(_: None, chunk: tuple[Array, Array]) -> tuple[None, Tree]:
        indices, used = chunk
        return None, jax.lax.cond(used, lambda: rows(at(indices)), none)

    _, results = jax.lax.scan(step, None, (chunks.indices, chunks.used))

    def back(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[chunks.places].reshape(*acting.shape, *leaf.shape[2:])

    return jax.tree.map(back, results)


def sum_gradients(
    function: Callable[..., Array],
    parameters: Float[Array, " parameters"],
    task: ContinuousTask,
    acting: Bool[Array, "*batch moves"],
    arrays: tuple[Array, ...],
    groups: Int[Array, "*batch moves"],
    count: int,
) -> Float[Array, "groups parameters"]:
    """Return the sums over groups of moves with an action of the gradients of function(parameters, task, …).

    Args:
        function: Of the parameters, of the task, and of an entry of each array.
        parameters: θ as one vector.
        task: The task of each rollout.
        acting: Whether an action was taken.
        arrays: Arrays with all axes of `acting`.
        groups: The group of each move, from 0.
        count: The number of groups.
    """

    def gradient(task: ContinuousTask, *entries: Array) -> Array:
        return jax.grad(function)(parameters, task, *entries)

    rows, at = _rows(gradient, task, acting, arrays)
    chunks, total, groups = _deal(acting, task), jnp.zeros((count, len(parameters)), parameters.dtype), groups.ravel()
    if chunks is None:
        return total.at[groups].add(rows(at(jnp.arange(acting.size))))

    def step(total: Array, chunk: tuple[Array, Array]) -> tuple[Array, None]:
        indices, used = chunk

        def added(total: Array) -> Array:
            return total.at[groups[indices]].add(rows(at(indices)))

        return jax.lax.cond(used, added, lambda total: total, total), None

    return jax.lax.scan(step, total, (chunks.indices, chunks.used))[0]


def _rows(
    function: Callable[..., Tree], task: ContinuousTask, acting: Array, arrays: tuple[Array, ...]
) -> tuple[Callable[[tuple], Tree], Callable[[Array], tuple]]:
    """Return a function of what some moves have, with rows of 0 where no action was taken; and what they have."""
    axes, moves = acting.ndim, acting.shape[-1]
    tasks = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[axes - 1 :]), task)
    flat, counted = [leaf.reshape(-1, *leaf.shape[axes:]) for leaf in arrays], jnp.append(acting.ravel(), False)

    def at(indices: Array) -> tuple[Any, ...]:
        return (
            counted[indices],
            jax.tree.map(lambda leaf: leaf[indices // moves], tasks),
            *(leaf[indices] for leaf in flat),
        )

    def rows(entries: tuple[Any, ...]) -> Tree:
        counts, *rest = entries
        results = jax.vmap(function)(*rest)
        return jax.tree.map(lambda leaf: jnp.where(counts.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, 0), results)

    return rows, at


def _deal(acting: Array, task: ContinuousTask) -> _Chunks | None:
    """Return the chunks, or None where they would save nothing: for few moves, and tasks that never end."""
    if acting.size <= _FEW or not task.can_end:
        return None
    flat, size = acting.ravel(), acting.size
    total = flat.sum()
    places = jnp.where(flat, jnp.cumsum(flat) - 1, total + jnp.cumsum(~flat) - 1)
    number = -(-size // _CHUNK)
    # the last chunk is filled up with a move of no rollout
    order = jnp.full(number * _CHUNK, size, places.dtype).at[places].set(jnp.arange(size))
    return _Chunks(order.reshape(number, _CHUNK), jnp.arange(number) * _CHUNK < total, places)
