"""`sidestep learn`: from a map and a table of walks to a learned map."""

from typing import TYPE_CHECKING

from sidestep.cli.options import Folder, LearnOptions, MapFile, Walks, with_learn_options

if TYPE_CHECKING:
    from pathlib import Path

    from sidestep.maps.learned_map import LearnedMap

_SYMBOLS = {"beta": "β", "discount": "γ"}


@with_learn_options
def learn(walks: Walks, map_file: MapFile, out: Folder, options: LearnOptions) -> None:
    """Learn a map from walks: map.yaml, blocked.npy, information.npy, samples.npz, summary.json, learned.png."""
    from sidestep.cli.display import fit_progress, print_lines, print_notes, with_error
    from sidestep.io.walks import read_walks
    from sidestep.maps.fit import max_iterations
    from sidestep.maps.learn import learn_map

    config, grid, checkpoint = options.config(), options.grid(map_file), out / "fit.checkpoint"
    with fit_progress(max_iterations(config.fit)) as callback:
        table, inputs = read_walks(walks), options.more_inputs(grid, checkpoint)
        learned = learn_map(grid, table, config, callback=callback, **inputs)
        save_learned(learned, out, command="learn", files={"walks": str(walks), "map": str(map_file)})
    checkpoint.unlink(missing_ok=True)
    learning = learned.learning
    assert learning is not None
    data = learning.data
    print_lines(f"{data.walks} walks, {data.moves} moves, {data.goals} goals, {data.unknown_cells} unknown cells")
    if data.walks_left_out or data.moves_left_out:
        walks_out, moves_out = data.walks_left_out, data.moves_left_out
        print_lines(f"left out: {walks_out} walks that start at their goal, and {moves_out} moves after the arrival")
    print_notes(*(f"note: {note}" for note in learning.notes))
    print_lines(learning.fit.description)
    for name, number in learning.fit.learned_behavior.items():
        print_lines(f"{_SYMBOLS.get(name, name)} {with_error(*number)}")
    if not learned.converged:
        print_notes(f"warning: {learning.fit.status.value}: {learning.fit.status.advice or learning.fit.message}")
    silent, sources = learned.without_evidence.sum(), "walks and sensors" if learning.sensor else "walks"
    less = f"{sources} say less than {learned.unknown_below:g} nats (hatched)"
    print_lines(f"{silent} of {data.unknown_cells} unknown cells: {less}")
    print_lines(f"learned map in {out}")


def save_learned(learned: "LearnedMap", folder: "Path", **entries: object) -> None:
    """Draw a learned map and write it to a folder, with more entries of `summary.json`."""
    import numpy as np

    from sidestep.cli.drawing import draw
    from sidestep.maps.sensors import seen_cells

    learning = learned.learning
    assert learning is not None
    objective = np.array([progress.objective for progress in learning.fit.history])
    seen = None if learning.sensor is None else seen_cells(learning.sensor, learned.grid.known)
    paths = learning.demonstrations.paths()
    goals = np.flatnonzero(np.asarray(learning.demonstrations.tasks.terminal).any(axis=0))
    silent = learned.without_evidence
    values = learned.grid, paths, learned.blocked, objective, seen, goals, silent
    picture = draw("figure_fit", folder / "learned.png", *values)
    learned.save(folder, **entries)
    picture.result()
