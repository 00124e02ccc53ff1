"""Roll-outs: trajectories of agents that follow a given policy in a world.

A plan knows only the model it was made with. Followed in another one, such as the true world, it may meet a wall that
the model did not know: the move fails, and an optimal plan repeats it forever. `roll_out` shows that.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, Shaped

from sidestep._arguments import to_floats, to_key, to_mask, to_states
from sidestep._repr import short_repr
from sidestep.errors import to_count
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.checks import check_model, check_policy
from sidestep.tabular.models import TransitionModel


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
        >>> from sidestep.tabular.planning import plan
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
    policy: Shaped[ArrayLike, "..."] | Sequence[Any],
    terminal: Shaped[ArrayLike, "..."] | Sequence[bool],
    starts: Shaped[ArrayLike, "..."] | Sequence[int],
    max_moves: int,
) -> RollOuts:
    """Return trajectories of agents that follow a policy in a world.

    Args:
        key: Of the random choices; the trajectory of agent i does not depend on how many agents come after it.
        world: The transition model that moves follow; the policy may have been made for another one.
        policy: The probability of each action in every state; with an axis of moves before these, of each move.
        terminal: Whether agents stop, in each state.
        starts: The state that each agent starts in.
        max_moves: The number of moves after which an agent stops anyway.

    Returns:
        The trajectories, one for each start.

    Raises:
        InputError: For a start that is not a state, a number of moves below 1, terminal states that are not booleans, a
            policy of another shape, and, with state and action, one that is no distribution or gives probability to an
            action that is not available, in a state that is not terminal.

    Example:
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.planning import plan
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
    policy, terminal = to_jax(to_floats(policy, "policy")), to_jax(to_mask(terminal, "terminal"))
    check_policy(policy, terminal, world.graph, max_moves)
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
