"""Simulation-based calibration of sampled maps (Talts et al. 2018), with the mean field beside them.

Each of many maps is drawn from the prior, agents that know it walk on it, and its posterior follows from their walks.
If prior, walks and posterior belong to one model, the rank of any quantity of the true map among those of independent
draws from the posterior is uniform (`sidestep.evaluation.ranks`). Three quantities are ranked:

- the length of the shortest path from A to B, cells in the middle of the upper and of the lower edge; infinite if
  there is none
- the log-likelihood of the walks, by `sidestep.log_likelihood` and not by the sampler's own numbers
- whether the door, a cell in the middle of the map, is open

The walks follow the sampler's model exactly:

1. A, B, and the places where walks start and end are the same on all maps, and known to be free.
2. Agents plan and move in a world in which open cells let them pass with probability .997 and closed ones with .003
   (`PASSING`). They stop at the goal, or after a number of moves that does not depend on the map.
3. The sampler holds cells that walks crossed for open, which its model makes nearly certain. So a map on which a walk
   crossed a closed cell is drawn again, together with the walks. Given that, what the sampler holds is certain.

The prior has .7 times the default weights of the shapes of samples, and log-odds of −2.25. With the whole weights most
maps of 12² have more than half of their cells closed at log-odds of −2.5, and few at −3. A chain of this prior forgets
within 30 sweeps whether it started from no or from all cells closed; some 21 of 144 are.

The mean field has the same prior and walks. Its draws are of independent cells with its P(closed); cells that walks
crossed are open in them.
"""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

import sidestep as ss
from sidestep.errors import check
from sidestep.evaluation.ranks import UniformBand, band_excess, outside_fraction, rank, rank_difference, uniform_band
from sidestep.experiments.calibration_cases import (
    QUANTITIES,
    CalibrationConfig,
    Case,
    draw_case,
    draw_seed,
    quantities_of,
)
from sidestep.experiments.output import Notify, Summary, quiet, write_results
from sidestep.inference.coordinate_ascent import BarrierMeanField
from sidestep.inference.diagnostics import effective_sizes
from sidestep.inference.sampler import BarrierPosterior
from sidestep.maps.fit import infer_map
from sidestep.plotting.ranks import figure_ranks

Draws = Bool[np.ndarray, "draws cells"]


class CaseResult(NamedTuple):
    """What was found on a map.

    Attributes:
        sampler: The rank of each quantity of the true map among the sampler's draws.
        mean_field: The same among draws of the mean field.
        effective_sizes: How many independent draws the sampler's draws of each quantity are worth.
        mixed: Whether the sampler's chains have mixed.
        converged: Whether the mean field has converged.
    """

    sampler: Int[np.ndarray, " quantities"]
    mean_field: Int[np.ndarray, " quantities"]
    effective_sizes: Float[np.ndarray, " quantities"]
    mixed: bool
    converged: bool


def run(folder: Path, seed: int = 0, notify: Notify = quiet, config: CalibrationConfig | None = None) -> Summary:
    """Run the experiment; write `calibration.png` and `summary.json`.

    Args:
        folder: The folder to write to.
        seed: Draws everything random.
        notify: Called with a line of text for each map.
        config: The size of the experiment.

    Returns:
        The content of `summary.json`; `table` has `rank_scores` of each method and quantity.
    """
    config, started, results = config or CalibrationConfig(), time.monotonic(), []
    for number in range(config.maps):
        notify(f"map {number + 1} of {config.maps}")
        random = np.random.default_rng([seed, number])
        results.append(case_result(config, draw_case(config, random), random))
    band = uniform_band(config.maps, config.draws)
    methods = {"sampler": [each.sampler for each in results], "mean field": [each.mean_field for each in results]}
    ranks = {
        quantity: {method: np.array(own)[:, index] for method, own in methods.items()}
        for index, quantity in enumerate(QUANTITIES)
    }
    sizes = np.median([each.effective_sizes for each in results], axis=0)
    entries = {
        "maps": config.maps,
        "draws": config.draws,
        "band_coverage": band.coverage,
        "sampler_mixed": float(np.mean([each.mixed for each in results])),
        "mean_field_converged": float(np.mean([each.converged for each in results])),
        "median_effective_sizes": dict(zip(QUANTITIES, sizes.tolist(), strict=True)),
        "table": {f"{method}, {name}": rank_scores(ranks[name][method], band) for method in methods for name in ranks},
        "ranks": {name: {method: each.tolist() for method, each in own.items()} for name, own in ranks.items()},
        "settings": asdict(config),
    }
    figure = figure_ranks({QUANTITIES[name]: own for name, own in ranks.items()}, band)
    return write_results(folder, "calibration", seed, started, figure, entries)


def case_result(config: CalibrationConfig, case: Case, random: np.random.Generator) -> CaseResult:
    """Find the posterior of a map by the sampler and by the mean field, and rank the true map among draws of each.

    Args:
        config: The model.
        case: The map and its walks.
        random: The generator.
    """
    model = ss.ObstacleGrid(config.grid)
    posterior = infer_map(model, case.walks, config.learning("sample", draw_seed(random)))
    mean_field = infer_map(model, case.walks, config.learning("mean_field"))
    assert isinstance(posterior, BarrierPosterior)
    assert isinstance(mean_field, BarrierMeanField)
    closed = mean_field.closed
    sampled, independent = thinned(posterior, config.draws), random.random((config.draws, len(closed))) < closed
    truth, of_sampled, of_independent = (
        quantities_of(config, case.walks, maps) for maps in (case.closed[None], sampled, independent)
    )
    # no path is longer than there are cells, but an infinite length would have no variance
    by_chain = np.minimum(of_sampled, len(closed)).reshape(len(posterior.samples), -1, len(QUANTITIES))
    by_sampler, by_mean_field = (ranks_of(truth[0], draws, random) for draws in (of_sampled, of_independent))
    return CaseResult(by_sampler, by_mean_field, effective_sizes(by_chain), posterior.converged, mean_field.converged)


def thinned(posterior: BarrierPosterior[Any], count: int) -> Draws:
    """Return a number of samples at equal distances along the chains, as many of each.

    Args:
        posterior: The samples.
        count: A multiple of the number of chains.
    """
    chains, draws, cells = posterior.samples.shape
    own = count // chains
    check(own <= draws, f"expected at most {chains * draws}, found {count}; or more sweeps", field="draws")
    last = draws * np.arange(1, own + 1) // own - 1
    return posterior.samples[:, last].reshape(-1, cells)


def ranks_of(
    truth: Float[np.ndarray, " quantities"], draws: Float[np.ndarray, "draws quantities"], random: np.random.Generator
) -> Int[np.ndarray, " quantities"]:
    """Return the rank of each quantity of the true map among those of draws.

    Args:
        truth: The quantities of the true map.
        draws: Those of the draws.
        random: Breaks ties.
    """
    return np.array([rank(float(true), own, random) for true, own in zip(truth, draws.T, strict=True)])


def rank_scores(ranks: Int[np.ndarray, " maps"], band: UniformBand) -> dict[str, float]:
    """Return how far ranks are from uniform ones.

    Args:
        ranks: A rank for each map.
        band: The band of as many uniform ranks.

    Returns:
        `largest_difference`, of their empirical distribution from the uniform one; `band_excess`, by which it leaves
        the band at most, 0 inside; `outside_90`, the fraction of maps outside the central 90 % of the draws.
    """
    return {
        "largest_difference": float(np.abs(rank_difference(ranks, band.draws)).max()),
        "band_excess": band_excess(ranks, band),
        "outside_90": outside_fraction(ranks, band.draws),
    }
