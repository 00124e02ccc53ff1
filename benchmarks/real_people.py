"""How well walls that nobody bumped into are learned from the walks of real people (or rats).

    python benchmarks/real_people.py
    python benchmarks/real_people.py --set beta=5 prior_mean=-2
    python benchmarks/real_people.py --behavior auto
    python benchmarks/real_people.py --animal rats --trials 1 4 --json rats.json

Tartarus (de Cothi et al. 2022): twelve mazes of 10×10 cells of which the learner is told nothing. The layout is learned
over trials 1–10, so trials 5–10 are the purposeful ones (`--trials 1 4`: the others). Of these, N walks are drawn by
seed without replacement (all of them where there are no more), a map is learned with the defaults of `sidestep learn`,
and all cells are scored against the truth, beside the ranking of cells by how rarely the same walks visit them. Scores
are averaged over the seeds of a maze, then over mazes.
"""

import argparse
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import measuring
from settings import add_set_option, changed, described
from sidestep._files import write_json
from sidestep.errors import InputError
from sidestep.evaluation.metrics import score_map, visit_ranking
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.gridding import grid_walks
from sidestep.io.maps import read_map
from sidestep.io.walks import Walks, read_walks
from sidestep.maps.config import Settings, fit_map
from sidestep.maps.selection import choose_behavior
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid

DATA = Path(__file__).parents[2] / "shared" / "data" / "tartarus"
TRIALS = (5, 10)
OWN = ("sample", "seed", "unknown")
"""Settings that are this script's own business: how many walks are drawn, and what `--behavior` learns of people."""
SCORES = ("auc", "average_precision", "auc_relevant", "average_precision_relevant")


@dataclass(frozen=True)
class Maze:
    """A maze, what the learner is told of it, and walks in it."""

    name: str
    blank: Grid
    truth: Grid
    walks: Walks


def read_maze(folder: Path, animal: str, settings: Settings, trials: Sequence[int] = TRIALS) -> Maze:
    """The maze in a folder, with the walks from the first to the last of some trials.

    Raises `InputError` for missing files and walks without numbers of trials.
    """
    source = folder / f"{animal}.csv"
    walks = read_walks(source)
    trial = np.asarray(walks.per_walk("trial"))
    first, last = trials
    return Maze(
        folder.name,
        read_map(folder / "blank.yaml", connectivity=settings.connectivity),
        read_map(folder / "truth.yaml", connectivity=settings.connectivity),
        walks.select((trial >= first) & (trial <= last)),
    )


def draws(maze: Maze, count: int, seeds: int) -> Iterator[tuple[int, Walks]]:
    """`count` walks for each seed; all walks, once, where there are no more."""
    if count >= len(maze.walks):
        yield 0, maze.walks
        return
    for seed in range(seeds):
        drawn = np.random.default_rng(seed).choice(len(maze.walks), count, replace=False)
        yield seed, maze.walks.select(np.sort(drawn))


def score(maze: Maze, walks: Walks, settings: Settings, auto: bool) -> dict[str, Any]:
    """The scores of the map learned from some walks, and of the ranking by visits."""
    started = time.perf_counter()
    if auto:
        settings = choose_behavior(maze.blank, grid_walks(walks, maze.blank), settings).settings
    demos = demonstrations_from_walks(walks, maze.blank, discount=settings.discount, step_cost=settings.step_cost)
    found = fit_map(ObstacleGrid(maze.blank, settings.prior_mean), demos, settings)
    seconds = time.perf_counter() - started
    visited = demos.visited_state_goals()
    relevant = relevant_obstacles(maze.truth, visited[:, 0], visited[:, 1])
    rankings = {
        "learned": np.asarray(found.model.blocked, dtype=np.float64),
        "visits": visit_ranking(np.concatenate(demos.paths()), maze.blank),
    }
    everywhere = np.ones(maze.truth.shape, dtype=bool)
    scores = {name: asdict(score_map(ranking, maze.truth, everywhere, relevant)) for name, ranking in rankings.items()}
    return {
        "learned": scores["learned"],
        "visits": {key: scores["visits"][key] for key in SCORES},
        "moves": len(demos),
        "behavior": {name: getattr(settings, name) for name in ("beta", "discount", "step_cost", "tempering")},
        "iterations": found.final.iteration,
        "converged": found.converged,
        "seconds": round(seconds, 3),
    }


def measure(
    mazes: Sequence[Maze], counts: Sequence[int], seeds: int, settings: Settings, auto: bool
) -> list[dict[str, Any]]:
    """One record for every maze, number of walks and seed."""
    work = [(maze, count, *draw) for count in counts for maze in mazes for draw in draws(maze, count, seeds)]
    records = []
    with Progress(console=Console(stderr=True), transient=True) as bar:
        for maze, count, seed, walks in bar.track(work, description="learning"):
            label = {"maze": maze.name, "walks": count, "walks_found": len(walks), "seed": seed}
            records.append({**label, **score(maze, walks, settings, auto)})
    return records


def mean_over_mazes(records: Iterable[dict[str, Any]], method: str, key: str) -> float:
    """The mean of a score over mazes, each the mean over its seeds; NaN where no maze has one."""
    by_maze: dict[str, list[float]] = {}
    for record in records:
        if (value := record[method][key]) is not None:
            by_maze.setdefault(record["maze"], []).append(value)
    return float(np.mean([np.mean(values) for values in by_maze.values()])) if by_maze else float("nan")


def summarise(records: Sequence[dict[str, Any]], counts: Sequence[int]) -> list[dict[str, Any]]:
    """The mean scores for every number of walks."""
    rows = []
    for count in counts:
        own = [record for record in records if record["walks"] == count]
        row: dict[str, Any] = {"walks": count, "converged": all(record["converged"] for record in own)}
        for method in ("learned", "visits"):
            row[method] = {key: mean_over_mazes(own, method, key) for key in SCORES}
        rows.append(row)
    return rows


def print_summary(rows: Sequence[dict[str, Any]], title: str) -> None:
    """The table."""
    table = Table(title=title)
    table.add_column("walks", justify="right")
    for name in ("AUC", "average precision", "AUC of those that matter"):
        for method in ("learned", "visits"):
            table.add_column(f"{name}\n{method}", justify="right")
    for row in rows:
        cells = (row[method][key] for key in SCORES[:3] for method in ("learned", "visits"))
        table.add_row(str(row["walks"]), *(f"{value:.3f}" for value in cells))
    Console().print(table)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Maps learned from real walks, against the truth.")
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="maze_*/ with walks and maps")
    parser.add_argument("--walks", type=int, nargs="+", default=[10, 40, 150], metavar="N", help="how many to draw")
    parser.add_argument("--seeds", type=int, default=3, help="how many draws")
    parser.add_argument("--animal", choices=("humans", "rats"), default="humans")
    parser.add_argument("--trials", type=int, nargs=2, default=list(TRIALS), metavar=("FIRST", "LAST"))
    parser.add_argument("--behavior", choices=("given", "auto"), default="given", help="as for `sidestep learn`")
    add_set_option(parser, Settings, OWN)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the means and every record")
    parser.add_argument("--quick", action="store_true", help="every fourth maze, 10 walks, one draw")
    arguments = parser.parse_args()
    if min(*arguments.walks, arguments.seeds) < 1:
        parser.error("--walks and --seeds: expected numbers above 0")
    if arguments.quick:
        arguments.walks, arguments.seeds = [10], 1
    return arguments


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes what the arguments ask for."""
    chosen = changed(Settings(), arguments.set, OWN)
    folders = sorted(arguments.data.glob("maze_*"))[:: 4 if arguments.quick else 1]
    if not folders:
        raise InputError(
            "expected folders maze_01, maze_02, …; give the right folder with --data", source=arguments.data
        )
    mazes = [read_maze(folder, arguments.animal, chosen, arguments.trials) for folder in folders]
    auto = arguments.behavior == "auto"
    records = measure(mazes, arguments.walks, arguments.seeds, chosen, auto)
    rows = summarise(records, arguments.walks)
    first, last = arguments.trials
    people = f"{arguments.animal}, trials {first}–{last}, behavior {arguments.behavior}"
    print_summary(rows, f"{people}, {len(mazes)} mazes, {described(chosen)}")
    if not all(row["converged"] for row in rows):
        Console(stderr=True).print("warning: some fits have not converged; see the records")
    if arguments.json:
        write_json(arguments.json, {"settings": asdict(chosen), "means": rows, "records": records})


if __name__ == "__main__":
    sys.exit(measuring.main(run, _arguments()))
