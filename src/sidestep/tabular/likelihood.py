"""The likelihood of demonstrations under a transition model (eqs. 1 and 6).

    log L(θ) = Σ_i Σ_t [ log π_θ(a_t | s_t)  +  ln T_θ(s_t, a_t, s_{t+1}) ],      log π_θ = βQ_θ − log Σ_a exp βQ_θ

Agents plan with the dynamics that they know, so both terms depend on θ: the *actions* through the values, the observed
*transitions* directly. Each can be left out. Each move counts by its weight.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import check
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations, next_power_of_two, pad_to_power_of_two
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import Solution, SolveOptions, solve
from sidestep.tabular.solvers.base import WarmStart, action_values
from sidestep.tabular.tasks import Task

Term = Literal["actions", "transitions"]
Terms = tuple[Term, ...]
ALL_TERMS: Terms = ("actions", "transitions")
_MIN_LENGTH = 16
"""Lists of choices and of arrivals are padded to this length at least."""


class LogLikelihood(NamedTuple):
    """The two terms of the log-likelihood, in nats.

    Attributes:
        actions: Σ log π_θ(a | s) over all moves; 0 if left out.
        transitions: Σ ln T_θ(s, a, s′) over all moves; 0 if left out.

    Example:
        >>> float(LogLikelihood(jnp.asarray(-2.0), jnp.asarray(-1.0)).total)
        -3.0
    """

    actions: Float[Array, ""]
    transitions: Float[Array, ""]

    @property
    def total(self) -> Float[Array, ""]:
        """Return log L(θ)."""
        return self.actions + self.transitions


def log_likelihood(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    terms: Terms = ALL_TERMS,
    options: SolveOptions | None = None,
) -> LogLikelihood:
    """Return log L(θ) of demonstrations by agents that act as `behavior` describes and know `model`.

    Args:
        model: The transition model; differentiable in its parameters θ.
        demonstrations: Moves and tasks. One compiled function serves demonstrations of many lengths.
        behavior: The policy that values of actions lead to; after a fit, `fit.behavior.behavior_of(person)`.
        terms: The terms that count, "actions", "transitions" or both.
        options: How values are computed; by default `SolveOptions()`.

    Returns:
        Both terms. The actions' term is NaN if the values of a task did not converge.

    Raises:
        InputError: For a `BehaviorModel`, which has a behavior of each person.

    Example:
        >>> from sidestep.tabular.backups import BoltzmannAverage
        >>> from sidestep.tabular.demonstrations import Trajectory, gather
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> walk = Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)
        >>> shown = gather([walk], [reach(grid, 2)])
        >>> float(log_likelihood(true_model(grid), shown, Behavior(BoltzmannAverage())).transitions)
        0.0

    References:
        Equations 1 and 6 of the behavior-aware modeling paper.
    """
    message = "expected a Behavior; a BehaviorModel has one of each person: `behavior_of(person)`"
    check(isinstance(behavior, Behavior), message, field="behavior")
    return _log_likelihood(model, pad_to_power_of_two(demonstrations), behavior, terms, options or SolveOptions())


@eqx.filter_jit
def _log_likelihood(
    model: TransitionModel, demonstrations: Demonstrations, behavior: Behavior, terms: Terms, options: SolveOptions
) -> LogLikelihood:
    actions = transitions = jnp.zeros((), model.probabilities().dtype)
    if "actions" in terms:
        each = _log_policies(model, demonstrations, behavior, options)
        actions = jnp.sum(each * demonstrations.weights.astype(each.dtype))
    if "transitions" in terms:
        transitions = arrival_log_likelihood(model, _arrivals(demonstrations))
    return LogLikelihood(actions, transitions)


def log_policies(
    model: TransitionModel, demonstrations: Demonstrations, behavior: Behavior, *, options: SolveOptions | None = None
) -> Float[Array, " moves"]:
    """Return log π_θ(a | s) of every move; NaN if the values of a task did not converge.

    Args:
        model: As for `log_likelihood`, like the other arguments.
        demonstrations: Moves and tasks.
        behavior: The policy that values of actions lead to.
        options: How values are computed; by default `SolveOptions()`.

    Returns:
        One number for each move, in nats.

    Example:
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.demonstrations import Trajectory, gather
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> shown = gather([Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [reach(grid, 2)])
        >>> log_policies(true_model(grid), shown, Behavior(HardMax(), 50.0)).shape
        (2,)
    """
    padded = pad_to_power_of_two(demonstrations)
    return _first(_log_policies(model, padded, behavior, options or SolveOptions()), len(demonstrations))


@eqx.filter_jit
def _log_policies(
    model: TransitionModel, demonstrations: Demonstrations, behavior: Behavior, options: SolveOptions
) -> Float[Array, " moves"]:
    solution = solve(model, demonstrations.tasks, behavior, options=options)
    q = visited_action_values(model, demonstrations, solution.values_after)
    # a factor, so that the gradient is NaN too
    each = _log_policy(model, behavior, q, demonstrations.states, demonstrations.actions)
    return each * jnp.where(solution.converged.all(), 1.0, jnp.nan)


class Choices(NamedTuple):
    """The distinct actions taken in pursuit of a task, with a leading `tasks` axis for several tasks.

    Attributes:
        states: The state in which each action was taken.
        actions: The action.
        counts: The sum of the weights of these moves; 0 for padding.
    """

    states: Int[Array, "*tasks choices"]
    actions: Int[Array, "*tasks choices"]
    counts: Float[Array, "*tasks choices"]


def choice_log_likelihood(
    model: TransitionModel,
    task: Task,
    choices: Choices,
    behavior: Behavior,
    start: WarmStart,
    *,
    options: SolveOptions | None = None,
    region: Bool[Array, " states"] | None = None,
) -> tuple[Float[Array, ""], Solution]:
    """Return Σ log π_θ(a | s) over the choices made in pursuit of one task, and the task's solution.

    Over the tasks of `choices_of(demonstrations)` it adds up to the actions' term of `log_likelihood`.

    Args:
        model: As for `solve`, like the arguments that are not explained here.
        task: One task.
        choices: Of that task.
        behavior: The policy that values of actions lead to.
        start: The solve's start.
        options: How values are computed.
        region: The states that have to be solved.

    Returns:
        The log-likelihood, NaN if the values did not converge, and the solution.
    """
    solution = solve(model, task, behavior, options=options, start=start, visited=choices.states, region=region)
    q = solution.action_values
    each = _log_policy(model, behavior, q, choices.states, choices.actions)
    # those that do not count may be impossible
    total = jnp.sum(jnp.where(choices.counts > 0, choices.counts.astype(q.dtype) * each, 0))
    return total * jnp.where(solution.converged, 1.0, jnp.nan), solution


def choices_of(demonstrations: Demonstrations) -> Choices:
    """Return the distinct choices of each task, with their counts.

    Args:
        demonstrations: The moves and their tasks.
    """
    distinct, counts = _distinct_moves(demonstrations, "task", "states", "actions")
    sizes = np.bincount(distinct[0], minlength=len(demonstrations.tasks.terminal))
    filled = np.arange(next_power_of_two(max(int(sizes.max()), _MIN_LENGTH))) < sizes[:, None]

    def padded(part: np.ndarray) -> Array:
        whole = np.zeros(filled.shape, part.dtype if part.dtype.kind == "f" else np.int32)
        whole[filled] = part
        return to_jax(whole)

    return Choices(padded(distinct[1]), padded(distinct[2]), padded(counts))


class Arrivals(NamedTuple):
    """The distinct transitions (s, a, s′) of demonstrations.

    Attributes:
        states: s.
        actions: a.
        next_states: s′.
        counts: The sum of the weights of these moves; 0 for padding.
    """

    states: Int[Array, " arrivals"]
    actions: Int[Array, " arrivals"]
    next_states: Int[Array, " arrivals"]
    counts: Float[Array, " arrivals"]


def arrivals_of(demonstrations: Demonstrations) -> Arrivals:
    """Return the distinct transitions of all tasks, with their counts; padded by the first one with counts of 0.

    Args:
        demonstrations: The moves.
    """
    distinct, counts = _distinct_moves(demonstrations, "states", "actions", "next_states")
    missing = next_power_of_two(max(len(counts), _MIN_LENGTH)) - len(counts)
    padded = np.concatenate([distinct, np.repeat(distinct[:, :1], missing, axis=1)], axis=1)
    states, actions, next_states = (to_jax(part) for part in padded)
    return Arrivals(states, actions, next_states, to_jax(np.pad(counts, (0, missing))))


def _distinct_moves(demonstrations: Demonstrations, *fields: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct values of some fields, one move a column, and the sum of the weights of each."""
    moves = np.stack([np.asarray(getattr(demonstrations, field)) for field in fields])
    distinct, which = np.unique(moves, axis=1, return_inverse=True)
    return distinct, np.bincount(which.ravel(), np.asarray(demonstrations.weights))


def arrival_log_likelihood(model: TransitionModel, arrivals: Arrivals) -> Float[Array, ""]:
    """Return Σ ln T_θ(s, a, s′) over arrivals, each by its count; those that count 0 may be impossible.

    Args:
        model: The transition model.
        arrivals: Of its graph.
    """
    each = jnp.log(jnp.where(arrivals.counts > 0, _transition_probabilities(model, arrivals), 1))
    return jnp.sum(each * arrivals.counts.astype(each.dtype))


def visited_action_values(
    model: TransitionModel, demonstrations: Demonstrations, values: Float[Array, "tasks states"]
) -> Float[Array, "moves actions"]:
    """Return Q(s, a) of the state before each move, from the values of all tasks.

    Args:
        model: The transition model.
        demonstrations: Moves and tasks.
        values: V of each task after an action (`Solution.values_after`).
    """
    tasks, task, states = demonstrations.tasks, demonstrations.task, demonstrations.states
    after = values[task[:, None, None], model.graph.successors[states]]
    probabilities, available = model.probabilities()[states], model.graph.available
    reward = tasks.reward[task, states if tasks.reward.shape[1] > 1 else 0].astype(values.dtype)
    if tasks.outcome_reward is not None:
        of_outcomes = tasks.outcome_reward[task, states if tasks.outcome_reward.shape[1] > 1 else 0]
        reward = reward + jnp.sum(probabilities * of_outcomes.astype(values.dtype), axis=-1)
    mask = available[states if len(available) > 1 else jnp.zeros_like(states)]
    discount = tasks.discount[task, None].astype(values.dtype)
    return action_values(values[task, states], after, probabilities, reward, mask, discount)


def transition_probabilities(model: TransitionModel, moves: Demonstrations) -> Float[Array, " moves"]:
    """Return T_θ(s, a, s′) of every move.

    Args:
        model: The transition model.
        moves: Their states, actions and next states.
    """
    return _first(_transition_probabilities(model, _arrivals(pad_to_power_of_two(moves))), len(moves))


def _arrivals(moves: Demonstrations) -> Arrivals:
    return Arrivals(moves.states, moves.actions, moves.next_states, moves.weights)


@eqx.filter_jit
def _transition_probabilities(model: TransitionModel, moves: Arrivals) -> Float[Array, " moves"]:
    states, actions = moves.states, moves.actions
    leads_there = model.graph.successors[states, actions] == moves.next_states[:, None]
    return jnp.sum(jnp.where(leads_there, model.probabilities()[states, actions], 0), axis=-1)


def _log_policy(
    model: TransitionModel,
    behavior: Behavior,
    q: Float[Array, "visits actions"],
    states: Int[Array, " visits"],
    actions: Int[Array, " visits"],
) -> Float[Array, " visits"]:
    available = model.graph.available
    mask = available[states] if len(available) > 1 else None
    return jnp.take_along_axis(behavior.log_policy(q, mask), actions[:, None], axis=-1)[:, 0]


def _first(each: Float[Array, " padded"], count: int) -> Float[Array, " moves"]:
    """Return the first entries, without compiling a slice for every count."""
    return each[:count] if isinstance(each, Tracer) else to_jax(np.asarray(each)[:count])
