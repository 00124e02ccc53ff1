"""Samples of barriers from their prior, by the Metropolis chain of `sampler` without evidence."""

import numpy as np
from jaxtyping import Bool, Int, UInt8

from sidestep.errors import check_count
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.prior_kernels import MAX_CHANGED, MRFTerms, sweep_prior
from sidestep.tabular.grid import Cell

KINDS = np.array([0.6, 0.8])
"""The cumulative probabilities of flips and of moves; the rest are runs."""
_WARMUP_SWEEPS, _LEVELS = 200, 20


def sample_prior(
    prior: BinaryMRF, known: Int[np.ndarray, " barriers"], count: int, *, apart: int = 50, seed: int = 0
) -> Bool[np.ndarray, "count barriers"]:
    """Sample barriers from their prior.

    A chain starts from independent barriers, and follows the weights of shapes as they grow to their strength. From
    then on it is read at equal distances.

    Args:
        prior: The prior.
        known: The `Cell` value of each barrier; known ones stay.
        count: The number of samples, at least 1.
        apart: The sweeps between samples, at least 1; the fewer, the more alike samples are.
        seed: The seed.

    Returns:
        Whether each barrier is closed, in each sample.

    Example:
        >>> draws = sample_prior(BinaryMRF(np.array([-1.0, 9.0])), np.array([Cell.FREE, Cell.UNKNOWN]), 3)
        >>> draws.tolist()
        [[False, True], [False, True], [False, True]]
    """
    check_count(count, 1, "count")
    check_count(apart, 1, "apart")
    random = np.random.Generator(np.random.PCG64(seed))
    free = np.flatnonzero(known == Cell.UNKNOWN)
    closed = (known == Cell.OCCUPIED).astype(np.uint8)
    for level in np.linspace(0, 1, _LEVELS, endpoint=False):
        run_prior(native_terms(prior, level), free, closed, _WARMUP_SWEEPS // _LEVELS, random)
    terms = native_terms(prior)
    run_prior(terms, free, closed, _WARMUP_SWEEPS, random)
    return np.stack([run_prior(terms, free, closed, apart, random)[-1] for _ in range(count)])


def run_prior(
    terms: MRFTerms,
    free: Int[np.ndarray, " free"],
    closed: UInt8[np.ndarray, " barriers"],
    sweeps: int,
    random: np.random.Generator,
) -> Bool[np.ndarray, "sweeps barriers"]:
    """Run a chain with the prior's distribution; return the map after each sweep.

    Args:
        terms: The prior.
        free: The barriers that are sampled.
        closed: The map at which the chain begins, changed in place.
        sweeps: The number of sweeps; each has a proposal for each free barrier.
        random: The generator.
    """
    samples, changed = np.zeros((sweeps, len(closed)), bool), np.zeros(MAX_CHANGED, np.int32)
    sweep_prior(random, sweeps, free, is_free_of(free, len(closed)), terms, KINDS, closed, changed, samples)
    return samples


def native_terms(prior: BinaryMRF, strength: float = 1.0) -> MRFTerms:
    """Return a prior as native code reads it.

    Args:
        prior: The prior.
        strength: A factor of the weights of shapes.
    """
    return MRFTerms(prior.field, strength * prior.weights, *(prior.shape or (0, 0)))


def is_free_of(free: Int[np.ndarray, " free"], barriers: int) -> Bool[np.ndarray, " barriers"]:
    """Return whether each barrier is sampled.

    Args:
        free: The barriers that are sampled.
        barriers: The number of barriers.
    """
    is_free = np.zeros(barriers, bool)
    is_free[free] = True
    return is_free
