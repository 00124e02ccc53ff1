"""Batches of tasks: as many together as fit into memory, so that one compiled function serves them all."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sidestep.demonstrations import Demonstrations
from sidestep.tabular.likelihood import Choices, choices_of
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solvers.host import cores
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.ordered import Ordered
from sidestep.tabular.solvers.process import Solver
from sidestep.tasks import Task

LARGE = 10_000
"""From how many states on a solve takes long."""

_WORKSPACE: dict[type[Solver], int] = {Jacobi: 12}
"""How many times a task's probabilities a solve and its gradient take (the default is for `Ordered`), roughly."""
_FIXED = 8
"""And how many times, whatever the number of tasks."""


class Batch(NamedTuple):
    """Some tasks, and what was done in pursuit of them."""

    tasks: Task
    choices: Choices


def planned(model: TransitionModel, solver: Solver, tasks: int, memory: float, devices: int) -> tuple[int, bool]:
    """How many tasks a batch has, a multiple of the devices; and whether there is room to keep starts and parts.

    Batches are as equal as can be, and as few as fit into `memory` bytes on each device; one of a task a device always
    is possible. On one device, where a solve takes long, a batch has no more tasks than there are cores: the fewer, the
    more often an evaluation can take over what a batch added to an earlier one.
    """
    probabilities, parameters = jax.eval_shape(model.probabilities), jax.eval_shape(lambda: model.parameters)
    item = probabilities.dtype.itemsize
    size = probabilities.size * item
    share = math.ceil(tasks / devices)
    starts = share * model.graph.states * (2 * item + 4)
    slope = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(parameters))
    alone = devices == 1 and isinstance(solver, Ordered) and model.graph.states >= LARGE
    most_useful = cores() if alone else share
    for keeps in (True, False):
        free = memory - _FIXED * size - (starts if keeps else 0)
        most = max(1, min(most_useful, int(free / (_WORKSPACE.get(type(solver), 3) * size))))
        rounds = math.ceil(share / most)
        if starts + rounds * slope <= memory / 2:
            break
    return devices * math.ceil(share / rounds), keeps


def batches_of(demonstrations: Demonstrations, together: int) -> list[Batch]:
    """Batches of that many tasks; the last is filled up with tasks that have ended, and nothing done."""
    tasks, choices = demonstrations.tasks, choices_of(demonstrations)
    count = len(tasks.terminal)
    missing = -count % together

    def filled(leaf: Array, value: float | bool = 0) -> Array:
        return jnp.concatenate([leaf, jnp.full((missing, *leaf.shape[1:]), value, leaf.dtype)])

    ended = Task(filled(tasks.reward), filled(tasks.final_reward), filled(tasks.terminal, True), filled(tasks.discount))
    whole = Batch(ended, jax.tree.map(filled, choices))
    return [
        jax.tree.map(lambda leaf, first=first: leaf[first : first + together], whole)
        for first in range(0, count, together)
    ]
