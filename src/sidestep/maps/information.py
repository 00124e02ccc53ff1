"""What walks and sensors say of each cell of a map, in nats (`sidestep.inference.cell_information`).

Samples of the posterior are compared with samples of the prior at densities and strengths that were sampled along, so
that what walks say of these does not count for every cell. Cells that no walk crossed are compared given those that
walks crossed: which these are follows from starts and goals, and only choices say what is beside them.

A fit has an approximation, with more than one optimum, and on large maps it ends early. So it is compared with itself
without evidence:

1. The gradient of the objective without that of the prior is what the evidence adds, at the end of the fit and by the
   probabilities: e(i) = ∂(log L + the evidence of sensors and first cells)/∂σ(θ(i)).
2. log p(θ) + Σ e(i) σ(θ(i)) is maximized, beginning where the fit ended. A fit that has converged stays there.
3. log p(θ) alone is maximized, beginning at the result. Cells that the evidence does not reach stay there.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep._programs import keep_program
from sidestep.inference.cell_information import information, prior_closed
from sidestep.inference.coordinate_ascent import BarrierMeanField, prior_mean_field
from sidestep.inference.fit import Fit, fit
from sidestep.inference.hierarchical import HierarchicalMRF
from sidestep.inference.objective import Parameters
from sidestep.inference.priors import Prior
from sidestep.inference.sampler import BarrierPosterior
from sidestep.inference.tabular_information import TabularInformation
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import MapPosterior, barrier_prior, prior_of_fit, sampled_prior
from sidestep.tabular.grid import Cell
from sidestep.tabular.models import ObstacleGrid

_DENSITIES, _SAMPLES = 5, 2_000
"""The number of sampled densities and strengths at which the prior is sampled, and its samples in all."""
_SURE_LOGIT = 6.0
"""The largest logit at which a fit without evidence begins: beyond, the gradient of a mean field vanishes."""
_NO_GRADIENT = 1e-3
"""The largest component of the gradient of a fit that counts as ended at its maximum."""
_LEAST_SLOPE = 1e-9
"""The least p (1 − p) by which a gradient is divided."""


class LinearEvidence(Prior):
    """A prior with evidence that is linear in the probabilities: log p(θ) + Σ e(i) σ(θ(i)).

    Attributes:
        prior: The prior.
        slopes: e of each cell, in nats.

    Example:
        >>> from sidestep.inference.priors import Normal
        >>> float(LinearEvidence(Normal(0.0, 1.0), jnp.array([2.0])).log_density(jnp.zeros(1)))
        1.0
    """

    prior: Prior
    slopes: Float[Array, " cells"]

    def log_density(self, parameters: Float[Array, " cells"]) -> Float[Array, ""]:
        """Return log p(θ) + Σ e(i) σ(θ(i))."""
        return self.prior.log_density(parameters) + self.slopes.astype(parameters.dtype) @ jax.nn.sigmoid(parameters)


def map_information(posterior: MapPosterior, config: MapConfig) -> Float[np.ndarray, "rows columns"]:
    """Return what walks and sensors say of each cell, in nats; 0 where the map knew.

    Args:
        posterior: The posterior of the map.
        config: The configuration by which it was found.
    """
    if isinstance(posterior, BarrierPosterior):
        before = _prior_of_samples(posterior, config)
        return information(np.asarray(posterior.model.blocked, np.float64), before)
    if isinstance(posterior, BarrierMeanField):
        return information(
            posterior.closed.reshape(posterior.model.known.shape), _prior_of_mean_field(posterior, config)
        )
    prior = prior_of_fit(config.prior, posterior.model)
    slopes = _slopes(posterior, prior)
    after = _maximum(posterior, LinearEvidence(prior, slopes), posterior.model)
    start = after.with_parameters(jnp.clip(after.parameters, -_SURE_LOGIT, _SURE_LOGIT))
    before = _maximum(posterior, LinearEvidence(prior, jnp.zeros_like(slopes)), start)
    return information(*(np.asarray(model.blocked, np.float64) for model in (after, before)))


def _prior_of_samples(
    posterior: BarrierPosterior[ObstacleGrid], config: MapConfig
) -> Float[np.ndarray, "rows columns"]:
    """Return P(blocked) of each cell before walks and sensors, with the posterior of the density and strength."""
    known = np.asarray(posterior.model.known)
    prior = sampled_prior(config.prior, known)
    if isinstance(prior, HierarchicalMRF):
        drawn = posterior.densities.reshape(-1, 2)
        at = np.linspace(0, len(drawn) - 1, _DENSITIES).round().astype(int)
        priors = [prior.at(log_odds, strength) for log_odds, strength in drawn[at].tolist()]
    else:
        priors = [prior]
    before = [
        np.mean([prior_closed(each, cells, count=_SAMPLES // len(priors), seed=config.seed) for each in priors], axis=0)
        for cells in _conditions(posterior.sampled, known)
    ]
    return np.where(posterior.sampled, *before).reshape(known.shape)


def _prior_of_mean_field(
    posterior: BarrierMeanField[ObstacleGrid], config: MapConfig
) -> Float[np.ndarray, "rows columns"]:
    """Return P(blocked) of each cell in the mean field of the prior alone, beginning at the posterior's best part."""
    known = np.asarray(posterior.model.known)
    prior, start = barrier_prior(config.prior, known, "mean_field"), posterior.parts[0]
    before = [prior_mean_field(prior, cells, start) for cells in _conditions(posterior.inferred, known)]
    return np.where(posterior.inferred, *before).reshape(known.shape)


def _conditions(
    inferred: Bool[np.ndarray, " cells"], known: Int[np.ndarray, "rows columns"]
) -> tuple[Int[np.ndarray, " cells"], Int[np.ndarray, " cells"]]:
    """Return what is known of each cell given the cells that walks crossed, and without walks."""
    visited = np.where(known == Cell.OCCUPIED, Cell.OCCUPIED, Cell.FREE).ravel()
    return np.where(inferred, known.ravel(), visited), known.ravel()


def _slopes(posterior: Fit[ObstacleGrid], prior: Prior) -> Float[Array, " cells"]:
    """Return what the evidence adds to the gradient of the prior, as derivatives by the probabilities."""
    logits = posterior.model.parameters
    alone, chances = _gradient(prior, logits), jax.nn.sigmoid(logits)
    whole = np.zeros(len(logits))
    if not posterior.final.gradient <= _NO_GRADIENT:
        parameters = Parameters(logits, posterior.behavior.parameters)
        whole = TabularInformation(posterior.problem, parameters).gradient[: len(logits)]
    # where solves failed, a fit counts as ended at its maximum
    whole = jnp.asarray(np.where(np.isfinite(whole), whole, 0.0), logits.dtype)
    return (whole - alone) / jnp.maximum(chances * (1 - chances), _LEAST_SLOPE)


@keep_program
def _gradient(prior: Prior, parameters: Float[Array, " cells"]) -> Float[Array, " cells"]:
    return jax.grad(prior.log_density)(parameters)


def _maximum(posterior: Fit[ObstacleGrid], prior: Prior, start: ObstacleGrid) -> ObstacleGrid:
    """Return the map at which a prior is largest."""
    demonstrations = posterior.problem.demonstrations
    nothing = replace(demonstrations, weights=jnp.zeros_like(demonstrations.weights))
    return fit(start, nothing, posterior.behavior.behavior_of(), prior=prior, terms=("transitions",)).model
