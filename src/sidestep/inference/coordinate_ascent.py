"""The mean field of barriers by coordinate ascent, from several starts.

Barriers are taken as independent, q(z) = Π_i Bernoulli(p_i), and each p_i is set in turn to what the others imply:

    p_i = σ(η_i + E[h | z_i = 1] − E[h | z_i = 0] + log L(z_i = 1) − log L(z_i = 0))

h are the shape terms of the prior. Their means over q are exact, because each is a product of different barriers. L is
the likelihood where barrier i is closed or open, and the others let an agent pass with their mean probability. Were it
E[log L] over the others, this would be coordinate ascent variational inference (Bishop 2006, *Pattern Recognition and
Machine Learning*, section 10.1). One barrier alone is exact.

`MeanField` with `sidestep.fit` has L at the means of all barriers. Its gradient by p_i is the slope of log L at p_i.
But log L is far from linear: a barrier that lets an agent pass half of the time costs one step, one that never does
costs a detour. The posterior depends on the difference between closed and open.

Where any one of several barriers explains a detour, there are several mean fields. They are found from several starts,
and those that differ are mixed with weights in proportion to exp(log L + E[log p(z)] + H(q)) (Jaakkola & Jordan 1998,
*Improving the mean field approximation via the use of mixture distributions*, without their term for the overlap of the
parts).

Values follow each change by local value iteration, as in the sampler (`chain_kernels`). All states are solved anew
after every sweep. Sweeps go through the barriers forwards and backwards in turn. There is no objective that must rise,
and whole steps may go round in circles. So from the fifth sweep on, p_i moves half of the way.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key
from scipy.special import entr, expit, softmax

from sidestep._arguments import to_key
from sidestep._repr import short_repr
from sidestep.errors import check, check_count, check_function, check_instance
from sidestep.inference.chain_kernels import Chain, Workspace
from sidestep.inference.chains import BarrierProblem, problem_of
from sidestep.inference.checkpoints import Checkpoint, Saver, fingerprint
from sidestep.inference.fit import Estimate
from sidestep.inference.maximize import Status
from sidestep.inference.mrf import BinaryMRF, expected_shapes
from sidestep.inference.prior_chains import native_terms
from sidestep.inference.prior_kernels import ascend_prior
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.likelihood import ALL_TERMS, Terms
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.models.barriers import with_closed
from sidestep.tabular.solvers.native import run_batch

Model = TypeVar("Model", bound=TransitionModel)

_TOLERANCE = 1e-3
"""The largest gap between P(closed) and what the other barriers imply at which the mean field has converged."""
Sweep = Float[np.ndarray, "starts 4"]
"""Of each start after a sweep, the largest gap and the parts of the objective: of actions, transitions, the prior."""

_WHOLE_SWEEPS = 4
"""The number of first sweeps with whole steps."""
_NEARLY = (0.02, 0.98)
"""P(closed) of barriers that are open or closed at a random start."""
_DIFFERENT = 0.05
"""The largest difference of P(closed) up to which two mean fields are the same."""
_SURE = 1e-9
"""The least distance of the model's P(closed) from 0 and 1."""


class AscentProgress(NamedTuple):
    """The state of a mean field after a sweep.

    Attributes:
        iteration: The number of sweeps so far.
        total: The most sweeps that there may be.
        objective: log L + E[log p(z)] + H(q) in nats up to a constant, with L at the means; that of the best start.
        actions, transitions, prior: Its parts.
        gap: The largest difference between P(closed) and what the other barriers implied in the sweep, of all starts.

    Example:
        >>> AscentProgress(1, 100, objective=-3.0, actions=-2.0, transitions=-0.5, prior=-0.5, gap=0.2).gap
        0.2
    """

    iteration: int
    total: int
    objective: float
    actions: float
    transitions: float
    prior: float
    gap: float

    @property
    def description(self) -> str:
        """Return the objective and the largest gap as text."""
        return f"objective {self.objective:.3f}, P(closed) off by at most {self.gap:.2g}"


@short_repr()
@dataclass(frozen=True, eq=False)
class BarrierMeanField(Generic[Model]):
    """A mixture of independent barriers that approximates the posterior of a transition model.

    Attributes:
        model: The transition model with the mixture's P(closed).
        behavior: The behavior model; it stays as it was.
        inferred: Whether P(closed) of each barrier was inferred; the others are known, or walks crossed them.
        parts: P(closed) of each barrier in each part of the mixture.
        weights: The weights of the parts; they sum to 1.
        history: The progress after every sweep.
        status: `Status.CONVERGED` if the last gap is at most 1e-3, `Status.MAX_ITERATIONS` otherwise.
        learned_behavior: The parameters of the behavior that were learned before (see `Fit.learned_behavior`).

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(1, 3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1]), np.array([3]), task=0)], [ss.reach(grid, 1)])
        >>> prior = BinaryMRF(np.zeros(3), (1, 3))
        >>> behavior = ss.Behavior(ss.BoltzmannAverage())
        >>> posterior = mean_field_barriers(ss.ObstacleGrid(grid), shown, behavior, prior=prior)
        >>> posterior.closed.round(3).tolist()
        [0.0, 0.0, 0.5]
    """

    model: Model
    behavior: BehaviorModel
    inferred: Bool[np.ndarray, " barriers"]
    parts: Float[np.ndarray, "parts barriers"]
    weights: Float[np.ndarray, " parts"]
    history: tuple[AscentProgress, ...]
    status: Status
    learned_behavior: Mapping[str, Estimate] = field(default_factory=dict)

    @property
    def closed(self) -> Float[np.ndarray, " barriers"]:
        """P(closed) of each barrier."""
        return self.weights @ self.parts

    @property
    def converged(self) -> bool:
        """Whether, in each part, each P(closed) is what the others imply."""
        return self.status is Status.CONVERGED

    @property
    def final(self) -> AscentProgress:
        """The progress after the last sweep."""
        return self.history[-1]

    @property
    def message(self) -> str:
        """The status with its measure."""
        return f"{self.status.value} (P(closed) is within {self.final.gap:.2g} of what the others imply)"

    @property
    def description(self) -> str:
        """Return the objective and how the ascent ended as text."""
        return (
            f"mean field with objective {self.final.objective:.4f} after {self.final.iteration} sweeps; {self.message}"
        )

    def sample(self, key: Key[Array, ""], count: int) -> Bool[np.ndarray, "count barriers"]:
        """Draw maps: a part of the mixture each, and in it independent barriers.

        Args:
            key: The random key.
            count: The number of maps, at least 1.

        Returns:
            Whether each barrier is closed, in each map.
        """
        check_count(count, 1, "count")
        of_part, of_barriers = jax.random.split(to_key(key))
        part = np.asarray(jax.random.choice(of_part, len(self.weights), (count,), p=jax.numpy.asarray(self.weights)))
        return np.asarray(jax.random.uniform(of_barriers, (count, self.parts.shape[1]))) < self.parts[part]

    def summary(self) -> dict[str, Any]:
        """Return the numbers: log-likelihoods at the means and log prior in nats, and how the ascent ended.

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
            "iterations": final.iteration,
            "parts": len(self.parts),
            "largest_gap": final.gap,
            "converged": self.converged,
            "message": self.message,
            **({"learned_behavior": learned} if learned else {}),
        }


def mean_field_barriers(
    model: Model,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    *,
    prior: BinaryMRF,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
    starts: int = 4,
    max_sweeps: int = 100,
    seed: int = 0,
    report: Callable[[AscentProgress], None] | None = None,
    checkpoint: str | Path | Checkpoint | None = None,
    resume: bool = False,
) -> BarrierMeanField[Model]:
    """Approximate the posterior of the barriers of a transition model after demonstrations by mean fields.

    Args:
        model: An `ObstacleGrid`, `SlipperyGrid`, `walled_grid` or `road_network`; slips stay as they are.
        demonstrations: Trajectories of agents that know the true dynamics.
        behavior: The behavior of the agents, or a fitted `BehaviorModel`; it stays as it is.
        prior: The prior of the barriers.
        tempering: κ in (0, 1], a factor of the actions' log-likelihood.
        terms: The parts of the likelihood that count.
        starts: The number of starts, at least 1. The first is the prior without shapes, the others are random maps.
        max_sweeps: The most sweeps from each start, at least 1.
        seed: The seed of the starts. The result does not depend on the number of cores.
        report: Called with an `AscentProgress` after every sweep.
        checkpoint: The file that is kept up to date with the state of the ascent.
        resume: Continue from the checkpoint. The result is that of an uninterrupted run, to the last bit.

    Returns:
        P(closed) of each barrier, and whether the ascent has converged.

    Raises:
        InputError: For a model without barriers, a prior of another size, settings out of range, and a checkpoint
            that belongs to another problem.
        ImproperTask: For tasks without finite values.
        NotConverged: Where values do not converge.

    References:
        Bishop (2006), *Pattern Recognition and Machine Learning*, section 10.1; Blei, Kucukelbir & McAuliffe (2017),
        *Variational inference: a review for statisticians*.
    """
    check_count(starts, 1, "starts")
    check_count(max_sweeps, 1, "max_sweeps")
    check_instance(prior, BinaryMRF, "prior")
    if report is not None:
        check_function(report, "report")
    problem, agents = problem_of(model, demonstrations, behavior, prior, tempering=tempering, terms=terms)
    states, history = _starts(problem, prior, starts, seed), list[Sweep]()
    saver = Saver(checkpoint, fingerprint((astuple(problem), starts, seed)))
    if resume:
        history = _load(saver, states)
    while len(history) < max_sweeps and not (history and (history[-1][:, 0] <= _TOLERANCE).all()):
        after = np.zeros((starts, 4)) if not history else history[-1].copy()
        _sweep_all(problem, prior, states, len(history), after)
        history.append(after)
        if report is not None:
            report(_progress(after, len(history), max_sweeps))
        saver.save([_saved(state) for state in states], [each.ravel().tolist() for each in history])
    kept = _different(states, history[-1], problem.free)
    parts, weights = np.stack([states[at].means for at in kept]), softmax(history[-1][kept, 1:].sum(axis=1))
    learned = with_closed(model, np.clip(weights @ parts, _SURE, 1 - _SURE))
    inferred = np.isin(np.arange(parts.shape[1]), problem.free)
    progress = tuple(_progress(each[kept], number, len(history)) for number, each in enumerate(history, 1))
    status = Status.CONVERGED if progress[-1].gap <= _TOLERANCE else Status.MAX_ITERATIONS
    return BarrierMeanField(learned, agents, inferred, parts, weights, progress, status)


def prior_mean_field(
    prior: BinaryMRF,
    known: Int[np.ndarray, " barriers"],
    start: Float[np.ndarray, " barriers"],
    *,
    max_sweeps: int = 1000,
) -> Float[np.ndarray, " barriers"]:
    """Return P(closed) of each barrier in the mean field of a prior alone.

    Args:
        prior: The prior.
        known: The `Cell` value of each barrier; known ones have 0 or 1.
        start: P(closed) at which the ascent begins; strong shape terms have several mean fields.
        max_sweeps: The most sweeps; it ends earlier where no P(closed) changes by more than 1e-3.

    Raises:
        InputError: For another number of barriers.

    Example:
        >>> prior_mean_field(BinaryMRF(np.zeros(3)), np.array([-1, 0, 1]), np.zeros(3)).tolist()
        [0.5, 0.0, 1.0]
    """
    for name, values in (("known", known), ("start", start)):
        size = len(prior.field)
        check(len(values) == size, f"expected {size} barriers, found {len(values)}", field=name)
    free, terms = np.flatnonzero(known == Cell.UNKNOWN), native_terms(prior)
    means = np.where(known == Cell.UNKNOWN, start, known == Cell.OCCUPIED).astype(np.float64)
    for number in range(max_sweeps):
        if ascend_prior(_order(free, number), _step(number), terms, means) <= _TOLERANCE:
            break
    return means


class _State(NamedTuple):
    """The state of an ascent, changed in place: a chain with mean probabilities, its memory, and P(closed)."""

    chain: Chain
    work: Workspace
    means: Float[np.ndarray, " barriers"]


def _starts(problem: BarrierProblem, prior: BinaryMRF, starts: int, seed: int) -> list[_State]:
    """Return the mean field of the prior without shape terms, and barriers that are open or closed at random."""
    random, free = np.random.default_rng(seed), problem.free
    occupied = problem.barriers.known == Cell.OCCUPIED
    states = []
    for number in range(starts):
        means = occupied.astype(np.float64)
        means[free] = expit(prior.field[free]) if number == 0 else random.choice(_NEARLY, len(free))
        chain, work = problem.allocate(occupied.astype(np.uint8))
        open_, closed = problem.world.passing[free].T
        chain.passing[free] = (1 - means[free]) * open_ + means[free] * closed
        states.append(_State(chain, work, means))
    return states


def _sweep_all(problem: BarrierProblem, prior: BinaryMRF, states: Sequence[_State], number: int, after: Sweep) -> None:
    """Make a sweep from every start that has not converged; fill in its gap and objective."""

    def sweep(place: tuple[int, ...]) -> None:
        (at,) = place
        after[at] = _sweep(problem, prior, states[at], number)

    run_batch(sweep, [(at,) for at in range(len(states)) if number == 0 or after[at, 0] > _TOLERANCE])


def _sweep(problem: BarrierProblem, prior: BinaryMRF, state: _State, number: int) -> tuple[float, ...]:
    """Set P(closed) of each barrier in turn; return the largest gap and the parts of the objective."""
    if number == 0:
        problem.solve(state.chain)
        problem.refresh(state.chain, state.work)
    arguments = problem.world, problem.evidence, native_terms(prior), state.means, state.chain, state.work
    ascend, order = problem.kernels.ascend, _order(problem.free, number)
    gap = ascend(order, _step(number), *arguments, *problem.backup)
    problem.refresh(state.chain, state.work)
    return gap, *state.chain.totals.tolist(), _mean_log_density(prior, state.means)


def _order(free: Int[np.ndarray, " free"], number: int) -> Int[np.ndarray, " free"]:
    return np.ascontiguousarray(free[::-1] if number % 2 else free)


def _step(number: int) -> float:
    """Return the part of each gap that a sweep closes."""
    return 1.0 if number < _WHOLE_SWEEPS else 0.5


def _mean_log_density(prior: BinaryMRF, closed: Float[np.ndarray, " barriers"]) -> float:
    """Return E[log p(z)] + H(q), up to a constant."""
    total = prior.field @ closed + entr(closed).sum() + entr(1 - closed).sum()
    if prior.shape is not None:
        total += prior.weights @ expected_shapes(np.pad(closed.reshape(prior.shape), 1))
    return float(total)


def _different(states: Sequence[_State], last: Sweep, free: Int[np.ndarray, " free"]) -> list[int]:
    """Return the starts with mean fields that differ, the best first."""
    kept: list[int] = []
    for at in np.argsort(-last[:, 1:].sum(axis=1), kind="stable").tolist():
        gaps = [np.abs(states[at].means - states[other].means)[free].max(initial=0.0) for other in kept]
        if min(gaps, default=1.0) > _DIFFERENT:
            kept.append(at)
    return kept


def _progress(sweep: Sweep, number: int, total: int) -> AscentProgress:
    """Return the progress after a sweep."""
    actions, transitions, prior = max(sweep[:, 1:].tolist(), key=sum)
    gap = float(sweep[:, 0].max())
    return AscentProgress(number, total, actions + transitions + prior, actions, transitions, prior, gap)


def _saved(state: _State) -> tuple[np.ndarray, ...]:
    """Return the arrays on which the future of an ascent depends."""
    return *state.chain, state.work.counters, state.means


def _load(saver: Saver, states: Sequence[_State]) -> list[Sweep]:
    """Fill in the states from a checkpoint; return the sweeps that they have made."""
    saved, history, _ = saver.load([_saved(state) for state in states])
    for state, arrays in zip(states, saved, strict=True):
        for into, array in zip(_saved(state), arrays, strict=True):
            into[...] = array
    return [np.array(row, np.float64).reshape(len(states), 4) for row in history]
