"""Pictures of physical systems: what they did over time, and how a belief about them was found."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

_WALK, _BELIEVED, _REAL = "#0072b2", "#d62728", "0.35"


def figure_belief(
    angles: Sequence[Float[np.ndarray, " moves"]],
    time_step: float,
    way: Float[np.ndarray, " iterations"],
    mark_visited_free: float,
    real: float,
) -> Figure:
    """A figure of pendulums over time (radians, seconds), and of the gravity learned, iteration by iteration.

    `mark_visited_free` and `real` are drawn as lines of their own.
    """
    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    swings, learned = figure.subplots(1, 2)
    for angle in angles:
        swings.plot(time_step * np.arange(len(angle)), angle, color=_WALK, linewidth=0.8, alpha=0.6)
    swings.axhline(np.pi, color="0.6", linewidth=0.8, linestyle=":")
    swings.set(
        title=f"{len(angles)} people bring a pendulum to rest", xlabel="time (s)", ylabel="angle from upright (rad)"
    )
    learned.plot(np.arange(len(way)), way, color=_WALK, label="learned from actions")
    learned.axhline(mark_visited_free, color=_BELIEVED, linestyle="--", label="what people believe")
    learned.axhline(real, color=_REAL, linestyle=":", label="what is so")
    learned.set(title="Gravity", xlabel="iteration", ylabel="m/s²")
    learned.set_ylim(0.6 * min(real, mark_visited_free, way.min()), 1.15 * max(real, mark_visited_free, way.max()))
    learned.legend(frameon=False, loc="lower right")
    for axes in (swings, learned):
        axes.grid(color="0.92")
    return figure
