"""Samples of barriers from their posterior, by a Metropolis chain with exact values.

    p(z | walks) ∝ L(z)^κ p(z),      z(i) = 1 where barrier i is closed

Each map z has transitions of its own, and L(z) is the likelihood of `sidestep.tabular.likelihood` with these. A closed
barrier lets an agent pass with probability .003, an open one with .997, so that no observation is impossible.

The chain is that of Metropolis et al. (1953), *Equation of state calculations by fast computing machines*:

1. A proposal flips a barrier, moves a closed cell to one of the eight cells around it, or flips a run of 2 to 7 equal
   cells of a row or column. A proposal and its reverse are equally probable.
2. It is accepted in two stages (delayed acceptance, Christen & Fox 2005): with probability min(1, p(z′)/p(z)) by the
   prior, and if so with probability min(1, L(z′)/L(z)). The likelihood is computed for what the prior accepts only.
   Detailed balance holds in each stage, so also together.
3. Values follow a proposal by local value iteration (`chain_kernels`) up to a tolerance, and are solved anew from
   nothing every ten sweeps. So the chain is exact up to the tolerance.
4. In the first third of the sweeps the posterior is heated: log p/T, with T falling from 4 to 1. These are dropped.
5. Several chains start from few and from many closed barriers. Split-R̂ and effective sample sizes
   (`diagnostics`) compare them.

Barriers that walks crossed are open and stay so.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.errors import InputError, check, check_count
from sidestep.inference.chain_kernels import (
    BACKUPS,
    MAX_CHANGED,
    Chain,
    Evidence,
    MRFTerms,
    Workspace,
    World,
    chain_kernels,
)
from sidestep.inference.mrf import BinaryMRF
from sidestep.tabular.backups import Behavior, HardMax
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import ALL_TERMS, Terms
from sidestep.tabular.models.barriers import NO_BARRIER, Barriers
from sidestep.tabular.grid import Cell
from sidestep.tabular.solvers.base import SolveResult, WarmStart, neg_inf
from sidestep.tabular.solvers.gauss_seidel import KERNELS
from sidestep.tabular.solvers.native import HostProcess, NativeBackup, NativeEquation
from sidestep.tabular.solvers.values import solve_values

PASSING = (0.997, 0.003)
"""The probability that an open barrier, and a closed one, lets an agent pass."""
_FLIPS, _MOVES = 0.6, 0.8
"""The cumulative probabilities of flips and of moves; the rest are runs."""
_HEAT, _HEATED = 4.0, 1 / 3
"""The first heat, and the fraction of the sweeps that are heated."""
_FRESH_SWEEPS = 10
"""The number of sweeps after which values are solved from nothing."""
_TOLERANCE = 7e-4
"""The change of β V that is passed on (nats)."""
_EXACT = 1e-9
"""The tolerance of values solved from nothing."""


class ChainState(NamedTuple):
    """A chain with everything that its future depends on, and what it has sampled.

    Attributes:
        chain: The present map, its values and likelihood.
        work: Memory.
        random: The generator.
        samples: The map after each sweep.
        log_likelihoods: Those of actions and transitions after each sweep.
        log_priors: log p(z) after each sweep.
    """

    chain: Chain
    work: Workspace
    random: np.random.Generator
    samples: Bool[np.ndarray, "sweeps barriers"]
    log_likelihoods: Float[np.ndarray, "sweeps 2"]
    log_priors: Float[np.ndarray, " sweeps"]


@dataclass(frozen=True, eq=False)
class BarrierProblem:
    """What is sampled: the world, the evidence and the prior, as native code reads them.

    Attributes:
        barriers: The barriers of the model.
        world: The same with what depends on which.
        evidence: The tasks and the moves that were observed.
        prior: The prior of the barriers.
        free: The barriers that are sampled; the others are known, or walks crossed them.
        backup: The number of the backup, and the part of the best value within which actions tie.
        terminal: Where each task ends.
        terminal_reward: What each task pays there.
    """

    barriers: Barriers
    world: World
    evidence: Evidence
    prior: BinaryMRF
    free: Int[np.ndarray, " free"]
    backup: tuple[int, float]
    terminal: Bool[np.ndarray, "tasks states"]
    terminal_reward: Float[np.ndarray, "tasks #states"]

    def start(self, closed: Bool[np.ndarray, " barriers"], sweeps: int, random: np.random.Generator) -> ChainState:
        """Return a chain that starts from a map.

        Args:
            closed: Whether each barrier is closed; known barriers and those that walks crossed are as they are.
            sweeps: The number of sweeps that it will make.
            random: The generator of its proposals.
        """
        states, actions, attempts = self.barriers.successors.shape
        tasks, rows = len(self.terminal), len(self.evidence.choices)
        z = np.where(self.barriers.known == Cell.OCCUPIED, 1, 0).astype(np.uint8)
        z[self.free] = closed[self.free]
        values = np.zeros((tasks, states))
        chain = Chain(z, np.empty((states, actions, attempts)), values, np.zeros(rows), np.zeros(2))
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
        return ChainState(
            chain, work, random, np.zeros((sweeps, len(z)), bool), np.zeros((sweeps, 2)), np.zeros(sweeps)
        )

    def solve(self, state: ChainState) -> None:
        """Solve all tasks of a chain from nothing, and compute its likelihood.

        Args:
            state: The chain, changed in place.
        """
        compute_likelihood, _ = chain_kernels(*self.barriers.successors.shape[1:])
        successors, probabilities = _outcomes(self.barriers, self.world, state.chain.closed)
        kind, tie = self.backup
        for task, values in enumerate(state.chain.values):
            reward, discount = self.evidence.reward[task], self.evidence.discount[task]
            ends, pays = self.terminal[task], self.terminal_reward[task]
            process = HostProcess(successors, probabilities, reward, pays, ends, discount)
            backup = NativeBackup(kind, self.evidence.beta[task], np.float64(tie))
            equation = NativeEquation(process, backup, np.float64(_EXACT))
            result = _empty_result(len(values))
            cold = WarmStart(
                np.full(len(values), neg_inf(values.dtype)), np.zeros(0), np.full(len(values), -1, np.int32)
            )
            solve_values(
                5_000, result, equation, _lower_bound(reward, ends, discount), cold, np.ones(len(values), bool)
            )
            values[:] = result.values
        compute_likelihood(self.world, self.evidence, state.chain, neg_inf(np.dtype(float)))

    def sweep(self, state: ChainState, number: int, sweeps: int) -> None:
        """Make one proposal for each free barrier.

        Args:
            state: The chain, changed in place.
            number: The number of this sweep, from 0.
            sweeps: The number of all sweeps.
        """
        if number % _FRESH_SWEEPS == 0:
            self.solve(state)
        _, sweep = chain_kernels(*self.barriers.successors.shape[1:])
        prior = MRFTerms(self.prior.field, self.prior.weights, *(self.prior.shape or (0, 0)))
        is_free = np.zeros(len(state.chain.closed), bool)
        is_free[self.free] = True
        kinds, (kind, tie) = np.array([_FLIPS, _MOVES]), self.backup
        arguments = (self.free, is_free, self.world, self.evidence, prior, kinds, state.chain, state.work)
        sweep(state.random, len(self.free), heat(number, sweeps), *arguments, kind, tie, neg_inf(np.dtype(float)))
        state.samples[number] = state.chain.closed
        state.log_likelihoods[number] = state.chain.totals
        state.log_priors[number] = self.prior.log_density(state.chain.closed)


def heat(number: int, sweeps: int) -> float:
    """Return the heat of a sweep: from 4 to 1 over the first third, 1 from then on."""
    heated = sweeps * _HEATED
    return 1.0 if number >= heated else _HEAT ** (1 - number / heated)


def barrier_problem(
    barriers: Barriers,
    demonstrations: Demonstrations,
    behaviors: list[Behavior],
    prior: BinaryMRF,
    *,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
) -> BarrierProblem:
    """Return what is sampled, from a model's barriers and demonstrations.

    Args:
        barriers: The barriers.
        demonstrations: The moves and tasks.
        behaviors: The behavior of the agents in each task.
        prior: The prior of the barriers.
        tempering: The weight of the actions' log-likelihood, in (0, 1].
        terms: The parts of the likelihood that count.
    """
    tasks = demonstrations.tasks
    terminal = np.array(tasks.terminal)
    passing = np.where(
        (barriers.known == Cell.UNKNOWN)[:, None], PASSING, np.where(barriers.known == Cell.FREE, 1.0, 0.0)[:, None]
    )
    states = np.arange(len(barriers.successors))
    needed = barriers.needed
    state, _, _, place = np.nonzero(needed != NO_BARRIER)
    gated_begin, gated = _grouped(needed[needed != NO_BARRIER], state, len(barriers.known))
    leads = (barriers.attempts > 0) & (barriers.successors != states[:, None, None])
    before_begin, before = _grouped(barriers.successors[leads], np.nonzero(leads)[0], len(states))
    world = World(
        barriers.successors.astype(np.int32), barriers.attempts, needed.astype(np.int32), passing,
        gated_begin, gated, before_begin, before,
    )  # fmt: skip
    moved, stayed = _transitions(barriers, demonstrations)
    crossed = _crossed(barriers, demonstrations, moved)
    if "transitions" not in terms:
        moved, stayed, crossed = np.zeros_like(moved), np.zeros_like(stayed), np.zeros_like(crossed)
    choice_row, choices = _choices(demonstrations, barriers.successors.shape[1])
    weight = tempering if "actions" in terms else 0.0
    beta = np.array([float(each.beta) for each in behaviors])
    evidence = Evidence(
        reward=np.array(tasks.reward, np.float64),
        solved=_solvable(barriers, terminal),
        discount=np.array(tasks.discount, np.float64),
        beta=beta,
        lapse=np.array([0.0 if each.lapse is None else float(each.lapse) for each in behaviors]),
        tolerance=_TOLERANCE / beta,
        choice_row=choice_row,
        choices=weight * choices,
        moved=moved,
        stayed=stayed,
        has_transitions=moved.any(axis=(1, 2)) | stayed.any(axis=1),
    )
    backup = behaviors[0].backup
    if type(backup) not in KERNELS:
        raise InputError(f"expected one of {', '.join(kind.__name__ for kind in KERNELS)}", field="backup")
    tie = backup.tie if isinstance(backup, HardMax) else 0.0
    free = np.flatnonzero((barriers.known == Cell.UNKNOWN) & ~crossed).astype(np.int64)
    rewards = np.array(tasks.terminal_reward, np.float64)
    return BarrierProblem(barriers, world, evidence, prior, free, (KERNELS[type(backup)], tie), terminal, rewards)


def run_chains(
    problem: BarrierProblem,
    sweeps: int,
    chains: int = 2,
    seed: int = 0,
    report: Callable[[int], None] = lambda _: None,
) -> list[ChainState]:
    """Run chains side by side.

    Args:
        problem: What is sampled.
        sweeps: The number of sweeps of each chain, at least 3.
        chains: Their number.
        seed: The seed; each chain has a generator of its own, so the number of cores changes nothing.
        report: Called after each sweep of all chains, with its number.

    Returns:
        The chains, with their samples.
    """
    check_count(sweeps, 3, "sweeps")
    fractions = np.linspace(0.05, 0.5, chains) if chains > 1 else np.array([0.05])
    states = []
    for fraction, sequence in zip(fractions, np.random.SeedSequence(seed).spawn(chains), strict=True):
        random = np.random.Generator(np.random.PCG64(sequence))
        states.append(problem.start(random.random(len(problem.barriers.known)) < fraction, sweeps, random))
    with ThreadPoolExecutor(chains) as pool:
        for number in range(sweeps):
            list(pool.map(lambda state: problem.sweep(state, number, sweeps), states))
            report(number)
    return states


def _outcomes(barriers: Barriers, world: World, closed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return successors and probabilities with staying as the last outcome."""
    passing = np.append(world.passing[np.arange(len(closed)), closed], 1.0)
    success = barriers.attempts * passing[barriers.needed].prod(axis=-1)
    stay = np.broadcast_to(np.arange(len(success))[:, None, None], (*success.shape[:2], 1))
    successors = np.concatenate([world.successors, stay], axis=-1).astype(np.int32)
    return successors, np.concatenate([success, 1 - success.sum(axis=-1, keepdims=True)], axis=-1)


def _empty_result(states: int) -> SolveResult:
    values, order = np.empty(states), np.empty(states, np.int32)
    arrays: tuple[Any, ...] = (values, order, np.empty((), np.int64), np.empty(()), np.empty((), bool))
    return SolveResult(*arrays)


def _lower_bound(reward: np.ndarray, terminal: np.ndarray, discount: float) -> np.floating:
    """As `base.lower_bound`."""
    worst = np.broadcast_to(reward.max(axis=-1), terminal.shape)[~terminal].min(initial=0.0)
    return np.float64(worst / (1 - discount) if discount < 1 else neg_inf(np.dtype(float)))


def _grouped(keys: np.ndarray, items: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct items of each key, one group after another, and where each group begins."""
    pairs = np.unique(np.stack([keys, items], axis=1), axis=0)
    begin = np.searchsorted(pairs[:, 0], np.arange(groups + 1))
    return begin.astype(np.int64), pairs[:, 1].astype(np.int64)


def _solvable(barriers: Barriers, terminal: np.ndarray) -> np.ndarray:
    """Return whether each task goes on in each state and can end from there, were all unknown barriers open."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    closed = np.append(barriers.known == Cell.OCCUPIED, False)
    possible = (barriers.attempts > 0) & ~closed[barriers.needed].any(axis=-1)
    state = np.nonzero(possible)[0]
    size = len(possible)
    solvable = np.zeros(terminal.shape, bool)
    for task, ends in enumerate(terminal):
        # one more state leads to every end
        rows = np.concatenate([barriers.successors[possible], np.full(ends.sum(), size)])
        columns = np.concatenate([state, np.flatnonzero(ends)])
        graph = csr_array((np.ones(len(rows)), (rows, columns)), shape=(size + 1, size + 1))
        reached = breadth_first_order(graph, size, return_predecessors=False)
        solvable[task, reached[reached < size]] = True
    return solvable & ~terminal


def _transitions(barriers: Barriers, demonstrations: Demonstrations) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of observed transitions by each attempt, and of those that stayed."""
    moved = np.zeros(barriers.successors.shape)
    stayed = np.zeros(barriers.successors.shape[:2])
    s, a, after, weight = (
        np.asarray(each)
        for each in (demonstrations.states, demonstrations.actions, demonstrations.next_states, demonstrations.weights)
    )
    stays = s == after
    np.add.at(stayed, (s[stays], a[stays]), weight[stays])
    s, a, after, weight = (each[~stays] for each in (s, a, after, weight))
    leads = (barriers.successors[s, a] == after[:, None]) & (barriers.attempts[s, a] > 0)
    check(leads.any(axis=-1).all(), "expected transitions that the model allows", field="demonstrations")
    np.add.at(moved, (s, a, leads.argmax(axis=-1)), weight)
    return moved, stayed


def _crossed(barriers: Barriers, demonstrations: Demonstrations, moved: np.ndarray) -> np.ndarray:
    """Return the barriers that agents crossed, and where these are cells, those that agents were in."""
    crossed = np.zeros(len(barriers.known) + 1, bool)
    crossed[barriers.needed[moved > 0]] = True
    crossed = crossed[:-1]
    if barriers.shape is not None:
        counts = np.asarray(demonstrations.weights) > 0
        for each in (demonstrations.states, demonstrations.next_states):
            crossed[np.asarray(each)[counts]] = True
    return crossed


def _choices(demonstrations: Demonstrations, actions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the row of each task and state in which actions were observed, and the weight of each action there."""
    task, s, a, weight = (
        np.asarray(each)
        for each in (demonstrations.task, demonstrations.states, demonstrations.actions, demonstrations.weights)
    )
    shape = np.asarray(demonstrations.tasks.terminal).shape
    row, flat = np.full(shape, -1, np.int32), task.astype(np.int64) * shape[1] + s
    distinct, which = np.unique(flat, return_inverse=True)
    row.reshape(-1)[distinct] = np.arange(len(distinct))
    choices = np.zeros((len(distinct), actions))
    np.add.at(choices, (which, a), weight)
    return row, choices
