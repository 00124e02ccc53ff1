"""Pictures of ranks: their empirical distribution less the uniform one, with the band of uniform ranks.

The picture is that of Säilynoja et al. (2022), *Graphical test for discrete uniformity and its applications*.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sidestep.evaluation.ranks import UniformBand, rank_difference
from sidestep.plotting import palette
from sidestep.plotting.layout import DOTS_PER_INCH

Ranks = Mapping[str, Int[np.ndarray, " ranks"]]
"""The ranks by each method."""


def figure_ranks(panels: Mapping[str, Ranks], band: UniformBand) -> Figure:
    """Return a figure with a panel for each quantity, side by side.

    Args:
        panels: The ranks of each quantity by method, one or two of them.
        band: The band of uniform ranks.
    """
    size = 0.6 + 3.1 * len(panels), 3.5
    figure = Figure(figsize=size, dpi=DOTS_PER_INCH, layout="constrained")
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (title, ranks) in zip(row, panels.items(), strict=True):
        axes.set_title(title, fontsize=10)
        draw_ranks(axes, ranks, band)
    row[0].set_ylabel("ECDF of ranks less uniform")
    handles, labels = row[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=9)
    return figure


def draw_ranks(axes: Axes, ranks: Ranks, band: UniformBand) -> None:
    """Draw the empirical distribution of ranks less the uniform one, for each method, over the band.

    Args:
        axes: Where to draw.
        ranks: The ranks by method.
        band: The band of uniform ranks.
    """
    uniform = np.arange(1, band.draws + 1) / (band.draws + 1)
    x = np.concatenate([[0.0], uniform, [1.0]])
    low, high = (_ended(numbers / band.ranks - uniform) for numbers in (band.low, band.high))
    axes.fill_between(x, low, high, color="0.88", label="95 % band of uniform ranks")
    for edge in (low, high):
        axes.plot(x, edge, color="0.6", linewidth=0.8)
    axes.axhline(0, color="0.6", linewidth=0.8)
    for (method, own), (color, style, _) in zip(ranks.items(), reversed(palette.SERIES[:2]), strict=False):
        axes.plot(x, _ended(rank_difference(own, band.draws)), style, color=color, linewidth=1.5, label=method)
    axes.set(xlabel="rank of the truth / number of draws", xlim=(0, 1))


def _ended(difference: Float[np.ndarray, " draws"]) -> Float[np.ndarray, " ends"]:
    """Return a difference with the zeros at both ends."""
    return np.concatenate([[0.0], difference, [0.0]])
