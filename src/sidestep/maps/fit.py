"""The fit of an obstacle grid to demonstrations that a `MapConfig` describes.

The posterior is that of `sidestep.inference.fit`, with two additions. The first cell of every walk counts as evidence
that it is free (`FreeCellEvidence`), and a blocked cell between two others is more probable (`WallPrior`). The fit
starts where the transitions alone lead. On large maps every unvisited unknown cell is then almost surely blocked.
"""

from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sidestep.inference.fit import Fit, fit
from sidestep.inference.maximize import Progress
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer, Rprop
from sidestep.inference.priors import FreeCellEvidence, Normal, WallPrior
from sidestep.io.demonstrations import demonstrations_from_moves
from sidestep.io.gridding import Moves
from sidestep.maps.config import BehaviorConfig, FitConfig, MapConfig
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions

_BLOCKED_LOGIT = 8.0
"""The first logit of an unvisited cell of a large map: some 3,000 tries, longer than most detours."""
_TOLERANCE_PER_MOVE = 1e-3
"""A large map is learned when the next step promises less than this for each move of the walks (nats)."""


def demonstrations_of(moves: Moves, grid: Grid, config: MapConfig) -> Demonstrations:
    """Return the demonstrations of gridded walks with the reward of a configuration.

    Args:
        moves: From `grid_walks`.
        grid: The map.
        config: The configuration, for its reward.

    Raises:
        InputError: As `demonstrations_from_moves` does.
    """
    return demonstrations_from_moves(moves, grid, discount=config.reward.discount, step_cost=config.reward.step_cost)


def behavior_of(config: BehaviorConfig) -> Behavior:
    """Return the behavior that a configuration describes.

    Args:
        config: The configuration.

    Raises:
        InputError: For a β or lapse out of range.
    """
    return Behavior(BACKUPS[config.backup](), config.beta, config.lapse)


def behavior_model_of(config: MapConfig, person: Int[np.ndarray, " tasks"] | None = None) -> BehaviorModel:
    """Return the behavior model that a configuration describes.

    Args:
        config: The configuration; `config.behavior.learn` names what is learned.
        person: The person (0…n−1) of each task, where each person has their own β.
    """
    learn = config.behavior.learn
    discount = config.reward.discount if "discount" in learn else None
    return behavior_model(behavior_of(config.behavior), learn, discount=discount, person=person)


def fit_map(
    model: ObstacleGrid,
    demonstrations: Demonstrations,
    config: MapConfig,
    *,
    cell_prior: Normal | None = None,
    behavior: BehaviorModel | None = None,
    initialize: bool = True,
    callback: Callable[[Progress], None] | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> Fit[ObstacleGrid]:
    """Fit an obstacle grid to demonstrations.

    Args:
        model: The grid; its parameters are where the fit starts.
        demonstrations: Moves on the grid, with tasks that have the reward of `config`.
        config: The configuration; `config.reward` counts only where the discount is learned.
        cell_prior: The prior of the cells' logits; by default that of `config.prior`.
        behavior: The agents; by default those of `config.behavior`.
        initialize: Start where the transitions and first cells lead instead of at `model`.
        callback: Called with the progress of every iteration.
        checkpoint: The file that is kept up to date while the fit runs.
        resume: Continue from the checkpoint.

    Returns:
        The fit, as `sidestep.fit` returns it.

    Raises:
        InputError: For settings or demonstrations that do not fit, as `sidestep.fit` does.
    """
    behavior = behavior or behavior_model_of(config)
    weights, unknown = np.asarray(demonstrations.weights), np.asarray(model.known).ravel() == Cell.UNKNOWN
    prior = cell_prior or Normal(config.prior.mean, config.prior.variance)
    if config.prior.wall_prior:
        prior = WallPrior(prior, model.known, config.prior.wall_prior)
    if config.fit.terms != "actions":
        # of each unknown cell, the walks that begin there, by their weights
        first = demonstrations.first_moves()
        counts = np.bincount(np.asarray(demonstrations.states)[first], weights[first], minlength=len(unknown))
        prior = FreeCellEvidence(prior, to_jax(np.where(unknown, counts, 0.0)))
    optimizer = optimizer_for(config.fit, model.graph.states, round(float(weights.sum())))
    if initialize and config.fit.terms == "both":
        model = fit(model, demonstrations, behavior, prior=prior, terms=("transitions",)).model
    if initialize and isinstance(optimizer, Rprop):
        # With every unvisited cell almost surely blocked, no other path is possible at first. The prior lowers cells
        # until another path would be taken. The ascent from below takes long: of all gaps in a wall, the likelihood
        # sees only the one that agents would take next.
        visited = np.zeros(model.graph.states, dtype=bool)
        for states in (demonstrations.states, demonstrations.next_states):
            visited[np.asarray(states)[weights > 0]] = True
        model = model.with_parameters(jnp.where(jnp.asarray(~visited & unknown), _BLOCKED_LOGIT, model.parameters))
    return fit(
        model,
        demonstrations,
        behavior,
        prior=prior,
        tempering=config.behavior.tempering,
        terms=ALL_TERMS if config.fit.terms == "both" else (config.fit.terms,),
        options=SolveOptions(gradient=config.fit.gradient, horizon=config.behavior.horizon),
        optimizer=optimizer,
        memory=config.fit.memory * 2**30,
        large_map=config.fit.large_map,
        report=callback,
        checkpoint=checkpoint,
        resume=resume,
    )


def optimizer_for(config: FitConfig, cells: int, moves: int) -> Optimizer:
    """Return the optimizer of a fit.

    It is Adam for the fixed-policy gradient, Rprop for the exact gradient on large maps, and L-BFGS otherwise
    (`docs/design.md` gives the reasons).

    Args:
        config: The configuration of the fit.
        cells: The number of cells.
        moves: The number of moves that count.
    """
    limit = {} if config.max_iterations is None else {"max_iterations": config.max_iterations}
    if config.gradient == "fixed_policy":
        return Adam(**limit)
    if cells < config.large_map or config.terms == "transitions":
        return LBFGS(**limit)
    return Rprop(tolerance=_TOLERANCE_PER_MOVE * moves, **limit)


def max_iterations(config: FitConfig) -> int:
    """Return the most iterations that a fit may take, whatever the map.

    Args:
        config: The configuration of the fit.
    """
    return max(optimizer_for(config, cells, moves=1).max_iterations for cells in (0, config.large_map))
