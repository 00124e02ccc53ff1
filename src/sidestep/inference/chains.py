"""A Metropolis chain over the barriers of a model: its state, its evidence, and its sweeps.

`sampler` describes the chain, `chain_evidence` has what it reads of world and demonstrations, and `chain_kernels` its
native code. Values are solved from nothing before the first sweep, by the solver of `sidestep.tabular.solvers.values`,
and followed by local value iteration from then on.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from sidestep.errors import InputError, NotConverged, check, check_instance, to_count
from sidestep.inference.arguments import check_evidence
from sidestep.inference.chain_evidence import crossed_barriers, evidence_of, world_of
from sidestep.inference.chain_kernels import Chain, ChainKernels, Evidence, Workspace, World, chain_kernels
from sidestep.inference.hierarchical import HierarchicalMRF, as_hierarchical, evidence_normalizers
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.prior_chains import KINDS, is_free_of, native_terms
from sidestep.inference.prior_kernels import MAX_CHANGED
from sidestep.tabular.backups import Behavior, HardMax
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.likelihood import ALL_TERMS, Terms
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.models.barriers import Barriers, barriers_of
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solvers.base import SolveResult, WarmStart
from sidestep.tabular.solvers.bounds import MoveCosts
from sidestep.tabular.solvers.gauss_seidel import KERNELS
from sidestep.tabular.solvers.native import HostProcess, NativeBackup, NativeEquation
from sidestep.tabular.solvers.values import solve_values

_FRESH_SWEEPS = 10
"""The number of sweeps after which all states are solved again, from the values at hand."""
_FINER = 0.01
"""The factor of the evidence's tolerance where all states are solved again."""
_EXACT, _MAX_SWEEPS = 1e-9, 5_000
"""The tolerance of values solved from nothing, and the most sweeps."""


class ChainState(NamedTuple):
    """A chain with everything that its future depends on, and what it has sampled.

    Attributes:
        chain: The present map, its values and likelihood.
        work: Memory.
        random: The generator.
        samples: The map after each sweep.
        log_likelihoods: Those of actions and transitions after each sweep.
        log_priors: log p(z) after each sweep.
        accepted: The number of accepted proposals in each sweep.
        densities: δ and λ of the prior in each sweep (`HierarchicalMRF`).
    """

    chain: Chain
    work: Workspace
    random: np.random.Generator
    samples: Bool[np.ndarray, "sweeps barriers"]
    log_likelihoods: Float[np.ndarray, "sweeps 2"]
    log_priors: Float[np.ndarray, " sweeps"]
    accepted: Int[np.ndarray, " sweeps"]
    densities: Float[np.ndarray, "sweeps 2"]


@dataclass(frozen=True, eq=False)
class BarrierProblem:
    """What is sampled: the world, the evidence and the prior, as native code reads them.

    Attributes:
        barriers: The barriers of the model.
        world: The same with what depends on which.
        evidence: The tasks and the moves that were observed.
        prior: The prior of the barriers.
        log_normalizers: log Z of the prior at each δ and λ, up to a constant.
        free: The barriers that are sampled; the others are known, or walks crossed them.
        backup: The number of the backup, and the part of the best value within which actions tie.
        terminal: Where each task ends.
        terminal_reward: What each task pays there.
        available: Whether each action is available in each state.
    """

    barriers: Barriers
    world: World
    evidence: Evidence
    prior: HierarchicalMRF
    log_normalizers: Float[np.ndarray, "densities strengths"]
    free: Int[np.ndarray, " free"]
    backup: tuple[int, float]
    terminal: Bool[np.ndarray, "tasks states"]
    terminal_reward: Float[np.ndarray, "tasks #states"]
    available: Bool[np.ndarray, "states actions"]

    @property
    def kernels(self) -> ChainKernels:
        """Return the native code."""
        return chain_kernels(*self.barriers.successors.shape[1:])

    def start(self, closed: Bool[np.ndarray, " barriers"], sweeps: int, random: np.random.Generator) -> ChainState:
        """Return a chain that starts from a map.

        Args:
            closed: Whether each barrier is closed; known barriers and those that walks crossed are as they are.
            sweeps: The number of sweeps that it will make.
            random: The generator of its proposals.
        """
        z = np.where(self.barriers.known == Cell.OCCUPIED, 1, 0).astype(np.uint8)
        z[self.free] = closed[self.free]
        chain, work = self.allocate(z)
        return ChainState(
            chain,
            work,
            random,
            samples=np.zeros((sweeps, len(z)), bool),
            log_likelihoods=np.zeros((sweeps, 2)),
            log_priors=np.zeros(sweeps),
            accepted=np.zeros(sweeps, np.int64),
            densities=np.zeros((sweeps, 2)),
        )

    def allocate(self, closed: UInt8[np.ndarray, " barriers"]) -> tuple[Chain, Workspace]:
        """Return the arrays of a chain at a map, before anything is solved.

        Args:
            closed: Whether each barrier is closed.
        """
        states, actions, attempts = self.barriers.successors.shape
        tasks, rows = len(self.terminal), len(self.evidence.choices)
        values = np.zeros((tasks, states))
        passing = self.world.passing[np.arange(len(closed)), closed]
        chain = Chain(closed, passing, np.empty((states, actions, attempts)), values, np.zeros(rows), np.zeros(2))
        size = tasks * states
        work = Workspace(
            queue=np.zeros(states, np.int32),
            queued=np.zeros(states, np.bool_),
            sources=np.zeros(states, np.int64),
            marked=np.zeros(states, np.int64),
            log_task=np.zeros(size, np.int32),
            log_state=np.zeros(size, np.int64),
            log_value=np.zeros(size),
            logged=np.zeros((tasks, states), np.int64),
            log_row=np.zeros(rows, np.int32),
            log_row_value=np.zeros(rows),
            changed=np.zeros(MAX_CHANGED, np.int32),
            counters=np.zeros(5, np.int64),
        )
        return chain, work

    def solve(self, chain: Chain) -> None:
        """Solve all tasks of a chain from nothing.

        Args:
            chain: The chain, changed in place.

        Raises:
            NotConverged: Where values do not converge.
        """
        successors, probabilities = _outcomes(self.barriers, chain.passing)
        kind, tie = self.backup
        for task, values in enumerate(chain.values):
            reward, discount = self.evidence.reward[task], np.float64(self.evidence.discount[task])
            ends, pays = self.terminal[task], self.terminal_reward[task]
            backup = NativeBackup(kind, np.float64(self.evidence.beta[task]), np.float64(tie))
            process = HostProcess(successors, probabilities, reward, pays, ends, self.available, discount)
            values[:] = _solved(NativeEquation(process, backup, np.float64(_EXACT)))

    def refresh(self, chain: Chain, work: Workspace) -> None:
        """Solve all tasks of a chain from the values that it has, and compute its likelihood anew.

        Args:
            chain: The chain, changed in place.
            work: Its memory.

        Raises:
            InputError: For actions that no map gives a probability.
        """
        exact = self.evidence._replace(tolerance=_FINER * self.evidence.tolerance)
        self.kernels.refresh(self.world, exact, chain, work, *self.backup)
        check_possible(chain.totals)

    def sweep(self, state: ChainState, number: int, heat: float) -> None:
        """Make as many proposals as there are free barriers.

        Args:
            state: The chain, changed in place.
            number: The number of this sweep, from 0.
            heat: T, where the chain samples the posterior to the power 1/T.
        """
        if number == 0:
            self.solve(state.chain)
        if number % _FRESH_SWEEPS == 0:
            self.refresh(state.chain, state.work)
        place = self._draw_density(state, heat)
        density = float(self.prior.log_odds[place[0]]), float(self.prior.strengths[place[1]])
        free = self.free, is_free_of(self.free, len(state.chain.closed))
        terms = native_terms(self.prior.at(*density))
        arguments = (*free, self.world, self.evidence, terms, KINDS, state.chain, state.work)
        sweep = self.kernels.sweep
        state.accepted[number] = sweep(state.random, len(self.free), heat, *arguments, *self.backup)
        state.samples[number] = state.chain.closed
        state.log_likelihoods[number] = state.chain.totals
        state.log_priors[number] = self._log_priors(state)[place]
        state.densities[number] = density

    def _log_priors(self, state: ChainState) -> Float[np.ndarray, "densities strengths"]:
        return self.prior.log_densities(state.chain.closed) - self.log_normalizers

    def _draw_density(self, state: ChainState, heat: float) -> tuple[int, int]:
        """Return the numbers of δ and λ, drawn given the map, or at their mode while the chain is heated.

        A heated chain loses its walls, and λ near 0 would be drawn from what is left.
        """
        scores = self.prior.log_prior
        if heat == 1:
            scores = self._log_priors(state) + state.random.gumbel(size=scores.shape)
        row, column = np.unravel_index(scores.argmax(), scores.shape)
        return int(row), int(column)


def problem_of(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    prior: BinaryMRF | HierarchicalMRF,
    *,
    seed: int = 0,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
) -> tuple[BarrierProblem, BehaviorModel]:
    """Check what is to be inferred of a model; return it with the model of the agents.

    Args:
        model: A model of barriers (`barriers_of`).
        demonstrations: The moves and tasks.
        behavior: The behavior of the agents, or a fitted model of it.
        prior: The prior of the barriers.
        seed, tempering, terms: As for `barrier_problem`.

    Raises:
        InputError: For a model without barriers, a prior of another size, and a weight out of range.
        ImproperTask: For tasks without finite values.
    """
    check_evidence(model, demonstrations, behavior, tempering, terms)
    to_count(seed, "seed", 0)
    agents = behavior if isinstance(behavior, BehaviorModel) else behavior_model(behavior)
    barriers = barriers_of(model)
    check_prior(barriers, prior)
    check_proper(demonstrations.tasks, agents, model.graph)
    run: Any = {"seed": seed, "tempering": tempering, "terms": terms}
    return barrier_problem(barriers, demonstrations, agents, prior, available=model.graph.available, **run), agents


def barrier_problem(
    barriers: Barriers,
    demonstrations: Demonstrations,
    agents: BehaviorModel,
    prior: BinaryMRF | HierarchicalMRF,
    *,
    available: Bool[Array | np.ndarray, "#states #actions"],
    seed: int = 0,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
) -> BarrierProblem:
    """Return what is sampled, from a model's barriers and demonstrations.

    Args:
        barriers: The barriers.
        demonstrations: The moves and tasks.
        agents: The behavior of the agents.
        prior: The prior of the barriers.
        available: Whether each action is available in each state.
        seed: The seed of the chains that find the prior's log Z.
        tempering: The weight of the actions' log-likelihood, in (0, 1].
        terms: The parts of the likelihood that count.
    """
    tasks = agents.tasks_of(demonstrations.tasks)
    message = "expected rewards R(s, a), found R(s, a, s′), which depends on the barriers"
    check(tasks.outcome_reward is None, message, field="tasks")
    persons = [None] * len(tasks.terminal) if agents.person is None else np.asarray(agents.person).tolist()
    behaviors = [agents.behavior_of(person) for person in persons]
    backup = behaviors[0].backup
    if type(backup) not in KERNELS:
        raise InputError(f"expected one of {', '.join(kind.__name__ for kind in KERNELS)}", field="backup")
    tie = backup.tie if isinstance(backup, HardMax) else 0.0
    mask = np.broadcast_to(np.asarray(available), barriers.successors.shape[:2])
    weight = tempering if "actions" in terms else 0.0
    crossed = crossed_barriers(barriers, demonstrations, terms)
    free = np.flatnonzero((barriers.known == Cell.UNKNOWN) & ~crossed).astype(np.int64)
    hierarchical = as_hierarchical(prior)
    return BarrierProblem(
        barriers,
        world_of(barriers),
        evidence_of(barriers, demonstrations, tasks, behaviors, mask, weight, terms),
        hierarchical,
        evidence_normalizers(hierarchical, barriers.known, free, seed),
        free,
        (KERNELS[type(backup)], tie),
        np.array(tasks.terminal),
        np.array(tasks.terminal_reward, np.float64),
        mask,
    )


def check_possible(log_likelihoods: Float[np.ndarray, "..."]) -> None:
    """Raise `InputError` for demonstrations that have the probability 0 whatever barriers are closed.

    Args:
        log_likelihoods: Of one map or more.
    """
    message = "expected actions after which the task can end (or agents with a lapse), found one after which it cannot"
    check(not np.isneginf(log_likelihoods).any(), message, field="demonstrations")


def check_prior(barriers: Barriers, prior: BinaryMRF | HierarchicalMRF) -> None:
    """Check that a prior is one of these barriers.

    Args:
        barriers: The barriers.
        prior: The prior.

    Raises:
        InputError: For another number of barriers, and for shape terms on another grid.
    """
    check_instance(prior, (BinaryMRF, HierarchicalMRF), "prior")
    size, prior = len(barriers.known), as_hierarchical(prior).shapes
    check(len(prior.field) == size, f"expected {size} barriers, found {len(prior.field)}", field="prior")
    message = f"expected shape {barriers.shape} or None, found {prior.shape}"
    check(prior.shape is None or prior.shape == barriers.shape, message, field="prior")


def _outcomes(barriers: Barriers, passing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return successors and probabilities with staying as the last outcome."""
    success = barriers.attempts * np.append(passing, 1.0)[barriers.needed].prod(axis=-1)
    stay = np.broadcast_to(np.arange(len(success))[:, None, None], (*success.shape[:2], 1))
    successors = np.concatenate([barriers.successors, stay], axis=-1).astype(np.int32)
    return successors, np.concatenate([success, 1 - success.sum(axis=-1, keepdims=True)], axis=-1)


def _solved(equation: NativeEquation) -> Float[np.ndarray, " states"]:
    """Return the values of a task, solved from nothing."""
    process, states = equation.process, len(equation.process.terminal)
    best = np.where(process.available, process.reward, -np.inf).max(axis=-1)
    worst = best[~process.terminal].min(initial=0.0)
    # as `bounds.lower_bound`
    bound = np.float64(worst / (1 - process.discount) if process.discount < 1 else -np.inf)
    no_cost: Any = np.float64(0)
    costs, everywhere = MoveCosts(no_cost, no_cost), np.ones(states, bool)
    info = (np.empty((), kind) for kind in (int, float, float, bool))
    arrays: Any = np.empty(states), np.empty(states, np.int32), *info
    start: Any = np.full(states, -np.inf), np.zeros(0), np.full(states, -1, np.int32)
    result = SolveResult(*arrays)
    solve_values(_MAX_SWEEPS, result, equation, bound, costs, WarmStart(*start), everywhere)
    if not result.converged:
        raise NotConverged(f"the values of a task did not converge in {_MAX_SWEEPS} sweeps")
    return arrays[0]
