"""The colors of every picture.

The lines and markers are colors of Okabe and Ito (2008) or near them, which color-blind readers can distinguish; every
picture also distinguishes them by style or shape, so that it can be read in black and white.
"""

BLOCKED = "magma_r"
"""The color map of P(blocked): perceptually uniform, from nearly white at 0 to black at 1."""

KNOWN = ("0.82", "1.0", "0.2")
"""Cells of a map: unknown light gray, free white, occupied nearly black."""

BLUE, RED, GREEN, CYAN = "#0072b2", "#d62728", "#009e73", "#00a5c8"
PATH, START, GOAL, OUTLINE = BLUE, RED, GREEN, CYAN

SERIES = ((RED, "--", "o"), (BLUE, "-", "s"), ("0.4", ":", "^"))
"""Color, line style and marker of each curve in a plot."""
