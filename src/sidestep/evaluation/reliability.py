"""Calibration of P(blocked): how often cells that are blocked with some probability are obstacles.

The expected calibration error has ten bins of equal width and weighs each by its cells (Naeini et al. 2015). The Brier
score and the log loss are means over cells. A single small map has few cells in a bin, and so an error of some
hundredths by chance; `Reliability` of several maps can be added, and then has the error of all cells together.

References:
    M. P. Naeini, G. F. Cooper and M. Hauskrecht (2015). Obtaining well calibrated probabilities using Bayesian binning.
    AAAI Conference on Artificial Intelligence.
    G. W. Brier (1950). Verification of forecasts expressed in terms of probability. Monthly Weather Review 78.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._arguments import to_finite, to_mask
from sidestep.tabular.grid import Cell, Grid

BINS = 10
"""The number of bins of P(blocked), all of the same width."""
LEAST_PROBABILITY = 1e-6
"""For the log loss P(blocked) is clipped to this and 1 less this, so that a cell costs 14 nats at most."""

_Values = Float[np.ndarray, " cells"]
_Flags = Bool[np.ndarray, " flags"]
_Bins = Float[np.ndarray, " bins"]


@dataclass(frozen=True, eq=False)
class Reliability:
    """How many cells of each bin of P(blocked) are obstacles; the sum of two is that of the cells of both.

    Attributes:
        cells: The number of cells in each bin, from the lowest P(blocked) on.
        expected: The sum of P(blocked) over them: the expected number of obstacles.
        obstacles: The number of obstacles among them.

    Example:
        >>> one = reliability(np.array([0.0, 0.25]), np.array([False, True]))
        >>> other = reliability(np.array([0.25]), np.array([False]))
        >>> one.calibration_error, (one + other).calibration_error
        (0.375, 0.16666666666666666)
    """

    cells: Int[np.ndarray, " bins"]
    expected: _Bins
    obstacles: Int[np.ndarray, " bins"]

    def __add__(self, other: "Reliability") -> "Reliability":
        return Reliability(self.cells + other.cells, self.expected + other.expected, self.obstacles + other.obstacles)

    @property
    def mean_prediction(self) -> _Bins:
        """The mean of P(blocked) in each bin; NaN in one without cells."""
        return _ratio(self.expected, self.cells)

    @property
    def obstacle_fraction(self) -> _Bins:
        """The fraction of obstacles in each bin; NaN in one without cells."""
        return _ratio(self.obstacles, self.cells)

    @property
    def calibration_error(self) -> float | None:
        """The mean over cells of |mean prediction − fraction of obstacles| of a cell's bin; None without cells."""
        total = self.cells.sum()
        return float(np.abs(self.expected - self.obstacles).sum() / total) if total else None

    def to_dict(self) -> dict[str, list[float] | list[int]]:
        """Return the three sums by name, as lists."""
        return {name: sums.tolist() for name, sums in vars(self).items()}


def reliability(blocked: _Values, obstacle: _Flags) -> Reliability:
    """Count cells and obstacles by P(blocked), in `BINS` bins.

    Args:
        blocked: P(blocked) of each cell, in [0, 1].
        obstacle: Which cells are obstacles.

    Returns:
        The counts; a cell between two bins counts in the upper one, one with P(blocked) = 1 in the last.

    Raises:
        InputError: For arrays of different lengths, and for numbers outside [0, 1].
    """
    blocked, obstacle = _checked(blocked, obstacle)
    own = np.minimum((BINS * blocked).astype(np.int64), BINS - 1)
    cells, obstacles = (np.bincount(bins, minlength=BINS) for bins in (own, own[obstacle]))
    expected = np.zeros(BINS)
    np.add.at(expected, own, blocked)
    return Reliability(cells, expected, obstacles)


def brier_score(blocked: _Values, obstacle: _Flags) -> float | None:
    """Return the mean of (P(blocked) − 1)² over obstacles and P(blocked)² over other cells; None without cells.

    Args:
        blocked: P(blocked) of each cell, in [0, 1].
        obstacle: Which cells are obstacles.

    Raises:
        InputError: For arrays of different lengths, and for numbers outside [0, 1].

    Example:
        >>> brier_score(np.array([0.5, 0.0]), np.array([True, False]))
        0.125
    """
    blocked, obstacle = _checked(blocked, obstacle)
    return float(np.mean((blocked - obstacle) ** 2)) if len(blocked) else None


def log_loss(blocked: _Values, obstacle: _Flags) -> float | None:
    """Return the mean of −ln P over cells, P being the probability of what a cell is, in nats; None without cells.

    P(blocked) is clipped to [`LEAST_PROBABILITY`, 1 − `LEAST_PROBABILITY`] first.

    Args:
        blocked: P(blocked) of each cell, in [0, 1].
        obstacle: Which cells are obstacles.

    Raises:
        InputError: For arrays of different lengths, and for numbers outside [0, 1].

    Example:
        >>> round(log_loss(np.array([0.5, 0.0]), np.array([True, False])), 6)
        0.346574
    """
    blocked, obstacle = _checked(blocked, obstacle)
    clipped = np.clip(blocked, LEAST_PROBABILITY, 1 - LEAST_PROBABILITY)
    return float(-np.log(np.where(obstacle, clipped, 1 - clipped)).mean()) if len(blocked) else None


def map_reliability(
    ranking: Float[np.ndarray, "rows columns"] | None, truth: Grid, scored: Bool[np.ndarray, "rows columns"]
) -> Reliability | None:
    """Return the reliability of a map over its scored cells; None where `scored_probabilities` has none.

    Args:
        ranking: P(blocked) of each cell, or other numbers; None of a method that does not rank cells.
        truth: The true map.
        scored: The cells to score.
    """
    scores = None if ranking is None else scored_probabilities(ranking, truth, scored)
    return None if scores is None else reliability(*scores)


def scored_probabilities(
    ranking: Float[np.ndarray, "rows columns"], truth: Grid, scored: Bool[np.ndarray, "rows columns"]
) -> tuple[_Values, _Flags] | None:
    """Return P(blocked) of the scored cells that the true map knows, and which of them are obstacles.

    Args:
        ranking: A number for each cell.
        truth: The true map.
        scored: The cells to score.

    Returns:
        A number and a flag for each cell; None if the ranking is no probability, because any of its numbers is outside
        [0, 1] as counts of visits are, or if there are no cells.
    """
    known = scored & (truth.known != Cell.UNKNOWN)
    if not known.any() or not ((ranking >= 0) & (ranking <= 1)).all():
        return None
    return ranking[known], truth.known[known] == Cell.OCCUPIED


def _checked(blocked: _Values, obstacle: _Flags) -> tuple[_Values, _Flags]:
    cells = np.asarray(to_finite(blocked, "blocked", ("cells",), least=0, most=1))
    return cells, np.asarray(to_mask(obstacle, "obstacle", cells.shape))


def _ratio(sums: np.ndarray, cells: Int[np.ndarray, " bins"]) -> _Bins:
    return np.divide(sums, cells, out=np.full(len(cells), np.nan), where=cells > 0)
