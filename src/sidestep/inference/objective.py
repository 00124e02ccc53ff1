"""The objective of a fit and its gradient, task by task: in batches that fit into memory, over one device or many.

    log L(θ) + log prior(θ),        log L(θ) = κ Σ_tasks Σ_choices log π_θ(a | s)  +  Σ_moves ln T_θ(s, a, s′)

κ, the tempering, is 1 unless the steps of a walk are taken to say less than as many independent ones would. θ is all
that is learned: of the transition model, and of people what is not known of them.

The sum over tasks is the only costly part, and tasks have nothing to do with each other. So they are cut into batches
of equal size, one compiled function serves them all, and with a mesh of devices each device takes its share of a
batch's tasks and the shares are added up (JAX's SPMD; on several machines, the same on all of them).

What a batch's solves leave behind (values, adjoints, orders) is where those of the next evaluation start. It stays on
the device whose tasks they are; everything else that an evaluation yields, all processes have.

An evaluation may also save work by what it knows of an earlier one: what a batch adds is known, to first order, to
change by less than Σ |∂ log L/∂θ · Δθ|. Where the tasks of a batch are elsewhere than the parameters that have changed
that is nothing, and the part is taken over. Where it is little, only the states are solved that mattered before; if
others have come to matter (see `process`), the batch is evaluated again, all states solved. These are estimates, so who
asks for them must look again before relying on them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PyTree

from sidestep.errors import InputError
from sidestep.inference.batching import Batch, batches_of, planned
from sidestep.inference.checkpoints import fingerprint
from sidestep.inference.priors import Prior
from sidestep.tabular.behavior_model import BehaviorModel, BehaviorParameters
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import (
    Arrivals,
    Choices,
    Term,
    arrival_log_likelihood,
    arrivals_of,
    choice_log_likelihood,
)
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.base import Solver, WarmStart, is_reachable
from sidestep.tabular.tasks import Task

MEMORY = 2.0 * 2**30
"""How many bytes the arrays of a fit may take on a device, unless more are allowed."""
AXIS = "tasks"
"""The name of the axis of a mesh that tasks are spread over."""


class Parameters(NamedTuple):
    """All that is learned: θ of the transition model, and of people what is not known of them."""

    model: PyTree
    people: BehaviorParameters


class Problem(eqx.Module):
    """All that the objective depends on, besides what is learned; arguments as for `fit`."""

    model: TransitionModel
    people: BehaviorModel
    demonstrations: Demonstrations
    prior: Prior
    terms: tuple[Term, ...] = eqx.field(static=True)
    options: SolveOptions
    tempering: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    @property
    def solver(self) -> Solver:
        """Return the solver of the options."""
        return self.options.solver_for(self.people.behavior.backup, self.model.graph.states)

    @property
    def parameters(self) -> Parameters:
        """What is learned, where it starts."""
        return Parameters(self.model.parameters, self.people.parameters)


class Solved(NamedTuple):
    """How the solves of some tasks went; `stuck` marks choices made where the goal cannot be reached from."""

    sweeps: Int[Array, " tasks"]
    residual: Float[Array, " tasks"]
    converged: Bool[Array, " tasks"]
    stuck: Bool[Array, "tasks choices"]


class Part(NamedTuple):
    """What the tasks of a batch add to the actions' log-likelihood and to the slope of the loss, and at which θ.

    `everywhere`: whether all states were solved.
    """

    parameters: PyTree[np.ndarray]
    actions: float
    slope: PyTree[np.ndarray]
    solved: Solved
    everywhere: bool


class Evaluation(NamedTuple):
    """The objective and its parts at some θ, the slope of the loss (minus the objective), and how its solves went.

    `parts` are what the batches added, for a next evaluation to take over; none where it is not to.
    """

    objective: float
    actions: float
    transitions: float
    prior: float
    slope: PyTree[np.ndarray]
    solved: list[Solved]
    parts: list[Part]


class Objective:
    """The objective of a problem, evaluated batch by batch.

    - `memory`: about how many bytes the arrays may take on a device.
    - `mesh`: devices to spread tasks over (`tasks_mesh`); None for one device.
    - `takes_over`: whether evaluations are to take over parts of earlier ones, where that pays (see `planned`).

    With a mesh over several processes, each must make it from the same problem and call the same methods with the same
    arguments; `InputError` says where they do not.
    """

    def __init__(self, problem: Problem, memory: float, mesh: Mesh | None = None, takes_over: bool = False):
        self.problem, self.mesh = problem, mesh
        tasks = len(problem.demonstrations.tasks.terminal)
        devices = 1 if mesh is None else mesh.size
        self.planned = planned(problem.model, problem.solver, tasks, memory, devices, takes_over)
        _check_same(problem, mesh)
        batches = (
            batches_of(problem.demonstrations, problem.people, self.planned.together)
            if "actions" in problem.terms
            else []
        )
        self.batches = [_shared_out(batch, mesh) for batch in batches]
        # of the data, batches and arrivals are all that is needed
        self.lasting = eqx.tree_at(
            lambda problem: (problem.demonstrations, problem.people.person),
            problem,
            (None, None),
            is_leaf=lambda leaf: leaf is None,
        )
        self.solving = _on_all(self.lasting, mesh)
        self.arrivals = arrivals_of(problem.demonstrations) if "transitions" in problem.terms else None

    @property
    def processes(self) -> list[int]:
        """The processes that tasks are spread over. With several, none has all starts."""
        if self.mesh is None:
            return [jax.process_index()]
        return sorted({device.process_index for device in self.mesh.devices.flat})

    def cold_starts(self) -> list[WarmStart]:
        """Where the solves of each batch start when nothing is known."""
        if not self.batches:
            return []
        model, solver = self.problem.model, self.problem.solver
        one = solver.cold_start(model.graph.states, jax.eval_shape(model.probabilities).dtype)
        tasks = len(self.batches[0].tasks.terminal)
        cold = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (tasks, *leaf.shape)), one)
        # arrays do not change, so one serves all batches
        return self.placed([cold]) * len(self.batches)

    def placed(self, starts: list[WarmStart]) -> list[WarmStart]:
        """Starts of batches on the devices where their tasks are."""
        return [_shared_out(start, self.mesh) for start in starts]

    def evaluate(
        self,
        parameters: Parameters,
        starts: list[WarmStart],
        tolerance: float | None = None,
        known: Sequence[Part] = (),
        negligible: float = 0.0,
        little: float = 0.0,
    ) -> tuple[Evaluation, list[WarmStart]]:
        """The objective at θ, and where the next evaluation may start.

        - `tolerance`: that of the solves, where the solver leaves it open. The objective is NaN if a solve failed.
        - `known`: the parts of an earlier evaluation with the same tolerance. Those at the same θ are taken over if all
          states were solved (or, with `little`, need not be), and those to which, by their slope, the way from their θ
          to this one makes a difference below `negligible` (nats).
        - `little`: only the states that mattered are solved where this way changes a batch's part by less than this
          share of it.
        """
        slope, (transitions, prior) = jax.tree.map(
            np.asarray, _apart_from_actions(self.lasting, self.arrivals, parameters)
        )
        here = jax.tree.map(np.asarray, parameters)
        parameters, tolerance = _on_all((parameters, tolerance), self.mesh)
        solving = _with_tolerance(self.solving, tolerance)
        actions, solved, parts, left = 0.0, [], [], []
        for index, (batch, start) in enumerate(zip(self.batches, starts, strict=True)):
            change = _changed_by(known[index], here) if known else np.inf
            if change < negligible or (change == 0 and (known[index].everywhere or little > 0)):
                part, after = known[index], start
            else:
                everywhere = not (known and change < little * abs(known[index].actions))
                (found, by, after, how), everywhere = _evaluated(
                    solving, parameters, batch, start, everywhere, self.mesh
                )
                part = Part(here, float(found), jax.tree.map(np.asarray, by), how, everywhere)
            actions += part.actions
            slope = jax.tree.map(np.add, slope, part.slope)
            solved.append(part.solved)
            if self.planned.takes_over:
                parts.append(part)
            left.append(after)
        terms = (actions, float(transitions), float(prior))
        return Evaluation(sum(terms), *terms, slope, solved, parts), left if self.planned.keeps_starts else starts


def tasks_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """A mesh that spreads tasks over devices, by default over all that there are (of all processes)."""
    return Mesh(np.asarray(jax.devices() if devices is None else devices), (AXIS,))


def _changed_by(part: Part, parameters: PyTree[np.ndarray]) -> float:
    """By how many nats at most, to first order, what a batch adds has changed since; 0 only at the same θ."""
    moves = jax.tree.map(np.subtract, parameters, part.parameters)
    if not any(move.any() for move in jax.tree.leaves(moves)):
        return 0.0
    changes = jax.tree.map(lambda slope, move: np.abs(slope * move).sum(), part.slope, moves)
    return max(float(sum(jax.tree.leaves(changes))), np.finfo(np.float64).tiny)


def _evaluated(
    problem: Problem, parameters: PyTree, batch: Batch, starts: WarmStart, everywhere: bool, mesh: Mesh | None
) -> tuple[tuple[Array, PyTree, WarmStart, Solved], bool]:
    """`_of_actions`, of all states if without some of them there is no slope; and whether it was of all."""
    found, slope, left, solved = _of_actions(problem, parameters, batch, starts, everywhere, mesh)
    if everywhere or not jnp.isfinite(found) or all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(slope)):
        return (found, slope, left, solved), everywhere
    kept = jnp.where(jnp.isfinite(left.adjoint), left.adjoint, starts.adjoint)
    return _of_actions(problem, parameters, batch, left._replace(adjoint=kept), True, mesh), True


@eqx.filter_jit
def _apart_from_actions(
    problem: Problem, arrivals: Arrivals | None, parameters: Parameters
) -> tuple[PyTree, tuple[Array, Array]]:
    """The slope of the loss's other parts, and the parts: the transitions' log-likelihood and the log prior."""

    def loss(parameters: Parameters) -> tuple[Array, tuple[Array, Array]]:
        prior = problem.prior.log_density(parameters.model)
        transitions = jnp.zeros_like(prior)
        prior = prior + problem.people.with_parameters(parameters.people).log_density().astype(prior.dtype)
        if arrivals is not None:
            model = problem.model.with_parameters(parameters.model)
            transitions = arrival_log_likelihood(model, arrivals)
        return -transitions - prior, (transitions, prior)

    return jax.grad(loss, has_aux=True)(parameters)


def _of_actions(
    problem: Problem, parameters: PyTree, batch: Batch, starts: WarmStart, everywhere: bool, mesh: Mesh | None
) -> tuple[Array, PyTree, WarmStart, Solved]:
    """The actions' log-likelihood over the tasks of a batch, the slope of the loss, new starts, how the solves went."""
    if mesh is None:
        return _share(problem, parameters, batch, starts, jnp.asarray(everywhere))
    part, slope, left, solved = _shares(problem, parameters, batch, starts, jnp.asarray(everywhere), mesh)
    # Devices that wait for each other give up after some seconds, and one may have far more to do than the others: so
    # they first finish all their work, and only then is it added up.
    jax.block_until_ready((part, slope))
    (part, slope), solved = _added_up((part, slope), solved, mesh)
    return part, slope, left, solved


@eqx.filter_jit
def _share(
    problem: Problem, parameters: Parameters, batch: Batch, starts: WarmStart, everywhere: Bool[Array, ""]
) -> tuple[Array, PyTree, WarmStart, Solved]:
    """`_of_actions` on one device."""

    def of_one(
        model: TransitionModel,
        people: BehaviorModel,
        task: Task,
        person: Array,
        choices: Choices,
        start: WarmStart,
        region: Array,
    ) -> tuple[Array, tuple]:
        value, found = choice_log_likelihood(
            model,
            people.tasks_of(task),
            choices,
            people.behavior_of(person),
            start,
            options=problem.options,
            region=region,
        )
        stuck = (choices.counts > 0) & ~is_reachable(found.values[choices.states])
        return value, (found.start, Solved(found.sweeps, found.residual, found.converged, stuck))

    def loss(parameters: Parameters, adjoint: Array) -> tuple[Array, tuple]:
        model = problem.model.with_parameters(parameters.model)
        people = problem.people.with_parameters(parameters.people)
        given = starts._replace(adjoint=adjoint)
        each = jax.vmap(of_one, in_axes=(None, None, 0, 0, 0, 0, 0))
        values, left = each(model, people, batch.tasks, batch.person, batch.choices, given, region)
        return -problem.tempering.astype(values.dtype) * values.sum(), left

    region = starts.region | everywhere
    # the gradient by the old adjoint is the new one
    gradient = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    (value, (left, solved)), (slope, adjoint) = gradient(parameters, starts.adjoint)
    return -value, slope, left._replace(adjoint=adjoint), solved


@eqx.filter_jit
def _shares(
    problem: Problem, parameters: PyTree, batch: Batch, starts: WarmStart, everywhere: Bool[Array, ""], mesh: Mesh
) -> tuple[Array, PyTree, WarmStart, Solved]:
    """`_share` of every device; sums over its tasks have an axis of devices in front."""
    known, settings = eqx.partition((problem, parameters, everywhere), eqx.is_array)

    def share(known: PyTree, batch: Batch, starts: WarmStart) -> tuple[Array, PyTree, WarmStart, Solved]:
        problem, parameters, everywhere = eqx.combine(known, settings)
        part, slope, left, solved = _share(problem, parameters, batch, starts, everywhere)
        part, slope = jax.tree.map(lambda leaf: leaf[None], (part, slope))
        return part, slope, left, solved

    own = PartitionSpec(AXIS)
    spread = jax.shard_map(share, mesh=mesh, in_specs=(PartitionSpec(), own, own), out_specs=own, check_vma=False)
    return spread(known, batch, starts)


@eqx.filter_jit
def _added_up(sums: PyTree, solved: Solved, mesh: Mesh) -> tuple[PyTree, Solved]:
    """The devices' sums added up, and how all solves went; both on all devices."""
    added = jax.tree.map(lambda leaf: leaf.sum(axis=0), sums)
    return jax.lax.with_sharding_constraint((added, solved), NamedSharding(mesh, PartitionSpec()))


def _on_all(tree: PyTree, mesh: Mesh | None) -> PyTree:
    """Arrays and numbers on each device of a mesh; `InputError` if not all processes have the same ones."""
    if mesh is None:
        return tree
    values, rest = eqx.partition(tree, lambda leaf: eqx.is_array(leaf) or isinstance(leaf, float))
    try:
        values = jax.device_put(jax.tree.map(np.asarray, values), NamedSharding(mesh, PartitionSpec()))
    except AssertionError as error:  # JAX compares what it is given
        raise InputError(_NOT_THE_SAME) from error
    return eqx.combine(values, rest)


def _shared_out(tree: PyTree, mesh: Mesh | None) -> PyTree:
    """Arrays over tasks, each device with its share of them; a process holds the shares of its own devices."""
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))

    def put(leaf: Array) -> Array:
        array = np.asarray(leaf)
        return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])

    return jax.tree.map(put, tree)


_NOT_THE_SAME = """\
expected the same model, demonstrations, settings and checkpoint in all processes, found different ones (machines that \
are not of the same kind may differ in the last bits)"""


def _check_same(problem: Problem, mesh: Mesh | None) -> None:
    """Raises `InputError` unless all processes have the same problem."""
    if jax.process_count() > 1:
        _on_all(np.frombuffer(bytes.fromhex(fingerprint(problem)), np.uint8), mesh)


def _with_tolerance(problem: Problem, tolerance: float | Array | None) -> Problem:
    if tolerance is None:
        return problem
    return eqx.tree_at(
        lambda problem: problem.options.solver.tolerance,
        problem,
        jnp.asarray(tolerance),
        is_leaf=lambda leaf: leaf is None,
    )
