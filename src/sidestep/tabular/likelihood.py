"""The likelihood of demonstrations under a transition model (eqs. 1 and 6).

    log L(θ) = Σ_i Σ_t [ log π_θ(a_t | s_t)  +  ln T_θ(s_t, a_t, s_{t+1}) ],      log π_θ = βQ_θ − log Σ_a exp βQ_θ

People plan with the dynamics that they know, so both terms depend on θ: the *actions* through the values, the observed
*transitions* directly. Each can be left out. Where demonstrations have weights, each move counts by its weight.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations, next_power_of_two
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import Solution, SolveOptions, solve
from sidestep.tabular.solvers.base import WarmStart, action_values
from sidestep.tabular.tasks import Task

Term = Literal["actions", "transitions"]
ALL_TERMS: tuple[Term, ...] = ("actions", "transitions")


class LogLikelihood(NamedTuple):
    """The two terms of the log-likelihood, in nats; one that was left out is 0."""

    actions: Float[Array, ""]
    transitions: Float[Array, ""]

    @property
    def total(self) -> Float[Array, ""]:
        """log L(θ)."""
        return self.actions + self.transitions


def log_likelihood(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    terms: tuple[Term, ...] = ALL_TERMS,
    options: SolveOptions | None = None,
) -> LogLikelihood:
    """log L(θ) of `demonstrations` by people who behave as `behavior` says and know `model`.

    `terms` are those that count; the other arguments are those of `solve`. The actions' term is NaN if a task's values
    did not converge.
    """
    actions = transitions = jnp.zeros((), model.probabilities().dtype)
    if "actions" in terms:
        actions = action_log_likelihood(model, demonstrations, behavior, options=options)
    if "transitions" in terms:
        transitions = transition_log_likelihood(model, demonstrations)
    return LogLikelihood(actions, transitions)


def action_log_likelihood(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    options: SolveOptions | None = None,
) -> Float[Array, ""]:
    """Σ log π_θ(a | s) over all moves; NaN if a task's values did not converge."""
    each = log_policies(model, demonstrations, behavior, options=options)
    return _weighted(demonstrations, each)


def log_policies(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    options: SolveOptions | None = None,
) -> Float[Array, " moves"]:
    """log π_θ(a | s) of every move; NaN if a task's values did not converge."""
    return _log_policies(model, demonstrations, behavior, options)


@eqx.filter_jit
def _log_policies(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    options: SolveOptions | None,
) -> Float[Array, " moves"]:
    tasks, task, states = demonstrations.tasks, demonstrations.task, demonstrations.states
    solution = solve(model, tasks, behavior, options=options)
    q = visited_action_values(model, tasks, solution.values, task, states)
    # a factor, so that the gradient is NaN too
    return _log_policy(behavior, q, demonstrations.actions) * _nan_unless(solution.converged.all())


class Choices(NamedTuple):
    """What was done in pursuit of a task: action `actions` in state `states`, and how much it counts in all.

    `counts` says how often it was done, where moves have no weights. With a leading `tasks` axis, for several tasks;
    shorter lists are filled up with counts of 0.
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
    """Σ log π_θ(a | s) over the choices made in pursuit of one task, and the task's solution (from `start`).

    The arguments are those of `solve`. NaN if its values did not converge. Over the tasks of
    `choices_of(demonstrations)` it adds up to `action_log_likelihood`.
    """
    solution = solve(
        model,
        task,
        behavior,
        options=options,
        start=start,
        visited=choices.states,
        region=region,
    )
    q = solution.action_values
    total = jnp.sum(choices.counts.astype(q.dtype) * _log_policy(behavior, q, choices.actions))
    return total * _nan_unless(solution.converged), solution


def choices_of(demonstrations: Demonstrations) -> Choices:
    """The moves of each task as choices, equal ones counted."""
    task, states, actions = (np.asarray(getattr(demonstrations, name)) for name in ("task", "states", "actions"))
    different, which = np.unique(np.stack([task, states, actions]), axis=1, return_inverse=True)
    counts = np.bincount(which.ravel(), np.asarray(demonstrations.weights))
    sizes = np.bincount(different[0], minlength=len(demonstrations.tasks.terminal))
    filled = np.arange(next_power_of_two(max(int(sizes.max()), 16))) < sizes[:, None]

    def padded(part: np.ndarray) -> Array:
        whole = np.zeros(filled.shape, part.dtype if part.dtype.kind == "f" else np.int32)
        whole[filled] = part
        return jnp.asarray(whole)

    return Choices(padded(different[1]), padded(different[2]), padded(counts))


class Arrivals(NamedTuple):
    """Where actions led: `actions` in `states` to `next_states`, and how much each counts in all."""

    states: Int[Array, " arrivals"]
    actions: Int[Array, " arrivals"]
    next_states: Int[Array, " arrivals"]
    counts: Float[Array, " arrivals"]


def arrivals_of(demonstrations: Demonstrations) -> Arrivals:
    """The moves of all tasks as arrivals, equal ones counted; filled up by the first one, with counts of 0."""
    moves = np.stack([np.asarray(getattr(demonstrations, name)) for name in ("states", "actions", "next_states")])
    different, which = np.unique(moves, axis=1, return_inverse=True)
    counts = np.bincount(which.ravel(), np.asarray(demonstrations.weights))
    missing = next_power_of_two(max(len(counts), 16)) - len(counts)
    filled = np.concatenate([different, np.repeat(different[:, :1], missing, axis=1)], axis=1)
    states, actions, next_states = (jnp.asarray(part) for part in filled)
    return Arrivals(states, actions, next_states, jnp.asarray(np.pad(counts, (0, missing))))


def arrival_log_likelihood(model: TransitionModel, arrivals: Arrivals) -> Float[Array, ""]:
    """Σ ln T_θ(s, a, s′) over arrivals; those of demonstrations add up to `transition_log_likelihood`."""
    # what counts for nothing must not be impossible
    each = jnp.log(jnp.where(arrivals.counts > 0, transition_probabilities(model, arrivals), 1))
    return jnp.sum(each * arrivals.counts.astype(each.dtype))


def visited_action_values(
    model: TransitionModel,
    tasks: Task,
    values: Float[Array, "tasks states"],
    task: Int[Array, " visits"],
    states: Int[Array, " visits"],
) -> Float[Array, "visits actions"]:
    """Q(s, a) of visited states, from the values of all tasks."""
    after = values[task[:, None, None], model.graph.successors[states]]
    reward = tasks.reward[task, states if tasks.reward.shape[1] > 1 else 0].astype(values.dtype)
    discount = tasks.discount[task, None].astype(values.dtype)
    return action_values(values[task, states], after, model.probabilities()[states], reward, discount)


def _log_policy(
    behavior: Behavior, q: Float[Array, "visits actions"], actions: Int[Array, " visits"]
) -> Float[Array, " visits"]:
    return jnp.take_along_axis(behavior.log_policy(q), actions[:, None], axis=-1)[:, 0]


def _weighted(demonstrations: Demonstrations, parts: Float[Array, " moves"]) -> Float[Array, ""]:
    """The sum over moves, each by its weight."""
    return jnp.sum(parts * demonstrations.weights.astype(parts.dtype))


def _nan_unless(condition: Bool[Array, ""]) -> Float[Array, ""]:
    return jnp.where(condition, 1.0, jnp.nan)


def transition_log_likelihood(model: TransitionModel, demonstrations: Demonstrations) -> Float[Array, ""]:
    """Σ ln T_θ(s, a, s′) over all moves."""
    return _weighted(demonstrations, jnp.log(transition_probabilities(model, demonstrations)))


def transition_probabilities(model: TransitionModel, moves: Demonstrations | Arrivals) -> Float[Array, " moves"]:
    """T_θ(s, a, s′) of every move."""
    states, actions = moves.states, moves.actions
    leads_there = model.graph.successors[states, actions] == moves.next_states[:, None]
    return jnp.sum(jnp.where(leads_there, model.probabilities()[states, actions], 0), axis=-1)
