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
    """Score a learned map: AUC, average precision, recall, and the legality and length of planned paths."""
    from sidestep.cli.display import print_notes, print_scores, stage_progress
    from sidestep.evaluation.evaluate import sample_sizes
    from sidestep.io.maps import read_map_like
    from sidestep.maps.learned_map import add_to_summary, load_map

    with stage_progress() as callback:
        learned = load_map(folder)
        truth = read_map_like(true_map, learned.grid)
        scores = learned.evaluate(truth, seed=seed, bump_cost=bump_cost, callback=callback).to_dict()
    limits = {"planned_at_most": sample_sizes(truth.size)._asdict(), "bump_cost": bump_cost}
    add_to_summary(folder, out or folder, None, {"true_map": str(true_map), **limits, **scores})
    print_scores({str(folder): scores})
    if scores["auc"] is None:
        content = f"no obstacle or no free cell to score, and {(truth.known == -1).sum()} unknown cells"
        print_notes(f"note: there is no ranking, because the true map has {content}")
