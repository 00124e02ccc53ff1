"""Reliability diagrams: the fraction of obstacles among cells against their P(blocked), or of other events.

The interval of a bin is Wilson's, at 95 %, which takes cells for independent. Neighboring cells of one map are not, so
the true uncertainty is larger.

References:
    M. H. DeGroot and S. E. Fienberg (1983). The comparison and evaluation of forecasters. The Statistician 32.
    E. B. Wilson (1927). Probable inference, the law of succession, and statistical inference. Journal of the American
    Statistical Association 22.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from sidestep.evaluation.reliability import BINS, Reliability
from sidestep.plotting import palette
from sidestep.plotting.layout import DOTS_PER_INCH

_QUANTILE = 1.959964
"""Of the standard normal distribution at 97.5 %."""
_PANEL, _HEIGHT = 2.9, 4.8
"""The width of a diagram and the height of the figure in inches."""
_LEFT, _BELOW, _ABOVE, _GAP = 0.6, 0.75, 0.45, 0.15
"""The space for labels, legend and titles, and between diagrams, in inches."""
_LEAST_CELLS = 0.5
"""Where the logarithmic scale of numbers of cells begins."""


def figure_reliability(
    diagrams: Mapping[str, Reliability],
    *,
    probability: str = "P(blocked)",
    event: str = "obstacles",
    unit: str = "cells",
) -> Figure:
    """Return a figure with a reliability diagram for each name, side by side, the number of cells below.

    Args:
        diagrams: The cells of each diagram by title.
        probability: The name of the probability.
        event: What has this probability, in the plural.
        unit: What is counted, in the plural.
    """
    # places in inches: a constrained layout takes longer than the drawing itself
    width, across = _LEFT + _PANEL * len(diagrams) + _GAP * (len(diagrams) - 1) + _GAP, _GAP / _PANEL
    figure = Figure(figsize=(width, _HEIGHT), dpi=DOTS_PER_INCH)
    edges = {"left": _LEFT / width, "right": 1 - _GAP / width, "bottom": _BELOW / _HEIGHT, "top": 1 - _ABOVE / _HEIGHT}
    grid = figure.add_gridspec(2, len(diagrams), height_ratios=[3.3, 1.0], wspace=across, hspace=0.08, **edges)
    upper, lower = grid.subplots(sharex=True, sharey="row", squeeze=False)
    for fractions, numbers, (title, bins) in zip(upper, lower, diagrams.items(), strict=True):
        error = bins.calibration_error
        fractions.set_title(title if error is None else f"{title}\ncalibration error {error:.3f}", fontsize=10)
        draw_reliability(fractions, bins, unit)
        draw_cell_numbers(numbers, bins, probability)
    upper[0].set_ylabel(f"fraction of {event}")
    lower[0].set_ylabel(f"{unit} (log)")
    # numbers stand above the bars
    lower[0].set_ylim(_LEAST_CELLS, 5 * max(1, *(bins.cells.max() for bins in diagrams.values())))
    handles, labels = upper[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def draw_reliability(axes: Axes, bins: Reliability, unit: str = "cells") -> None:
    """Draw the fraction of obstacles of each bin with its interval, beside the diagonal of perfect calibration.

    Args:
        axes: Where to draw.
        bins: The cells.
        unit: What is counted, in the plural.
    """
    axes.plot([0, 1], [0, 1], "--", color="0.55", linewidth=1.0, label="calibrated")
    filled = bins.cells > 0
    x, y = bins.mean_prediction[filled], bins.obstacle_fraction[filled]
    low, high = wilson_intervals(bins.obstacles[filled], bins.cells[filled])
    style = {"color": palette.BLUE, "markersize": 5, "linewidth": 1.2, "capsize": 2.5, "elinewidth": 0.9}
    axes.errorbar(x, y, (y - low, high - y), fmt="-o", label=f"{unit}, 95 % interval", **style)
    axes.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    axes.grid(color="0.92")


def draw_cell_numbers(axes: Axes, bins: Reliability, probability: str = "P(blocked)") -> None:
    """Draw how many cells each bin has: a bar on a logarithmic scale, and the number.

    Args:
        axes: Where to draw.
        bins: The cells.
        probability: The name of the probability.
    """
    edges = np.linspace(0, 1, BINS + 1)
    axes.stairs(bins.cells, edges, baseline=_LEAST_CELLS, fill=True, color="0.8")
    axes.stairs(bins.cells, edges, baseline=_LEAST_CELLS, color="0.3", linewidth=0.8)
    for left, count in zip(edges, bins.cells, strict=False):
        height = max(count, _LEAST_CELLS)
        axes.text(left + 0.5 / BINS, 1.3 * height, str(count), ha="center", va="bottom", fontsize=6.5)
    axes.set(yscale="log", xlabel=probability)
    axes.yaxis.set(major_locator=NullLocator(), minor_locator=NullLocator())


def wilson_intervals(
    successes: Int[np.ndarray, " bins"], trials: Int[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    """Return the ends of Wilson's 95 % intervals of the probabilities of success.

    Args:
        successes: The number of successes.
        trials: The number of trials, at least 1.

    Example:
        >>> low, high = wilson_intervals(np.array([0, 5]), np.array([10, 10]))
        >>> low.round(3).tolist(), high.round(3).tolist()
        ([0.0, 0.237], [0.278, 0.763])
    """
    fraction, weight = successes / trials, _QUANTILE**2 / trials
    middle = (fraction + weight / 2) / (1 + weight)
    half = np.sqrt(weight * (fraction * (1 - fraction) + weight / 4)) / (1 + weight)
    # the interval reaches the fraction itself at 0 and at 1, up to rounding
    return np.minimum(middle - half, fraction), np.maximum(middle + half, fraction)
