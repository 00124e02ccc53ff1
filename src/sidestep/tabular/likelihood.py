"""The likelihood of demonstrations under a transition model (eqs. 1 and 6).

    log L(θ) = Σ_i Σ_t [ log π_θ(a_t | s_t)  +  ln T_θ(s_t, a_t, s_{t+1}) ],      log π_θ = βQ_θ − log Σ_a exp βQ_θ

Agents plan with the dynamics that they know, so both terms depend on θ: the *actions* through the values, the observed
*transitions* directly. Each can be left out. Each move counts by its weight.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import check, check_instance
from sidestep.tabular.arrays import is_traced, to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel, as_behavior_model
from sidestep.tabular.checks import (
    check_behavior,
    check_demonstrations,
    check_model,
    check_persons,
)
from sidestep.tabular.demonstrations import Demonstrations, next_power_of_two, pad_to_power_of_two
from sidestep.tabular.graph import available_mask
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solve import Solution, SolveOptions, expected_reward, solve
from sidestep.tabular.solvers.base import WarmStart, advantages
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
    behavior: Behavior | BehaviorModel,
    *,
    terms: Terms = ALL_TERMS,
    options: SolveOptions | None = None,
) -> LogLikelihood:
    """Return log L(θ) of demonstrations by agents that act as `behavior` describes and know `model`.

    Args:
        model: The transition model; differentiable in its parameters θ, twice with the exact gradient (`jax.hessian`).
        demonstrations: Moves and tasks. One compiled function serves demonstrations of many lengths.
        behavior: The policy that values of actions lead to; after a fit, `fit.behavior`.
        terms: The terms that count, "actions", "transitions" or both.
        options: How values are computed; by default `SolveOptions()`.

    Returns:
        Both terms. The actions' term is NaN if the values of a task did not converge.

    Raises:
        InputError: For demonstrations of another world, or with actions that are not available, and for other terms.
        ImproperTask: For tasks without values.

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
    options = SolveOptions() if options is None else options
    check_terms(terms)
    check_likelihood(model, demonstrations, behavior, options)
    padded, agents = padded_for(demonstrations, behavior)
    return _log_likelihood(model, padded, agents, terms, options)


def check_terms(terms: Terms) -> None:
    """Raise `InputError` unless terms are "actions", "transitions" or both.

    Args:
        terms: The terms.
    """
    known = isinstance(terms, (tuple, list)) and len(terms) > 0 and set(terms) <= set(ALL_TERMS)
    check(known, f"expected one or both of {ALL_TERMS} in a tuple, found {terms!r}", field="terms")


def check_likelihood(
    model: TransitionModel, demonstrations: Demonstrations, behavior: Behavior | BehaviorModel, options: SolveOptions
) -> None:
    """Raise an error unless demonstrations have a likelihood under a model.

    Args:
        model: The transition model.
        demonstrations: Moves and tasks.
        behavior: The agents'.
        options: How values are computed.

    Raises:
        InputError: For arguments of another kind, or of different worlds.
        ImproperTask: For tasks without values.
    """
    check_instance(options, SolveOptions, "options")
    check_model(model)
    check_behavior(behavior, model.graph)
    check_demonstrations(demonstrations, model.graph)
    check_persons(behavior, len(demonstrations.tasks.terminal))
    check_deadline(demonstrations, options)
    if not is_traced(model, demonstrations, behavior):
        check_proper(demonstrations.tasks, behavior, model.graph, options.horizon)


def check_deadline(demonstrations: Demonstrations, options: SolveOptions) -> None:
    """Raise `InputError` unless all trajectories end by the deadline, where there is one.

    Args:
        demonstrations: Moves and tasks.
        options: With the horizon.
    """
    if options.deadline and not is_traced(demonstrations):
        lengths = np.bincount(np.asarray(demonstrations.trajectory))
        longest = int(np.argmax(lengths))
        message = f"expected at most {options.horizon} moves by the deadline, found {lengths[longest]}"
        valid = lengths[longest] <= (options.horizon or 0)
        check(valid, message, source=f"trajectory {longest}", field="demonstrations")


def padded_for(
    demonstrations: Demonstrations, behavior: Behavior | BehaviorModel
) -> tuple[Demonstrations, BehaviorModel]:
    """Return demonstrations padded to powers of two, and a behavior model with a person of each padded task.

    Args:
        demonstrations: Moves and tasks.
        behavior: The agents'.
    """
    padded, agents = pad_to_power_of_two(demonstrations), as_behavior_model(behavior)
    if agents.person is None:
        return padded, agents
    missing = len(padded.tasks.terminal) - len(agents.person)
    person = to_jax(np.pad(np.asarray(agents.person), (0, missing)))
    return padded, eqx.tree_at(lambda each: each.person, agents, person)


@eqx.filter_jit
def _log_likelihood(
    model: TransitionModel, demonstrations: Demonstrations, agents: BehaviorModel, terms: Terms, options: SolveOptions
) -> LogLikelihood:
    actions = transitions = jnp.zeros((), model.probabilities().dtype)
    if "actions" in terms:
        each = _log_policies(model, demonstrations, agents, options)
        counts = demonstrations.weights.astype(each.dtype)
        # moves that do not count may be impossible
        actions = jnp.sum(jnp.where((counts > 0) | jnp.isnan(each), counts * each, 0))
    if "transitions" in terms:
        transitions = arrival_log_likelihood(model, _arrivals(demonstrations))
    return LogLikelihood(actions, transitions)


def log_policies(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    *,
    options: SolveOptions | None = None,
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
    options = SolveOptions() if options is None else options
    check_likelihood(model, demonstrations, behavior, options)
    padded, agents = padded_for(demonstrations, behavior)
    return _first(_log_policies(model, padded, agents, options), len(demonstrations))


@eqx.filter_jit
def _log_policies(
    model: TransitionModel, demonstrations: Demonstrations, agents: BehaviorModel, options: SolveOptions
) -> Float[Array, " moves"]:
    moves = eqx.tree_at(lambda each: each.tasks, demonstrations, agents.tasks_of(demonstrations.tasks))
    behavior, task = agents.behavior_of(), moves.task
    if options.deadline:
        count = len(demonstrations.tasks.terminal)
        times = jnp.minimum(move_times(moves.trajectory), (options.horizon or 1) - 1)
        visited, times = (jnp.broadcast_to(each, (count, len(each))) for each in (moves.states, times))
        solution = solve(model, demonstrations.tasks, agents, options=options, visited=visited, times=times)
        q = solution.advantages[task, jnp.arange(len(task))]
    else:
        solution = solve(model, demonstrations.tasks, agents, options=options)
        q = visited_advantages(model, moves, solution.values_after)
    betas = agents.betas(solution.values.shape[0])[task]

    def of_move(beta: Array, q: Array, state: Array, action: Array) -> Array:
        own = Behavior(behavior.backup, beta, behavior.lapse)
        return _log_policy(model, own, q[None], state[None], action[None])[0]

    # a factor, so that the gradient is NaN too
    each = jax.vmap(of_move)(betas, q, moves.states, moves.actions)
    return each * jnp.where(solution.converged.all(), 1.0, jnp.nan)


class Choices(NamedTuple):
    """The distinct actions taken in pursuit of a task, with a leading `tasks` axis for several tasks.

    Attributes:
        states: The state in which each action was taken.
        actions: The action.
        counts: The sum of the weights of these moves; 0 for padding.
        times: The number of moves before it, where policies depend on it; otherwise None.
    """

    states: Int[Array, "*tasks choices"]
    actions: Int[Array, "*tasks choices"]
    counts: Float[Array, "*tasks choices"]
    times: Int[Array, "*tasks choices"] | None = None


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
    visited, times = choices.states, choices.times
    solution = solve(model, task, behavior, options=options, start=start, visited=visited, times=times, region=region)
    q = solution.advantages
    each = _log_policy(model, behavior, q, choices.states, choices.actions)
    # those that do not count may be impossible
    total = jnp.sum(jnp.where(choices.counts > 0, choices.counts.astype(q.dtype) * each, 0))
    return total * jnp.where(solution.converged, 1.0, jnp.nan), solution


def choices_of(demonstrations: Demonstrations, *, deadline: bool = False) -> Choices:
    """Return the distinct choices of each task, with their counts.

    Args:
        demonstrations: The moves and their tasks.
        deadline: Whether choices after different numbers of moves are distinct (see `SolveOptions`).
    """
    times = [np.asarray(move_times(demonstrations.trajectory))] if deadline else []
    distinct, counts = _distinct_moves(demonstrations, "task", "states", "actions", others=times)
    sizes = np.bincount(distinct[0], minlength=len(demonstrations.tasks.terminal))
    filled = np.arange(next_power_of_two(max(int(sizes.max()), _MIN_LENGTH))) < sizes[:, None]

    def padded(part: np.ndarray) -> Array:
        whole = np.zeros(filled.shape, part.dtype if part.dtype.kind == "f" else np.int32)
        whole[filled] = part
        return to_jax(whole)

    return Choices(padded(distinct[1]), padded(distinct[2]), padded(counts), *map(padded, distinct[3:]))


def move_times(trajectory: Int[Array, " moves"]) -> Int[Array, " moves"]:
    """Return the number of moves before each move in its trajectory.

    Args:
        trajectory: The trajectory of each move.
    """
    places = jnp.arange(len(trajectory))
    return places - jnp.full_like(places, len(trajectory)).at[trajectory].min(places)[trajectory]


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


def _distinct_moves(
    demonstrations: Demonstrations, *fields: str, others: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct values of some fields, one move a column, and the sum of the weights of each."""
    moves = np.stack([*(np.asarray(getattr(demonstrations, field)) for field in fields), *others])
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


def visited_advantages(
    model: TransitionModel, demonstrations: Demonstrations, values: Float[Array, "tasks states"]
) -> Float[Array, "moves actions"]:
    """Return Q(s, a) − V(s) of the state before each move, from the values of all tasks.

    Args:
        model: The transition model.
        demonstrations: Moves and tasks.
        values: V of each task after an action (`Solution.values_after`).
    """
    tasks, task, states = demonstrations.tasks, demonstrations.task, demonstrations.states
    after = values[task[:, None, None], model.graph.successors[states]]
    probabilities, available = model.probabilities()[states], model.graph.available
    reward = tasks.reward[task, states if tasks.reward.shape[1] > 1 else 0].astype(values.dtype)
    own = tasks.outcome_reward
    of_outcomes = None if own is None else own[task, states if own.shape[1] > 1 else 0]
    reward = expected_reward(reward, of_outcomes, probabilities)
    mask = available[states if len(available) > 1 else jnp.zeros_like(states)]
    discount = tasks.discount[task, None].astype(values.dtype)
    return advantages(values[task, states], after, probabilities, reward, mask, discount)


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
    mask = available_mask(model.graph.available, model.graph.states, model.graph.actions)
    log_policy = behavior.log_policy(q, None if mask is None else mask[states])
    return jnp.take_along_axis(log_policy, actions[:, None], axis=-1)[:, 0]


def _first(each: Float[Array, " padded"], count: int) -> Float[Array, " moves"]:
    """Return the first entries, without compiling a slice for every count."""
    return each[:count] if isinstance(each, Tracer) else to_jax(np.asarray(each)[:count])
