"""A robot that plans in a learned map, walks in the true world, and plans again whenever it bumps into something.

What a robot finds out closes one cell, or few, and changes the values of those states alone whose best ways led through
it. So a plan is mended: first, from the closed cell outwards, the states are found whose value nothing supports any
more; then these are given values anew, from their border inwards, the best first (Ramalingam & Reps, 1996). Since no
action has a value above that of where it leads, the best of them depends on none of the others.

A robot that has only a policy has nothing to mend: it does not try again what it knows to fail, and goes on as its
policy says. Without anything new it does the same in the same state, so who returns to one will never arrive.
"""

from heapq import heappop, heappush
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.tabular.backups import HardMax
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.planning import plan
from sidestep.tabular.solvers.base import is_reachable
from sidestep.tabular.solvers.compiled import compiled
from sidestep.tabular.tasks import Task


class World(NamedTuple):
    """The true world as a robot finds it out.

    - `needed`: the cells that must be free for each move (see `moves_into`); `lengths`: of each action, in cell sides.
    - `walls`: the cells that are not free, and false one past the last: the entry of `needed` for "no such cell".
    """

    needed: Int[np.ndarray, "states actions 3"]
    lengths: Float[np.ndarray, " actions"]
    walls: Bool[np.ndarray, " cells"]


class _Mind(NamedTuple):
    """What a robot holds of the world and of its task, to reach the state `goal`.

    - `chances`: that each move succeeds; 0 for moves off the map and those that it knows to fail.
    - `values`: of the states by these chances, the goal's own included; −∞ at discount 1 where there is no way.
    - `reward`: of each action in each state. `tie`: within which share of the best its ties lie.
    """

    chances: Float[np.ndarray, "states actions"]
    values: Float[np.ndarray, " states"]
    reward: Float[np.ndarray, "states actions"]
    discount: float
    goal: int
    tie: float


def world_of(truth: Grid) -> World:
    """The world that a map shows; what the map does not know counts as not free."""
    return World(moves_into(truth), truth.lengths, np.append(truth.known.reshape(-1) != Cell.FREE, False))


def lengths_with_bumps(
    model: ObstacleGrid, world: World, task: Task, goal: int, starts: Int[np.ndarray, " starts"]
) -> Float[np.ndarray, " starts"]:
    """How far a robot goes from each start that plans in a learned map, and again whenever it bumps into something.

    `task` is to reach `goal`. In cell sides, with moves that failed; infinite if the
    robot never arrives because the learned map is sure of an obstacle that is not there. Each robot sets out knowing
    `model`, not what others found out. Raises `NotConverged` if the first plan's values did not converge.
    """
    found = plan(model, task).solution.values
    tie = max(HardMax().tie, 64 * float(jnp.finfo(found.dtype).eps))
    values = np.where(is_reachable(found), found, -np.inf).astype(np.float64)
    on_the_map = world.needed[..., 0] < len(values)
    chances = np.where(on_the_map, np.asarray(model.probabilities(), dtype=np.float64)[..., 0], 0.0)
    reward = np.array(np.broadcast_to(task.reward, chances.shape), dtype=np.float64)

    def mind() -> _Mind:
        return _Mind(chances.copy(), values.copy(), reward, float(task.discount), goal, tie)

    return np.array([_walked(world, mind(), start) for start in starts.tolist()])


def lengths_by_policy(
    policy: Float[np.ndarray, "states actions"], world: World, goal: int, starts: Int[np.ndarray, " starts"]
) -> Float[np.ndarray, " starts"]:
    """How far a robot goes from each start that takes the most probable action, and after a bump the next.

    What has probability 0 is not tried. In cell sides, with moves that failed; infinite if the robot goes round in
    circles, or has nothing left to try. Each robot sets out knowing nothing but the policy.
    """
    ranked = np.argsort(-policy, axis=-1, kind="stable")
    return np.array([_walked_by(policy, ranked, world, goal, start) for start in starts.tolist()])


@compiled()
def _hit(world, here, action):  # pragma: no cover
    """The cells that a robot bumps into where it takes an action; none where it gets through."""
    needed = world.needed[here, action]
    return needed[world.walls[needed]]


@compiled()
def _walked_by(policy, ranked, world, goal, start):  # pragma: no cover
    """How far the robot goes from the start to the goal by the actions' rank in each state."""
    here, length, since_a_bump = start, 0.0, 0
    found = np.zeros(len(world.walls), np.bool_)
    while here != goal:
        action = -1
        for a in ranked[here]:
            if policy[here, a] > 0 and not found[world.needed[here, a]].any():
                action = a
                break
        if action < 0 or since_a_bump > len(policy):
            return np.inf
        length += world.lengths[action]
        since_a_bump += 1
        hit = _hit(world, here, action)
        found[hit] = True
        if len(hit):
            since_a_bump = 0
        else:
            here = world.needed[here, action, 0]
    return length


@compiled()
def _walked(world, mind, start):  # pragma: no cover
    """How far a robot goes from the start to the goal; what it bumps into changes its mind."""
    here, length, since_a_bump = start, 0.0, 0
    stale = np.zeros(len(mind.values), np.bool_)
    while here != mind.goal:
        # below discount 1 states without a way have values too: who walks on for so long will never arrive
        if mind.values[here] == -np.inf or since_a_bump > len(mind.values):
            return np.inf
        action = _chosen(mind, world.needed, here)
        if action < 0:
            return np.inf
        length += world.lengths[action]
        since_a_bump += 1
        hit = _hit(world, here, action)
        for cell in hit:
            _close(mind, world.needed, cell, stale)
        if len(hit):
            since_a_bump = 0
        else:
            here = world.needed[here, action, 0]
    return length


@compiled()
def _chosen(mind, needed, here):  # pragma: no cover
    """The first of the best actions, as an optimal plan has it (see `HardMax`); −1 if none leads anywhere."""
    worths = np.full(mind.reward.shape[1], -np.inf)
    own = mind.values[here]
    for a in range(len(worths)):
        if mind.chances[here, a] > 0:
            gain = mind.chances[here, a] * (mind.values[needed[here, a, 0]] - own)
            worths[a] = mind.reward[here, a] + mind.discount * (own + gain)
    best = worths.max()
    return np.argmax(worths >= best - mind.tie * abs(best)) if best > -np.inf else -1


@compiled()
def _supported(mind, needed, state, stale):  # pragma: no cover
    """The best that a state can have of those around it that are not stale: by one action, tried until it succeeds."""
    best = -np.inf
    for a in range(mind.reward.shape[1]):
        move = mind.discount * mind.chances[state, a]
        if move > 0 and not stale[needed[state, a, 0]]:
            best = max(
                best, (mind.reward[state, a] + move * mind.values[needed[state, a, 0]]) / (1 - mind.discount + move)
            )
    return best


@compiled()
def _close(mind, needed, cell, stale):  # pragma: no cover
    """Closes a cell and mends the values; `stale` is false everywhere, before and after."""
    waiting = [(0.0, 0) for _ in range(0)]
    for state in needed[cell, :, 0]:
        if state < len(stale):
            for a in range(mind.reward.shape[1]):
                if cell in needed[state, a]:
                    mind.chances[state, a] = 0.0
            heappush(waiting, (-mind.values[state], state))
    lost = [0 for _ in range(0)]
    while waiting:
        _, state = heappop(waiting)
        value = mind.values[state]
        supported = state == mind.goal or _supported(mind, needed, state, stale) >= value - mind.tie * abs(value)
        if stale[state] or supported:
            continue
        stale[state] = True
        lost.append(state)
        for after in needed[state, :, 0]:
            if after < len(stale) and not stale[after] and mind.values[after] < value:
                heappush(waiting, (-mind.values[after], after))
    for state in lost:
        mind.values[state] = _supported(mind, needed, state, stale)
        heappush(waiting, (-mind.values[state], state))
    while waiting:
        _, state = heappop(waiting)
        if not stale[state]:
            continue
        stale[state] = False
        for before in needed[state, :, 0]:
            if before < len(stale) and stale[before]:
                better = _supported(mind, needed, before, stale)
                if better > mind.values[before]:
                    mind.values[before] = better
                    heappush(waiting, (-better, before))
