"""`sidestep plan`: a path in a learned map, as CSV and PNG."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sidestep.cli.options import BUMP_COST, BumpCost, LearnedFolder, position_of

if TYPE_CHECKING:
    from sidestep.maps.learned_map import PlannedPath

_DOUBTFUL = 0.05
"""The P(blocked) of a goal above which a note says that it may not be free, where no risk is named."""


def plan(
    folder: LearnedFolder,
    start: Annotated[str, typer.Option(help="In metres.", metavar="X,Y")],
    goal: Annotated[str, typer.Option(help="In metres.", metavar="X,Y")],
    out: Annotated[Path | None, typer.Option("--out", help="The folder to write to (DIR/plan).", metavar="DIR")] = None,
    bump_cost: BumpCost = BUMP_COST,
    max_risk: Annotated[
        float | None,
        typer.Option(
            help="The largest probability that the path is not open, given that start and goal are free.", metavar="P"
        ),
    ] = None,
) -> None:
    """Plan a path in a learned map: path.csv, path.png, summary.json."""
    import numpy as np

    from sidestep.cli.display import print_lines
    from sidestep.cli.drawing import draw
    from sidestep.maps.learned_map import add_to_summary, load_map

    out = out or folder / "plan"
    first, last = position_of(start, "--start"), position_of(goal, "--goal")
    learned = load_map(folder)
    path = learned.plan(first, last, bump_cost=bump_cost, max_risk=max_risk)
    others = [other.states for other in path.alternatives]
    title = f"Planned path, open with probability {path.open_probability:.2f}"
    picture = draw("figure_plan", out / "path.png", learned.grid, learned.blocked, path.states, others, title)
    # imported while the second process draws
    import pyarrow as pa

    from sidestep.io.tables import write_table

    x, y = path.positions.T
    write_table(out / "path.csv", pa.table({"step": np.arange(len(x)), "x": x, "y": y, "blocked": path.blocked}))
    settings = {"command": "plan", "start": first, "goal": last, "bump_cost": bump_cost, "max_risk": max_risk}
    add_to_summary(folder, out, "plan", {**settings, **_summary(path)})
    picture.result()
    _print_path(path, "in maps from the posterior" if learned.samples is not None else "if cells were independent")
    _print_doubts(path, max_risk)
    print_lines(f"path in {out}")


def _summary(path: "PlannedPath") -> dict[str, Any]:
    """Return what summary.json says of a path."""
    return {
        "moves": len(path.states) - 1,
        "length_metres": path.length,
        "max_probability_blocked": float(path.blocked.max()),
        "open_probability": path.open_probability,
        "goal_probability_blocked": path.goal_blocked,
        "expected_length_metres": path.expected_length,
        "alternatives": [
            {"length_metres": other.length, "open_probability": other.open_probability} for other in path.alternatives
        ],
    }


def _print_path(path: "PlannedPath", joint: str) -> None:
    """Print the length and the risk of a path and its alternatives; `joint` says where its cells are open together."""
    from sidestep.cli.display import print_lines

    moves, likeliest = len(path.states) - 1, float(path.blocked.max())
    print_lines(f"{moves} moves, {path.length:g} m; the likeliest obstacle on the way has P(blocked) = {likeliest:.3f}")
    print_lines(f"open with probability {path.open_probability:.3f} {joint}, given that start and goal are free")
    if path.expected_length is not None:
        print_lines(f"expected length with bumps and detours: {path.expected_length:.4g} m")
    for other in path.alternatives:
        print_lines(f"alternative: {other.length:g} m, open with probability {other.open_probability:.3f}")


def _print_doubts(path: "PlannedPath", max_risk: float | None) -> None:
    """Print a note of a goal that may be blocked, and a warning of a risk above the one that is allowed."""
    from sidestep.cli.display import print_notes

    if path.goal_blocked > (_DOUBTFUL if max_risk is None else max_risk):
        print_notes(
            f"note: the goal itself is blocked with probability {path.goal_blocked:.2g}; this is not counted above"
        )
    if max_risk is not None and not path.within(max_risk):
        risk = 1 - path.open_probability
        print_notes(f"warning: no path has a risk of at most {max_risk:g}; this one has the least, {risk:.2g}")
