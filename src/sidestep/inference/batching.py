"""Batches of tasks of one size that fit into memory, so that one compiled function serves them all."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int

from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations, next_power_of_two
from sidestep.tabular.likelihood import Choices, choices_of
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solvers.base import Solver
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.native import cores
from sidestep.tabular.tasks import Task

LARGE_MAP = 10_000
"""The number of states from which a map is large: a solve takes long there."""
MEMORY = 2.0 * 2**30
"""The bytes that the arrays of a fit may take on a device by default."""

_WORKSPACE_PER_TASK: dict[type[Solver], int] = {Jacobi: 12}
"""About how many times the size of the probabilities a solve and its gradient take; 3 for `GaussSeidel`."""
_FIXED_WORKSPACE = 8
"""About how many times the size of the probabilities all batches take together."""


class Batch(NamedTuple):
    """Some tasks, the person of each, and the choices of its demonstrations.

    Attributes:
        tasks: Of equal number in all batches of a fit.
        person: The person of each task.
        choices: The distinct choices of each task.
    """

    tasks: Task
    person: Int[Array, " tasks"]
    choices: Choices


class BatchPlan(NamedTuple):
    """The size of batches, and what is stored between evaluations.

    Attributes:
        size: The number of tasks of a batch, on all devices together.
        keeps_warm_starts: Whether solves start where those of the last evaluation ended.
        reuses: Whether evaluations keep the contributions of batches for the next one.
    """

    size: int
    keeps_warm_starts: bool
    reuses: bool


def plan_batches(
    model: TransitionModel,
    solver: Solver,
    tasks: int,
    *,
    memory: float = MEMORY,
    devices: int = 1,
    reuse: bool = False,
    large_map: int = LARGE_MAP,
) -> BatchPlan:
    """Return the fewest batches of equal size that fit into memory.

    With `reuse`, a batch of a large map on a single device has at most one task per core: the smaller a batch is, the
    more often it can be reused. On maps that are not large, a single batch is rounded up to a power of two per device
    if it fits, so that one compiled function serves other data too.

    Args:
        model: The transition model, for its size.
        solver: Computes the values.
        tasks: The number of tasks.
        memory: Bytes per device. A batch has at least one task per device, even if that takes more.
        devices: The number of devices that share a batch.
        reuse: Whether evaluations should reuse the contributions of batches (see `Objective.evaluate`).
        large_map: The number of states from which a map is large.

    Returns:
        The number of tasks of a batch, and whether warm starts and contributions are stored between evaluations.
    """
    probabilities, parameters = jax.eval_shape(model.probabilities), jax.eval_shape(lambda: model.parameters)
    states, item = model.graph.states, probabilities.dtype.itemsize
    size = probabilities.size * item
    per_task = _WORKSPACE_PER_TASK.get(type(solver), 3) * size
    tasks_per_device = math.ceil(tasks / devices)
    start = states * (2 * item + 4)
    starts = tasks_per_device * start
    keeps_warm_starts = starts <= memory / 2
    free = memory - _FIXED_WORKSPACE * size - (starts if keeps_warm_starts else 0)
    # a contribution has a gradient and the parameters where it was computed
    contributions = 2 * tasks_per_device * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(parameters))
    slow = isinstance(solver, GaussSeidel) and states >= large_map
    reuses = reuse and slow and devices == 1 and keeps_warm_starts and contributions <= free / 2
    most = max(1, int((free - (contributions if reuses else 0)) / per_task))
    batches = math.ceil(tasks_per_device / (min(most, cores()) if reuses else most))
    together = math.ceil(tasks_per_device / batches)
    if batches == 1 and states < large_map:
        rounded = next_power_of_two(together)
        added = (rounded - tasks_per_device) * start + _FIXED_WORKSPACE * size
        together = rounded if rounded * per_task + starts + added <= memory else together
    return BatchPlan(devices * together, keeps_warm_starts, reuses)


def make_batches(
    demonstrations: Demonstrations, behavior: BehaviorModel, size: int, *, deadline: bool = False
) -> list[Batch]:
    """Return batches of `size` tasks; the last is padded with terminated tasks without choices.

    Args:
        demonstrations: The moves and all tasks.
        behavior: The behavior model, for the persons.
        size: The number of tasks of a batch.
        deadline: As in `SolveOptions`.
    """
    tasks, choices = demonstrations.tasks, choices_of(demonstrations, deadline=deadline)
    count = len(tasks.terminal)
    missing = -count % size

    def padded(leaf: Array | np.ndarray, value: float | bool = 0) -> Any:
        leaf = np.asarray(leaf)
        return np.concatenate([leaf, np.full((missing, *leaf.shape[1:]), value, leaf.dtype)])

    padded_tasks = eqx.tree_at(lambda task: task.terminal, jax.tree.map(padded, tasks), padded(tasks.terminal, True))
    person = np.zeros(count, np.int32) if behavior.person is None else behavior.person
    whole = Batch(padded_tasks, padded(person), jax.tree.map(padded, choices))
    return [
        jax.tree.map(lambda leaf, first=first: jax.device_put(leaf[first : first + size]), whole)
        for first in range(0, count, size)
    ]
