"""Behavior-aware modeling beside its rivals: walls, people's actions, and robots with goals that nobody had.

    python benchmarks/rivals.py offices
    python benchmarks/rivals.py tartarus --behavior auto
    python benchmarks/rivals.py tartarus --walks 10 --methods behavior visits --json rivals.json

`offices` are drawn by seed, with simulated walkers who go the best ways, ties at random, between eight places; robots
are to reach 24 others. `tartarus` are the mazes of `real_people.py`, whose people all have one goal; robots are to
reach twelve other cells. Of the walks N are learned from, but at most four fifths. Others, at most a hundred, tell how
probable the actions are that each method expects (nats a move).

Robots set out from every free cell and plan by what each method has learned (`sidestep.robots.robot`; who knows
nothing but
costs pursues these). `legal` is the share of planned paths that bump into nothing, `regret` by how many cells robots go
farther than they had to, bumps and ways around included, and `arriving` the share of those who ever arrive; the regret
is a mean over the worlds in which all do, held-out nats over those in which values are found for all held-out goals.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import measuring
from real_people import DATA, Maze, read_maze
from settings import add_set_option, changed, described
from sidestep._files import write_json
from sidestep.cli.compare import METHODS
from sidestep.cli.simulate import Walkers, walk
from sidestep.errors import ImproperTask, InputError, NotConverged
from sidestep.evaluation.evaluate import evaluate
from sidestep.evaluation.study import mean_log_likelihood
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.gridding import grid_walks
from sidestep.io.trajectories import walks_from_trajectories
from sidestep.io.walks import Walks
from sidestep.maps.config import Settings
from sidestep.maps.selection import choose_behavior
from sidestep.tabular.grid import Cell, Grid
from sidestep.worlds.offices import office, places

ROWS, COLUMNS = 14, 24
PLACES, NEW_PLACES, NEW_CELLS = 8, 24, 12
HELD_OUT = 100
FIRST = 200
"""The first office: robots' costs of bumps (`sidestep.robots.robot`) were chosen on offices of lower seeds."""
OWN = ("sample", "seed", "unknown")
SCORES = {
    "average_precision": "average\nprecision",
    "auc": "AUC",
    "heldout_log_likelihood": "held-out\nnats a move",
    "legal_fraction": "legal",
    "regret": "regret",
    "arriving_fraction": "arriving",
}


@dataclass(frozen=True, eq=False)
class Problem:
    """Walks to learn from, others to be predicted, and goals that nobody had."""

    name: str
    truth: Grid
    walks: Walks
    others: Walks
    goals: Int[np.ndarray, " goals"]


def offices(counts: Sequence[int], seeds: Sequence[int]) -> Iterator[tuple[int, Problem]]:
    """One office for each seed; with each number of walks."""
    for seed in seeds:
        truth = office(ROWS, COLUMNS, seed)
        for count in counts:
            trajectories, goals = walk(truth, Walkers(walks=count + HELD_OUT, goals=PLACES, seed=seed))
            walks = walks_from_trajectories(trajectories, goals, truth)
            drawn = np.random.default_rng(seed).permutation(len(walks))
            elsewhere = places(truth, NEW_PLACES + len(goals), seed + 1)
            new = elsewhere[~np.isin(elsewhere, goals)][:NEW_PLACES]
            yield count, Problem(f"office {seed}", truth, *_split(walks, drawn, count), new)


def mazes(read: Sequence[Maze], counts: Sequence[int], seeds: int) -> Iterator[tuple[int, Problem]]:
    """Each maze with each number of walks, drawn by each seed."""
    for maze in read:
        free = np.flatnonzero(maze.truth.known == Cell.FREE)
        for count in counts:
            for seed in range(seeds):
                random = np.random.default_rng(seed)
                drawn = random.permutation(len(maze.walks))
                own = min(count, len(maze.walks) * 4 // 5)
                goals = np.sort(random.choice(free, NEW_CELLS, replace=False))
                yield count, Problem(maze.name, maze.truth, *_split(maze.walks, drawn, own), goals)


def _split(walks: Walks, drawn: Int[np.ndarray, " walks"], count: int) -> tuple[Walks, Walks]:
    return walks.select(np.sort(drawn[:count])), walks.select(np.sort(drawn[count : count + HELD_OUT]))


def score(problem: Problem, settings: Settings, auto: bool, methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The scores of each method."""
    blank = problem.truth.forget()
    if auto:
        settings = choose_behavior(blank, grid_walks(problem.walks, blank), settings).settings
    own, others = (
        demonstrations_from_walks(walks, blank, discount=settings.discount, step_cost=settings.step_cost)
        for walks in (problem.walks, problem.others)
    )
    everywhere = np.ones(blank.shape, dtype=bool)
    scores: dict[str, dict[str, Any]] = {}
    for name in methods:
        try:
            learned = METHODS[name](blank, own, settings)
            found = evaluate(
                learned.planner,
                learned.ranking,
                problem.truth,
                everywhere,
                own.visited_state_goals(),
                goals=problem.goals,
            )
        except (ImproperTask, NotConverged) as error:
            Console(stderr=True).print(f"{problem.name}, {name}: {error}")
            continue
        if not learned.converged:
            Console(stderr=True).print(f"{problem.name}, {name}: did not converge")
        scores[name] = {
            key: {**found.to_dict(), "heldout_log_likelihood": mean_log_likelihood(learned, others)}[key]
            for key in SCORES
        }
    return scores


def mean(records: Sequence[dict[str, Any]], method: str, key: str) -> float | None:
    """The mean over problems of those that have the score; None where none has."""
    values = [record["methods"][method][key] for record in records if method in record["methods"]]
    values = [value for value in values if value is not None]
    return float(np.mean(values)) if values else None


def summarise(records: Sequence[dict[str, Any]], methods: Sequence[str]) -> list[dict[str, Any]]:
    """A row for every number of walks and method."""
    rows = []
    for count in dict.fromkeys(record["walks"] for record in records):
        own = [record for record in records if record["walks"] == count]
        for method in methods:
            rows.append({"walks": count, "method": method, **{key: mean(own, method, key) for key in SCORES}})
    return rows


def print_summary(rows: Sequence[dict[str, Any]], title: str) -> None:
    """The table."""
    table = Table(title=title)
    table.add_column("walks", justify="right")
    table.add_column("method")
    for name in SCORES.values():
        table.add_column(name, justify="right")
    for row in rows:
        values = ("–" if row[key] is None else f"{row[key]:.3f}" for key in SCORES)
        table.add_row(str(row["walks"]), row["method"], *values)
    Console().print(table)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Behavior-aware modeling beside its rivals.")
    parser.add_argument("worlds", choices=("offices", "tartarus"))
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="maze_*/ with walks and maps")
    parser.add_argument("--walks", type=int, nargs="+", metavar="N", help="how many are learned from")
    parser.add_argument("--seeds", type=int, help="how many offices, or draws of each maze")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS), metavar="NAME")
    parser.add_argument("--behavior", choices=("given", "auto"), default="given", help="as for `sidestep learn`")
    parser.add_argument(
        "--first", type=int, default=FIRST, metavar="SEED", help="the first office's (default %(default)s)"
    )
    add_set_option(parser, Settings, OWN)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the means and every record")
    parser.add_argument("--quick", action="store_true", help="one office of 20 walks, or every fourth maze of 10")
    arguments = parser.parse_args()
    in_offices = arguments.worlds == "offices"
    arguments.walks = arguments.walks or ([20, 40, 160] if in_offices else [10, 40])
    arguments.seeds = arguments.seeds or (6 if in_offices else 1)
    if min(*arguments.walks, arguments.seeds) < 1:
        parser.error("--walks and --seeds: expected numbers above 0")
    if arguments.first < 0:
        parser.error("--first: expected a number of at least 0")
    if arguments.quick:
        arguments.walks, arguments.seeds = arguments.walks[:1], 1
    return arguments


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes what the arguments ask for."""
    chosen = changed(Settings(), arguments.set, OWN)
    if arguments.worlds == "offices":
        problems = list(offices(arguments.walks, range(arguments.first, arguments.first + arguments.seeds)))
    else:
        folders = sorted(arguments.data.glob("maze_*"))[:: 4 if arguments.quick else 1]
        if not folders:
            raise InputError("expected folders maze_01, maze_02, …", source=arguments.data)
        problems = list(
            mazes([read_maze(folder, "humans", chosen) for folder in folders], arguments.walks, arguments.seeds)
        )
    records = []
    with Progress(console=Console(stderr=True), transient=True) as bar:
        for count, problem in bar.track(problems, description="learning and planning"):
            scores = score(problem, chosen, arguments.behavior == "auto", arguments.methods)
            records.append({"world": problem.name, "walks": count, "methods": scores})
            if arguments.json:
                write_json(arguments.json, {"settings": asdict(chosen), "records": records})
    rows = summarise(records, arguments.methods)
    print_summary(rows, f"{arguments.worlds}, behavior {arguments.behavior}, {described(chosen)}")
    if arguments.json:
        write_json(arguments.json, {"settings": asdict(chosen), "means": rows, "records": records})


if __name__ == "__main__":
    sys.exit(measuring.main(run, _arguments()))
