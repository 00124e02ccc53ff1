"""Choosing trajectories out of demonstrations, and joining demonstrations."""

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int

from sidestep._arguments import to_indices
from sidestep.errors import check, to_list
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.demonstrations import Demonstrations, Tasks, flat_moves
from sidestep.tabular.tasks import Task, stack_tasks, task_at


def choose(demonstrations: Demonstrations[Tasks], chosen: Any) -> Demonstrations[Tasks]:
    """Return some trajectories, as `Demonstrations.__getitem__` describes.

    Args:
        demonstrations: Their moves.
        chosen: A slice, indices, or whether each trajectory is chosen.
    """
    indices = _indices(chosen, demonstrations.trajectories)
    first = demonstrations.first_moves()
    lengths = np.diff(first, append=len(demonstrations))[indices]
    begins = np.cumsum(lengths) - lengths
    rows = np.arange(lengths.sum()) + np.repeat(first[indices] - begins, lengths)
    kept = eqx.tree_at(lambda each: each.tasks, demonstrations, None)
    kept = jax.tree.map(lambda leaf: to_jax(np.asarray(leaf)[rows]), kept)
    changes = demonstrations.tasks, flat_moves([np.repeat(np.arange(len(lengths)), lengths)])
    return eqx.tree_at(lambda each: (each.tasks, each.trajectory), kept, changes, is_leaf=lambda leaf: leaf is None)


def _indices(chosen: Any, count: int) -> Int[np.ndarray, " chosen"]:
    """Return the indices of chosen trajectories, of which there are `count`."""
    single = isinstance(chosen, Integral) or getattr(chosen, "shape", None) == ()
    if isinstance(chosen, slice):
        indices = np.arange(count)[chosen]
    else:
        indices = to_indices([chosen] if single else chosen, count, "chosen", "trajectories")
    check(indices.size, "expected at least one trajectory", field="chosen")
    return indices


def join(parts: Sequence[Demonstrations[Task]]) -> Demonstrations[Task]:
    """Return the trajectories of several demonstrations in the same world, one after another.

    Tasks that are equal become one, so that each is solved once.

    Args:
        parts: At least one. A person has the same number in all of them.

    Returns:
        All moves, with all tasks.

    Raises:
        InputError: For nothing, for anything but demonstrations, for worlds of different sizes, and where some parts
            tell persons apart and others do not.

    Example:
        >>> from sidestep.tabular.demonstrations import Trajectory, gather
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.tasks import reach
        >>> walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)
        >>> shown = gather([walk], [reach(Grid.unknown(rows=1, columns=3), 2)])
        >>> joined = join([shown, shown])
        >>> joined.trajectories, len(joined.tasks.terminal)
        (2, 1)
    """
    parts = to_list(parts, Demonstrations, "parts")
    states = [part.tasks.terminal.shape[-1] for part in parts]
    check(len(set(states)) == 1, f"expected the same number of states in all parts, found {states}", field="parts")
    known = [part.person is not None for part in parts]
    check(all(known) or not any(known), "expected persons in all parts or in none", field="parts")
    every = [task_at(part.tasks, at) for part in parts for at in range(_count(part))]
    stacked = stack_tasks(every)
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(stacked)]
    _, first, which = np.unique(
        [b"".join(leaf[at].tobytes() for leaf in leaves).hex() for at in range(len(every))],
        return_index=True,
        return_inverse=True,
    )
    order = np.argsort(first)
    tasks = jax.tree.map(lambda leaf: to_jax(np.asarray(leaf)[first[order]]), stacked)
    number = np.argsort(order)[which]
    begins = np.cumsum([0, *map(_count, parts)]), np.cumsum([0, *(part.trajectories for part in parts)])

    def joined(name: str) -> Int[Array, " moves"]:
        return flat_moves([np.asarray(getattr(part, name)) for part in parts])

    def concatenated(name: str) -> Array:
        return to_jax(np.concatenate([np.asarray(getattr(part, name)) for part in parts]))

    return Demonstrations(
        *map(joined, ("states", "actions", "next_states")),
        task=flat_moves([number[np.asarray(part.task) + start] for part, start in zip(parts, begins[0], strict=False)]),
        trajectory=flat_moves([np.asarray(p.trajectory) + start for p, start in zip(parts, begins[1], strict=False)]),
        tasks=tasks,
        weights=concatenated("weights"),
        person=joined("person") if all(known) else None,
        truncated=concatenated("truncated"),
    )


def _count(part: Demonstrations[Task]) -> int:
    return len(part.tasks.terminal)
