"""Pictures of maps, learned maps, walks and paths, and of the progress of a fit, in meters, row 0 at the top.

Darker means more probably blocked, in color and in black and white; starts and goals differ by shape as well as by
color. Functions named `draw_…` draw onto axes, and functions named `figure_…` return a whole figure, which
`save` writes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.patheffects import Normal, Stroke
from matplotlib.transforms import Affine2D

from sidestep._files import write_whole
from sidestep.plotting import palette
from sidestep.plotting.layout import DOTS_PER_INCH, ColorBar, arrange, new_figure
from sidestep.tabular.grid import Cell, Grid
from sidestep.worlds.grids import World

_MOST_CELL_LINES = 25
"""Maps with at most this many rows and columns show thin lines between cells."""
_PANEL, _FIT, _PLAN = 2.9, 4.2, 5.5
"""The longer side of a map in inches, in each kind of figure."""
_OBJECTIVE_SPAN = 1.0
"""The least height of the objective's axis, in nats: smaller changes look as small as they are."""

Values = Float[np.ndarray, "rows columns"]
Cells = Bool[np.ndarray, "rows columns"]
Places = Integer[np.ndarray, " _"] | Float[np.ndarray, "_ 2"]
"""States, or positions in metres."""
Marks = Sequence[int] | Places


@dataclass(frozen=True, eq=False)
class Panel:
    """One map of a figure with several.

    Attributes:
        title: The text above the map.
        grid: The map.
        blocked: P(blocked) of each cell; None draws `grid` as it is.
        truth: The true map; its obstacles are outlined.
        paths: The places along each path. A place is a state, or a position in metres.
        starts: Places that get a red square.
        goals: Places that get a green diamond.
        without_evidence: Cells that are hatched, since walks say next to nothing of them; None for none.
    """

    title: str
    grid: Grid
    blocked: Values | None = None
    truth: Grid | None = None
    paths: Sequence[Places] = ()
    starts: Marks = ()
    goals: Marks = ()
    without_evidence: Cells | None = None


def draw_cells(
    axes: Axes, values: np.ndarray, grid: Grid, colors: str | ListedColormap, limits: tuple[float, float]
) -> AxesImage:
    """Draw one value per cell at the cells' places in the map's frame, with axes in metres; return the image.

    Args:
        axes: Where to draw.
        values: Of each cell, row 0 at the top.
        grid: The geometry of the map.
        colors: The color map.
        limits: The values of the first and the last color.
    """
    rows, columns = grid.shape
    x, y, yaw = grid.origin
    extent = (0.0, columns * grid.resolution, 0.0, rows * grid.resolution)
    image = axes.imshow(values, cmap=colors, clim=limits, extent=extent, origin="upper", interpolation_stage="rgba")
    image.set_transform(Affine2D().rotate(yaw).translate(x, y) + axes.transData)
    low, high = grid.corners().min(axis=0), grid.corners().max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    if max(grid.shape) <= _MOST_CELL_LINES:
        axes.add_collection(LineCollection(_cell_lines(grid), colors="0.75", linewidths=0.4, zorder=1), autolim=False)
    return image


def draw_map(axes: Axes, grid: Grid) -> AxesImage:
    """Draw the known cells of a map: free white, occupied dark, unknown light gray; return the image.

    Args:
        axes: The axes to draw on.
        grid: The map.
    """
    limits = float(Cell.UNKNOWN), float(Cell.OCCUPIED)
    return draw_cells(axes, grid.known, grid, ListedColormap(palette.KNOWN), limits)


def draw_blocked(axes: Axes, blocked: Values, grid: Grid, truth: Grid | None = None) -> AxesImage:
    """Draw P(blocked) in colors for 0 to 1, with the obstacles of `truth` outlined; return the image.

    Args:
        axes: The axes to draw on.
        blocked: P(blocked) of each cell, in [0, 1].
        grid: The map.
        truth: The true map, or None.
    """
    image = draw_cells(axes, blocked, grid, palette.BLOCKED, (0.0, 1.0))
    if truth is not None:
        draw_outlines(axes, truth)
    return image


def draw_outlines(axes: Axes, truth: Grid) -> None:
    """Outline the obstacles of a true map.

    Args:
        axes: The axes to draw on.
        truth: The true map, fully known.
    """
    segments = _borders(truth.known == Cell.OCCUPIED, truth)
    width = _width(truth, 0.2, 1.6)
    outline = LineCollection(segments, colors=palette.OUTLINE, linewidths=width, zorder=2, label="true obstacle")
    outline.set(capstyle="projecting", path_effects=_halo(width))
    axes.add_collection(outline, autolim=False)


def draw_without_evidence(axes: Axes, cells: Cells, grid: Grid) -> None:
    """Hatch cells that walks say next to nothing of, over a veil that lets their P(blocked) through.

    Args:
        axes: The axes to draw on.
        cells: Whether each cell is hatched, row 0 at the top.
        grid: The map.
    """
    if not cells.any():
        return
    path = Outline.make_compound_path(*(Outline(corners, closed=True) for corners in _runs(cells, grid)))
    style = {"facecolor": (1.0, 1.0, 1.0, 0.6), "edgecolor": "0.35", "linewidth": 0.0, "hatch": "/////"}
    axes.add_patch(PathPatch(path, label="walks say next to nothing", zorder=1.5, **style))


def draw_walks(axes: Axes, paths: Sequence[Places], grid: Grid, label: str = "walk") -> None:
    """Draw walks as thin lines, each walk of states with a small shift of its own, so that bundles remain visible.

    Args:
        axes: Where to draw.
        paths: The places along each walk.
        grid: The map.
        label: The name of the walks in the legend.
    """
    if not len(paths):
        return
    shifts = _shifts(len(paths)) * grid.resolution
    lines = [_metres(path, grid) + shift * (path.ndim == 1) for path, shift in zip(paths, shifts, strict=True)]
    opacity = float(np.clip(12 / len(paths), 0.2, 0.7))
    width = _width(grid, 1.2, 1.8) if len(paths) <= 6 else _width(grid, 0.6, 0.9)
    walks = LineCollection(lines, colors=palette.PATH, linewidths=width, alpha=opacity, zorder=3, label=label)
    axes.add_collection(walks, autolim=False)


def draw_path(axes: Axes, states: Integer[np.ndarray, " steps"], grid: Grid) -> None:
    """Draw one path (states) as a bold line from a square at its start to a star at its end.

    Args:
        axes: The axes to draw on.
        states: The states along the path.
        grid: The map.
    """
    x, y = grid.centers(states).T
    width = _width(grid, 1.6, 2.4)
    axes.plot(x, y, color=palette.PATH, linewidth=width, path_effects=_halo(width), zorder=4, label="path")
    _draw_markers(axes, states[:1], grid, "s", palette.START, "start")
    _draw_markers(axes, states[-1:], grid, "*", palette.GOAL, "goal", scale=1.7)


def draw_places(axes: Axes, starts: Marks, goals: Marks, grid: Grid) -> None:
    """Draw starts as red squares and goals as green diamonds.

    Args:
        axes: The axes to draw on.
        starts: The starts: states, or positions in metres.
        goals: The goals: states, or positions in metres.
        grid: The map.
    """
    _draw_markers(axes, starts, grid, "s", palette.START, "start")
    _draw_markers(axes, goals, grid, "D", palette.GOAL, "goal")


def figure_environments(worlds: Sequence[World]) -> Figure:
    """Return a figure of true maps with their starts and goals, side by side.

    Args:
        worlds: The worlds.
    """
    return figure_learned([Panel(world.name, world.truth, starts=world.starts, goals=world.goals) for world in worlds])


def figure_learned(panels: Sequence[Panel], columns: int | None = None, label: str = "P(blocked)") -> Figure:
    """Return a figure of several maps with one color bar.

    Args:
        panels: The maps.
        columns: How many maps a row has; by default all maps are in one row.
        label: What the colors of learned maps mean.
    """
    columns = min(columns or len(panels), len(panels))
    figure, axes = new_figure(len(panels), columns)
    images = [_draw_panel(each, panel) for each, panel in zip(axes, panels, strict=True)]
    learned = [image for image in images if image is not None]
    width, height = _size(panels[0].grid, _PANEL)
    arrange(figure, [width] * columns, height, ColorBar(learned[0], columns - 1, label) if learned else None)
    return figure


def figure_fit(
    grid: Grid,
    paths: Sequence[Places],
    blocked: Values,
    objective: Float[np.ndarray, " _"],
    seen: Values | None = None,
    goals: Marks = (),
    without_evidence: Cells | None = None,
) -> Figure:
    """Return a figure of a fit: the walks and their goals, the learned map, and the objective in every iteration.

    Args:
        grid: The map before learning.
        paths: The states along each walk.
        blocked: The learned P(blocked) of each cell.
        objective: The log posterior (nats) before the first iteration and after each.
        seen: P(blocked) of each cell in the map of a sensor, NaN where it has none.
        goals: The goals of the walks.
        without_evidence: Cells of the learned map that are hatched; None for none.
    """
    width, height = _size(grid, _FIT)
    height = max(height, 2.2)
    figure, (before, after, progress) = new_figure(3, 3)
    draw_map(before, grid)
    if seen is not None:
        draw_cells(before, seen, grid, palette.BLOCKED, (0.0, 1.0))
    draw_walks(before, paths, grid)
    before.set_title(f"Known before, and {len(paths)} walks")
    image = draw_blocked(after, blocked, grid)
    after.set_title("Learned")
    if without_evidence is not None:
        draw_without_evidence(after, without_evidence, grid)
    for axes in (before, after):
        draw_places(axes, (), goals, grid)
    progress.plot(np.arange(len(objective)), objective, color=palette.BLUE, marker="." if len(objective) < 30 else "")
    progress.set(title="Objective", xlabel="iteration", ylabel="log posterior + constant (nats)")
    progress.locator_params(axis="x", integer=True)
    progress.ticklabel_format(axis="y", useOffset=False)
    low, high = progress.get_ylim()
    if high - low < _OBJECTIVE_SPAN:
        progress.set_ylim((low + high - _OBJECTIVE_SPAN) / 2, (low + high + _OBJECTIVE_SPAN) / 2)
    progress.grid(color="0.9")
    arrange(figure, [width, width, 2.8], height, ColorBar(image, column=1))
    return figure


def figure_plan(
    grid: Grid,
    blocked: Values,
    path: Integer[np.ndarray, " steps"],
    alternatives: Sequence[Integer[np.ndarray, " _"]] = (),
    title: str = "Planned path",
) -> Figure:
    """Return a figure of one path (states) planned in a learned map.

    Args:
        grid: The map.
        blocked: The learned P(blocked) of each cell, in [0, 1].
        path: The states along the path.
        alternatives: Other paths, drawn dashed.
        title: The title.
    """
    width, height = _size(grid, _PLAN)
    figure, (axes,) = new_figure(1, 1)
    image = draw_blocked(axes, blocked, grid)
    for other in alternatives:
        axes.plot(*grid.centers(other).T, color=palette.BLUE, linestyle="--", linewidth=1, label="alternative")
    draw_path(axes, path, grid)
    axes.set_title(title)
    arrange(figure, [width], height, ColorBar(image, column=0))
    return figure


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as a PNG atomically.

    Args:
        figure: The figure.
        path: The file to write.

    Raises:
        InputError: For a path that the file system refuses.
    """
    # a person waits for the picture, and a somewhat larger file is written sooner
    options = {"compress_level": 1}
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=DOTS_PER_INCH, pil_kwargs=options))


def _draw_panel(axes: Axes, panel: Panel) -> AxesImage | None:
    """Draw a panel; return its image if a color bar applies to it."""
    if panel.blocked is not None:
        image = draw_blocked(axes, panel.blocked, panel.grid, panel.truth)
        if panel.without_evidence is not None:
            draw_without_evidence(axes, panel.without_evidence, panel.grid)
    else:
        image = draw_map(axes, panel.grid)
    draw_walks(axes, panel.paths, panel.grid, label="path")
    draw_places(axes, panel.starts, panel.goals, panel.grid)
    axes.set_title(panel.title)
    return None if panel.blocked is None else image


def _cell_lines(grid: Grid) -> list[Float[np.ndarray, "2 2"]]:
    """Return the lines between columns and between rows and around the map, in metres."""
    rows, columns = grid.shape
    upright = [[[column, 0], [column, rows]] for column in range(columns + 1)]
    level = [[[0, row], [columns, row]] for row in range(rows + 1)]
    return [grid.to_metres(np.array(ends, dtype=np.float64)) for ends in upright + level]


def _borders(inside: Bool[np.ndarray, "rows columns"], grid: Grid) -> list[Float[np.ndarray, "2 2"]]:
    """Return the cell sides that separate cells inside from cells outside or from the edge of the map, in metres."""
    rows, padded = inside.shape[0], np.pad(inside, 1)
    row, column = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])  # left side of (row, column)
    upright = np.array([[column, rows - row], [column, rows - row - 1]])
    row, column = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])  # upper side of (row, column)
    level = np.array([[column, rows - row], [column + 1, rows - row]])
    sides = np.concatenate([upright, level], axis=-1).transpose(2, 0, 1)
    return list(grid.to_metres(sides.reshape(-1, 2).astype(np.float64)).reshape(-1, 2, 2))


def _runs(cells: Cells, grid: Grid) -> Float[np.ndarray, "runs 5 2"]:
    """Return the corners of each run of cells in a row, the first one twice, in metres."""
    change = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, left = np.nonzero(change == 1)
    _, right = np.nonzero(change == -1)  # in the same order: row by row
    above, below = cells.shape[0] - row, cells.shape[0] - row - 1
    corners = np.stack([[left, below], [right, below], [right, above], [left, above], [left, below]])
    return grid.to_metres(corners.transpose(2, 0, 1).reshape(-1, 2).astype(np.float64)).reshape(-1, 5, 2)


def _shifts(count: int) -> Float[np.ndarray, "walks 2"]:
    """Return shifts that fill a square of ±0.3 evenly, the first one 0 (the R₂ sequence of Roberts, 2018)."""
    plastic = 1.32471795724474602596
    return ((np.arange(count)[:, None] / np.array([plastic, plastic**2]) + 0.5) % 1.0 - 0.5) * 0.6


def _draw_markers(axes: Axes, places: Marks, grid: Grid, marker: str, color: str, label: str, scale: float = 1) -> None:
    if not len(places):
        return
    x, y = _metres(np.asarray(places), grid).T
    edge = {"markeredgecolor": "white", "markeredgewidth": 0.8}
    axes.plot(x, y, marker, color=color, markersize=scale * _width(grid, 7.0, 9.0), zorder=5, label=label, **edge)


def _metres(places: Places, grid: Grid) -> Float[np.ndarray, "places 2"]:
    """Return the positions of places."""
    return places if places.ndim == 2 else grid.centers(places)


def _halo(width: float) -> list[Stroke | Normal]:
    """Return a white edge around a line, which is then visible on dark and on light cells."""
    return [Stroke(linewidth=width + min(1.4, width), foreground="white"), Normal()]


def _width(grid: Grid, least: float, most: float) -> float:
    """Return the width in points of a line that is a fifth of a cell wide in a map four inches long, within limits."""
    return float(np.clip(60 / max(grid.shape), least, most))


def _size(grid: Grid, longer: float) -> tuple[float, float]:
    """Return width and height of a map with a longer side of `longer` inches."""
    span = np.ptp(grid.corners(), axis=0)
    width, height = np.maximum(span * longer / span.max(), 0.8)
    return float(width), float(height)
