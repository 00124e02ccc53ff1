"""`sidestep plan`: a path in a learned map, as CSV and PNG."""

from pathlib import Path
from typing import Annotated

import typer

from sidestep.cli.options import BUMP_COST, BumpCost, LearnedFolder, position_of


def plan(
    folder: LearnedFolder,
    start: Annotated[str, typer.Option(help="In metres.", metavar="X,Y")],
    goal: Annotated[str, typer.Option(help="In metres.", metavar="X,Y")],
    out: Annotated[Path | None, typer.Option("--out", help="The folder to write to (DIR/plan).", metavar="DIR")] = None,
    bump_cost: BumpCost = BUMP_COST,
) -> None:
    """Plan a path in a learned map: path.csv, path.png, summary.json."""
    import numpy as np

    from sidestep.cli.display import print_lines
    from sidestep.cli.drawing import draw
    from sidestep.maps.learned_map import add_to_summary, load_map

    out = out or folder / "plan"
    first, last = position_of(start, "--start"), position_of(goal, "--goal")
    learned = load_map(folder)
    path = learned.plan(first, last, bump_cost=bump_cost)
    picture = draw("figure_plan", out / "path.png", learned.grid, learned.blocked, path.states)
    # imported while the second process draws
    import pyarrow as pa

    from sidestep.io.tables import write_table

    x, y = path.positions.T
    write_table(out / "path.csv", pa.table({"step": np.arange(len(x)), "x": x, "y": y, "blocked": path.blocked}))
    moves, likeliest = len(path.states) - 1, float(path.blocked.max())
    settings = {"command": "plan", "start": first, "goal": last, "bump_cost": bump_cost}
    risk = {"max_probability_blocked": likeliest, "probability_free": float(np.prod(1 - path.blocked))}
    summary = {**settings, "moves": moves, "length_metres": path.length, **risk}
    add_to_summary(folder, out, "plan", summary)
    picture.result()
    print_lines(f"{moves} moves, {path.length:g} m; the likeliest obstacle on the way has P(blocked) = {likeliest:.3f}")
    print_lines(f"path in {out}")
