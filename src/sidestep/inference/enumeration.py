"""The exact posterior of few barriers, by the likelihood of every map: the standard that samplers are compared with."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.errors import check
from sidestep.inference.chains import PASSING, check_prior, crossed_barriers
from sidestep.inference.hierarchical import HierarchicalMRF, as_hierarchical, evidence_normalizers
from sidestep.inference.mrf import BinaryMRF
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.likelihood import ALL_TERMS, Terms, log_likelihood
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.models.barriers import barriers_of

MAX_BARRIERS = 16
"""The most unknown barriers; each doubles the number of maps."""
_BATCH = 1024


class ExactPosterior(NamedTuple):
    """The exact posterior of barriers.

    Attributes:
        closed: P(closed) of each barrier; exactly 0 or 1 where it is known or was crossed.
        log_evidence: ln Σ L(z) p(z), with the prior up to its constant, and the actions' part of L to the power κ.
    """

    closed: Float[np.ndarray, " barriers"]
    log_evidence: float


def enumerate_barriers(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    prior: BinaryMRF | HierarchicalMRF,
    *,
    tempering: float = 1.0,
    terms: Terms = ALL_TERMS,
    seed: int = 0,
) -> ExactPosterior:
    """Return the exact posterior of at most 16 unknown barriers, from the likelihood of each of the 2ⁿ maps.

    Args:
        model: The transition model; see `barriers_of`.
        demonstrations: The moves and tasks.
        behavior: The behavior of the agents.
        prior: The prior of the barriers; the density and strength of a `HierarchicalMRF` are summed over.
        tempering: κ, the weight of the actions' log-likelihood.
        terms: The parts of the likelihood that count.
        seed: The seed of the chains that find log Z of a `HierarchicalMRF`, as for `sample_barriers`.

    Returns:
        P(closed) of each barrier, and the evidence.

    Raises:
        InputError: For more than 16 barriers that are unknown and that no walk crossed, and a prior of others.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(1, 3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1]), np.array([3]), task=0)], [ss.reach(grid, 1)])
        >>> model, behavior = ss.ObstacleGrid(grid), ss.Behavior(ss.BoltzmannAverage())
        >>> exact = enumerate_barriers(model, shown, behavior, BinaryMRF(np.zeros(3), (1, 3)))
        >>> exact.closed.round(2).tolist()  # the walk says nothing of the third cell
        [0.0, 0.0, 0.5]
    """
    barriers = barriers_of(model)
    check_prior(barriers, prior)
    crossed = crossed_barriers(barriers, demonstrations, terms)
    free = np.flatnonzero((barriers.known == Cell.UNKNOWN) & ~crossed)
    message = f"expected at most {MAX_BARRIERS} unknown barriers to enumerate, found {len(free)}"
    check(len(free) <= MAX_BARRIERS, message, field="model")
    maps = np.zeros((2 ** len(free), len(barriers.known)), dtype=np.int64)
    maps[:, free] = np.arange(len(maps))[:, None] >> np.arange(len(free)) & 1
    maps[:, barriers.known == Cell.OCCUPIED] = 1
    log_odds = np.log(PASSING[0]) - np.log(PASSING[1])
    weights = np.array([tempering, 1.0])

    @jax.jit
    def log_likelihoods(batch: jax.Array) -> jax.Array:
        def one(closed: jax.Array) -> jax.Array:
            parameters = model.parameters.at[: len(closed)].set(log_odds * (2.0 * closed - 1))
            parts = log_likelihood(model.with_parameters(parameters), demonstrations, behavior, terms=terms)
            return jnp.stack([parts.actions, parts.transitions])

        return jax.vmap(one)(batch)

    parts = [log_likelihoods(jnp.asarray(maps[at : at + _BATCH])) for at in range(0, len(maps), _BATCH)]
    hierarchical = as_hierarchical(prior)
    log_normalizers = evidence_normalizers(hierarchical, barriers.known, free, seed)
    densities = hierarchical.log_densities(maps) - log_normalizers
    log_priors = np.logaddexp.reduce(densities.reshape(len(maps), -1), axis=1)
    log_posterior = np.concatenate(parts) @ weights + log_priors
    log_evidence = np.logaddexp.reduce(log_posterior)
    closed = np.minimum(np.exp(log_posterior - log_evidence) @ maps, 1.0)  # sums of rounded numbers
    return ExactPosterior(np.where(maps.all(axis=0), 1.0, closed), float(log_evidence))
