"""Ranks of true quantities among draws from their posterior: simulation-based calibration.

Where parameters are drawn from the prior and data from the model with these parameters, the rank of any quantity of the
true parameters among L independent draws from the posterior is uniform on 0…L, ties broken at random (Talts et al.
2018, theorem 1). A sampler with other ranks, or ranks of a wrong model, is detected by their empirical distribution:

    F(k) = the fraction of N ranks that are at most k,        F(k) − (k + 1)/(L + 1),    k = 0 … L − 1.

Uniform ranks lie inside the band of `uniform_band` for all k at once with a probability of 95 % or a little more. It is
that of Säilynoja et al. (2022): pointwise binomial intervals, all with the same tails, as narrow as the probability
allows. The probability is computed exactly, from one k to the next: given the number of ranks up to k, that of ranks
equal to k + 1 is binomial. It differs from theirs in that intervals are at every k, not at as many places as there are
ranks.

References:
    S. Talts, M. Betancourt, D. Simpson, A. Vehtari and A. Gelman (2018). Validating Bayesian inference algorithms with
    simulation-based calibration. arXiv:1804.06788.
    T. Säilynoja, P.-C. Bürkner and A. Vehtari (2022). Graphical test for discrete uniformity and its applications in
    goodness-of-fit evaluation and multiple sample comparison. Statistics and Computing 32.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._arguments import to_floats, to_integers, to_mask
from sidestep.errors import check, check_count, check_instance, to_count, to_number

_HALVINGS = 50
"""The steps of the bisection of the tails."""


class UniformBand(NamedTuple):
    """A band in which the empirical distribution of uniform ranks lies, for all ranks at once.

    Attributes:
        ranks: N, the number of ranks.
        low: The fewest ranks that are at most k, for k = 0 … L − 1.
        high: The most.
        coverage: The probability that uniform ranks lie inside for all k.

    Example:
        >>> uniform_band(ranks=2, draws=1).low.tolist()
        [0]
    """

    ranks: int
    low: Int[np.ndarray, " draws"]
    high: Int[np.ndarray, " draws"]
    coverage: float

    @property
    def draws(self) -> int:
        """Return L, the number of draws among which truths are ranked."""
        return len(self.low)


def rank(
    truth: float, draws: Float[np.ndarray, " draws"] | Bool[np.ndarray, " draws"], random: np.random.Generator
) -> int:
    """Return the rank of a true quantity among draws: the number of draws below it, ties broken at random.

    Args:
        truth: The quantity of the true parameters; it may be infinite.
        draws: The same quantity of draws from the posterior.
        random: Breaks ties: with t of them the rank is larger by 0 … t.

    Returns:
        A number from 0 to that of the draws.

    Raises:
        InputError: For NaN, which has no rank.

    Example:
        >>> rank(np.inf, np.array([3.0, 5.0]), np.random.default_rng(0))
        2
    """
    is_boolean = getattr(getattr(draws, "dtype", None), "kind", "") == "b"
    numbers = (to_mask if is_boolean else to_floats)(draws, "draws", ("draws",))
    value = truth if isinstance(truth, bool | np.bool_) else to_floats(truth, "truth", ())
    check(not np.isnan([value, *numbers]).any(), "expected numbers, found NaN", field="draws")
    check_instance(random, np.random.Generator, "random")
    return int(np.sum(numbers < value) + random.integers(0, np.sum(numbers == value), endpoint=True))


def rank_difference(ranks: Int[np.ndarray, " ranks"], draws: int) -> Float[np.ndarray, " draws"]:
    """Return the empirical distribution of ranks less the uniform one, F(k) − (k + 1)/(L + 1).

    Args:
        ranks: Numbers from 0 to L.
        draws: L.

    Returns:
        A difference for each k = 0 … L − 1.

    Raises:
        InputError: For ranks out of range.

    Example:
        >>> rank_difference(np.array([0, 0, 2]), draws=2).round(3).tolist()
        [0.333, 0.0]
    """
    return _numbers_up_to(ranks, draws) / len(ranks) - np.arange(1, draws + 1) / (draws + 1)


def band_excess(ranks: Int[np.ndarray, " ranks"], band: UniformBand) -> float:
    """Return how far the empirical distribution of ranks leaves a band at most; 0 where it stays inside.

    Args:
        ranks: As many numbers as the band is for, from 0 to L.
        band: The band.

    Raises:
        InputError: For another number of ranks, and for ranks out of range.
    """
    check_instance(band, UniformBand, "band")
    check(len(ranks) == band.ranks, f"expected {band.ranks} ranks, found {len(ranks)}", field="ranks")
    numbers = _numbers_up_to(ranks, band.draws)
    return float(np.maximum(numbers - band.high, band.low - numbers).max().clip(min=0) / len(ranks))


def outside_fraction(ranks: Int[np.ndarray, " ranks"], draws: int, probability: float = 0.9) -> float:
    """Return how often a truth is outside the central interval of its draws.

    Args:
        ranks: Numbers from 0 to L.
        draws: L.
        probability: Of the interval, in (0, 1).

    Returns:
        A fraction; of uniform ranks about 1 − `probability`.

    Example:
        >>> outside_fraction(np.arange(20), draws=19, probability=0.9)
        0.1
    """
    to_integers(ranks, "ranks", ("ranks",), least=0, most=to_count(draws, "draws"), what="ranks")
    tail = (1 - to_number(probability, "probability", above=0, below=1)) / 2 * (draws + 1)
    # a tail of 3 ranks has exactly 3 of them, whatever the rounding
    return float(np.mean(np.minimum(ranks, draws - ranks) < np.floor(tail + 1e-9)))


def uniform_band(ranks: int, draws: int, probability: float = 0.95) -> UniformBand:
    """Return the band for a number of ranks.

    Args:
        ranks: N, at least 1.
        draws: L, at least 1.
        probability: The least probability that uniform ranks lie inside, in (0, 1).

    Returns:
        The narrowest band of pointwise binomial intervals with equal tails.

    Raises:
        InputError: For settings out of range.

    References:
        Säilynoja et al. (2022), section 2.
    """
    from scipy.stats import binom

    check_count(ranks, 1, "ranks")
    check_count(draws, 1, "draws")
    to_number(probability, "probability", above=0, below=1)
    uniform = np.arange(1, draws + 1) / (draws + 1)
    so_far = np.arange(ranks + 1)
    # the number of ranks up to k, from that up to k − 1
    steps = [binom.pmf(so_far - so_far[:, None], ranks - so_far[:, None], 1 / (draws + 1 - k)) for k in range(draws)]

    def band(tail: float) -> UniformBand:
        low, high = (
            edge.astype(np.int64) for edge in (binom.ppf(tail, ranks, uniform), binom.isf(tail, ranks, uniform))
        )
        return UniformBand(ranks, low, high, _coverage(steps, low, high))

    # tails of one end of the interval are certainly narrow enough by Bonferroni's inequality, of the other too wide
    narrow, wide = (1 - probability) / (2 * draws), 1 - probability
    for _ in range(_HALVINGS):
        middle = (narrow + wide) / 2
        narrow, wide = (middle, wide) if band(middle).coverage >= probability else (narrow, middle)
    return band(narrow)


def _coverage(
    steps: Sequence[Float[np.ndarray, "before after"]], low: Int[np.ndarray, " draws"], high: Int[np.ndarray, " draws"]
) -> float:
    """Return the probability that the numbers of ranks up to each k lie between two bounds."""
    numbers = np.arange(len(steps[0]))
    inside = (numbers == 0).astype(np.float64)
    for step, least, most in zip(steps, low, high, strict=True):
        inside = (inside @ step) * ((numbers >= least) & (numbers <= most))
    return float(inside.sum())


def _numbers_up_to(ranks: Int[np.ndarray, " ranks"], draws: int) -> Int[np.ndarray, " draws"]:
    numbers = to_integers(ranks, "ranks", ("ranks",), least=0, most=to_count(draws, "draws"), what="ranks")
    check(len(numbers), "expected at least one rank, found none", field="ranks")
    return np.cumsum(np.bincount(numbers, minlength=draws + 1))[:-1]
