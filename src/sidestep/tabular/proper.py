"""Proper tasks: those with finite and unique values.

At discount 1 a policy is *proper* if it surely ends (Bertsekas & Tsitsiklis, *An analysis of stochastic shortest path
problems*, 1991). Where every action that may be followed by another one costs something, policies that are not proper
are worth −∞, and values are finite wherever there is a proper one. That is what is checked. Differs in two points: it
is sufficient, not necessary, and the entropy bonus of a log-sum-exp agent counts as a reward of every action.
"""

import numpy as np
from jaxtyping import Bool, Float

from sidestep.errors import ImproperTask
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.behavior_model import BehaviorModel, as_behavior_model
from sidestep.tabular.checks import check_behavior, check_persons, check_task
from sidestep.tabular.graph import Graph
from sidestep.tabular.tasks import Task


def check_proper(task: Task, behavior: Behavior | BehaviorModel, world: Graph, horizon: int | None = None) -> None:
    """Check that the values of every task are finite and unique.

    Tasks with a finite horizon or a discount below 1 are proper. At discount 1 a task needs a terminal state, and every
    action must have a cost unless it surely ends the task; with the log-sum-exp backup one above log(actions)/β, the
    entropy bonus of an action, as agents otherwise gain by never arriving.

    Args:
        task: One task or a stack.
        behavior: Of the agents; each task is checked with the β of its person.
        world: The graph of the model.
        horizon: As in `SolveOptions`.

    Raises:
        InputError: For a task, behavior or graph of another type, and a task of another world.
        ImproperTask: Where values are infinite or not unique.

    Example:
        >>> from sidestep.tabular.graph import grid_graph
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid.unknown(2, 2)
        >>> goal = reach(grid, 0, discount=1.0, step_cost=1.0)
        >>> check_proper(goal, Behavior("logsumexp", beta=10.0), grid_graph(grid))
    """
    check_task(task, world)
    check_behavior(behavior, world)
    agents = as_behavior_model(behavior)
    task, tasks = agents.tasks_of(task), len(np.atleast_1d(np.asarray(task.discount)))
    if task.terminal.ndim == 2:
        check_persons(behavior, tasks)
    endless = np.atleast_1d(np.asarray(task.discount)) == 1
    if horizon is not None or not endless.any():
        return
    terminal = np.atleast_2d(np.asarray(task.terminal))[endless]
    if not terminal.any(axis=-1).all():
        raise ImproperTask("a task with discount 1 needs a terminal state: expected one, or a discount below 1")
    available = np.broadcast_to(np.asarray(world.available), (world.states, world.actions))
    has_bonus = isinstance(agents.behavior.backup, LogSumExp)
    betas = np.asarray(agents.betas(tasks)) if task.terminal.ndim == 2 else [agents.behavior_of().beta]
    for index, ends in zip(np.flatnonzero(endless), terminal, strict=True):
        # a bonus for each number of available actions
        beta = float(betas[index])
        bonus = np.log(available.sum(axis=1)) / beta if has_bonus else np.zeros(world.states)
        gains = _largest_rewards(task, int(index), world, available, ends, bonus)
        if (gains >= 0).any():
            raise ImproperTask(
                "at discount 1 every action must cost something unless it surely ends the task: "
                f"{_place(gains, 0 * bonus)} is worth {gains.max():g}; expected rewards below 0, a discount below 1 "
                "(.99, say), or for tasks of few actions `SolveOptions(horizon=…)`"
            )
        if (gains >= -bonus).any():
            raise ImproperTask(
                f"at discount 1 a log-sum-exp agent with β = {beta:g} gains log(actions)/β = {bonus.max():.4g} with "
                f"every action, so an endless path is worth more than one to the goal: {_place(gains, bonus)} costs "
                "less; expected a step cost above that, a larger β, a discount below 1 or another backup"
            )


def _largest_rewards(
    task: Task,
    index: int,
    world: Graph,
    available: Bool[np.ndarray, "states actions"],
    terminal: Bool[np.ndarray, " s"],
    bonus: Float[np.ndarray, " states"],
) -> Float[np.ndarray, " states"]:
    """Return the largest reward of an action of each state that another action may follow; −∞ where there is none."""
    reward = np.asarray(task.reward).reshape(-1, *task.reward.shape[-2:])[index]
    if task.outcome_reward is None:
        gains = np.where(available, reward, -np.inf).max(axis=1)
        if not (gains >= -bonus)[~terminal].any():
            # no action gains, whether it ends the task or not
            return np.where(terminal, -np.inf, gains)
        of_outcomes = reward[..., None]
    else:
        rewards = np.asarray(task.outcome_reward).reshape(-1, *task.outcome_reward.shape[-3:])[index]
        of_outcomes = reward[..., None] + rewards
    goes_on = available[..., None] & ~terminal[np.asarray(world.successors)] & ~terminal[:, None, None]
    return np.where(goes_on, of_outcomes, -np.inf).max(axis=(1, 2))


def _place(gains: Float[np.ndarray, " states"], bonus: Float[np.ndarray, " states"]) -> str:
    return f"an action of state {int(np.argmax(gains + bonus))}"
