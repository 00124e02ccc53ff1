"""Dense tables of probabilities and rewards, P[s, a, s′] and R, as a model and a task."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Shaped

from sidestep._arguments import to_floats
from sidestep.errors import InputError, check
from sidestep.io.environments import Environment, model_of
from sidestep.tabular.distributions import check_distributions
from sidestep.tabular.tasks import Task, check_discount, task, with_outcome_reward

Table = Shaped[ArrayLike, "..."] | Sequence[Any]
"""An array, or nested lists."""


def from_dense(
    P: Table, R: Table, *, discount: float, terminal: Table | None = None, available: Table | None = None
) -> Environment:
    """Return the model and the task of dense tables.

    Args:
        P: P[s, a, s′], the probability of s′ after action a in state s. Rows of terminal states and of actions that
            are not available have no meaning.
        R: R[s], which terminal states pay once too, or R[s, a] or R[s, a, s′], with which terminal states pay nothing.
            −∞ in the last two marks an action that is not available, in R[s, a, s′] for every s′ that is possible.
        discount: γ in (0, 1].
        terminal: Whether the task ends in each state; by default it does nowhere.
        available: Whether each action can be taken in each state; by default all can that R does not mark.

    Returns:
        With an outcome for every s′ of a probability above 0.

    Raises:
        InputError: For tables of other shapes, such as P[a, s, s′], or that are no numbers, and, with state and action,
            for probabilities that are negative, not finite or do not sum to 1, and for rewards that are not finite; for
            a state that is not terminal and has no action, and a discount outside (0, 1].

    Example:
        >>> P = [[[0.5, 0.5], [1.0, 0.0]], [[0.0, 1.0], [0.0, 1.0]]]
        >>> R = [[1.0, 0.0], [2.0, -np.inf]]
        >>> made = from_dense(P, R, discount=0.9)
        >>> made.model.probabilities()[0, 0].tolist(), made.model.graph.available.tolist()
        ([0.5, 0.5], [[True, True], [True, False]])

    References:
        The layout, and −∞ for actions that are not available, are those of `DiscreteDP` of QuantEcon.py.
    """
    check_discount(discount)
    probabilities = _probabilities(P)
    states, actions, _ = probabilities.shape
    rewards = np.asarray(to_floats(R, "R", (states,), (states, actions), probabilities.shape), np.float64)
    ends = _booleans(terminal, np.zeros(states, bool), "terminal")
    can = _booleans(available, np.ones((states, actions), bool), "available")
    can = ends[:, None] | can & ~_marked(rewards, probabilities)
    acting = can & ~ends[:, None]
    check_distributions(probabilities, ("state", "action"), counts=acting)
    staying = np.broadcast_to(np.eye(states)[:, None], probabilities.shape)
    probabilities = np.where(acting[..., None], probabilities, staying)
    width = int((probabilities > 0).sum(axis=-1).max())
    successors = np.argsort(probabilities == 0, axis=-1, stable=True)[..., :width]
    chosen = np.take_along_axis(probabilities, successors, axis=-1)
    # padding repeats the first outcome, so that what is impossible pays nothing else than what is possible
    successors = np.where(chosen > 0, successors, successors[..., :1])
    return Environment(model_of(chosen, successors, can), _task(rewards, acting, successors, discount, ends), {})


def _task(
    rewards: Float[np.ndarray, "..."],
    acting: Bool[np.ndarray, "states actions"],
    successors: Shaped[np.ndarray, "states actions outcomes"],
    discount: float,
    ends: Bool[np.ndarray, " states"],
) -> Task:
    """Return the task; raise `InputError` for rewards that count and are not finite."""
    if rewards.ndim == 1:
        return task(rewards, discount, ends)
    if rewards.ndim == 2:
        paid = np.where(acting, rewards, 0.0)
        _check_finite(paid)
        return task(paid, discount, ends)
    paid = np.where(acting[..., None], np.take_along_axis(rewards, successors, axis=-1), 0.0)
    _check_finite(paid)
    return with_outcome_reward(task(np.zeros(acting.shape), discount, ends), paid)


def _probabilities(P: Table) -> Float[np.ndarray, "states actions states"]:
    """Return P as an array; raise `InputError` for another shape."""
    table = np.asarray(to_floats(P, "P"), np.float64)
    message = f"expected P[s, a, s′] of shape (states, actions, states), found shape {table.shape}"
    check(table.ndim == 3 and table.size, message, field="P")
    first, second, third = table.shape
    turned = first != third and second == third
    check(not turned, f"{message}; for P[a, s, s′] pass np.moveaxis(P, 0, 1), and of R likewise", field="P")
    check(first == third, message, field="P")
    return table


def _booleans(table: Table | None, default: Bool[np.ndarray, "..."], field: str) -> Bool[np.ndarray, "..."]:
    """Return a table as booleans of the default's shape, or the default."""
    if table is None:
        return default
    array = np.asarray(table)
    message = f"expected booleans of shape {default.shape}, found {array.dtype} {array.shape}"
    check(array.dtype == bool and array.shape == default.shape, message, field=field)
    return array


def _marked(
    rewards: Float[np.ndarray, "..."], probabilities: Float[np.ndarray, "states actions states"]
) -> Bool[np.ndarray, "#states #actions"]:
    """Return whether R marks each action as not available."""
    if rewards.ndim == 1:
        return np.zeros((1, 1), bool)
    if rewards.ndim == 2:
        return rewards == -np.inf
    marked, possible = rewards == -np.inf, probabilities > 0
    return (marked | ~possible).all(axis=-1) & marked.any(axis=-1)


def _check_finite(paid: Float[np.ndarray, "states actions *outcomes"]) -> None:
    """Raise `InputError`, with state and action, for a reward that is not finite."""
    for state, action, *others in np.argwhere(~np.isfinite(paid))[:1].tolist():
        message = f"expected finite rewards, or −∞ for all outcomes, found {paid[state, action, *others]}"
        raise InputError(message, source=f"state {state}, action {action}", field="R")
