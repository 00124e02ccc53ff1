"""Greedy constraint inference: which forbidden cells best explain what people did (Scobee & Sastry 2020).

People are taken to know a map without hidden obstacles, but for some cells that they must not enter. One cell after
another is forbidden, each time the one that people would now visit most without ever having been seen there: that
takes the most probability off what was not done. It ends where the log-likelihood of what was done grows by less than
it costs to name one of the cells that could be forbidden, the logarithm of their number.

Here people behave as they do everywhere in `sidestep`, at random with probabilities ∝ exp βQ. How often they would
visit each cell, N, solves (I − P_π)ᵀ N = starts.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import spsolve

from sidestep.baselines.interface import ModelResult, model_result
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import behavior_of
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.planning import Plan, plan

_SURE = 6.0
"""The logit of the first cell that was forbidden."""


class _People(NamedTuple):
    """What people would do on a map: how often they would visit each cell, and how probable what they did is."""

    visits: Float[np.ndarray, " cells"]
    log_likelihood: float


def constraint_inference(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Cells forbidden one after another; the earlier, the surer."""
    seen = np.zeros(grid.size, dtype=bool)
    seen[np.concatenate(demonstrations.paths())] = True
    possible = ~seen & (grid.known.ravel() == Cell.UNKNOWN)
    forbidden: list[int] = []
    found = _people(grid, forbidden, demonstrations, config)
    while (possible.sum() - len(forbidden)) > 0:
        visits = np.where(possible, found.visits, -np.inf)
        visits[forbidden] = -np.inf
        after = _people(grid, [*forbidden, int(visits.argmax())], demonstrations, config)
        if after.log_likelihood - found.log_likelihood < np.log(possible.sum()):
            break
        forbidden.append(int(visits.argmax()))
        found = after
    logits = _logits(possible, forbidden, found.visits)
    model = ObstacleGrid(grid, logits)
    return model_result(model, demonstrations, config)


def _logits(
    possible: Bool[np.ndarray, " cells"], forbidden: list[int], visits: Float[np.ndarray, " cells"]
) -> Float[np.ndarray, " cells"]:
    """Above 0 where it is forbidden; below where it is not, the more people would go there the nearer to it."""
    logits = np.full(len(visits), -_SURE)
    share = visits / max(visits[possible].max(initial=0.0), 1e-300)
    logits[possible] = -_SURE + (_SURE - 2) * np.clip(share[possible], 0, 1)
    logits[forbidden] = np.linspace(_SURE, 2, len(forbidden))
    return logits


def _people(grid: Grid, forbidden: list[int], demonstrations: Demonstrations, config: MapConfig) -> _People:
    known = grid.passable().known
    known.flat[forbidden] = Cell.OCCUPIED
    model = true_model(replace(grid, known=known))
    visits, total = np.zeros(grid.size), 0.0
    states, actions, task = (np.asarray(getattr(demonstrations, name)) for name in ("states", "actions", "task"))
    first = demonstrations.first_moves()
    for index in range(len(demonstrations.tasks.terminal)):
        made = plan(
            model,
            jax.tree.map(lambda leaf, index=index: leaf[index], demonstrations.tasks),
            behavior_of(config.behavior),
        )
        own = task == index
        total += float(np.log(np.asarray(made.policy)[states[own], actions[own]]).sum())
        starts = np.bincount(states[first[task[first] == index]], minlength=grid.size).astype(np.float64)
        visits += _visits(model, made, starts)
    return _People(visits, total)


def _visits(model: ObstacleGrid, made: Plan, starts: Float[np.ndarray, " cells"]) -> Float[np.ndarray, " cells"]:
    """How often people who follow a plan would visit each cell."""
    going = ~np.asarray(made.terminal)
    chances = (np.asarray(made.policy)[..., None] * np.asarray(model.probabilities()))[going]
    origin = np.broadcast_to(np.flatnonzero(going)[:, None, None], chances.shape)
    target = np.asarray(model.graph.successors)[going]
    moves = coo_array((chances.ravel(), (target.ravel(), origin.ravel())), shape=(len(going),) * 2)
    return np.asarray(spsolve((eye_array(len(going)) - moves).tocsc(), starts))
