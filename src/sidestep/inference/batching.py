"""Batches of tasks: as many together as fit into memory, so that one compiled function serves them all."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
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

LARGE = 10_000
"""From how many states on a solve takes long."""

_WORKSPACE: dict[type[Solver], int] = {Jacobi: 12}
"""How many times a task's probabilities a solve and its gradient take (the default is for `GaussSeidel`), roughly."""
_FIXED = 8
"""And how many times, whatever the number of tasks."""


class Batch(NamedTuple):
    """Some tasks, whose each is, and what was done in pursuit of it."""

    tasks: Task
    person: Int[Array, " tasks"]
    choices: Choices


class Planned(NamedTuple):
    """How tasks are batched: how many are together in a batch, and what there is room for.

    - `keeps_starts`: to keep where solves start, from evaluation to evaluation.
    - `takes_over`: to keep what each batch added, for the next evaluation to take over.
    """

    together: int
    keeps_starts: bool
    takes_over: bool


def planned(
    model: TransitionModel, solver: Solver, tasks: int, memory: float, devices: int, takes_over: bool = False
) -> Planned:
    """The batches of so many tasks: as few and as equal as can be, of a multiple of the devices.

    They fit into `memory` bytes on each device; one of a task a device always is possible. If evaluations are to take
    over what batches added to earlier ones (`takes_over`), and solves take long, a batch on a single device has no more
    tasks than there are cores: the fewer, the more often it can. Where solves do not take long and there is
    room, a device's share of a single batch is rounded up to a power of two, for one compiled function to serve other
    data too.
    """
    probabilities, parameters = jax.eval_shape(model.probabilities), jax.eval_shape(lambda: model.parameters)
    item = probabilities.dtype.itemsize
    size = probabilities.size * item
    share = math.ceil(tasks / devices)
    starts = share * model.graph.states * (2 * item + 4)
    keeps_starts = starts <= memory / 2
    free = memory - _FIXED * size - (starts if keeps_starts else 0)
    # of each batch a slope and the parameters that it belongs to
    parts = 2 * share * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(parameters))
    long = isinstance(solver, GaussSeidel) and model.graph.states >= LARGE
    takes_over = takes_over and long and devices == 1 and keeps_starts and parts <= free / 2
    most = max(1, int((free - (parts if takes_over else 0)) / (_WORKSPACE.get(type(solver), 3) * size)))
    rounds = math.ceil(share / (min(most, cores()) if takes_over else most))
    together = math.ceil(share / rounds)
    if rounds == 1 and model.graph.states < LARGE:
        rounded = next_power_of_two(together)
        added = (rounded - share) * model.graph.states * (2 * item + 4) + _FIXED * size
        fits = rounded * _WORKSPACE.get(type(solver), 3) * size + starts + added <= memory
        together = rounded if fits else together
    return Planned(devices * together, keeps_starts, takes_over)


def batches_of(demonstrations: Demonstrations, people: BehaviorModel, together: int) -> list[Batch]:
    """Batches of that many tasks; the last is filled up with tasks that have ended, and nothing done."""
    tasks, choices = demonstrations.tasks, choices_of(demonstrations)
    count = len(tasks.terminal)
    missing = -count % together

    def filled(leaf: Array, value: float | bool = 0) -> Array:
        return jnp.concatenate([leaf, jnp.full((missing, *leaf.shape[1:]), value, leaf.dtype)])

    ended = Task(
        filled(tasks.reward), filled(tasks.terminal_reward), filled(tasks.terminal, True), filled(tasks.discount)
    )
    person = jnp.zeros(count, jnp.int32) if people.person is None else people.person
    whole = Batch(ended, filled(person), jax.tree.map(filled, choices))
    return [
        jax.tree.map(lambda leaf, first=first: leaf[first : first + together], whole)
        for first in range(0, count, together)
    ]
