"""Planning under a model: policies, the paths they mean to take, and what happens when they are followed.

A plan knows only the model it was made with. Followed in another one, the true world say, it may meet a wall that the
model did not know: the move fails, and an optimal plan tries it again for ever. `roll_out` shows that.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sidestep.errors import InputError, NotConverged
from sidestep.tabular.backups import Behavior, HardMax
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import Solution, SolveOptions, check_proper, solve
from sidestep.tabular.solvers.base import is_reachable
from sidestep.tabular.tasks import Task


class Plan(eqx.Module):
    """What to do in every state to pursue one task under a model.

    - `policy`: the probability of each action; an optimal policy is uniform over ties.
    - `intended`: where the best action (the first of ties) is meant to lead: its most probable outcome elsewhere, or
      the state itself if it leads nowhere else.
    - `terminal`: where the task ends.
    - `solution`: values and convergence.
    """

    policy: Float[Array, "states actions"]
    intended: Int[Array, " states"]
    terminal: Bool[Array, " states"]
    solution: Solution

    def path_from(self, start: int) -> Int[np.ndarray, " steps"]:
        """The states that the plan means to pass from `start` on.

        The path ends at a terminal state; or, where the plan never arrives, before the first state that would repeat.
        Raises `InputError` for a start that is not a state or, at discount 1, from which no terminal state can be
        reached.
        """
        if not isinstance(start, (int, np.integer)) or not 0 <= start < len(self.terminal):
            raise InputError(f"expected a state in 0…{len(self.terminal) - 1}, found {start}", field="start")
        if not bool(is_reachable(self.solution.values[start])):
            raise InputError(f"the goal cannot be reached from state {start}", field="start")
        return self.follow(np.array([start]))[0]

    def follow(self, starts: Int[np.ndarray, " starts"]) -> list[Int[np.ndarray, " _"]]:
        """The states that the plan means to pass from each start on: `path_from`, but also where there is no way."""
        return followed(np.asarray(self.intended), np.asarray(self.terminal), starts)


def followed(
    intended: Int[np.ndarray, " states"], terminal: Bool[np.ndarray, " states"], starts: Int[np.ndarray, " starts"]
) -> list[Int[np.ndarray, " _"]]:
    """The states from each start on, `intended` after each; they end at a terminal one, or before one would repeat."""
    return [_followed(intended, terminal, start) for start in starts.tolist()]


def _followed(
    intended: Int[np.ndarray, " states"], terminal: Bool[np.ndarray, " states"], start: int
) -> Int[np.ndarray, " steps"]:
    path, seen = [start], {start}
    while not terminal[path[-1]] and (state := int(intended[path[-1]])) not in seen:
        path.append(state)
        seen.add(state)
    return np.asarray(path)


def plan(
    model: TransitionModel, task: Task, behavior: Behavior | None = None, *, options: SolveOptions | None = None
) -> Plan:
    """The optimal plan for a task under a model; with `behavior`, how such people would act (∝ exp βQ).

    Raises `ImproperTask` for a task without values and `NotConverged` if they are not found.

    >>> from sidestep.tabular.grid import Grid
    >>> from sidestep.tabular.models import ObstacleGrid
    >>> from sidestep.tabular.tasks import reach
    >>> grid = Grid.unknown(rows=1, columns=4)
    >>> plan(ObstacleGrid(grid), reach(grid, 3)).path_from(0).tolist()
    [0, 1, 2, 3]
    """
    people = behavior or Behavior(HardMax())
    options = options or SolveOptions()
    check_proper(task, people, model.graph.actions, options.horizon)
    made = _plan(model, task, people, behavior is None, options)
    if not bool(made.solution.converged):
        raise NotConverged(
            f"values still changed by {float(made.solution.residual):.2g} in sweep {int(made.solution.sweeps)}: "
            "a smaller β, more sweeps or another backup may help"
        )
    return made


@eqx.filter_jit
def _plan(model: TransitionModel, task: Task, behavior: Behavior, optimal: bool, options: SolveOptions) -> Plan:
    solution = solve(model, task, behavior, options=options)
    q = solution.action_values
    policy = behavior.backup.fixed_policy_weights(q, behavior.beta) if optimal else jnp.exp(behavior.log_policy(q))
    states = jnp.arange(model.graph.states)
    best = jnp.argmax(policy, axis=-1)
    outcomes = model.graph.successors[states, best]
    chances = jnp.where(outcomes == states[:, None], 0, model.probabilities()[states, best])
    meant = jnp.take_along_axis(outcomes, jnp.argmax(chances, axis=-1)[:, None], axis=-1)[:, 0]
    intended = jnp.where(chances.max(axis=-1) > 0, meant, states)
    return Plan(policy, intended.astype(jnp.int32), task.terminal, solution)


class RollOuts(NamedTuple):
    """Walks of several walkers in a world.

    - `states`: where each was before every action, and at the end.
    - `actions`: what each did; −1 after it had arrived.
    - `arrived`: whether it reached a terminal state in time.
    """

    states: Int[Array, "walkers moves+1"]
    actions: Int[Array, "walkers moves"]
    arrived: Bool[Array, " walkers"]

    @property
    def moves(self) -> Int[Array, " walkers"]:
        """How many actions each walker took."""
        return jnp.sum(self.actions >= 0, axis=-1)

    @property
    def failed(self) -> Int[Array, " walkers"]:
        """How many of its actions left a walker where it was."""
        return jnp.sum((self.actions >= 0) & (self.states[:, 1:] == self.states[:, :-1]), axis=-1)


@eqx.filter_jit
def roll_out(
    key: PRNGKeyArray,
    world: TransitionModel,
    policy: Float[Array, "states actions"],
    terminal: Bool[Array, " states"],
    starts: Int[Array, " walkers"],
    moves: int,
) -> RollOuts:
    """Walkers who follow a policy in a world, each for at most `moves` actions or until a terminal state.

    The world may be another model than the policy was made for.
    """
    log_policy, log_chances = jnp.log(policy), jnp.log(world.probabilities())

    def walk(key: PRNGKeyArray, start: Int[Array, ""]) -> tuple[Array, Array]:
        def step(state: Int[Array, ""], key: PRNGKeyArray) -> tuple[Array, tuple[Array, Array]]:
            choosing, leading = jax.random.split(key)
            action = jax.random.categorical(choosing, log_policy[state])
            outcome = jax.random.categorical(leading, log_chances[state, action])
            after = world.graph.successors[state, action, outcome]
            done = terminal[state]
            after = jnp.where(done, state, after)
            return after, (after, jnp.where(done, -1, action))

        _, (states, actions) = jax.lax.scan(step, start, jax.random.split(key, moves))
        return jnp.concatenate([start[None], states]), actions

    starts = starts.astype(world.graph.successors.dtype)
    states, actions = jax.vmap(walk)(jax.random.split(key, len(starts)), starts)
    return RollOuts(states, actions, terminal[states[:, -1]])
