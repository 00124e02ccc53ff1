"""Figures of maps: axes of given sizes in rows, one color bar, and one legend.

The size of a map is fixed in inches, so `arrange` measures the labels around each map once and places everything. A
constrained layout of Matplotlib measures several times, which takes longer than the drawing itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.transforms import Bbox

DOTS_PER_INCH = 150
_GAP = 0.12
"""The least space in inches between neighbors and along the edge of a figure."""


Lengths = Float[np.ndarray, " parts"]


class ColorBar(NamedTuple):
    """A color bar for `image`, to the right of a column of axes; `label` names the values."""

    image: AxesImage
    column: int
    label: str = "P(blocked)"


def new_figure(count: int, columns: int) -> tuple[Figure, list[Axes]]:
    """Return a figure and `count` axes, row by row; draw on them, then call `arrange`.

    Args:
        count: The number of axes, 1 or more.
        columns: The number of axes in a row.
    """
    figure = Figure(dpi=DOTS_PER_INCH)
    return figure, [figure.add_subplot(-(-count // columns), columns, index + 1) for index in range(count)]


def arrange(figure: Figure, widths: Sequence[float], height: float, bar: ColorBar | None = None) -> None:
    """Place the axes of a figure in rows, add a color bar and a legend, and fit the size of the figure to them.

    Args:
        figure: From `new_figure`, with everything drawn.
        widths: The width of each column in inches.
        height: The height of each row in inches.
        bar: The color bar, which is 85 % as long as all rows together.
    """
    renderer = FigureCanvasAgg(figure).get_renderer()
    axes, columns = list(figure.axes), len(widths)
    rows = -(-len(axes) // columns)
    margins = np.zeros((rows, columns, 4))
    for index, each in enumerate(axes):
        each.set_title(each.get_title(), y=1.0)  # without a place of its own, a title has each axis measured again
        margins[divmod(index, columns)] = _margins(each, widths[index % columns], height, renderer)
    left, right = margins[:, :, :2].max(axis=0).T
    below, above = margins[::-1, :, 2:].max(axis=1).T
    x, total_width = _starts(left, np.asarray(widths), right)
    y, total_height = _starts(below, np.full(rows, height), above)
    boxes: dict[Axes, tuple[float, float, float, float]] = {}
    if bar:
        cax = figure.add_axes((0, 0, 1, 1))
        figure.colorbar(bar.image, cax=cax, label=bar.label, ticks=[0, 0.25, 0.5, 0.75, 1])
        length = max(0.85 * (y[-1] + height - y[0]), 1.0)
        thickness, distance = length / 25, widths[bar.column] + right[bar.column] + _GAP
        boxes[cax] = (x[bar.column] + distance, (y[0] + y[-1] + height - length) / 2, thickness, length)
        right[bar.column] += _GAP + thickness + _margins(cax, thickness, length, renderer)[1]
        x, total_width = _starts(left, np.asarray(widths), right)
    for index, each in enumerate(axes):
        row, column = divmod(index, columns)
        boxes[each] = (x[column], y[rows - 1 - row], widths[column], height)
    legend_width, legend_height = _add_legend(figure, axes, renderer)
    width, height = max(total_width, legend_width), total_height + legend_height
    figure.set_size_inches(width, height)
    for each, (left, bottom, across, up) in boxes.items():
        start = left + (width - total_width) / 2
        each.set_position((start / width, (bottom + legend_height) / height, across / width, up / height))


def _margins(axes: Axes, width: float, height: float, renderer: RendererAgg) -> Float[np.ndarray, " 4"]:
    """Return the reach of labels beyond axes of this size: left, right, below and above, in inches."""
    whole_width, whole_height = axes.figure.get_figure(root=True).get_size_inches()
    axes.set_position((0, 0, width / whole_width, height / whole_height))
    # not those of `axes.get_tightbbox`, which measures each axis twice
    labels = axes.xaxis.get_tightbbox(renderer), axes.yaxis.get_tightbbox(renderer)
    box = Bbox.union([axes.bbox, axes.title.get_window_extent(renderer), *filter(None, labels)])
    x0, y0, x1, y1 = np.asarray(box.extents) / DOTS_PER_INCH
    return np.maximum([-x0, x1 - width, -y0, y1 - height], 0.0)


def _starts(before: Lengths, sizes: Lengths, after: Lengths) -> tuple[Lengths, float]:
    """Return where each part of a row or column starts, and the length of all, with a gap around each part."""
    ends = np.cumsum(_GAP + before + sizes + after)
    return ends - after - sizes, float(ends[-1]) + _GAP


def _add_legend(figure: Figure, axes: Sequence[Axes], renderer: RendererAgg) -> tuple[float, float]:
    """Add one legend at the bottom of a figure for everything labeled; return its width and height in inches."""
    handles: dict[str, Artist] = {}
    for each in axes:
        for handle, label in zip(*each.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if not handles:
        return 0.0, 0.0
    legend = figure.legend([*handles.values()], [*handles], loc="lower center", ncols=len(handles), frameon=False)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)  # the color of a single walk is too pale to recognize
    width, height = np.asarray(legend.get_window_extent(renderer).size) / DOTS_PER_INCH
    return float(width), float(height)
