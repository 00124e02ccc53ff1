"""Planning under a model: policies, and the paths that they intend."""

from collections.abc import Sequence
from itertools import takewhile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from sidestep._arguments import to_integers, to_states
from sidestep._programs import keep_program
from sidestep._repr import short_repr
from sidestep.errors import NotConverged, check, check_instance
from sidestep.tabular.backups import Behavior, HardMax, finite_or_zero, tied_where_lost
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.checks import check_behavior, check_model, check_task
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solve import Solution, SolveOptions, decision_process, solve
from sidestep.tabular.solvers.base import DecisionProcess, finite_horizon, is_reachable
from sidestep.tabular.tasks import Task

_TIE = 1e-12
"""The error of an advantage in 64-bit numbers, of solvers and not of rounding, as a part of what it is summed from."""


@short_repr()
class Plan(eqx.Module):
    """A policy for one task under a model; made by `plan`.

    Attributes:
        policy: The probability of each action in every state; an optimal policy is uniform over ties. With a deadline
            (`SolveOptions`), policies depend on the time: an axis of moves comes first, one entry for each move.
        intended: The state that the most probable action (the first of ties) is meant to reach: its most probable
            outcome other than the state itself, or the state itself if there is none. With a deadline, for each move.
        terminal: Where the task ends.
        solution: Values and convergence; with a deadline, values before the first move.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid.unknown(rows=1, columns=4)
        >>> made = plan(ObstacleGrid(grid), reach(grid, 3))
        >>> made.intended.tolist()
        [1, 2, 3, 3]
    """

    policy: Float[Array, "*moves states actions"]
    intended: Int[Array, "*moves states"]
    terminal: Bool[Array, " states"]
    solution: Solution

    def path_from(self, start: int) -> Int[np.ndarray, " steps"]:
        """Return the states that the plan intends to visit from `start` on, which is the first.

        The path ends at a terminal state; if the plan never arrives, before the first state that would repeat. With a
        deadline it ends there at the latest, and states may repeat.

        Args:
            start: A state.

        Raises:
            InputError: For a start that is not a state or, at discount 1, from which no terminal state can be reached.
        """
        state = int(to_integers(start, "start", (), least=0, most=len(self.terminal) - 1, what="a state"))
        reaches = is_reachable(self.solution.values[state])
        check(reaches, f"the goal cannot be reached from state {state}", field="start")
        return self.follow([state])[0]

    def follow(self, starts: Shaped[ArrayLike, "..."] | Sequence[int]) -> list[Int[np.ndarray, " _"]]:
        """Return `path_from` of each start, also where no terminal state can be reached.

        Args:
            starts: The first state of each path.

        Raises:
            InputError: For a start that is not a state.
        """
        states = to_states(starts, len(self.terminal), "starts")
        return followed(np.asarray(self.intended), np.asarray(self.terminal), states)


def followed(
    intended: Int[np.ndarray, "*moves states"],
    terminal: Bool[np.ndarray, " states"],
    starts: Int[np.ndarray, " starts"],
) -> list[Int[np.ndarray, " _"]]:
    """Return the states from each start on, `intended` after each, up to a terminal one or before one would repeat.

    Args:
        intended: The state after each state; with an axis of moves before it, for each move. Paths then end after the
            last move, and states may repeat.
        terminal: Where paths end.
        starts: The first state of each path.
    """

    def path(start: int) -> Int[np.ndarray, " steps"]:
        states, seen = [start], {start}
        while not terminal[states[-1]] and (state := int(intended[states[-1]])) not in seen:
            states.append(state)
            seen.add(state)
        return np.asarray(states)

    def path_by_time(start: int) -> Int[np.ndarray, " steps"]:
        states = [start]
        for own in takewhile(lambda _: not terminal[states[-1]], intended):
            states.append(int(own[states[-1]]))
        return np.asarray(states)

    return [(path if intended.ndim == 1 else path_by_time)(start) for start in starts.tolist()]


def plan(
    model: TransitionModel,
    task: Task,
    behavior: Behavior | BehaviorModel | None = None,
    *,
    person: int | None = None,
    options: SolveOptions | None = None,
) -> Plan:
    """Return the optimal plan for a task under a model, or with `behavior` the plan of an agent that behaves like that.

    Args:
        model: The transition model.
        task: One task.
        behavior: The agent's, π ∝ exp βQ; None for the optimal policy. With a `BehaviorModel`, such as that of a fit,
            the task has its discount, reward weights and costs.
        person: The person that plans, where a `BehaviorModel` distinguishes them; by default a typical one.
        options: How values are computed; by default `SolveOptions()`. With a deadline, the plan has a policy for each
            move up to it.

    Returns:
        The probabilities of actions and the intended next state of every state, with the values.

    Raises:
        InputError: For a task of another world or a stack of tasks, and a person that does not exist.
        ImproperTask: For a task that has no values.
        NotConverged: If the values do not converge.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid.unknown(rows=1, columns=4)
        >>> plan(ObstacleGrid(grid), reach(grid, 3)).path_from(0).tolist()
        [0, 1, 2, 3]
    """
    options = SolveOptions() if options is None else options
    check_instance(options, SolveOptions, "options")
    check_model(model)
    check_task(task, model.graph)
    tasks = task.terminal.shape[:-1]
    check(not tasks, f"expected one task, found a stack of {tasks}", field="task")
    if behavior is not None:
        check_behavior(behavior, model.graph)
    agent = behavior or Behavior(HardMax())
    if isinstance(agent, BehaviorModel):
        task, agent = agent.tasks_of(task), agent.behavior_of(person)
    else:
        message = f"expected none without a BehaviorModel, found {person!r}"
        check(person is None, message, field="person")
    check_proper(task, agent, model.graph, options.horizon)
    made = _plan(model, task, agent, behavior is None, options)
    solution = made.solution
    if not bool(solution.converged):
        raise NotConverged(
            f"values still changed by {float(solution.residual):.2g} in sweep {int(solution.sweeps)}, with errors of "
            f"up to {float(solution.error):.2g}: 64-bit numbers (`jax_enable_x64`), more sweeps, a smaller β or "
            "another backup may help"
        )
    return made


@keep_program
def _plan(model: TransitionModel, task: Task, behavior: Behavior, optimal: bool, options: SolveOptions) -> Plan:
    solution = solve(model, task, behavior, options=options)
    process = decision_process(model, model.probabilities(), task)
    if options.deadline:
        beta = behavior.beta.astype(solution.values.dtype)
        _, later = finite_horizon(process, behavior.backup, beta, options.horizon or 1, options.gradient)
        advantages = jax.vmap(process.advantages)(later)
        decided = jax.vmap(lambda *own: _decided(process, behavior, optimal, *own))(later, advantages)
    else:
        decided = _decided(process, behavior, optimal, solution.values_after, solution.advantages)
    return Plan(*decided, task.terminal, solution)


def _decided(
    process: DecisionProcess,
    behavior: Behavior,
    optimal: bool,
    values: Float[Array, " states"],
    advantages: Float[Array, "states actions"],
) -> tuple[Float[Array, "states actions"], Int[Array, " states"]]:
    """Return the policy, and the intended state of each state, of agents with these values after an action."""
    available = jnp.broadcast_to(process.available, advantages.shape)
    advantages = tied_where_lost(advantages, available)
    if optimal:
        policy = _uniform_over_best(advantages, _summed(process, values))
    else:
        policy = jnp.exp(behavior.log_policy(advantages, available))
    states = jnp.arange(len(policy))
    best = _first_best(policy, advantages)
    outcomes = process.successors[states, best]
    elsewhere = jnp.where(outcomes == states[:, None], 0, process.probabilities[states, best])
    most_probable = jnp.take_along_axis(outcomes, jnp.argmax(elsewhere, axis=-1)[:, None], axis=-1)[:, 0]
    return policy, jnp.where(elsewhere.max(axis=-1) > 0, most_probable, states).astype(jnp.int32)


def _summed(process: DecisionProcess, values: Float[Array, " states"]) -> Float[Array, "states actions"]:
    """Return the sum of the absolute numbers that each advantage is summed from; its rounding is a fraction of it."""
    sizes = jnp.abs(finite_or_zero(values))
    here, after = sizes[:, None], sizes[process.successors]
    stays = process.successors == jnp.arange(len(sizes))[:, None, None]
    moves = jnp.sum(jnp.where(stays, 0, process.probabilities * (after + here[..., None])), axis=-1)
    return jnp.abs(process.reward) + process.discount * moves + (1 - process.discount) * here


def rounding_of(dtype: np.dtype) -> float:
    """Return the error of an advantage, as a part of the sum of the absolute numbers that it is summed from.

    Args:
        dtype: Of the values.
    """
    return max(_TIE, 2 * float(jnp.finfo(dtype).eps))


def _uniform_over_best(
    advantages: Float[Array, "states actions"], summed: Float[Array, "states actions"]
) -> Float[Array, "states actions"]:
    """Return the policy that is uniform over actions that may be the best, given the rounding of their advantages.

    Advantages are differences, so those of values that are large against their differences keep what tells actions
    apart; of Q it would be lost.
    """
    rounding = rounding_of(advantages.dtype) * summed
    # the best counts even if a compiler, rounding twice, makes it fall short of itself
    first = jax.nn.one_hot(advantages.argmax(axis=-1), advantages.shape[-1], dtype=bool)
    least = (advantages - rounding).max(axis=-1, keepdims=True)
    ties = ((advantages + rounding >= least) | first).astype(advantages.dtype)
    return ties / ties.sum(axis=-1, keepdims=True)


def _first_best(
    policy: Float[Array, "states actions"], advantages: Float[Array, "states actions"]
) -> Int[Array, " states"]:
    """Return the first of the most probable actions; of those that are as probable, the best by its advantage."""
    tied = policy >= policy.max(axis=-1, keepdims=True)
    among = jnp.where(tied, advantages, -jnp.inf)
    largest = among.max(axis=-1, keepdims=True)
    size = jnp.where(jnp.isneginf(advantages), 0, jnp.abs(advantages)).max(axis=-1, keepdims=True)
    return jnp.argmax(among >= largest - 64 * jnp.finfo(advantages.dtype).eps * size, axis=-1)
