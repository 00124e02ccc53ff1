"""Whether the entropy of going on keeps log-sum-exp agents from their goal.

A log-sum-exp agent gains up to log(n)/β by each choice among n actions, for ever where it never arrives. With rewards
of 0 on the way and a goal that pays G, V = G in all states is the solution of the Bellman equation at

    G = log(n) / (β (1 − γ)),

whatever the dynamics. Agents are then indifferent between arriving and going on. Where the goal pays less, they arrive
less often than by chance; where costs c are paid on the way, with log(n)/β − c in place of log(n)/β.

In general nothing is known before the values are. So the condition is one of the solution. Goals are the terminal
states that pay most on arrival, and with them the states from which agents surely arrive there, whatever they choose.
Agents *wander* if

1. γ < 1, the horizon is infinite and the backup is the log-sum-exp,
2. no agent without entropy would: arriving is worth more than r/(1 − γ), with r the largest reward on the way, and
3. in every state from which an action may lead to a goal, and another one less probably, the policy leads there with a
   smaller probability than actions chosen at random.
"""

import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import SidestepWarning
from sidestep.tabular.backups import LogSumExp
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.tasks import Task

_INDIFFERENT = 1e-3
"""The part of a probability by which it must be smaller than by chance."""


class _Way(NamedTuple):
    """What one task pays, and where it leads.

    Attributes:
        rewards: R(s, a) + R(s, a, s′) of each outcome.
        probabilities: T of each outcome; 0 for actions that are not available.
        successors: The state of each outcome.
        terminal: Where the task ends.
        values: Of terminal states.
        discount: γ.
    """

    rewards: Float[np.ndarray, "states actions outcomes"]
    probabilities: Float[np.ndarray, "states actions outcomes"]
    successors: Int[np.ndarray, "states actions outcomes"]
    terminal: Bool[np.ndarray, " states"]
    values: Float[np.ndarray, " states"]
    discount: float

    @property
    def arrives(self) -> Bool[np.ndarray, "states actions outcomes"]:
        """Return which outcomes end the task."""
        return self.possible & self.terminal[self.successors]

    @property
    def possible(self) -> Bool[np.ndarray, "states actions outcomes"]:
        """Return which outcomes can happen before the end."""
        return (self.probabilities > 0) & ~self.terminal[:, None, None]

    @property
    def worth(self) -> Float[np.ndarray, "states actions outcomes"]:
        """Return what each outcome is worth if it ends the task."""
        return self.rewards + self.discount * self.values[self.successors]

    @property
    def endless(self) -> float:
        """Return the most that going on for ever is worth without entropy; −∞ where agents cannot go on."""
        on = self.possible & ~self.arrives
        return float(self.rewards.max(where=on, initial=-np.inf)) / (1 - self.discount)

    @property
    def entropy(self) -> float:
        """Return log(n)/(1 − γ): the most that the choices of an endless path are worth, times β."""
        actions = self.possible.any(axis=-1).sum(axis=1).max()
        return float(np.log(max(actions, 1))) / (1 - self.discount)

    @property
    def best(self) -> float:
        """Return the most that arriving is worth before the last action; −∞ where agents cannot arrive."""
        return float(self.worth.max(where=self.arrives, initial=-np.inf))


def warn_of_wandering(
    model: TransitionModel,
    task: Task,
    agents: BehaviorModel,
    values: Float[Array | np.ndarray, "*tasks states"],
    converged: Bool[Array | np.ndarray, "*tasks"],
) -> None:
    """Warn the caller of the calling function if agents of a task wander; once, of the first such task.

    Args:
        model: The transition model.
        task: One task or a stack.
        agents: Their behavior.
        values: V of each task at an infinite horizon.
        converged: Whether they have converged; others are not looked at.
    """
    for index in suspects(model, task, agents):
        way, beta = _way(model, agents.tasks_of(task), index), _betas(agents, task)[index]
        own = np.atleast_2d(np.asarray(values, np.float64))[index]
        if np.atleast_1d(np.asarray(converged))[index] and _wanders(way, beta, own):
            text = (
                f"agents of task {index} avoid its goal: for a log-sum-exp agent with β = {beta:.3g} at "
                f"γ = {way.discount:.4g}, the entropy of going on, up to log(actions)/(β (1 − γ)) = "
                f"{way.entropy / beta:.3g}, is worth more than arriving, {way.best:.3g}; expected a larger β, costs of "
                "actions, or the mellowmax backup, which has no such bonus"
            )
            warnings.warn(text, SidestepWarning, stacklevel=3)
            return


def suspects(model: TransitionModel, task: Task, agents: BehaviorModel) -> list[int]:
    """Return the tasks in which agents may wander, by what is known without the values.

    With n the largest number of actions of a state, agents arrive at least as often as by chance if the best arrival is
    worth no less than (r + γ log(n)/β) / (1 − γ).

    Args:
        model: The transition model.
        task: One task or a stack.
        agents: Their behavior.
    """
    if not isinstance(agents.behavior.backup, LogSumExp):
        return []
    own, betas = agents.tasks_of(task), _betas(agents, task)
    result = []
    for index in np.flatnonzero(np.atleast_1d(np.asarray(own.discount)) < 1).tolist():
        way = _way(model, own, index)
        if way.endless < way.best < way.endless + way.discount * way.entropy / betas[index]:
            result.append(index)
    return result


def _betas(agents: BehaviorModel, task: Task) -> Float[np.ndarray, " tasks"]:
    """Return β of each task, of one task as well."""
    return np.asarray(agents.betas(task.terminal.size // task.terminal.shape[-1]), np.float64)


def _way(model: TransitionModel, tasks: Task, index: int) -> _Way:
    """Return what a task pays, and where it leads."""
    world, shape = model.graph, model.graph.successors.shape
    task = jax.tree.map(np.asarray, tasks)
    if task.terminal.ndim == 2:
        task = jax.tree.map(lambda leaf: leaf[index], task)
    available = np.broadcast_to(np.asarray(world.available), shape[:2])
    probabilities = np.where(available[..., None], np.asarray(_probabilities(model), np.float64), 0.0)
    rewards = task.reward[..., None] + (0.0 if task.outcome_reward is None else task.outcome_reward)
    values = np.broadcast_to(task.terminal_reward, task.terminal.shape).astype(np.float64)
    return _Way(
        np.broadcast_to(rewards, shape).astype(np.float64),
        probabilities,
        np.asarray(world.successors),
        task.terminal,
        values,
        float(task.discount),
    )


@eqx.filter_jit
def _probabilities(model: TransitionModel) -> Float[Array, "states actions outcomes"]:
    return model.probabilities()


def _wanders(way: _Way, beta: float, values: Float[np.ndarray, " states"]) -> bool:
    """Return whether agents of one task wander, by its values."""
    expected = np.where(way.arrives, way.worth, way.endless)
    attempts = (way.probabilities * expected).sum(axis=-1, where=way.possible)
    if not (attempts > way.endless).any(where=way.arrives.any(axis=-1)):
        return False
    available = way.probabilities.sum(axis=-1) > 0
    q = (way.probabilities * (way.rewards + way.discount * values[way.successors])).sum(axis=-1)
    exponents = np.where(available, beta * q, -np.inf)
    odds = np.exp(exponents - exponents.max(axis=1, keepdims=True))
    policy, even = (part / part.sum(axis=1, keepdims=True) for part in (odds, available.astype(float)))
    reached = (way.probabilities * _goals(way)[way.successors]).sum(axis=-1)
    spread = np.ptp(np.where(available, reached, reached.max(axis=1, keepdims=True)), axis=1)
    doors = (spread > 1e-9) & ~way.terminal & ~_goals(way)
    arriving, by_chance = ((part * reached).sum(axis=1)[doors] for part in (policy, even))
    return bool(doors.any() and (arriving < (1 - _INDIFFERENT) * by_chance).all())


def _goals(way: _Way) -> Bool[np.ndarray, " states"]:
    """Return the terminal states that pay most, and the states from which agents surely arrive there."""
    best = way.arrives & (way.worth >= way.best - 1e-9 * abs(way.best))
    goals = np.zeros(len(way.terminal), bool)
    goals[way.successors[best]] = True
    while True:
        sure = np.where(way.possible, goals[way.successors], True).all(axis=(1, 2)) & ~way.terminal
        if (goals | sure == goals).all():
            return goals
        goals |= sure
