"""`sidestep evaluate`: a learned map against the true map."""

from pathlib import Path
from typing import Annotated

from typer import Option

from sidestep.cli.options import BUMP_COST, BumpCost, LearnedFolder, Seed, TrueMap


def evaluate(
    folder: LearnedFolder,
    true_map: TrueMap,
    out: Annotated[Path | None, Option("--out", help="The folder to write to (DIR itself).", metavar="DIR")] = None,
    seed: Seed = 0,
    bump_cost: BumpCost = BUMP_COST,
) -> None:
    """Score a learned map's cells, calibration and planned paths: scores in summary.json, and reliability.png."""
    from sidestep.cli.display import print_lines, print_notes, print_scores, stage_progress
    from sidestep.cli.drawing import draw
    from sidestep.evaluation.evaluate import sample_sizes
    from sidestep.evaluation.reliability import map_reliability
    from sidestep.io.maps import read_map_like
    from sidestep.maps.learned_map import add_to_summary, load_map

    out = out or folder
    with stage_progress() as callback:
        learned = load_map(folder)
        truth = read_map_like(true_map, learned.grid)
        bins, picture = map_reliability(learned.blocked, truth, learned.unknown), None
        if bins is not None:
            title = f"P(blocked) of {bins.cells.sum()} cells"
            picture = draw("figure_reliability", out / "reliability.png", {title: bins}, module="reliability")
        scores = learned.evaluate(truth, seed=seed, bump_cost=bump_cost, callback=callback).to_dict()
    limits = {"planned_at_most": sample_sizes(truth.size)._asdict(), "bump_cost": bump_cost}
    add_to_summary(folder, out, None, {"true_map": str(true_map), **limits, **scores})
    print_scores({str(folder): scores})
    if scores["auc"] is None:
        content = f"no obstacle or no free cell to score, and {(truth.known == -1).sum()} unknown cells"
        print_notes(f"note: there is no ranking, because the true map has {content}")
    if picture is not None:
        picture.result()
        print_lines(f"reliability diagram and numbers in {out}")
