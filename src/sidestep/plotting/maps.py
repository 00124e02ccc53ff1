"""Every picture: maps, learned maps, walks, paths and how a fit went, in metres, row 0 at the top.

Darker means more surely blocked, in colour as in black and white; starts and goals differ by shape as well as
by colour. Functions named `draw_…` draw onto axes that are given, those named `figure_…` make a whole figure;
`save` writes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patheffects import Normal, Stroke
from matplotlib.transforms import Affine2D

from sidestep._files import write_whole
from sidestep.tabular.grid import Cell, Grid
from sidestep.worlds.grids import World

COLOURS = "magma_r"
"""The colour map of P(blocked): perceptually uniform, from nearly white at 0 to black at 1."""

_KNOWN_COLOURS = ListedColormap(["0.82", "1.0", "0.2"])
"""Unknown light grey, free white, occupied nearly black."""
_START, _GOAL, _WALK, _OUTLINE = "#d62728", "#009e73", "#0072b2", "#00a5c8"
_SMALL = 25
"""Up to how many rows and columns the single cells are told apart by thin lines."""
_PANEL = 2.9
"""The longer side of a map in a figure with several, in inches."""
_DOTS_PER_INCH = 150


Places = Integer[np.ndarray, " _"] | Float[np.ndarray, "_ 2"]
"""States, or positions in metres."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One map of a figure with several.

    - `blocked`: P(blocked); `None` draws the map `grid` as it is.
    - `truth`: the true map, whose obstacles are outlined.
    - `paths`: the places along each path; `starts`, `goals`: places. A place is a state, or a position in metres.
    """

    title: str
    grid: Grid
    blocked: Float[np.ndarray, "rows columns"] | None = None
    truth: Grid | None = None
    paths: Sequence[Places] = ()
    starts: Sequence[int] | Places = ()
    goals: Sequence[int] | Places = ()


def draw_cells(
    axes: Axes, values: np.ndarray, grid: Grid, colours: str | ListedColormap, limits: tuple[float, float]
) -> AxesImage:
    """Draw a value a cell where the cells lie in the map's frame, and set the axes up in metres."""
    rows, columns = grid.shape
    x, y, yaw = grid.origin
    extent = (0.0, columns * grid.resolution, 0.0, rows * grid.resolution)
    image = axes.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], extent=extent, origin="upper")
    image.set_transform(Affine2D().rotate(yaw).translate(x, y) + axes.transData)
    corners = grid.to_metres(np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], dtype=np.float64))
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    if _is_small(grid):
        axes.add_collection(LineCollection(_cell_lines(grid), colors="0.75", linewidths=0.4, zorder=1), autolim=False)
    return image


def draw_map(axes: Axes, grid: Grid) -> AxesImage:
    """Draw what a map knows: free cells white, occupied ones dark, unknown ones light grey."""
    return draw_cells(axes, grid.known, grid, _KNOWN_COLOURS, (float(Cell.UNKNOWN), float(Cell.OCCUPIED)))


def draw_blocked(
    axes: Axes, blocked: Float[np.ndarray, "rows columns"], grid: Grid, truth: Grid | None = None
) -> AxesImage:
    """Draw P(blocked) as colours from 0 to 1, the true obstacles outlined; returns the image."""
    image = draw_cells(axes, blocked, grid, COLOURS, (0.0, 1.0))
    if truth is not None:
        draw_outlines(axes, truth)
    return image


def draw_outlines(axes: Axes, truth: Grid) -> None:
    """Outline the obstacles of a true map."""
    segments = _borders(truth.known == Cell.OCCUPIED, truth)
    width = _width(truth, 0.2, 1.6)
    outline = LineCollection(segments, colors=_OUTLINE, linewidths=width, zorder=2, label="true obstacle")
    outline.set(capstyle="projecting", path_effects=_halo(width))
    axes.add_collection(outline, autolim=False)


def draw_walks(axes: Axes, paths: Sequence[Places], grid: Grid, label: str = "walk") -> None:
    """Draw walks as thin lines; those of states are each shifted by a little of their own so that bundles can be seen.

    `label` names them in the legend.
    """
    if not len(paths):
        return
    shift = _shifts(len(paths)) * grid.resolution
    lines = [_metres(path, grid) + own * (path.ndim == 1) for path, own in zip(paths, shift, strict=True)]
    opacity = float(np.clip(12 / len(paths), 0.2, 0.7))
    few = len(paths) <= 6
    width = _width(grid, 1.2, 1.8) if few else _width(grid, 0.6, 0.9)
    walks = LineCollection(lines, colors=_WALK, linewidths=width, alpha=opacity, zorder=3, label=label)
    axes.add_collection(walks, autolim=False)


def draw_path(axes: Axes, states: Integer[np.ndarray, " steps"], grid: Grid) -> None:
    """Draw one path (states) as a bold line from a square at its start to a star at its end."""
    x, y = grid.centres(states).T
    width = _width(grid, 1.6, 2.4)
    axes.plot(x, y, color=_WALK, linewidth=width, path_effects=_halo(width), zorder=4, label="path")
    _draw_markers(axes, states[:1], grid, marker="s", colour=_START, label="start")
    _draw_markers(axes, states[-1:], grid, marker="*", colour=_GOAL, label="goal", scale=1.7)


def draw_places(axes: Axes, starts: Sequence[int] | Places, goals: Sequence[int] | Places, grid: Grid) -> None:
    """Draw starts as red squares and goals as green diamonds."""
    _draw_markers(axes, starts, grid, marker="s", colour=_START, label="start")
    _draw_markers(axes, goals, grid, marker="D", colour=_GOAL, label="goal")


def figure_environments(worlds: Sequence[World]) -> Figure:
    """A figure of true maps with their starts and goals, side by side."""
    return figure_learned([Panel(world.name, world.truth, starts=world.starts, goals=world.goals) for world in worlds])


def figure_learned(panels: Sequence[Panel], columns: int | None = None, label: str = "P(blocked)") -> Figure:
    """A figure of several maps in rows of `columns` (default: all in one row), with one colour bar and its `label`."""
    columns = min(columns or len(panels), len(panels))
    rows = -(-len(panels) // columns)
    width, height = _size(panels[0].grid, _PANEL)
    size = (columns * (width + 0.55) + 0.9, rows * (height + 0.75) + 0.4)
    figure = Figure(figsize=size, layout="compressed")
    all_axes = figure.subplots(rows, columns, squeeze=False).ravel()
    images = [_draw_panel(axes, panel) for axes, panel in zip(all_axes, panels, strict=False)]
    for axes in all_axes[len(panels) :]:
        axes.remove()
    learned = [image for image in images if image is not None]
    if learned:
        _colour_bar(figure, learned[0], list(all_axes[: len(panels)]), label)
    _legend(figure, list(all_axes[: len(panels)]))
    return figure


def figure_fit(
    grid: Grid,
    paths: Sequence[Integer[np.ndarray, " _"]],
    blocked: Float[np.ndarray, "rows columns"],
    objective: Float[np.ndarray, " iterations"],
    seen: Float[np.ndarray, "rows columns"] | None = None,
) -> Figure:
    """A figure of a fit: the walks that went in, the P(blocked) that came out, and the objective.

    `seen` is P(blocked) as a sensor's map has it, NaN where that says nothing.
    """
    width, height = _size(grid, 4.2)
    figure = Figure(figsize=(2 * width + 4.9, max(height, 2.2) + 1.2), layout="compressed")
    before, after, progress = figure.subplots(1, 3, width_ratios=[width, width, 2.8])
    draw_map(before, grid)
    if seen is not None:
        draw_cells(before, seen, grid, COLOURS, (0.0, 1.0))
    draw_walks(before, paths, grid)
    before.set_title(f"What was known, and {len(paths)} walks")
    _colour_bar(figure, draw_blocked(after, blocked, grid), [after])
    after.set_title("What was learned")
    marker = "." if len(objective) < 30 else ""
    progress.plot(np.arange(len(objective)), objective, color=_WALK, marker=marker)
    progress.set(title="Objective", xlabel="iteration", ylabel="log posterior (nats)")
    progress.set_box_aspect(max(height, 2.2) / 2.8)
    progress.grid(color="0.9")
    _legend(figure, [before, after])
    return figure


def figure_plan(grid: Grid, blocked: Float[np.ndarray, "rows columns"], path: Integer[np.ndarray, " steps"]) -> Figure:
    """A figure of one path (states) planned in a learned map."""
    width, height = _size(grid, 5.5)
    figure = Figure(figsize=(width + 1.7, height + 1.3), layout="compressed")
    axes = figure.subplots()
    _colour_bar(figure, draw_blocked(axes, blocked, grid), [axes])
    draw_path(axes, path, grid)
    axes.set_title("Planned path")
    _legend(figure, [axes])
    return figure


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as a PNG, whole or not at all; raises `InputError` where the file system refuses."""
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=_DOTS_PER_INCH, bbox_inches="tight"))


def _draw_panel(axes: Axes, panel: Panel) -> AxesImage | None:
    """Draw a panel; returns its image if a colour bar applies to it."""
    image = None
    if panel.blocked is None:
        draw_map(axes, panel.grid)
    else:
        image = draw_blocked(axes, panel.blocked, panel.grid, panel.truth)
    draw_walks(axes, panel.paths, panel.grid, label="path")
    draw_places(axes, panel.starts, panel.goals, panel.grid)
    axes.set_title(panel.title)
    return image


def _cell_lines(grid: Grid) -> list[Float[np.ndarray, "2 2"]]:
    """The lines between columns and between rows, those around the map included, in metres."""
    rows, columns = grid.shape
    upright = [[[column, 0], [column, rows]] for column in range(columns + 1)]
    level = [[[0, row], [columns, row]] for row in range(rows + 1)]
    return [grid.to_metres(np.array(ends, dtype=np.float64)) for ends in upright + level]


def _borders(inside: Bool[np.ndarray, "rows columns"], grid: Grid) -> list[Float[np.ndarray, "2 2"]]:
    """The cell sides between cells that are inside and cells that are not (or nothing), in metres."""
    rows = inside.shape[0]
    padded = np.pad(inside, 1)
    row, column = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])  # left side of (row, column)
    upright = np.stack([np.stack([column, rows - row], -1), np.stack([column, rows - row - 1], -1)], axis=1)
    row, column = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])  # upper side of (row, column)
    level = np.stack([np.stack([column, rows - row], -1), np.stack([column + 1, rows - row], -1)], axis=1)
    corners = np.concatenate([upright, level]).astype(np.float64)
    return list(grid.to_metres(corners.reshape(-1, 2)).reshape(-1, 2, 2))


def _shifts(count: int) -> Float[np.ndarray, "walks 2"]:
    """Shifts that fill a square of ±0.3 evenly, the first one 0 (Roberts' R₂ sequence)."""
    plastic = 1.32471795724474602596
    sequence = np.arange(count)[:, None] / np.array([plastic, plastic**2])
    return ((sequence + 0.5) % 1.0 - 0.5) * 0.6


def _draw_markers(
    axes: Axes,
    places: Sequence[int] | Places,
    grid: Grid,
    *,
    marker: str,
    colour: str,
    label: str,
    scale: float = 1.0,
) -> None:
    if not len(places):
        return
    x, y = _metres(np.asarray(places), grid).T
    size = scale * _width(grid, 7.0, 9.0)
    edge = {"markeredgecolor": "white", "markeredgewidth": 0.8}
    axes.plot(x, y, marker, color=colour, markersize=size, zorder=5, label=label, **edge)


def _metres(places: Places, grid: Grid) -> Float[np.ndarray, "places 2"]:
    """Where states or positions are."""
    return places if places.ndim == 2 else grid.centres(places)


def _halo(width: float) -> list[Stroke | Normal]:
    """A white edge around a line, so that it shows on dark and on light cells."""
    return [Stroke(linewidth=width + min(1.4, width), foreground="white"), Normal()]


def _width(grid: Grid, least: float, most: float) -> float:
    """The width in points of a line that should be a fifth of a cell wide in a map four inches long."""
    return float(np.clip(60 / max(grid.shape), least, most))


def _colour_bar(figure: Figure, image: AxesImage, axes: list[Axes], label: str = "P(blocked)") -> None:
    figure.colorbar(image, ax=axes, label=label, shrink=0.85, aspect=25, ticks=[0, 0.25, 0.5, 0.75, 1])


def _legend(figure: Figure, axes: list[Axes]) -> None:
    """One legend under the figure for whatever was drawn."""
    handles: dict[str, Artist] = {}
    for single in axes:
        for handle, label in zip(*single.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        names, drawn = list(handles), list(handles.values())
        legend = figure.legend(drawn, names, loc="outside lower center", ncols=len(names), frameon=False)
        for handle in legend.legend_handles:
            if handle is not None:
                handle.set_alpha(1.0)  # a single walk is too pale to be recognised


def _is_small(grid: Grid) -> bool:
    return max(grid.shape) <= _SMALL


def _size(grid: Grid, longer: float) -> tuple[float, float]:
    """Width and height in inches of a map whose longer side is `longer`."""
    rows, columns = grid.shape
    scale = longer / max(rows, columns)
    return max(columns * scale, 0.8), max(rows * scale, 0.8)
