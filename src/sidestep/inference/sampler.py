"""Samples of barriers from their posterior, by a Metropolis chain with exact values.

    p(z | walks) ∝ L(z) p(z),      z(i) = 1 where barrier i is closed

Each map z has transitions of its own, and L(z) is the likelihood of `sidestep.tabular.likelihood` with these, its part
of the actions to the power κ (`tempering`). A closed
barrier lets an agent pass with probability .003, an open one with .997, so that no observation is impossible.

The chain is that of Metropolis et al. (1953), *Equation of state calculations by fast computing machines*:

1. A proposal flips a barrier, exchanges a cell with one of the eight around it that is not equal, or flips a run of 2
   to 7 equal cells of a row or column. Where there is no grid, it flips a barrier or exchanges any two that are not
   equal. A proposal and its reverse are equally probable.
2. It is accepted in two stages (delayed acceptance, Christen & Fox 2005): with probability min(1, p(z′)/p(z)) by the
   prior, and if so with probability min(1, L(z′)/L(z)). The likelihood is computed for what the prior accepts only.
   Detailed balance holds in each stage, so also together.
3. Values follow a proposal by local value iteration (`chain_kernels`) up to a tolerance. Every ten sweeps all states
   are solved again, from the values at hand, to a hundredth of it. So the chain is exact up to the tolerance.
4. In the first third of the first round's sweeps the posterior is heated: log p/T, with T falling from 4 to 1. The
   first third of all sweeps is dropped.
5. Several chains start from few and from many closed barriers. Split-R̂ and effective sample sizes
   (`diagnostics`) compare them.
6. Chains that have not mixed at the end of a round are continued: twice as many sweeps in all, up to a limit.

Barriers that walks crossed are open and stay so. The density and strength of a hierarchical prior are drawn before each
sweep, given the map (`hierarchical`); while the chain is heated they are at their mode.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from itertools import count, takewhile
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from sidestep._arguments import to_key
from sidestep._repr import short_repr
from sidestep.errors import check_count, check_function
from sidestep.inference.chains import BarrierProblem, ChainState, problem_of
from sidestep.inference.checkpoints import Checkpoint, Saver, fingerprint
from sidestep.inference.diagnostics import effective_sizes, split_rhat
from sidestep.inference.fit import Estimate
from sidestep.inference.hierarchical import HierarchicalMRF
from sidestep.inference.maximize import Status
from sidestep.inference.mrf import BinaryMRF
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.likelihood import ALL_TERMS, Terms
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.models.barriers import with_closed
from sidestep.tabular.solvers.native import run_batch

Model = TypeVar("Model", bound=TransitionModel)

_HEAT, _DROPPED = 4.0, 1 / 3
"""The first heat, and the fraction of the sweeps that are dropped."""
_FEWEST, _MOST = 0.05, 0.5
"""The fractions of closed barriers from which the first and the last chain start."""
MIN_SWEEPS = 12
"""The fewest sweeps: two thirds of them have to be 4 draws or more in each half."""
_SURE = 1e-9
"""The least distance of the model's P(closed) from 0 and 1."""
MIXED_RHAT, _MIXED_FRACTION = 1.05, 0.9
"""Chains have mixed where split-R̂ is at most 1.05 for nine of ten barriers."""


class SweepProgress(NamedTuple):
    """The state of a sampler after a sweep; means over the chains.

    Attributes:
        iteration: The number of sweeps so far.
        total: The most sweeps that there may be; in a history the number of all sweeps.
        objective: log L(z) + log p(z), in nats, up to a constant.
        actions, transitions, prior: Its parts.
        accepted: The fraction of accepted proposals.

    Example:
        >>> SweepProgress(1, 300, objective=-3.0, actions=-2.0, transitions=-0.5, prior=-0.5, accepted=0.1).objective
        -3.0
    """

    iteration: int
    total: int
    objective: float
    actions: float
    transitions: float
    prior: float
    accepted: float

    @property
    def description(self) -> str:
        """Return the objective and the fraction of accepted proposals as text."""
        return f"objective {self.objective:.3f}, {self.accepted:.1%} of proposals accepted"


@short_repr("model", "behavior", "closed", "samples", "description")
@dataclass(frozen=True, eq=False)
class BarrierPosterior(Generic[Model]):
    """Samples of the barriers of a transition model from their posterior.

    Attributes:
        model: The transition model with the posterior's P(closed).
        behavior: The behavior model; it is not sampled.
        densities: δ and λ of the prior in each sweep that counts (`HierarchicalMRF`); empty where they are known.
        sampled: Whether each barrier was sampled; the others are known, or walks crossed them.
        samples: Whether each barrier is closed, after each sweep that counts, for each chain.
        closed: P(closed) of each barrier: (n + ½)/(N + 1) of n samples in N; exactly 0 or 1 where it is known.
        rhat: Split-R̂ of each barrier.
        effective_sizes: The number of independent samples that each P(closed) is worth.
        history: The progress after every sweep, heated ones included.
        status: `Status.MIXED` if the chains agree, `Status.NOT_MIXED` otherwise.
        learned_behavior: The parameters of the behavior that were learned before (see `Fit.learned_behavior`).

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(1, 3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1]), np.array([3]), task=0)], [ss.reach(grid, 1)])
        >>> prior = BinaryMRF(np.zeros(3), (1, 3))
        >>> posterior = sample_barriers(ss.ObstacleGrid(grid), shown, ss.Behavior(ss.BoltzmannAverage()), prior=prior)
        >>> posterior.sample(jax.random.key(0), 2).shape
        (2, 3)
    """

    model: Model
    behavior: BehaviorModel
    densities: Float[np.ndarray, "chains densities 2"]
    sampled: Bool[np.ndarray, " barriers"]
    samples: Bool[np.ndarray, "chains draws barriers"]
    closed: Float[np.ndarray, " barriers"]
    rhat: Float[np.ndarray, " barriers"]
    effective_sizes: Float[np.ndarray, " barriers"]
    history: tuple[SweepProgress, ...]
    status: Status
    learned_behavior: Mapping[str, Estimate] = field(default_factory=dict)

    @property
    def converged(self) -> bool:
        """Whether the chains have mixed."""
        return self.status is Status.MIXED

    @property
    def final(self) -> SweepProgress:
        """The means over the sweeps that count."""
        kept = np.array(self.history[-self.samples.shape[1] :]).mean(axis=0).tolist()
        return SweepProgress(len(self.history), len(self.history), *kept[2:])

    @property
    def message(self) -> str:
        """The status with its measure."""
        if not self.sampled.any():
            return f"{self.status.value} (no barrier was unknown)"
        size = np.median(self.effective_sizes[self.sampled])
        return (
            f"{self.status.value} (split-R̂ at most {MIXED_RHAT} for {self.fraction_mixed:.0%} of the sampled barriers, "
            f"median effective size {size:.0f})"
        )

    @property
    def fraction_mixed(self) -> float:
        """The fraction of sampled barriers with split-R̂ of at most 1.05; 1 if there are none."""
        return float((self.rhat[self.sampled] <= MIXED_RHAT).mean()) if self.sampled.any() else 1.0

    @property
    def description(self) -> str:
        """Return the number of samples, their mean objective and whether the chains have mixed as text."""
        chains, draws = self.samples.shape[:2]
        return f"{draws} samples of each of {chains} chains, mean objective {self.final.objective:.4f}; {self.message}"

    def thinned(self, most: int) -> Bool[np.ndarray, "draws barriers"]:
        """Return samples at equal distances along each chain.

        Args:
            most: The most samples of all chains together, at least their number.
        """
        chains, draws = self.samples.shape[:2]
        check_count(most, chains, "most")
        step = math.ceil(chains * draws / most)
        return self.samples[:, step - 1 :: step].reshape(-1, self.samples.shape[-1])

    def sample(self, key: Key[Array, ""], count: int) -> Bool[np.ndarray, "count barriers"]:
        """Draw maps from the samples of all chains, with replacement.

        Args:
            key: The random key.
            count: The number of maps, at least 1.

        Returns:
            Whether each barrier is closed, in each map.
        """
        check_count(count, 1, "count")
        every = self.samples.reshape(-1, self.samples.shape[-1])
        return every[np.asarray(jax.random.randint(to_key(key), (count,), 0, len(every)))]

    def summary(self) -> dict[str, Any]:
        """Return the posterior's numbers: log-likelihoods and log prior in nats, and how well the chains agree.

        Returns:
            Plain numbers and texts.
        """
        final = self.final
        learned = {name: number._asdict() for name, number in self.learned_behavior.items()}
        return {
            "objective": final.objective,
            "log_likelihood_actions": final.actions,
            "log_likelihood_transitions": final.transitions,
            "log_prior": final.prior,
            **self._density_summary(),
            "chains": self.samples.shape[0],
            "draws": self.samples.shape[1],
            "iterations": final.iteration,
            "accepted": final.accepted,
            "largest_rhat": float(self.rhat.max()) if np.isfinite(self.rhat).all() else None,
            "fraction_mixed": self.fraction_mixed,
            "smallest_effective_size": float(self.effective_sizes.min()),
            "converged": self.converged,
            "message": self.message,
            **({"learned_behavior": learned} if learned else {}),
        }

    def _density_summary(self) -> dict[str, dict[str, float]]:
        """Return the means and standard deviations of δ and λ; nothing where they are known."""
        if not self.densities.size:
            return {}
        means, deviations = self.densities.mean(axis=(0, 1)), self.densities.std(axis=(0, 1))
        pairs = zip(("prior_density", "prior_strength"), means, deviations, strict=True)
        return {name: {"mean": float(mean), "deviation": float(deviation)} for name, mean, deviation in pairs}


def sample_barriers(
    model: Model,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    *,
    prior: BinaryMRF | HierarchicalMRF,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
    sweeps: int = 300,
    most_sweeps: int | None = None,
    chains: int = 2,
    seed: int = 0,
    report: Callable[[SweepProgress], None] | None = None,
    checkpoint: str | Path | Checkpoint | None = None,
    resume: bool = False,
) -> BarrierPosterior[Model]:
    """Sample the barriers of a transition model from their posterior after demonstrations.

    Args:
        model: An `ObstacleGrid`, `SlipperyGrid`, `walled_grid` or `road_network`; slips stay as they are.
        demonstrations: Trajectories of agents that know the true dynamics.
        behavior: The behavior of the agents, or a fitted `BehaviorModel`; it stays as it is.
        prior: The prior of the barriers; the density and strength of a `HierarchicalMRF` are sampled along.
        tempering: κ in (0, 1], a factor of the actions' log-likelihood.
        terms: The parts of the likelihood that count.
        sweeps: The number of sweeps of each chain, at least 12; a sweep has a proposal for each unknown barrier.
        most_sweeps: The number of sweeps up to which chains that have not mixed are continued; None for `sweeps`.
        chains: The number of chains, at least 2.
        seed: The seed. The result does not depend on the number of cores.
        report: Called with a `SweepProgress` after every sweep.
        checkpoint: The file that is kept up to date with the state of the chains.
        resume: Continue from the checkpoint. The result is that of an uninterrupted run, to the last bit.

    Returns:
        The samples after the first third of the sweeps, P(closed), and whether the chains have mixed.

    Raises:
        InputError: For a model without barriers, a prior of another size, settings out of range, and a checkpoint
            that belongs to another problem.
        ImproperTask: For tasks without finite values.
        NotConverged: Where values do not converge.

    References:
        Metropolis et al. (1953); Christen & Fox (2005), *Markov chain Monte Carlo using an approximation*.
    """
    check_count(sweeps, MIN_SWEEPS, "sweeps")
    if report is not None:
        check_function(report, "report")
    most = sweeps if most_sweeps is None else most_sweeps
    check_count(most, sweeps, "most_sweeps")
    check_count(chains, 2, "chains")
    problem, agents = problem_of(model, demonstrations, behavior, prior, seed=seed, tempering=tempering, terms=terms)
    barriers = problem.barriers
    states = start_chains(problem, most, chains, seed)
    saver = Saver(checkpoint, fingerprint((astuple(problem), sweeps, most, chains, seed)))
    done = _load(saver, states) if resume else 0
    free = max(1, len(problem.free))
    status, total, samples, rhat = Status.NOT_MIXED, 0, np.zeros((0, 0, 0), bool), np.zeros(0)
    for total in rounds(sweeps, most):
        for number in range(done, total):
            run_sweep(problem, states, number, heat(number, sweeps))
            if report is not None:
                report(_progress(states, number, most, free))
            saver.save([_saved(state) for state in states], [[number + 1]])
        done = max(done, total)
        samples = np.stack([state.samples[dropped_sweeps(total) : total] for state in states])
        rhat = split_rhat(samples)
        if not len(problem.free) or (rhat[problem.free] <= MIXED_RHAT).mean() >= _MIXED_FRACTION:
            status = Status.MIXED
            break
    history = tuple(_progress(states, number, total, free) for number in range(total))
    known = barriers.known != Cell.UNKNOWN
    draws = samples.shape[0] * samples.shape[1]
    closed = np.where(known, samples[0, 0], (samples.sum(axis=(0, 1)) + 0.5) / (draws + 1))
    learned = with_closed(model, np.clip(closed, _SURE, 1 - _SURE))
    sampled = np.isin(np.arange(len(closed)), problem.free)
    sizes = effective_sizes(samples)
    counts = slice(dropped_sweeps(total) if problem.prior.log_prior.size > 1 else total, total)
    densities = np.stack([state.densities[counts] for state in states])
    return BarrierPosterior(learned, agents, densities, sampled, samples, closed, rhat, sizes, history, status)


def rounds(sweeps: int, most_sweeps: int) -> list[int]:
    """Return the numbers of sweeps after which it is checked whether the chains have mixed, ascending.

    Args:
        sweeps: The first of them.
        most_sweeps: The last of them; each of the others is twice the one before.

    Example:
        >>> rounds(200, 500)
        [200, 400, 500]
    """
    return [
        *takewhile(lambda total: total < most_sweeps, (sweeps * 2**doublings for doublings in count())),
        most_sweeps,
    ]


def dropped_sweeps(sweeps: int) -> int:
    """Return the number of sweeps that are dropped; of the first round, these are heated.

    Args:
        sweeps: The number of all sweeps.
    """
    return math.ceil(sweeps * _DROPPED)


def heat(number: int, sweeps: int) -> float:
    """Return the heat of a sweep: from 4 to 1 over the first third of the first round, 1 from then on.

    Args:
        number: The number of the sweep, from 0.
        sweeps: The number of sweeps of the first round.
    """
    heated = dropped_sweeps(sweeps)
    return 1.0 if number >= heated else _HEAT ** (1 - number / heated)


def start_chains(problem: BarrierProblem, sweeps: int, chains: int, seed: int) -> list[ChainState]:
    """Return chains that start from few to many closed barriers, each with a generator of its own.

    Args:
        problem: What is sampled.
        sweeps: The number of sweeps that they will make.
        chains: Their number.
        seed: The seed.
    """
    states = []
    sequences = np.random.SeedSequence(seed).spawn(chains)
    for fraction, sequence in zip(np.linspace(_FEWEST, _MOST, chains), sequences, strict=True):
        random = np.random.Generator(np.random.PCG64(sequence))
        states.append(problem.start(random.random(len(problem.barriers.known)) < fraction, sweeps, random))
    return states


def run_sweep(problem: BarrierProblem, states: Sequence[ChainState], number: int, heat: float) -> None:
    """Make a sweep of every chain, on all cores.

    Args:
        problem: What is sampled.
        states: The chains, changed in place.
        number: The number of the sweep, from 0.
        heat: T, where the chains sample the posterior to the power 1/T.
    """
    run_batch(lambda index: problem.sweep(states[index[0]], number, heat), [(at,) for at in range(len(states))])


def _progress(states: Sequence[ChainState], number: int, total: int, free: int) -> SweepProgress:
    actions, transitions = np.mean([state.log_likelihoods[number] for state in states], axis=0).tolist()
    prior = float(np.mean([state.log_priors[number] for state in states]))
    accepted = float(np.mean([state.accepted[number] for state in states])) / free
    return SweepProgress(number + 1, total, actions + transitions + prior, actions, transitions, prior, accepted)


def _saved(state: ChainState) -> tuple[Any, ...]:
    """Return the arrays on which the future of a chain depends, its generator as four words among them."""
    words = [state.random.bit_generator.state["state"][name] for name in ("state", "inc")]
    generator = np.array([word >> shift & (2**64 - 1) for word in words for shift in (64, 0)], np.uint64)
    samples = state.samples, state.log_likelihoods, state.log_priors, state.accepted, state.densities
    return tuple(state.chain), state.work.counters, *samples, generator


def _load(saver: Saver, states: Sequence[ChainState]) -> int:
    """Fill in the chains from a checkpoint; return the number of sweeps that they have made."""
    saved, history, _ = saver.load([_saved(state) for state in states])
    if not history:
        return 0
    for state, arrays in zip(states, saved, strict=True):
        for into, array in zip(jax.tree.leaves(_saved(state))[:-1], jax.tree.leaves(arrays)[:-1], strict=True):
            into[...] = array
        high, low, inc_high, inc_low = (int(word) for word in arrays[-1])
        words = {"state": high << 64 | low, "inc": inc_high << 64 | inc_low}
        state.random.bit_generator.state = {**state.random.bit_generator.state, "state": words}
    return int(history[0][0])
