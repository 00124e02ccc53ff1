"""The objective of a fit and its gradient, in batches of tasks on one device or many.

    log L(θ) + log p(θ),        log L(θ) = κ Σ_tasks Σ_choices log π_θ(a | s)  +  Σ_moves ln T_θ(s, a, s′)

κ is the tempering, and θ all that is learned: the parameters of the transition model and of behavior.

Only the sum over tasks is costly, and its terms are independent. Tasks are cut into batches of equal size for one
compiled function. With a mesh of devices each device computes its part of a batch, and the parts are added (JAX's
SPMD). The solves of an evaluation leave warm starts for those of the next one. These stay on the devices of their
tasks; all other results are in all processes.

An evaluation may reuse what an earlier one computed. To first order, the contribution of a batch changes by less than Σ
|∂ log L/∂θ · Δθ|. Where that is negligible, the earlier contribution is reused. Where it is small, only the states that
mattered before are solved; if others have come to matter (see `DecisionProcess`), the batch is evaluated again with all
states. These are estimates, so an evaluation that a result relies on must not use them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from sidestep._programs import keep_program
from sidestep._repr import short_repr
from sidestep._typing import Tree
from sidestep.inference.batching import Batch, BatchPlan, make_batches, plan_batches
from sidestep.inference.checkpoints import fingerprint
from sidestep.inference.devices import AXIS, replicate, shard
from sidestep.inference.priors import Prior
from sidestep.tabular.behavior_model import BehaviorModel, BehaviorParameters
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import Arrivals, Terms, arrival_log_likelihood, arrivals_of, choice_log_likelihood
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.base import Solver, WarmStart, is_reachable

Flag = Bool[Array | np.ndarray, ""]


@short_repr()
class Parameters(NamedTuple):
    """All that is learned.

    Attributes:
        model: The parameters of the transition model.
        behavior: Those of behavior.
    """

    model: Tree
    behavior: BehaviorParameters


@short_repr()
class Problem(eqx.Module):
    """All that the objective depends on besides the parameters.

    Attributes:
        model, behavior, demonstrations, prior, terms, options, tempering: As the arguments of `fit`.
    """

    model: TransitionModel
    behavior: BehaviorModel
    demonstrations: Demonstrations
    prior: Prior
    terms: Terms = eqx.field(static=True)
    options: SolveOptions
    tempering: Float[Array, ""] = eqx.field(converter=lambda number: jax.device_put(np.asarray(number)), default=1.0)

    @property
    def solver(self) -> Solver:
        """Return the solver of the options."""
        return self.options.solver_for(self.behavior.behavior.backup, self.model.graph.states)

    @property
    def parameters(self) -> Parameters:
        """Return the parameters where a fit starts."""
        return Parameters(self.model.parameters, self.behavior.parameters)


class SolveSummary(NamedTuple):
    """The solves of some tasks.

    Attributes:
        sweeps, residual, converged: As in `Solution`.
        unreachable: Whether each choice was taken in a state from which the goal cannot be reached.
    """

    sweeps: Int[Array | np.ndarray, " tasks"]
    residual: Float[Array | np.ndarray, " tasks"]
    converged: Bool[Array | np.ndarray, " tasks"]
    unreachable: Bool[Array | np.ndarray, "tasks choices"]


def joined(batches: Sequence[SolveSummary]) -> SolveSummary:
    """Return the solves of all batches, as NumPy arrays.

    Args:
        batches: At least one.
    """
    return SolveSummary(*(np.concatenate(leaves) for leaves in zip(*batches, strict=True)))


class BatchResult(NamedTuple):
    """The evaluation of a batch.

    Attributes:
        actions: The actions' log-likelihood, in nats.
        gradient: The gradient of the loss.
        warm_starts: For the next evaluation.
        solves: How the solves went.
    """

    actions: Array
    gradient: Tree
    warm_starts: WarmStart
    solves: SolveSummary


class Contribution(NamedTuple):
    """What a batch contributes to the objective at some parameters.

    Attributes:
        parameters: Where it was computed.
        actions: The actions' log-likelihood, in nats.
        gradient: The gradient of the loss.
        solves: How the solves went.
        all_states: False if only the states that mattered before were solved.
    """

    parameters: Tree
    actions: float
    gradient: Tree
    solves: SolveSummary
    all_states: bool

    def change(self, parameters: Tree) -> float:
        """Return a first-order bound of the change of `actions` up to these parameters; 0 only at the same ones.

        Args:
            parameters: Other parameters.
        """
        steps = jax.tree.map(np.subtract, parameters, self.parameters)
        if not any(step.any() for step in jax.tree.leaves(steps)):
            return 0.0
        changes = jax.tree.map(lambda gradient, step: np.abs(gradient * step).sum(), self.gradient, steps)
        return max(float(sum(jax.tree.leaves(changes))), np.finfo(np.float64).tiny)


class Evaluation(NamedTuple):
    """The objective at some parameters.

    Attributes:
        objective: The sum of the three parts, in nats.
        actions, transitions, prior: The parts.
        gradient: The gradient of the loss, which is minus the objective.
        solves: How the solves of each batch went.
        contributions: Those of the batches, for the next evaluation to reuse; none where the plan does not reuse.
    """

    objective: float
    actions: float
    transitions: float
    prior: float
    gradient: Tree
    solves: list[SolveSummary]
    contributions: list[Contribution]


class Objective:
    """The objective of a problem, evaluated batch by batch.

    With a mesh over several processes, all must construct it from the same problem and call the same methods with the
    same arguments.

    Args:
        problem: The problem.
        plan: The size of batches (see `plan_batches`), by default for a single device and 2 GiB.
        mesh: The devices over which tasks are spread (see `tasks_mesh`); None for one device.

    Raises:
        InputError: If processes have different problems.
    """

    def __init__(self, problem: Problem, plan: BatchPlan | None = None, mesh: Mesh | None = None):
        self.problem, self.mesh = problem, mesh
        terminal, uses_actions = problem.demonstrations.tasks.terminal, "actions" in problem.terms
        self.plan: BatchPlan = plan or plan_batches(problem.model, problem.solver, len(terminal))
        if jax.process_count() > 1:  # copies tell whether all processes have the same problem
            replicate(np.frombuffer(bytes.fromhex(fingerprint(problem)), np.uint8), mesh)
        rest = problem.behavior, self.plan.size
        deadline = problem.options.deadline
        batches = make_batches(problem.demonstrations, *rest, deadline=deadline) if uses_actions else []
        self.batches: list[Batch] = [shard(batch, mesh) for batch in batches]
        self.arrivals: Arrivals | None = arrivals_of(problem.demonstrations) if "transitions" in problem.terms else None
        # batches and arrivals replace the demonstrations
        problem = eqx.tree_at(lambda each: each.demonstrations, problem, None)
        person, is_none = lambda each: each.behavior.person, lambda leaf: leaf is None
        self.constants: Problem = eqx.tree_at(person, problem, None, is_leaf=is_none)
        self.replicated: Problem = replicate(self.constants, mesh)

    @property
    def processes(self) -> list[int]:
        """Return the processes over which tasks are spread. With several, none has all warm starts."""
        if self.mesh is None:
            return [jax.process_index()]
        return sorted({device.process_index for device in self.mesh.devices.flat})

    def cold_starts(self) -> list[WarmStart]:
        """Return the starts of each batch's first solves."""
        if not self.batches:
            return []
        model, tasks = self.problem.model, len(self.batches[0].tasks.terminal)
        start = self.problem.solver.cold_start(model.graph.states, jax.eval_shape(model.probabilities).dtype)
        cold = jax.tree.map(lambda leaf: jax.device_put(np.broadcast_to(leaf, (tasks, *np.shape(leaf)))), start)
        # arrays do not change, so one serves all batches
        return self.place([cold]) * len(self.batches)

    def place(self, starts: list[WarmStart]) -> list[WarmStart]:
        """Return warm starts on the devices of their tasks.

        Args:
            starts: Of each batch.
        """
        return [shard(start, self.mesh) for start in starts]

    def evaluate(
        self,
        parameters: Parameters,
        warm_starts: list[WarmStart],
        *,
        tolerance: float | None = None,
        known: Sequence[Contribution] = (),
        reuse_below: float = 0.0,
        partial_below: float = 0.0,
    ) -> tuple[Evaluation, list[WarmStart]]:
        """Evaluate the objective at θ.

        Args:
            parameters: θ.
            warm_starts: Where the solves start: `cold_starts()`, or the second value of an earlier call.
            tolerance: That of the solves, where the solver leaves it open.
            known: The contributions of an earlier evaluation with the same tolerance. Those at the same θ are reused.
            reuse_below: Reuse contributions that change by less than this, to first order (nats).
            partial_below: Solve only the states that mattered where a contribution changes by less than this fraction
                of it.

        Returns:
            The evaluation, NaN if a solve failed, and the warm starts for the next one.
        """
        model, behavior = self.constants.model, self.constants.behavior
        others = _transitions_and_prior(self.problem.prior, model, behavior, self.arrivals, parameters)
        gradient, (transitions, prior) = jax.tree.map(np.asarray, others)
        here = jax.tree.map(np.asarray, parameters)
        parameters, tolerance = replicate((parameters, tolerance), self.mesh)
        problem = _with_tolerance(self.replicated, tolerance)
        contributions, next_starts = [], []
        for index, (batch, start) in enumerate(zip(self.batches, warm_starts, strict=True)):
            change = known[index].change(here) if known else np.inf
            if change < reuse_below or (change == 0 and (known[index].all_states or partial_below > 0)):
                contribution, next_start = known[index], start
            else:
                all_states = not (known and change < partial_below * abs(known[index].actions))
                result, all_states = self._evaluate_until_finite(problem, parameters, batch, start, all_states)
                by_batch, next_start = jax.tree.map(np.asarray, result.gradient), result.warm_starts
                contribution = Contribution(here, float(result.actions), by_batch, result.solves, all_states)
            gradient = jax.tree.map(np.add, gradient, contribution.gradient)
            contributions.append(contribution)
            next_starts.append(next_start)
        actions = sum((contribution.actions for contribution in contributions), 0.0)
        terms = (actions, float(transitions), float(prior))
        solves = [contribution.solves for contribution in contributions]
        evaluation = Evaluation(sum(terms), *terms, gradient, solves, contributions if self.plan.reuses else [])
        return evaluation, next_starts if self.plan.keeps_warm_starts else warm_starts

    def _evaluate_until_finite(
        self, problem: Problem, parameters: Tree, batch: Batch, start: WarmStart, all_states: bool
    ) -> tuple[BatchResult, bool]:
        """Evaluate a batch; again with all states if those that mattered do not give a gradient."""
        result = self.evaluate_batch(problem, parameters, batch, start, all_states)
        numbers = (result.actions, *jax.tree.leaves(result.gradient))
        if all_states or not np.isfinite(numbers[0]) or all(np.isfinite(leaf).all() for leaf in numbers):
            return result, all_states
        adjoint = np.asarray(result.warm_starts.adjoint)
        adjoint = jax.device_put(np.where(np.isfinite(adjoint), adjoint, np.asarray(start.adjoint)))
        start = result.warm_starts._replace(adjoint=adjoint)
        return self.evaluate_batch(problem, parameters, batch, start, True), True

    def evaluate_batch(
        self, problem: Problem, parameters: Tree, batch: Batch, start: WarmStart, all_states: bool
    ) -> BatchResult:
        """Evaluate the actions' part of a batch; if not `all_states`, solve only the states that mattered before.

        Args:
            problem: The problem, on the devices.
            parameters: θ, on the devices.
            batch: The tasks.
            start: Where their solves start.
            all_states: Whether all states are solved.
        """
        if self.mesh is None:
            return _batch_result(problem, parameters, batch, start, np.asarray(all_states))
        result = _sharded_batch_result(problem, parameters, batch, start, np.asarray(all_states), self.mesh)
        sums = (result.actions, result.gradient)
        # Devices that wait for each other give up after some seconds, and one may have far more to do than the others:
        # so they finish their work before it is added up.
        jax.block_until_ready(sums)
        (actions, gradient), solves = _add_devices(sums, result.solves, self.mesh)
        return BatchResult(actions, gradient, result.warm_starts, solves)


def transitions_and_prior(
    prior: Prior, model: TransitionModel, behavior: BehaviorModel, arrivals: Arrivals | None, parameters: Parameters
) -> tuple[Array, Array]:
    """Return the terms of the objective that need no solves, in nats: the transitions' and the prior's.

    Args:
        prior, model, behavior: Of the problem.
        arrivals: Of its demonstrations; None where transitions do not count.
        parameters: θ.
    """
    log_density = prior.log_density(parameters.model)
    transitions = jnp.zeros_like(log_density)
    log_density += behavior.with_parameters(parameters.behavior).log_density().astype(log_density.dtype)
    if arrivals is not None:
        transitions = arrival_log_likelihood(model.with_parameters(parameters.model), arrivals)
    return transitions, log_density


@keep_program
def _transitions_and_prior(
    prior: Prior, model: TransitionModel, behavior: BehaviorModel, arrivals: Arrivals | None, parameters: Parameters
) -> tuple[Tree, tuple[Array, Array]]:
    """Return the gradient of the loss without the actions' part, and its terms."""

    def loss(parameters: Parameters) -> tuple[Array, tuple[Array, Array]]:
        transitions, log_density = transitions_and_prior(prior, model, behavior, arrivals, parameters)
        return -transitions - log_density, (transitions, log_density)

    return jax.grad(loss, has_aux=True)(parameters)


def actions_log_likelihood(
    problem: Problem, parameters: Parameters, batch: Batch, starts: WarmStart, region: Array
) -> tuple[Array, tuple[WarmStart, SolveSummary]]:
    """Return the actions' log-likelihood of a batch, in nats and tempered, the next starts, and how the solves went.

    Args:
        problem: The problem.
        parameters: θ.
        batch: The tasks.
        starts: Where their solves start.
        region: The states that have to be solved, of each task.
    """
    model = problem.model.with_parameters(parameters.model)
    behavior = problem.behavior.with_parameters(parameters.behavior)

    def of_task(one: Batch, start: WarmStart, region: Array) -> tuple[Array, tuple[WarmStart, SolveSummary]]:
        task, own = behavior.tasks_of(one.tasks), behavior.behavior_of(one.person)
        options = problem.options
        value, solution = choice_log_likelihood(model, task, one.choices, own, start, options=options, region=region)
        unreachable = (one.choices.counts > 0) & ~is_reachable(solution.values[one.choices.states])
        solves = SolveSummary(solution.sweeps, solution.residual, solution.converged, unreachable)
        return value, (solution.start, solves)

    values, aux = jax.vmap(of_task)(batch, starts, region)
    return problem.tempering.astype(values.dtype) * values.sum(), aux


@keep_program
def _batch_result(
    problem: Problem, parameters: Parameters, batch: Batch, starts: WarmStart, all_states: Flag
) -> BatchResult:
    """Evaluate the tasks of a batch that are on one device."""

    def loss(parameters: Parameters, adjoint: Array) -> tuple[Array, tuple[WarmStart, SolveSummary]]:
        value, aux = actions_log_likelihood(problem, parameters, batch, starts._replace(adjoint=adjoint), region)
        return -value, aux

    region = starts.region | all_states
    # the gradient by the old adjoint is the new adjoint
    value_and_gradient = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    (value, (next_starts, solves)), (gradient, adjoint) = value_and_gradient(parameters, starts.adjoint)
    return BatchResult(-value, gradient, next_starts._replace(adjoint=adjoint), solves)


@eqx.filter_jit
def _sharded_batch_result(
    problem: Problem, parameters: Tree, batch: Batch, starts: WarmStart, all_states: Flag, mesh: Mesh
) -> BatchResult:
    """Evaluate a batch on all devices; the sums over a device's tasks have a leading axis of devices."""
    arrays, static = eqx.partition((problem, parameters, all_states), eqx.is_array)

    def on_device(arrays: Tree, batch: Batch, starts: WarmStart) -> BatchResult:
        problem, parameters, all_states = eqx.combine(arrays, static)
        result = _batch_result(problem, parameters, batch, starts, all_states)
        actions, gradient = jax.tree.map(lambda leaf: leaf[None], (result.actions, result.gradient))
        return result._replace(actions=actions, gradient=gradient)

    sharded = PartitionSpec(AXIS)
    evaluate = jax.shard_map(
        on_device, mesh=mesh, in_specs=(PartitionSpec(), sharded, sharded), out_specs=sharded, check_vma=False
    )
    return evaluate(arrays, batch, starts)


@eqx.filter_jit
def _add_devices(sums: Tree, solves: SolveSummary, mesh: Mesh) -> tuple[Tree, SolveSummary]:
    """Add the devices' sums; return them and all solves on all devices."""
    added = jax.tree.map(lambda leaf: leaf.sum(axis=0), sums)
    return jax.lax.with_sharding_constraint((added, solves), NamedSharding(mesh, PartitionSpec()))


def _with_tolerance(problem: Problem, tolerance: float | Array | None) -> Problem:
    if tolerance is None:
        return problem
    replaced = jnp.asarray(tolerance)
    return eqx.tree_at(lambda each: each.options.solver.tolerance, problem, replaced, is_leaf=lambda leaf: leaf is None)
