"""Diagnostics of Markov chains: whether they agree, and how many independent draws they are worth.

Split-R̂ and the effective sample size are those of Gelman et al., *Bayesian Data Analysis* (2013), sections 11.4 and
11.5, with Geyer's initial monotone sequence. They differ from the rank-normalized ones of Vehtari et al. (2021): draws
here are 0 or 1, so ranks say nothing more. Each half of a chain counts as a chain. A quantity that is the same in every
draw has R̂ = 1 and as many effective draws as there are draws; one that is constant in each half, but not the same, has
an infinite R̂ and as many effective draws as there are halves.
"""

import numpy as np
from jaxtyping import Bool, Float

from sidestep._arguments import to_floats, to_mask
from sidestep.errors import check

Draws = Float[np.ndarray, "chains draws quantities"] | Bool[np.ndarray, "chains draws quantities"]


def split_rhat(draws: Draws) -> Float[np.ndarray, " quantities"]:
    """Return split-R̂ of each quantity: near 1 where all halves of all chains have the same distribution.

    Args:
        draws: Of several chains of the same length, at least 4 draws each.

    Returns:
        √(variance of all draws / variance within halves), about 1 or more.

    Raises:
        InputError: For fewer than 4 draws.

    Example:
        >>> draws = np.array([[0.0, 1.0, 0.0, 1.0], [5.0, 6.0, 5.0, 6.0]])
        >>> split_rhat(draws[:, :, None]).round(1).tolist()
        [4.1]
    """
    halves = _halves(draws)
    within, pooled = _variances(halves)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(pooled / within)
    return np.where(pooled == 0, 1.0, np.where(within == 0, np.inf, ratio))


def effective_sizes(draws: Draws) -> Float[np.ndarray, " quantities"]:
    """Return the effective sample size of each quantity: the number of independent draws that its mean is worth.

    Args:
        draws: As for `split_rhat`.

    Returns:
        At least 1, at most the number of draws.

    Raises:
        InputError: For fewer than 4 draws.

    Example:
        >>> draws = np.random.default_rng(0).random((2, 1000, 1))
        >>> bool(effective_sizes(draws)[0] > 1500)
        True
    """
    halves = _halves(draws)
    chains, length = halves.shape[:2]
    within, pooled = _variances(halves)
    correlations = _autocovariances(halves).mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the autocovariance of biased sums, as in the within-variance times (n - 1)/n
        rho = 1 - (within * (length - 1) / length - correlations) / pooled
        rho[0] = 1.0
        pairs = rho[: length // 2 * 2].reshape(length // 2, 2, *rho.shape[1:]).sum(axis=1)
        positive = np.cumprod(pairs > 0, axis=0).astype(bool)
        sums = np.where(positive, np.minimum.accumulate(pairs, axis=0), 0.0).sum(axis=0)
        sizes = chains * length / np.maximum(2 * sums - 1, 1.0)
    sizes = np.where(within == 0, float(chains), sizes)
    return np.where(pooled == 0, float(chains * length), np.clip(sizes, 1.0, chains * length))


def _halves(draws: Draws) -> Float[np.ndarray, "halves half quantities"]:
    is_boolean = getattr(getattr(draws, "dtype", None), "kind", "") == "b"
    numbers = np.asarray((to_mask if is_boolean else to_floats)(draws, "draws", ("chains", "draws", "quantities")))
    half = numbers.shape[1] // 2
    check(half >= 2, f"expected at least 4 draws of each chain, found {numbers.shape[1]}", field="draws")
    check(len(numbers), "expected at least one chain, found none", field="draws")
    return np.concatenate([numbers[:, :half], numbers[:, half : 2 * half]]).astype(np.float64)


def _variances(halves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean variance within halves, and the variance that all draws estimate."""
    length = halves.shape[1]
    within = halves.var(axis=1, ddof=1).mean(axis=0)
    between = halves.mean(axis=1).var(axis=0, ddof=1)
    return within, within * (length - 1) / length + between


def _autocovariances(halves: np.ndarray) -> np.ndarray:
    """Return the autocovariance of each half at each lag, by the fast Fourier transform."""
    length = halves.shape[1]
    centered = halves - halves.mean(axis=1, keepdims=True)
    spectrum = np.abs(np.fft.rfft(centered, 2 * length, axis=1)) ** 2
    return np.fft.irfft(spectrum, axis=1)[:, :length] / length
