"""How well walls are learned from the walks of real people (or rats), which nobody bumped into.

    python -m benchmarks people --set beta=5 log_odds=-3
    python -m benchmarks people --set prior.kind=normal prior.mean=-2
    python -m benchmarks people --animal rats --trials 1 4 --json rats.json

Tartarus (de Cothi et al. 2022): twelve mazes of 10×10 cells, all unknown to the learner. People and rats learn the
layout over trials 1–10, so trials 5–10 are the purposeful ones (`--trials 1 4`: the others). Of these, N walks are
drawn by seed without replacement (all of them where there are no more), a map is learned with the defaults of
`sidestep learn`, and all cells are scored against the true map, beside the ranking of cells by how rarely the same
walks visit them. Scores are averaged over the draws of a maze, then over mazes. A maze has few cells in each bin, and
so a calibration error of some hundredths by chance; `pooled` is the error of the cells of all mazes of a draw together,
averaged over draws. The picture has a reliability diagram for each number of walks.

Records: `problem`, `walks` (asked for), `drawn`, `draw`, `method`, the scores of `sidestep.evaluation` (for all cells,
and for relevant obstacles: those that a walk had to avoid), `reliability` (the bins of the calibration error, None
where there is none), `seconds`, `converged`, `failure`, `moves`, `iterations`, `objective`, `largest_gradient`,
`message`, and the fields of the configuration.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import SHARED_DATA, Record, changed, described, flat, groups, mean_over, note, option, print_table, warn
from sidestep.baselines import BASELINES
from sidestep.baselines.interface import ModelResult, model_result
from sidestep.errors import InputError
from sidestep.evaluation.reliability import Reliability
from sidestep.evaluation.study import Problem, run_method
from sidestep.io.gridding import grid_walks
from sidestep.io.maps import read_map
from sidestep.io.walks import Walks, read_walks
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import demonstrations_of
from sidestep.maps.learn import learn_map
from sidestep.plotting.reliability import figure_reliability
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Connectivity, Grid

METHODS = ("behavior", *BASELINES)
POOLED = "pooled_calibration_error"
CALIBRATION = {"calibration error": "calibration_error .3f", "pooled": f"{POOLED} .3f"}
CALIBRATION |= {"Brier": "brier_score .3f", "log loss": "log_loss .3f"}
CELLS = {"AUC": "auc .3f", "average precision": "average_precision .3f", **CALIBRATION}
RELEVANT = {"AUC of relevant": "auc_relevant .3f", "average precision of relevant": "average_precision_relevant .3f"}


@dataclass
class Options:
    """The options of this benchmark."""

    data: Path = option(SHARED_DATA / "tartarus", "maze_*/ with walks and maps")
    walks: list[int] = option([10, 40, 150], "how many to draw", quick=[10])
    seeds: int = option(3, "how many draws", quick=1)
    animal: str = option("humans", "who walked", choices=("humans", "rats"))
    trials: list[int] = option([5, 10], "the first and the last trial")
    every: int = option(1, "learn every n-th maze only", quick=4)
    set: list[str] = option([], f"FIELD=VALUE, of {', '.join(flat(MapConfig()))}")


@dataclass(frozen=True, eq=False)
class Maze:
    """A map, what the learner knows of it, and walks in it."""

    name: str
    blank: Grid
    truth: Grid
    walks: Walks


def read_mazes(folder: Path, pattern: str, walks: str, connectivity: Connectivity = 4, every: int = 1) -> list[Maze]:
    """Return the mazes in the folders of a name; raises `InputError` for missing files and for none."""
    folders = sorted(folder.glob(pattern))[::every]
    if not folders:
        raise InputError(f"expected folders {pattern}; name the right folder with --data", source=folder)
    return [
        Maze(
            own.name,
            read_map(own / "blank.yaml", connectivity=connectivity),
            read_map(own / "truth.yaml", connectivity=connectivity),
            read_walks(own / walks),
        )
        for own in folders
    ]


def in_trials(maze: Maze, first: int, last: int) -> Maze:
    """Return the maze with the walks of some trials; raises `InputError` for walks without numbers of trials."""
    trial = np.asarray(maze.walks.per_walk("trial"))
    return replace(maze, walks=maze.walks.select((trial >= first) & (trial <= last)))


def draws(walks: Walks, count: int, seeds: int) -> Iterator[tuple[int, Walks]]:
    """Yield `count` walks for each seed; all walks, once, where there are no more."""
    if count >= len(walks):
        yield 0, walks
        return
    for seed in range(seeds):
        drawn = np.random.default_rng(seed).choice(len(walks), count, replace=False)
        yield seed, walks.select(np.sort(drawn))


def learn_by(
    methods: Sequence[str],
    maze: Maze,
    config: MapConfig,
    others: Walks | None = None,
    goals: np.ndarray | None = None,
    paths: bool = False,
) -> Iterator[tuple[Record, Any, Demonstrations]]:
    """Yield, for each method that learns from the walks of a maze, the record, its result and the demonstrations.

    Args:
        methods: Names in `METHODS`.
        maze: The maze, with the walks to learn from.
        config: The configuration.
        others: Held-out walks, to be predicted.
        goals: The goals of robots (states), where they are not all free cells.
        paths: Whether robots plan and walk.
    """
    moves = grid_walks(maze.walks, maze.blank)
    demonstrations = demonstrations_of(moves, maze.blank, config)
    heldout = None if others is None else demonstrations_of(grid_walks(others, maze.blank), maze.blank, config)
    problem, fitted = Problem(maze.name, maze.blank, maze.truth, demonstrations, heldout, goals), {}

    def behavior(grid: Grid, demonstrations: Demonstrations) -> ModelResult:
        learned = learn_map(grid, maze.walks, config)
        assert learned.learning is not None
        fit = learned.learning.fit
        summary = fit.summary()
        fitted.update({key: summary.get(key) for key in ("iterations", "objective", "largest_gradient", "message")})
        result = model_result(learned.model, demonstrations, config)
        return result._replace(behavior=fit.behavior.behavior_of(), converged=fit.converged, planner=learned.robot())

    for name in methods:
        fitted.clear()
        learn = behavior if name == "behavior" else lambda grid, demos, name=name: BASELINES[name](grid, demos, config)
        record = run_method(problem, name, learn, paths=paths)
        if not record.converged:
            warn(f"{maze.name}, {name}: {record.failure or 'did not converge'}")
        seconds = "failed" if record.seconds is None else f"{record.seconds:.0f} s"
        note(f"{maze.name}, {len(maze.walks)} walks, {name}: {seconds}")
        bins = None if record.reliability is None else record.reliability.to_dict()
        numbers = {"reliability": bins, "moves": len(demonstrations), **fitted, **flat(config)}
        yield {**record.to_dict(), **numbers}, record.result, demonstrations


def means(records: Sequence[Record], columns: Mapping[str, str], within: str | None) -> Iterator[Record]:
    """Yield a row for each number of walks and method, with the means of the columns."""
    for label, own in groups(records, "walks", "method"):
        keys = [column.partition(" ")[0] for column in columns.values()]
        yield {**label, **{key: pooled_error(own) if key == POOLED else mean_over(own, key, within) for key in keys}}


def pooled_error(records: Sequence[Record]) -> float | None:
    """Return the calibration error of the cells of all problems of a draw, a mean over draws; None without bins.

    A problem with a single draw, such as all of its walks, belongs to every draw.
    """
    errors = []
    for draw in dict.fromkeys(record["draw"] for record in records):
        drawn = [one for _, own in groups(records, "problem") for one in own if len(own) == 1 or one["draw"] == draw]
        errors.append({POOLED: pooled.calibration_error if (pooled := pool(drawn)) else None})
    return mean_over(errors, POOLED)


def pool(records: Sequence[Record]) -> Reliability | None:
    """Return the reliability of the cells of all records together; None if none has any."""
    bins = [record["reliability"] for record in records if record["reliability"] is not None]
    parts = (Reliability(**{name: np.asarray(sums) for name, sums in each.items()}) for each in bins)
    return reduce(add, parts) if bins else None


def reliability_figure(records: Sequence[Record]) -> Figure:
    """Return the reliability diagrams of `behavior`: for each number of walks, of all cells and draws together."""
    behavior = [record for record in records if record["method"] == "behavior"]
    pooled = {f"{label['walks']} walks": pool(own) for label, own in groups(behavior, "walks")}
    return figure_reliability({name: bins for name, bins in pooled.items() if bins is not None})


def show_means(records: Sequence[Record], title: str, columns: Mapping[str, str], within: str | None) -> None:
    """Print these means."""
    rows = list(means(records, columns, within))
    print_table(title, rows, {"walks": "walks", "method": "method", **columns})


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each maze, number of walks, draw and method."""
    config = changed(MapConfig(), options.set)
    for maze in read_mazes(options.data, "maze_*", f"{options.animal}.csv", every=options.every):
        purposeful = in_trials(maze, options.trials[0], options.trials[-1])
        for count in options.walks:
            for draw, walks in draws(purposeful.walks, count, options.seeds):
                for record, *_ in learn_by(("behavior", "visits"), replace(maze, walks=walks), config):
                    yield {"walks": count, "drawn": len(walks), "draw": draw, **record}


def show(records: Sequence[Record], options: Options) -> None:
    """Print the mean scores."""
    first, last = options.trials[0], options.trials[-1]
    title = f"{options.animal}, trials {first}–{last}, {described(changed(MapConfig(), options.set))}"
    show_means(records, title, CELLS | RELEVANT, within="problem")


def draw(records: Sequence[Record], options: object = None) -> Figure:
    """Return the reliability diagrams."""
    del options
    return reliability_figure(records)
