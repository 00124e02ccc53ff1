"""Planning under a model: policies, the paths that they intend, and roll-outs of policies in other models.

A plan knows only the model it was made with. Followed in another one, such as the true world, it may meet a wall that
the model did not know: the move fails, and an optimal plan repeats it forever. `roll_out` shows that.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, Shaped

from sidestep._arguments import to_key, to_states
from sidestep._programs import keep_program
from sidestep._repr import short_repr
from sidestep.errors import NotConverged, check, check_instance, to_count
from sidestep.tabular.arrays import is_traced, to_jax
from sidestep.tabular.backups import Behavior, HardMax, tied_where_lost
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.checks import check_behavior, check_model, check_task
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.proper import check_proper
from sidestep.tabular.solve import Solution, SolveOptions, solve
from sidestep.tabular.solvers.base import is_reachable
from sidestep.tabular.tasks import Task


@short_repr()
class Plan(eqx.Module):
    """A policy for one task under a model; made by `plan`.

    Attributes:
        policy: The probability of each action in every state; an optimal policy is uniform over ties.
        intended: The state that the most probable action (the first of ties) is meant to reach: its most probable
            outcome other than the state itself, or the state itself if there is none.
        terminal: Where the task ends.
        solution: Values and convergence.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid.unknown(rows=1, columns=4)
        >>> made = plan(ObstacleGrid(grid), reach(grid, 3))
        >>> made.intended.tolist()
        [1, 2, 3, 3]
    """

    policy: Float[Array, "states actions"]
    intended: Int[Array, " states"]
    terminal: Bool[Array, " states"]
    solution: Solution

    def path_from(self, start: int) -> Int[np.ndarray, " steps"]:
        """Return the states that the plan intends to visit from `start` on, which is the first.

        The path ends at a terminal state; if the plan never arrives, before the first state that would repeat.

        Args:
            start: A state.

        Raises:
            InputError: For a start that is not a state or, at discount 1, from which no terminal state can be reached.
        """
        is_state = isinstance(start, (int, np.integer)) and 0 <= start < len(self.terminal)
        check(is_state, f"expected a state in 0…{len(self.terminal) - 1}, found {start}", field="start")
        reaches = is_reachable(self.solution.values[start])
        check(reaches, f"the goal cannot be reached from state {start}", field="start")
        return self.follow(np.array([start]))[0]

    def follow(self, starts: Int[np.ndarray, " starts"]) -> list[Int[np.ndarray, " _"]]:
        """Return `path_from` of each start, without its checks.

        Args:
            starts: The first state of each path.
        """
        return followed(np.asarray(self.intended), np.asarray(self.terminal), starts)


def followed(
    intended: Int[np.ndarray, " states"], terminal: Bool[np.ndarray, " states"], starts: Int[np.ndarray, " starts"]
) -> list[Int[np.ndarray, " _"]]:
    """Return the states from each start on, `intended` after each, up to a terminal one or before one would repeat.

    Args:
        intended: The state after each state.
        terminal: Where paths end.
        starts: The first state of each path.
    """

    def path(start: int) -> Int[np.ndarray, " steps"]:
        states, seen = [start], {start}
        while not terminal[states[-1]] and (state := int(intended[states[-1]])) not in seen:
            states.append(state)
            seen.add(state)
        return np.asarray(states)

    return [path(start) for start in starts.tolist()]


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
        options: How values are computed; by default `SolveOptions()`. With a deadline the plan is that of the first
            action; later ones are in `log_policies`.

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
    options = options or SolveOptions()
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
    available = jnp.broadcast_to(model.graph.available, solution.action_values.shape)
    q, advantages = (tied_where_lost(each, available) for each in (solution.action_values, solution.advantages))
    policy = (
        behavior.backup.fixed_policy_weights(q, behavior.beta)
        if optimal
        else jnp.exp(behavior.log_policy(advantages, available))
    )
    states = jnp.arange(model.graph.states)
    best = _first_best(policy, advantages)
    outcomes = model.graph.successors[states, best]
    elsewhere = jnp.where(outcomes == states[:, None], 0, model.probabilities()[states, best])
    most_probable = jnp.take_along_axis(outcomes, jnp.argmax(elsewhere, axis=-1)[:, None], axis=-1)[:, 0]
    intended = jnp.where(elsewhere.max(axis=-1) > 0, most_probable, states)
    return Plan(policy, intended.astype(jnp.int32), task.terminal, solution)


def policy_by_time(
    model: TransitionModel, task: Task, behavior: Behavior, options: SolveOptions
) -> Float[Array, "moves states actions"]:
    """Return the policy before each move of agents with a deadline.

    Args:
        model: The transition model.
        task: One task.
        behavior: The agents'.
        options: With the deadline.
    """
    states, moves = model.graph.states, options.horizon or 1
    every = np.tile(np.arange(states), moves), np.repeat(np.arange(moves), states)
    visited, times = (to_jax(each, np.int32) for each in every)
    solution = solve(model, task, behavior, options=options, visited=visited, times=times)
    advantages = solution.advantages.reshape(moves, states, -1)
    available = jnp.broadcast_to(model.graph.available, advantages.shape[1:])
    return jnp.exp(behavior.log_policy(advantages, available))


def _first_best(
    policy: Float[Array, "states actions"], advantages: Float[Array, "states actions"]
) -> Int[Array, " states"]:
    """Return the first of the most probable actions; of ties by the precision of Q, the best by its advantage."""
    tied = policy >= policy.max(axis=-1, keepdims=True)
    among = jnp.where(tied, advantages, -jnp.inf)
    largest = among.max(axis=-1, keepdims=True)
    size = jnp.where(jnp.isneginf(advantages), 0, jnp.abs(advantages)).max(axis=-1, keepdims=True)
    return jnp.argmax(among >= largest - 64 * jnp.finfo(advantages.dtype).eps * size, axis=-1)


@short_repr()
class RollOuts(NamedTuple):
    """Trajectories of several agents that follow a policy; made by `roll_out`.

    Attributes:
        states: The state before every move, and at the end.
        actions: The action of every move; −1 after the agent has arrived.
        arrived: Whether the agent reached a terminal state.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 4), dtype=int))
        >>> world = true_model(grid)
        >>> made = plan(world, reach(grid, 3))
        >>> rolled = roll_out(jax.random.key(0), world, made.policy, made.terminal, jnp.array([0, 2]), max_moves=5)
        >>> rolled.moves.tolist()
        [3, 1]
    """

    states: Int[Array, "agents moves+1"]
    actions: Int[Array, "agents moves"]
    arrived: Bool[Array, " agents"]

    @property
    def moves(self) -> Int[Array, " agents"]:
        """Return the number of moves of each agent."""
        return jnp.sum(self.actions >= 0, axis=-1)

    @property
    def failed(self) -> Int[Array, " agents"]:
        """Return the number of moves of each agent that left it in the same state."""
        return jnp.sum((self.actions >= 0) & (self.states[:, 1:] == self.states[:, :-1]), axis=-1)


def roll_out(
    key: PRNGKeyArray,
    world: TransitionModel,
    policy: Float[Array, "*moves states actions"],
    terminal: Bool[Array, " states"],
    starts: Shaped[ArrayLike, "..."] | Sequence[int],
    max_moves: int,
) -> RollOuts:
    """Return trajectories of agents that follow a policy in a world.

    Args:
        key: Of the random choices; the trajectory of agent i does not depend on how many agents come after it.
        world: The transition model that moves follow; the policy may have been made for another one.
        policy: The probability of each action in every state; with an axis of moves before these, of each move.
        terminal: Where agents stop.
        starts: The state that each agent starts in.
        max_moves: The number of moves after which an agent stops anyway.

    Returns:
        The trajectories, one for each start.

    Raises:
        InputError: For a start that is not a state, a policy of another shape or with rows that do not sum to one, and
            a number of moves below 1.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 4), dtype=int))
        >>> world = true_model(grid)
        >>> made = plan(world, reach(grid, 3))
        >>> rolled = roll_out(jax.random.key(0), world, made.policy, made.terminal, jnp.array([0, 2]), max_moves=5)
        >>> rolled.arrived.tolist()
        [True, True]
    """
    max_moves = to_count(max_moves, "max_moves")
    check_model(world)
    shape = world.graph.states, world.graph.actions
    fits = jnp.shape(policy) in (shape, (max_moves, *shape)) and jnp.shape(terminal) == shape[:1]
    message = f"expected a policy of shape {shape}, or one for each of {max_moves} moves, and terminal states of shape "
    message += f"{shape[:1]}, found "
    check(fits, f"{message}{jnp.shape(policy)} and {jnp.shape(terminal)}", field="policy, terminal")
    if not is_traced(policy):
        numbers = np.asarray(policy)
        valid = np.isclose(numbers.sum(axis=-1), 1, atol=1e-4) & (numbers >= 0).all(axis=-1)
        wrong = np.argwhere(~valid)[:1].tolist()
        message = f"expected probabilities that sum to one in every state, found other ones in state {wrong}"
        check(not wrong, message, field="policy")
    states = to_jax(to_states(starts, world.graph.states, "starts"), np.int32)
    return _roll_out(to_key(key), world, policy, terminal, states, max_moves)


@eqx.filter_jit
def _roll_out(
    key: PRNGKeyArray,
    world: TransitionModel,
    policy: Float[Array, "*moves states actions"],
    terminal: Bool[Array, " states"],
    starts: Int[Array, " agents"],
    max_moves: int,
) -> RollOuts:
    log_policy, log_probabilities = jnp.log(policy), jnp.log(world.probabilities())
    each = jnp.arange(max_moves)

    def of_agent(key: PRNGKeyArray, start: Int[Array, ""]) -> tuple[Array, Array]:
        def step(state: Int[Array, ""], move: tuple[PRNGKeyArray, Array]) -> tuple[Array, tuple[Array, Array]]:
            action_key, outcome_key = jax.random.split(move[0])
            own = log_policy[state] if log_policy.ndim == 2 else log_policy[move[1], state]
            action = jax.random.categorical(action_key, own)
            outcome = jax.random.categorical(outcome_key, log_probabilities[state, action])
            done = terminal[state]
            next_state = jnp.where(done, state, world.graph.successors[state, action, outcome])
            return next_state, (next_state, jnp.where(done, -1, action))

        _, (states, actions) = jax.lax.scan(step, start, (jax.random.split(key, max_moves), each))
        return jnp.concatenate([start[None], states]), actions

    starts = starts.astype(world.graph.successors.dtype)
    states, actions = jax.vmap(of_agent)(jax.random.split(key, len(starts)), starts)
    return RollOuts(states, actions, terminal[states[:, -1]])
