"""Planning under a model: policies, the paths that they intend, and roll-outs of policies in other models.

A plan knows only the model it was made with. Followed in another one, such as the true world, it may meet a wall that
the model did not know: the move fails, and an optimal plan repeats it forever. `roll_out` shows that.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sidestep._programs import keep_program
from sidestep._repr import short_repr
from sidestep.errors import NotConverged, check
from sidestep.tabular.backups import Behavior, HardMax
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import Solution, SolveOptions, check_proper, solve
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
    model: TransitionModel, task: Task, behavior: Behavior | None = None, *, options: SolveOptions | None = None
) -> Plan:
    """Return the optimal plan for a task under a model, or with `behavior` the plan of an agent that behaves like that.

    Args:
        model: The transition model.
        task: One task.
        behavior: The agent's, π ∝ exp βQ; None for the optimal policy.
        options: How values are computed; by default `SolveOptions()`.

    Returns:
        The probabilities of actions and the intended next state of every state, with the values.

    Raises:
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
    options, agent = options or SolveOptions(), behavior or Behavior(HardMax())
    check_proper(task, agent, model.graph.actions, options.horizon)
    made = _plan(model, task, agent, behavior is None, options)
    solution = made.solution
    if not bool(solution.converged):
        raise NotConverged(
            f"values still changed by {float(solution.residual):.2g} in sweep {int(solution.sweeps)}: "
            "a smaller β, more sweeps or another backup may help"
        )
    return made


@keep_program
def _plan(model: TransitionModel, task: Task, behavior: Behavior, optimal: bool, options: SolveOptions) -> Plan:
    solution = solve(model, task, behavior, options=options)
    q = solution.action_values
    policy = behavior.backup.fixed_policy_weights(q, behavior.beta) if optimal else jnp.exp(behavior.log_policy(q))
    states = jnp.arange(model.graph.states)
    best = jnp.argmax(policy, axis=-1)
    outcomes = model.graph.successors[states, best]
    elsewhere = jnp.where(outcomes == states[:, None], 0, model.probabilities()[states, best])
    most_probable = jnp.take_along_axis(outcomes, jnp.argmax(elsewhere, axis=-1)[:, None], axis=-1)[:, 0]
    intended = jnp.where(elsewhere.max(axis=-1) > 0, most_probable, states)
    return Plan(policy, intended.astype(jnp.int32), task.terminal, solution)


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


@eqx.filter_jit
def roll_out(
    key: PRNGKeyArray,
    world: TransitionModel,
    policy: Float[Array, "states actions"],
    terminal: Bool[Array, " states"],
    starts: Int[Array, " agents"],
    max_moves: int,
) -> RollOuts:
    """Return trajectories of agents that follow a policy in a world.

    Args:
        key: Of the random choices; the trajectory of agent i does not depend on how many agents come after it.
        world: The transition model that moves follow; the policy may have been made for another one.
        policy: The probability of each action in every state.
        terminal: Where agents stop.
        starts: The state that each agent starts in.
        max_moves: The number of moves after which an agent stops anyway.

    Returns:
        The trajectories, one for each start.

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
    log_policy, log_probabilities = jnp.log(policy), jnp.log(world.probabilities())

    def of_agent(key: PRNGKeyArray, start: Int[Array, ""]) -> tuple[Array, Array]:
        def step(state: Int[Array, ""], key: PRNGKeyArray) -> tuple[Array, tuple[Array, Array]]:
            action_key, outcome_key = jax.random.split(key)
            action = jax.random.categorical(action_key, log_policy[state])
            outcome = jax.random.categorical(outcome_key, log_probabilities[state, action])
            done = terminal[state]
            next_state = jnp.where(done, state, world.graph.successors[state, action, outcome])
            return next_state, (next_state, jnp.where(done, -1, action))

        _, (states, actions) = jax.lax.scan(step, start, jax.random.split(key, max_moves))
        return jnp.concatenate([start[None], states]), actions

    starts = starts.astype(world.graph.successors.dtype)
    states, actions = jax.vmap(of_agent)(jax.random.split(key, len(starts)), starts)
    return RollOuts(states, actions, terminal[states[:, -1]])
