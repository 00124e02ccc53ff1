"""Maximum likelihood constraint inference (Scobee & Sastry 2020): the forbidden cells that best explain the walks.

Agents know a map without hidden obstacles, but must not enter some cells. The algorithm is greedy: it forbids one cell
after another, each time the unvisited cell that agents would visit most. That removes the most probability from paths
that were not observed. It differs from the published algorithm in three ways:
1. agents choose actions with probabilities ∝ exp βQ by the configuration, instead of maximum entropy over paths;
2. the expected visits N are exact, from (I − P_π)ᵀ N = starts, instead of a forward recursion over time;
3. it stops when the log-likelihood grows by less than the cost of naming a cell, the logarithm of the number of
   candidates, instead of at a threshold of the divergence.

References:
    D. R. R. Scobee and S. S. Sastry (2020). Maximum likelihood constraint inference for inverse reinforcement
    learning. International Conference on Learning Representations.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from sidestep.baselines.interface import ModelResult, check_arguments, model_result, visited_states
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import behavior_of, solve_options_of
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.planning import Plan, plan
from sidestep.tabular.tasks import task_at

_Visits = Float[np.ndarray, " cells"]
_MAX_LOGIT = 6.0
"""The logit of the first forbidden cell."""


def constraint_inference(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Forbid cells one after another; P(blocked) is higher for cells that were forbidden earlier.

    Args:
        grid: The known map.
        demonstrations: The walks on it.
        config: The reward and the behavior of agents.

    Returns:
        A map in which forbidden cells have P(blocked) above 1/2.
    """
    check_arguments(grid, demonstrations, config)
    visited = np.zeros(grid.size, dtype=bool)
    visited[visited_states(demonstrations)] = True
    candidates = ~visited & (grid.known.ravel() == Cell.UNKNOWN)
    forbidden: list[int] = []
    visits, log_likelihood = _predict(grid, forbidden, demonstrations, config)
    while len(forbidden) < candidates.sum():
        ranking = np.where(candidates, visits, -np.inf)
        ranking[forbidden] = -np.inf
        cell = int(ranking.argmax())
        new_visits, new_log_likelihood = _predict(grid, [*forbidden, cell], demonstrations, config)
        if new_log_likelihood - log_likelihood < np.log(candidates.sum()):
            break
        forbidden.append(cell)
        visits, log_likelihood = new_visits, new_log_likelihood
    return model_result(ObstacleGrid(grid, _logits(candidates, forbidden, visits)), demonstrations, config)


def _logits(candidates: Bool[np.ndarray, " cells"], forbidden: list[int], visits: _Visits) -> _Visits:
    """Return logits above 0 for forbidden cells, and below for others; expected visits bring these nearer to 0."""
    logits = np.full(len(visits), -_MAX_LOGIT)
    relative = visits / max(visits[candidates].max(initial=0.0), 1e-300)
    logits[candidates] = -_MAX_LOGIT + (_MAX_LOGIT - 2) * np.clip(relative[candidates], 0, 1)
    logits[forbidden] = np.linspace(_MAX_LOGIT, 2, len(forbidden))
    return logits


def _predict(
    grid: Grid, forbidden: list[int], demonstrations: Demonstrations, config: MapConfig
) -> tuple[_Visits, float]:
    """Return the expected visits of each cell, and the log-likelihood of the observed actions."""
    known = grid.passable().known
    known.flat[forbidden] = Cell.OCCUPIED
    model, behavior, options = true_model(replace(grid, known=known)), behavior_of(config), solve_options_of(config)
    visits, total = np.zeros(grid.size), 0.0
    states, actions, task = (np.asarray(getattr(demonstrations, name)) for name in ("states", "actions", "task"))
    weights, first = np.asarray(demonstrations.weights, np.float64), demonstrations.first_moves()
    for index in range(len(demonstrations.tasks.terminal)):
        own_task = task_at(demonstrations.tasks, index)
        agents = plan(model, own_task, behavior, options=options)
        own = (task == index) & (weights > 0)
        total += float(weights[own] @ np.log(np.asarray(agents.policy)[states[own], actions[own]]))
        begins = first[task[first] == index]
        starts = np.bincount(states[begins], weights[begins], minlength=grid.size)
        visits += _expected_visits(model, agents, starts)
    return visits, total


def _expected_visits(model: ObstacleGrid, agents: Plan, starts: _Visits) -> _Visits:
    """Return the expected visits of each cell when agents follow a plan."""
    from scipy.sparse import coo_array, eye_array
    from scipy.sparse.linalg import spsolve

    active = ~np.asarray(agents.terminal)
    probabilities = (np.asarray(agents.policy)[..., None] * np.asarray(model.probabilities()))[active]
    origin = np.broadcast_to(np.flatnonzero(active)[:, None, None], probabilities.shape)
    target = np.asarray(model.graph.successors)[active]
    moves = coo_array((probabilities.ravel(), (target.ravel(), origin.ravel())), shape=(len(active),) * 2).tocsr()
    reached, before = starts > 0, 0
    while reached.sum() > before:
        before = reached.sum()
        reached |= moves @ reached.astype(np.float64) > 0
    # of other cells, those between obstacles lead only to themselves, and would make the matrix singular
    cells, visits = np.flatnonzero(reached), np.zeros(len(active))
    visits[cells] = np.asarray(spsolve((eye_array(len(cells)) - moves[cells][:, cells]).tocsc(), starts[cells]))
    return visits
