"""The devices over which the tasks of an objective are spread, and what is put on them."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from sidestep._typing import Tree
from sidestep.errors import InputError, to_list

AXIS = "tasks"
"""The name of a mesh's axis, over which tasks are spread."""


def tasks_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Return a mesh that spreads tasks over devices.

    Args:
        devices: JAX devices; by default all devices of all processes.

    Returns:
        The mesh, with one axis.

    Example:
        >>> tasks_mesh(jax.devices()[:1]).size
        1
    """
    own = jax.devices() if devices is None else to_list(devices, jax.Device, "devices")
    return Mesh(np.asarray(own), (AXIS,))


def replicate(tree: Tree, mesh: Mesh | None) -> Tree:
    """Return a tree with its arrays and numbers on each device.

    Args:
        tree: The tree.
        mesh: The devices; None for one, where the tree stays as it is.

    Raises:
        InputError: If processes have different ones.
    """
    if mesh is None:
        return tree
    values, rest = eqx.partition(tree, lambda leaf: eqx.is_array(leaf) or isinstance(leaf, float))
    try:
        values = jax.device_put(jax.tree.map(np.asarray, values), NamedSharding(mesh, PartitionSpec()))
    except AssertionError as error:  # JAX compares the processes' arrays
        raise InputError(
            "expected the same model, demonstrations, settings and checkpoint in all processes, found different ones "
            "(machines that are not of the same kind may differ in the last bits)"
        ) from error
    return eqx.combine(values, rest)


def shard(tree: Tree, mesh: Mesh | None) -> Tree:
    """Return a tree of arrays over tasks, spread over the devices; a process holds the parts of its own devices.

    Args:
        tree: The tree.
        mesh: The devices; None for one, where the tree stays as it is.
    """
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))

    def put(leaf: Array) -> Array:
        array = np.asarray(leaf)
        return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])

    return jax.tree.map(put, tree)
