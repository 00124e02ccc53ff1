"""Heat maps of a plan: the probability and the value of each action in each state, darker for more."""

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from sidestep.errors import check, check_instance
from sidestep.plotting import palette
from sidestep.plotting.graph_layout import POINTS, names_of, text_size
from sidestep.plotting.layout import DOTS_PER_INCH
from sidestep.tabular.demonstration_tables import Labels
from sidestep.tabular.planning import Plan

_NUMBERED = 30, 12
"""The most states and actions with numbers in the cells."""
_NAMED = 40
"""The most states with a name each."""
_DARK = 0.45
"""The fraction of the scale from which numbers are white."""
_NAMES = 8.0
"""The size of the names of states and actions in points."""


def figure_plan(plan: Plan, *, labels: Labels | None = None) -> Figure:
    """Return the policy and the action values of a plan as two heat maps, a row for each state.

    Terminal states, where no action is taken, and actions that never arrive are hatched.

    Args:
        plan: The plan.
        labels: Names of states and actions.

    Returns:
        The figure; `figure.savefig("plan.png")` writes it.

    Raises:
        InputError: For arguments of other types, for too few labels, and for a plan with values of some states only.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)
        >>> made = ss.plan(ss.ObstacleGrid(grid), ss.reach(grid, 2))
        >>> [axes.get_title() for axes in figure_plan(made, labels=ss.Labels(actions=("n", "s", "w", "e"))).axes[:2]]
        ['policy', 'action values']
    """
    check_instance(plan, Plan, "plan")
    check_instance(labels, (Labels, type(None)), "labels")
    policy, q = np.asarray(plan.policy, np.float64), np.asarray(plan.solution.action_values, np.float64)
    check(policy.shape == q.shape, f"expected values of {policy.shape}, found {q.shape}", field="plan")
    (states, actions), labels = policy.shape, labels or Labels()
    names = names_of(labels.states, states, "states"), names_of(labels.actions, actions, "actions")
    cell = 0.24 if states <= _NAMED else 6.0 / states
    # room for the names beside and below the cells
    beside = text_size(max(names[0], key=len), _NAMES)[0] / POINTS if states <= _NAMED else 0.4
    below = 0.0 if _short(names[1]) else 0.7 * text_size(max(names[1], key=len), _NAMES)[0] / POINTS
    size = 2.2 + beside + 1.0 * actions, max(1.6 + below + cell * states, 2.6 + below)
    figure = Figure(figsize=size, dpi=DOTS_PER_INCH, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    ended = np.broadcast_to(np.asarray(plan.terminal)[:, None], q.shape)
    endless = ended | ~np.isfinite(q)
    panels = ((left, policy, ended, "policy", "π(a | s)"), (right, q, endless, "action values", "Q(s, a), reward"))
    for axes, values, hidden, title, label in panels:
        image = draw_table(axes, values, hidden, *names, bounds=(0.0, 1.0) if title == "policy" else None)
        axes.set_title(title, fontsize=10)
        bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.9, aspect=18, ticks=MaxNLocator(4))
        bar.set_label(label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
    left.set_ylabel("state", fontsize=9)
    return figure


def draw_table(
    axes: Axes,
    values: Float[np.ndarray, "states actions"],
    hidden: Bool[np.ndarray, "states actions"],
    states: list[str],
    actions: list[str],
    bounds: tuple[float, float] | None = None,
) -> AxesImage:
    """Draw numbers of states and actions as a heat map, with the numbers where there is room.

    Args:
        axes: Where to draw.
        values: The numbers.
        hidden: Which cells are hatched instead.
        states: The names of the rows.
        actions: The names of the columns.
        bounds: The numbers of the first and the last color; by default the smallest and the largest.

    Returns:
        The image, for a color bar.
    """
    shown = np.ma.masked_array(values, hidden)
    least, most = bounds or ((float(shown.min()), float(shown.max())) if shown.count() else (0.0, 1.0))
    scale = Normalize(least, most if most > least else least + 1)
    image = axes.imshow(shown, cmap=palette.BLOCKED, norm=scale, aspect="auto", interpolation="nearest")
    for row, column in np.argwhere(hidden):
        cell = (column - 0.5, row - 0.5), 1, 1
        axes.add_patch(Rectangle(*cell, facecolor="white", edgecolor="0.7", hatch="////", linewidth=0))
    axes.set_xticks(range(len(actions)), actions, rotation=0 if _short(actions) else 45)
    if len(states) <= _NAMED:
        axes.set_yticks(range(len(states)), states)
    axes.tick_params(labelsize=_NAMES, length=2)
    axes.set_xlabel("action", fontsize=9)
    if len(states) <= _NUMBERED[0] and len(actions) <= _NUMBERED[1]:
        for row, column in np.argwhere(~hidden).tolist():
            value = float(values[row, column])
            color = "white" if scale(value) > _DARK else "black"
            axes.text(column, row, _number(value), ha="center", va="center", fontsize=7, color=color)
    return image


def _short(names: list[str]) -> bool:
    return max(map(len, names)) <= 6


def _number(value: float) -> str:
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.3g}"
