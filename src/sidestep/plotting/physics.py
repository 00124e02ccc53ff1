"""Pictures of physical systems: their motion over time, and a learned belief about their physics."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from sidestep.plotting import palette


def figure_belief(
    angles: Sequence[Float[np.ndarray, " moves"]],
    time_step: float,
    estimates: Float[np.ndarray, " iterations"],
    believed: float,
    true: float,
) -> Figure:
    """Return a figure of pendulums over time, and of the learned gravity in every iteration.

    Args:
        angles: Of each pendulum from upright, in radians, one per time step.
        time_step: The time between two angles, in seconds.
        estimates: The gravity (m/s²) after each iteration.
        believed: The gravity that the agents believe in, a dashed line.
        true: The gravity of the pendulums, a dotted line.
    """
    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    swings, learned = figure.subplots(1, 2)
    for angle in angles:
        swings.plot(time_step * np.arange(len(angle)), angle, color=palette.BLUE, linewidth=0.8, alpha=0.6)
    swings.axhline(np.pi, color="0.6", linewidth=0.8, linestyle=":")
    swings.set(title=f"{len(angles)} agents stop a pendulum", xlabel="time (s)", ylabel="angle from upright (rad)")
    learned.plot(np.arange(len(estimates)), estimates, color=palette.BLUE, label="learned from actions")
    learned.axhline(believed, color=palette.RED, linestyle="--", label="believed by the agents")
    learned.axhline(true, color="0.35", linestyle=":", label="true")
    low, high = np.percentile([believed, true, *estimates], [0, 100])
    learned.set(title="Gravity", xlabel="iteration", ylabel="m/s²", ylim=(0.6 * low, 1.15 * high))
    learned.legend(frameon=False, loc="lower right")
    for axes in (swings, learned):
        axes.grid(color="0.92")
    return figure
