"""The objective of a fit and its gradient, task by task: in batches that fit into memory, over one device or many.

    log L(θ) + log prior(θ),        log L(θ) = Σ_tasks Σ_choices log π_θ(a | s)  +  Σ_moves ln T_θ(s, a, s′)

The sum over tasks is the only costly part, and tasks have nothing to do with each other. So they are cut into batches
of equal size, one compiled function serves them all, and with a mesh of devices each device takes its share of a
batch's tasks and the shares are added up (JAX's SPMD; on several machines, the same on all of them).

What a batch's solves leave behind (values, adjoints, orders) is where those of the next evaluation start.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PyTree

from sidestep.demonstrations import Demonstrations
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, Gradient
from sidestep.tabular.likelihood import Choices, Term, choice_log_likelihood, choices_of, transition_log_likelihood
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solvers.jacobi import Jacobi
from sidestep.tabular.solvers.process import Solver, Start, reachable
from sidestep.tasks import Task

MEMORY = 2.0 * 2**30
"""How many bytes the arrays of a fit may take, unless more are allowed."""
AXIS = "tasks"
"""The name of the axis of a mesh that tasks are spread over."""


class Problem(eqx.Module):
    """All that the objective depends on, besides θ; arguments as for `fit`."""

    model: TransitionModel
    demonstrations: Demonstrations
    behavior: Behavior
    prior: Normal
    terms: tuple[Term, ...] = eqx.field(static=True)
    horizon: int | None = eqx.field(static=True)
    gradient: Gradient = eqx.field(static=True)
    solver: Solver


class Batch(NamedTuple):
    """Some tasks, and what was done in pursuit of them."""

    tasks: Task
    choices: Choices


class Solved(NamedTuple):
    """How the solves of some tasks went; `stuck` marks choices made where the goal cannot be reached from."""

    sweeps: Int[Array, " tasks"]
    residual: Float[Array, " tasks"]
    converged: Bool[Array, " tasks"]
    stuck: Bool[Array, "tasks choices"]


class Evaluation(NamedTuple):
    """The objective and its parts at some θ, the slope of the loss (minus the objective), and how its solves went."""

    objective: float
    actions: float
    transitions: float
    prior: float
    slope: PyTree[np.ndarray]
    solved: list[Solved]


class Objective:
    """The objective of a problem, evaluated batch by batch.

    - `memory`: about how many bytes the arrays may take.
    - `mesh`: devices to spread tasks over (`tasks_mesh`); None for one device.
    """

    def __init__(self, problem: Problem, memory: float, mesh: Mesh | None = None):
        self.mesh = mesh
        self.problem = _put(problem, mesh, PartitionSpec())
        together, self.keeps_starts = _plan(problem, memory, 1 if mesh is None else mesh.size)
        batches = _batches(problem.demonstrations, together) if "actions" in problem.terms else []
        self.batches = [_put(batch, mesh, PartitionSpec(AXIS)) for batch in batches]

    def cold_starts(self) -> list[Start]:
        """Where the solves of each batch start when nothing is known."""
        if not self.batches:
            return []
        model, solver = self.problem.model, self.problem.solver
        one = solver.cold_start(model.graph.states, jax.eval_shape(model.probabilities).dtype)
        tasks = len(self.batches[0].tasks.terminal)
        cold = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (tasks, *leaf.shape)), one)
        # arrays do not change, so one serves all batches
        return [_put(cold, self.mesh, PartitionSpec(AXIS))] * len(self.batches)

    def evaluate(
        self, parameters: PyTree, starts: list[Start], tolerance: float | None = None
    ) -> tuple[Evaluation, list[Start]]:
        """The objective at θ, and where the next evaluation may start.

        `tolerance` is that of the solves, where the solver leaves it open. The objective is NaN if a solve failed.
        """
        problem, parameters = _with_tolerance(self.problem, tolerance), _put(parameters, self.mesh, PartitionSpec())
        slope, (transitions, prior) = jax.tree.map(np.asarray, _apart_from_actions(problem, parameters))
        actions, solved, left = 0.0, [], []
        for batch, start in zip(self.batches, starts, strict=True):
            part, by, start, how = _of_actions(problem, parameters, batch, start, self.mesh)
            actions += float(part)
            slope = jax.tree.map(lambda mine, more: mine + np.asarray(more), slope, by)
            solved.append(how)
            left.append(start)
        parts = (actions, float(transitions), float(prior))
        evaluation = Evaluation(sum(parts), *parts, slope, solved)
        return evaluation, left if self.keeps_starts else starts


def tasks_mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh that spreads tasks over devices, by default over all that there are (of all processes)."""
    return Mesh(np.asarray(jax.devices() if devices is None else devices), (AXIS,))


@eqx.filter_jit
def _apart_from_actions(problem: Problem, parameters: PyTree) -> tuple[PyTree, tuple[Array, Array]]:
    """The slope of the loss's other parts, and the parts: the transitions' log-likelihood and the log prior."""

    def loss(parameters: PyTree) -> tuple[Array, tuple[Array, Array]]:
        prior = problem.prior.log_density(parameters)
        transitions = jnp.zeros_like(prior)
        if "transitions" in problem.terms:
            model = problem.model.with_parameters(parameters)
            transitions = transition_log_likelihood(model, problem.demonstrations)
        return -transitions - prior, (transitions, prior)

    return jax.grad(loss, has_aux=True)(parameters)


@eqx.filter_jit
def _of_actions(
    problem: Problem, parameters: PyTree, batch: Batch, starts: Start, mesh: Mesh | None
) -> tuple[Array, PyTree, Start, Solved]:
    """The actions' log-likelihood over the tasks of a batch, the slope of the loss, new starts, how the solves went."""

    def of_one(model: TransitionModel, task: Task, choices: Choices, start: Start) -> tuple[Array, tuple]:
        value, found = choice_log_likelihood(
            model,
            task,
            choices,
            problem.behavior,
            start,
            horizon=problem.horizon,
            gradient=problem.gradient,
            solver=problem.solver,
        )
        stuck = (choices.counts > 0) & ~reachable(found.values[choices.states])
        return value, (found.start, Solved(found.sweeps, found.residual, found.converged, stuck))

    def loss(parameters: PyTree, adjoint: Array, batch: Batch, starts: Start) -> tuple[Array, tuple]:
        model = problem.model.with_parameters(parameters)
        starts = starts._replace(adjoint=adjoint)
        values, left = jax.vmap(of_one, in_axes=(None, 0, 0, 0))(model, batch.tasks, batch.choices, starts)
        return -values.sum(), left

    def share(parameters: PyTree, batch: Batch, starts: Start) -> tuple[Array, PyTree, Start, Solved]:
        # the gradient by the old adjoint is the new one
        gradient = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
        (value, (left, solved)), (slope, adjoint) = gradient(parameters, starts.adjoint, batch, starts)
        if mesh is not None:
            value, slope = jax.lax.psum((value, slope), AXIS)
            solved = jax.lax.all_gather(solved, AXIS, tiled=True)
        return -value, slope, left._replace(adjoint=adjoint), solved

    if mesh is None:
        return share(parameters, batch, starts)
    all_of_it, own = PartitionSpec(), PartitionSpec(AXIS)
    spread = jax.shard_map(
        share,
        mesh=mesh,
        in_specs=(all_of_it, own, own),
        out_specs=(all_of_it, all_of_it, own, all_of_it),
        check_vma=False,
    )
    return spread(parameters, batch, starts)


def _put(tree: PyTree, mesh: Mesh | None, spec: PartitionSpec) -> PyTree:
    """Arrays on the devices of a mesh: on each of them all, or its share of the tasks."""
    if mesh is None:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.device_put(jax.tree.map(np.asarray, arrays), NamedSharding(mesh, spec)), rest)


def _with_tolerance(problem: Problem, tolerance: float | None) -> Problem:
    if tolerance is None:
        return problem
    return eqx.tree_at(
        lambda problem: problem.solver.tolerance, problem, jnp.asarray(tolerance), is_leaf=lambda leaf: leaf is None
    )


# ------------------------------------------------------------------------------------------------------- batches

_WORKSPACE = {Jacobi: 12}
"""How many times a task's probabilities a solve and its gradient take (the default is for `Ordered`), roughly."""
_FIXED = 8
"""And how many times, whatever the number of tasks."""


def _plan(problem: Problem, memory: float, devices: int) -> tuple[int, bool]:
    """How many tasks a batch has, a multiple of the devices; and whether there is room to keep starts.

    Batches are as equal as can be, and as few as fit into `memory`; one of a task a device always is possible.
    """
    graph, tasks = problem.model.graph, len(problem.demonstrations.tasks.terminal)
    probabilities = jax.eval_shape(problem.model.probabilities)
    size = probabilities.size * probabilities.dtype.itemsize
    starts = tasks * graph.states * (2 * probabilities.dtype.itemsize + 4)
    keeps = starts <= memory / 2
    free = memory - _FIXED * size - (starts if keeps else 0)
    most = max(1, int(free / (_WORKSPACE.get(type(problem.solver), 3) * size)) // devices)
    rounds = math.ceil(math.ceil(tasks / devices) / most)
    return devices * math.ceil(tasks / devices / rounds), keeps


def _batches(demonstrations: Demonstrations, together: int) -> list[Batch]:
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
