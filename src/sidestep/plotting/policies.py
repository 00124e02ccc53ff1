"""Pictures of robots that plan with a learned model: policies on maps, and fractions of outcomes over the stakes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patheffects import Normal, Stroke

from sidestep.plotting import palette
from sidestep.plotting.maps import Places, draw_cells, draw_outlines, draw_places, draw_walks
from sidestep.tabular.grid import Cell, Grid

States = Int[np.ndarray, " starts"]
_HALO = (Stroke(linewidth=2.2, foreground="white"), Normal())


@dataclass(frozen=True, eq=False)
class PolicyPanel:
    """A map and a policy of a robot on it.

    Attributes:
        title: The text above the map.
        values: Of each cell, drawn as colors.
        label: The name of the values.
        most: The value of the last color; the first color is that of 0.
        truth: The true map; its obstacles are outlined.
        goal: The state that the robot has to reach, if there is one.
        policy: The states from which the policy is drawn, the state that the next move from each should reach, and
            whether the robot stays at each instead.
        walks: The places along each demonstrated walk.
    """

    title: str
    values: Float[np.ndarray, "rows columns"]
    label: str
    most: float
    truth: Grid
    goal: int | None = None
    policy: tuple[States, States, Bool[np.ndarray, " starts"]] | None = None
    walks: Sequence[Places] = ()


@dataclass(frozen=True, eq=False)
class Curves:
    """How often each outcome happens, over the stakes.

    Attributes:
        title: The text above the curves.
        stakes: What a success pays, in units of a failure's cost.
        fractions: By method and outcome, one fraction of starts for each of the stakes.
    """

    title: str
    stakes: Sequence[float]
    fractions: Mapping[str, Mapping[str, Sequence[float]]]


def figure_policies(panels: Sequence[PolicyPanel], curves: Sequence[Curves]) -> Figure:
    """Return a figure of maps in a row, and below it a row of plots for each set of curves.

    Args:
        panels: The maps.
        curves: The sets of curves.
    """
    figure = Figure(figsize=(2.9 * len(panels), 2.7 + 2.5 * len(curves)), layout="constrained")
    rows = figure.add_gridspec(1 + len(curves), 1, height_ratios=[2.7, *[2.5] * len(curves)])
    parts = [figure.add_subfigure(row) for row in rows]
    for axes, panel in zip(parts[0].subplots(1, len(panels)), panels, strict=True):
        _draw_panel(parts[0], axes, panel)
    for part, each in zip(parts[1:], curves, strict=True):
        _draw_curves(part, each)
    return figure


def _draw_panel(figure: SubFigure, axes: Axes, panel: PolicyPanel) -> None:
    image = draw_cells(axes, panel.values, panel.truth, palette.BLOCKED, (0.0, panel.most))
    figure.colorbar(image, ax=axes, label=panel.label, location="bottom", shrink=0.8, aspect=25)
    draw_outlines(axes, panel.truth)
    draw_walks(axes, panel.walks, panel.truth)
    if panel.policy is not None:
        _draw_policy(axes, panel.truth, *panel.policy)
    if panel.goal is not None:
        draw_places(axes, [], [panel.goal], panel.truth)
    axes.set(xlabel="", ylabel="")
    axes.set_title(panel.title, fontsize=10)


def _draw_policy(axes: Axes, truth: Grid, starts: States, intended: States, stays: Bool[np.ndarray, " starts"]) -> None:
    """Draw an arrow where a robot moves, a ring where it stays, and a cross on every wall that it bumps into."""
    here, there = truth.centers(starts), truth.centers(intended)
    shape = {"arrowstyle": "->", "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0, "path_effects": _HALO}
    for place, step in zip(here[~stays], 0.4 * (there - here)[~stays], strict=True):
        axes.annotate("", tuple(place + step), tuple(place - step), arrowprops=shape)
    axes.plot(*here[stays].T, "o", markerfacecolor="white", markeredgecolor="black", markersize=3.5)
    targets = np.unique(intended[~stays])
    walls = targets[truth.known.ravel()[targets] == Cell.OCCUPIED]
    axes.plot(*truth.centers(walls).T, "X", color="white", markeredgecolor="black", markersize=6.5, zorder=5)


def _draw_curves(figure: SubFigure, curves: Curves) -> None:
    figure.suptitle(curves.title, fontsize=11)
    outcomes = next(iter(curves.fractions.values()))
    for axes, outcome in zip(figure.subplots(1, len(outcomes), sharey=True), outcomes, strict=True):
        for (method, fractions), (color, style, marker) in zip(curves.fractions.items(), palette.SERIES, strict=False):
            axes.plot(curves.stakes, fractions[outcome], style, color=color, marker=marker, markersize=4, label=method)
        axes.set(xscale="log", xlabel="stakes", title=outcome.replace("_", " "), ylim=(-0.04, 1.04))
        axes.set_xticks(curves.stakes, [f"{each:g}" for each in curves.stakes])
        axes.minorticks_off()
        axes.grid(color="0.9")
    figure.axes[0].set_ylabel("fraction of starts")
    figure.axes[-1].legend(frameon=False, fontsize=9, loc="upper left")
