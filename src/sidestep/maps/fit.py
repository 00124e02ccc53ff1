"""The posterior of an obstacle grid after demonstrations, as a `MapConfig` describes it.

Maps of up to `MAX_SAMPLED` unknown cells × cells × goals are sampled (`sample_barriers`), or have a mean field by
coordinate ascent (`mean_field_barriers`). Larger ones, and those with the paper's normal prior, are fitted: the
posterior of `sidestep.inference.fit` with the prior of the mean field, or with the normal one and `WallPrior`. In a
fit, the first cell of every walk counts as evidence that it is free (`FreeCellEvidence`). A fit starts where the
transitions alone lead. On large maps every unvisited unknown cell is then almost surely blocked. Parameters of the
behavior are learned by a fit; maps are sampled with these.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sidestep.errors import check
from sidestep.inference.coordinate_ascent import BarrierMeanField, mean_field_barriers
from sidestep.inference.fit import Fit, fit
from sidestep.inference.hierarchical import HierarchicalMRF, hierarchical_mrf
from sidestep.inference.maximize import Progress
from sidestep.inference.mean_field import MeanField
from sidestep.inference.mrf import SHAPE_TERMS, BinaryMRF
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer, Rprop
from sidestep.inference.priors import FreeCellEvidence, Prior, WallPrior
from sidestep.inference.sampler import BarrierPosterior, sample_barriers
from sidestep.io.demonstrations import demonstrations_from_moves
from sidestep.io.gridding import Moves
from sidestep.maps.config import (
    MAX_SAMPLED,
    SHAPE_WEIGHTS,
    FitConfig,
    MapConfig,
    PosteriorMethod,
    PriorConfig,
)
from sidestep.maps.sensors import SensorMap, cell_field, cell_prior, seen_cells
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions

MapPosterior = Fit[ObstacleGrid] | BarrierMeanField[ObstacleGrid] | BarrierPosterior[ObstacleGrid]
"""What is learned of a map: a fit, a mean field, or samples."""

_PROPOSALS, _FEWEST_SWEEPS, _MOST_SWEEPS = 12_000_000, 150, 800
"""Chains are continued up to this number over unknown cells × goals sweeps, within these bounds."""
_FIRST_SWEEPS = 200
"""The number of sweeps after which it is first checked whether chains have mixed."""
_BLOCKED_LOGIT = {"normal": 8.0, "binary": 5.0}
"""The first logit of an unvisited cell of a large map by its prior: some 3,000 or 150 tries, longer than most detours.
The gradient of a mean field has a factor p (1 − p), and so vanishes where a cell is more surely blocked."""
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


def behavior_of(config: MapConfig) -> Behavior:
    """Return the behavior that a configuration describes.

    Args:
        config: The configuration.

    Raises:
        InputError: For a β or lapse out of range.
    """
    return Behavior(BACKUPS[config.behavior.backup](), config.agents.beta, config.agents.lapse)


def behavior_model_of(config: MapConfig, person: Int[np.ndarray, " tasks"] | None = None) -> BehaviorModel:
    """Return the behavior model that a configuration describes.

    Args:
        config: The configuration; `config.behavior.learn` names what is learned.
        person: The person (0…n−1) of each task, where each person has their own β.
    """
    learn = config.behavior.learn
    discount = config.reward.discount if "discount" in learn else None
    return behavior_model(behavior_of(config), learn, discount=discount, person=person)


def solve_options_of(config: MapConfig) -> SolveOptions:
    """Return how the values of the agents that a configuration describes are computed.

    Args:
        config: The configuration.
    """
    return SolveOptions(gradient=config.fit.gradient, horizon=config.behavior.horizon)


class MapSize(NamedTuple):
    """The size of what is learned of a map.

    Attributes:
        unknown: The number of unknown cells.
        cells: The number of all cells.
        goals: The number of tasks.

    Example:
        >>> MapSize(unknown=10_000, cells=10_000, goals=40).sampled, MapSize(6_000, 200_000, 40).sampled
        (True, False)
    """

    unknown: int
    cells: int
    goals: int

    @property
    def sampled(self) -> bool:
        """Whether a map of this size is sampled by default."""
        return self.unknown * self.cells * self.goals <= MAX_SAMPLED


def posterior_method(config: MapConfig, size: MapSize) -> PosteriorMethod:
    """Return how the posterior of a map is found: the configured way, or one by the prior and the size.

    Args:
        config: The configuration.
        size: The size of the map.
    """
    if config.posterior.method is not None:
        return config.posterior.method
    if config.prior.kind == "normal":
        return "mode"
    return "sample" if _has_exact_values(config) and size.sampled else "mean_field"


def _has_exact_values(config: MapConfig) -> bool:
    """Return whether maps are evaluated with the agents' values: without a horizon and another gradient."""
    return config.behavior.horizon is None and config.fit.gradient == "exact"


def method_of(posterior: MapPosterior, config: MapConfig) -> PosteriorMethod:
    """Return the method that found a posterior.

    Args:
        posterior: The posterior.
        config: The configuration by which it was found.
    """
    if isinstance(posterior, BarrierPosterior):
        return "sample"
    return "mean_field" if config.prior.kind == "binary" else "mode"


def sweeps_for(config: MapConfig, size: MapSize) -> tuple[int, int]:
    """Return the fewest and the most sweeps: the configured number for both, or numbers by the size.

    Args:
        config: The configuration.
        size: The size of the map.
    """
    if config.posterior.sweeps is not None:
        return config.posterior.sweeps, config.posterior.sweeps
    most = max(_FEWEST_SWEEPS, min(_MOST_SWEEPS, _PROPOSALS // max(1, size.unknown * size.goals)))
    return min(_FIRST_SWEEPS, most), most


def barrier_prior(
    config: PriorConfig,
    known: Int[np.ndarray, "rows columns"],
    method: PosteriorMethod,
    sensor: SensorMap | None = None,
) -> BinaryMRF:
    """Return the binary prior of the cells of a map, of known density.

    Args:
        config: The configuration of the prior.
        known: The `Cell` value of each cell.
        method: The method, for the default weights of shapes.
        sensor: What sensors saw, if anything.
    """
    return BinaryMRF(cell_field(sensor, known, config).ravel(), known.shape, **shape_weights(config, method))


def sampled_prior(
    config: PriorConfig, known: Int[np.ndarray, "rows columns"], sensor: SensorMap | None = None
) -> BinaryMRF | HierarchicalMRF:
    """Return the prior with which maps are sampled; its density is unknown unless the configuration says it.

    Args:
        config: The configuration of the prior.
        known: The `Cell` value of each cell.
        sensor: What sensors saw, if anything.
    """
    if config.log_odds is not None:
        return barrier_prior(config, known, "sample", sensor)
    seen = np.isfinite(seen_cells(sensor, known))
    field = np.where(seen, cell_field(sensor, known, config), np.nan)
    return hierarchical_mrf(field.ravel(), known.shape, **shape_weights(config, "sample"))


def shape_weights(config: PriorConfig, method: PosteriorMethod) -> dict[str, float]:
    """Return the weights of the binary prior's shape terms: the configured ones, or the defaults of a method.

    Args:
        config: The configuration of the prior.
        method: The method.
    """
    weights = {name: getattr(config, name) for name in SHAPE_TERMS}
    return weights | {name: weight for name, weight in SHAPE_WEIGHTS[method].items() if weights[name] is None}


def infer_map(
    model: ObstacleGrid,
    demonstrations: Demonstrations,
    config: MapConfig,
    *,
    sensor: SensorMap | None = None,
    behavior: BehaviorModel | None = None,
    callback: Callable[[Any], None] | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> MapPosterior:
    """Find the posterior of an obstacle grid after demonstrations: samples of maps, a mean field, or a fit.

    Args:
        model: The grid; its parameters are where a fit starts.
        demonstrations: Moves on the grid, with tasks that have the reward of `config`.
        config: The configuration; `config.reward` counts only where the discount is learned.
        sensor: What sensors saw of unknown cells.
        behavior: The agents; by default those of `config.behavior`. What is learned of them is learned by a fit.
        callback: Called with the progress of every iteration or sweep.
        checkpoint: The file that is kept up to date meanwhile.
        resume: Continue from the checkpoint.

    Returns:
        Samples, a mean field or a fit, by `posterior_method` and the size.

    Raises:
        InputError: For settings or demonstrations that do not fit, as `sidestep.fit` and `sample_barriers` do.
    """
    behavior, known = behavior or behavior_model_of(config), np.asarray(model.known)
    size = MapSize(int((known == Cell.UNKNOWN).sum()), known.size, len(demonstrations.tasks.terminal))
    method = posterior_method(config, size)
    run: dict[str, Any] = {"checkpoint": checkpoint, "resume": resume}
    if method == "mode" or (method == "mean_field" and not (_has_exact_values(config) and size.sampled)):
        return fit_map(model, demonstrations, config, sensor=sensor, behavior=behavior, callback=callback, **run)
    message = "maps are sampled without a horizon: expected none, or the posterior mean_field"
    check(config.behavior.horizon is None, message, field="horizon")
    message = "maps are sampled without a gradient: expected exact, or the posterior mean_field"
    check(config.fit.gradient == "exact", message, field="gradient")
    learned: Fit[ObstacleGrid] | None = None
    if any(leaf is not None for leaf in behavior.parameters):
        learned = fit_map(model, demonstrations, config, sensor=sensor, behavior=behavior, callback=callback)
    agents = learned.behavior if learned else behavior
    run |= {"tempering": config.agents.tempering, "seed": config.seed, "report": callback}
    run |= {"terms": ALL_TERMS if config.fit.terms == "both" else (config.fit.terms,)}
    if method == "mean_field":
        # one start: random maps lead to phases of the prior in which floors without walks are full of walls
        prior = barrier_prior(config.prior, known, method, sensor)
        limit = {} if config.fit.max_iterations is None else {"max_sweeps": config.fit.max_iterations}
        posterior = mean_field_barriers(model, demonstrations, agents, prior=prior, starts=1, **limit, **run)
    else:
        prior, (sweeps, most) = sampled_prior(config.prior, known, sensor), sweeps_for(config, size)
        settings = {"sweeps": sweeps, "most_sweeps": most, "chains": config.posterior.chains}
        posterior = sample_barriers(model, demonstrations, agents, prior=prior, **settings, **run)
    return replace(posterior, learned_behavior=learned.learned_behavior) if learned else posterior


def fit_map(
    model: ObstacleGrid,
    demonstrations: Demonstrations,
    config: MapConfig,
    *,
    sensor: SensorMap | None = None,
    behavior: BehaviorModel | None = None,
    initialize: bool = True,
    callback: Callable[[Progress], None] | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> Fit[ObstacleGrid]:
    """Fit an obstacle grid to demonstrations, by the mean field of a binary prior or the mode of a normal one.

    Args:
        model: The grid; its parameters are where the fit starts.
        demonstrations: Moves on the grid, with tasks that have the reward of `config`.
        config: The configuration; `config.reward` counts only where the discount is learned.
        sensor: What sensors saw of unknown cells.
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
    prior = prior_of_fit(config.prior, model, sensor)
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
        blocked = _BLOCKED_LOGIT[config.prior.kind]
        model = model.with_parameters(jnp.where(jnp.asarray(~visited & unknown), blocked, model.parameters))
    return fit(
        model,
        demonstrations,
        behavior,
        prior=prior,
        tempering=config.agents.tempering,
        terms=ALL_TERMS if config.fit.terms == "both" else (config.fit.terms,),
        options=solve_options_of(config),
        optimizer=optimizer,
        memory=config.fit.memory * 2**30,
        large_map=config.fit.large_map,
        report=callback,
        checkpoint=checkpoint,
        resume=resume,
    )


def prior_of_fit(config: PriorConfig, model: ObstacleGrid, sensor: SensorMap | None = None) -> Prior:
    """Return the prior of the cells' logits with which a map is fitted.

    Args:
        config: The configuration of the prior.
        model: The grid.
        sensor: What sensors saw, if anything.
    """
    if config.kind == "binary":
        return MeanField(barrier_prior(config, np.asarray(model.known), "mean_field", sensor), model.known)
    prior = cell_prior(sensor, config)
    return WallPrior(prior, model.known, config.wall_prior) if config.wall_prior else prior


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
