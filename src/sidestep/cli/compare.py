"""`sidestep compare`: behavior-aware modeling beside its baselines, on the same walks and by the same scores."""

from typing import Annotated

import typer

from sidestep.cli.options import Folder, LearnOptions, MapFile, TrueMap, Walks, with_learn_options

_CELL_SCORES = "auc", "average_precision", "average_precision_relevant"
_COLUMNS = *_CELL_SCORES, "legal_fraction", "regret", "arriving_fraction", "heldout_log_likelihood", "seconds"


@with_learn_options
def compare(
    walks: Walks,
    map_file: MapFile,
    true_map: TrueMap,
    out: Folder,
    options: LearnOptions,
    hold_out: Annotated[
        float, typer.Option(help="The fraction of walks that are scored and not learned from; may be 0.")
    ] = 0.2,
) -> None:
    """Compare behavior-aware modeling with its baselines: compare.png, summary.json, the learned map in behavior/."""
    from sidestep._files import write_json
    from sidestep.baselines.comparison import compare_methods
    from sidestep.cli.display import print_lines, print_notes, print_scores, working
    from sidestep.cli.learn import save_learned
    from sidestep.io.maps import read_map_like
    from sidestep.io.walks import read_walks
    from sidestep.plotting.comparison import figure_comparison
    from sidestep.plotting.maps import save

    files = {"walks": str(walks), "map": str(map_file), "true_map": str(true_map)}
    grid, checkpoint = options.grid(map_file), out / "fit.checkpoint"
    truth = read_map_like(true_map, grid)
    with working("starting") as notify:
        table, inputs = read_walks(walks), options.more_inputs(grid, checkpoint)
        comparison = compare_methods(grid, truth, table, options.config(), hold_out=hold_out, notify=notify, **inputs)
        save(figure_comparison(comparison), out / "compare.png")
        if comparison.learned is not None:
            save_learned(comparison.learned, out / "behavior", command="learn", files=files)
        write_json(out / "summary.json", {"command": "compare", "files": files, **comparison.summary()})
    checkpoint.unlink(missing_ok=True)
    rows = comparison.method_scores()
    print_scores(rows, _COLUMNS)
    for name, scores in rows.items():
        if scores["failure"] is not None:
            print_notes(f"note: {name} failed: {scores['failure']}")
        elif not scores["converged"]:
            print_notes(f"note: {name} did not converge; its scores are those of where it stopped")
    print_lines(f"picture and numbers in {out}")
