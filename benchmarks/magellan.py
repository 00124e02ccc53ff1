"""Buildings that nobody drove into are learned from the drives of people with a virtual taxi.

    python benchmarks/magellan.py --picture magellan.png
    python benchmarks/magellan.py --set beta=1 prior_mean=-1.5
    python benchmarks/magellan.py --drives 14 56 --json magellan.json

Manning et al. (2014): four towns of 6×6 blocks, one of them a store at a time to which a passenger wants to go. Drives
are positions every half second, in blocks; they are gridded at a tenth of a block (8-connected) on a map of which the
learner is told nothing, and all cells are scored against the truth, the squares on which buildings stand. Beside
P(blocked) are the ranking of cells by how rarely the same drives visit them, and P(blocked) by the transitions alone,
which is what one learns without asking why people drove as they did.

N drives are drawn by seed without replacement (all of them, once, where there are no more). Scores are averaged over
the seeds of a town, then over towns. `into buildings` counts moves that end in a cell that the truth holds for
building, all towns and draws together: where positions are rounded to cells, or the truth to squares, there may be
some, and the learner has to live with them.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from measuring import argument_parser, complain, main, note, number, print_table, write_records
from real_people import SCORES, Maze, draws
from settings import add_set_option, changed, described
from sidestep.errors import InputError
from sidestep.evaluation.metrics import score_map, visit_ranking
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.maps import read_map
from sidestep.io.walks import Walks, read_walks
from sidestep.maps.config import Settings, fit_map
from sidestep.plotting.maps import Panel, figure_learned, save
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell
from sidestep.tabular.models import ObstacleGrid

DATA = Path(__file__).parents[2] / "shared" / "data" / "magellan"
DRIVERS = Settings(
    beta=0.3,
    discount=1.0,
    step_cost=1.0,
    prior_mean=-2.0,
    prior_variance=2.0,
    lines=0.0,
    connectivity=8,
)
"""Drives are long, so a step costs rather than the goal pays; the prior is the paper's, for buildings are no lines."""
OWN = ("sample", "seed", "unknown", "terms")
"""Settings that are this script's own business."""
METHODS = ("learned", "visits", "transitions")


def read_town(folder: Path, settings: Settings) -> Maze:
    """The town in a folder; raises `InputError` for missing files and those that are none."""
    return Maze(
        folder.name,
        read_map(folder / "blank.yaml", connectivity=settings.connectivity),
        read_map(folder / "truth.yaml", connectivity=settings.connectivity),
        read_walks(folder / "drives.csv"),
    )


def score(town: Maze, drives: Walks, settings: Settings) -> dict[str, Any]:
    """The record of some drives: the scores of each of `METHODS`, how the fit went, and P(blocked)."""
    demos = demonstrations_from_walks(drives, town.blank, discount=settings.discount, step_cost=settings.step_cost)
    model = ObstacleGrid(town.blank, settings.prior_mean)
    started = time.perf_counter()
    found = fit_map(model, demos, settings)
    seconds = time.perf_counter() - started
    without = fit_map(model, demos, replace(settings, terms="transitions"))
    rankings = {
        "learned": np.asarray(found.model.blocked, dtype=np.float64),
        "visits": visit_ranking(np.concatenate(demos.paths()), town.blank),
        "transitions": np.asarray(without.model.blocked, dtype=np.float64),
    }
    visited = demos.visited_state_goals()
    relevant = relevant_obstacles(town.truth, visited[:, 0], visited[:, 1])
    everywhere = np.ones(town.truth.shape, dtype=bool)
    scores = {name: asdict(score_map(ranks, town.truth, everywhere, relevant)) for name, ranks in rankings.items()}
    return {
        **{name: {key: scores[name][key] for key in SCORES} for name in METHODS},
        "moves": len(demos),
        "into_buildings": into_buildings(demos, town),
        "iterations": found.final.iteration,
        "converged": found.converged and without.converged,
        "seconds": round(seconds, 3),
        "blocked": rankings["learned"].tolist(),
    }


def into_buildings(demos: Demonstrations, town: Maze) -> int:
    """How many moves end in a cell that the truth holds for building."""
    return int((town.truth.known.reshape(-1)[np.asarray(demos.next_states)] == Cell.OCCUPIED).sum())


def measure(towns: Sequence[Maze], counts: Sequence[int], seeds: int, settings: Settings) -> list[dict[str, Any]]:
    """One record for every number of drives, town and seed."""
    records = []
    for count in counts:
        for town in towns:
            for seed, drives in draws(town, count, seeds):
                label = {"town": town.name, "drives": count, "drives_found": len(drives), "seed": seed}
                records.append({**label, **score(town, drives, settings)})
                learned, seconds = records[-1]["learned"]["auc"], records[-1]["seconds"]
                note(f"{town.name}, {len(drives)} drives, draw {seed}: AUC {number(learned, '.3f')}, {seconds:.0f} s")
    return records


def summarise(records: Sequence[dict[str, Any]], counts: Sequence[int]) -> list[dict[str, Any]]:
    """For every number of drives, mean scores over towns, each the mean over its seeds; None where there are none."""
    rows = []
    for count in counts:
        own = [record for record in records if record["drives"] == count]
        row: dict[str, Any] = {"drives": count, "converged": all(record["converged"] for record in own)}
        row["moves"] = float(np.mean([record["moves"] for record in own]))
        row["into_buildings"] = sum(record["into_buildings"] for record in own)
        for method in METHODS:
            row[method] = {key: _mean_over_towns(own, method, key) for key in SCORES}
        rows.append(row)
    return rows


def _mean_over_towns(records: Sequence[dict[str, Any]], method: str, key: str) -> float | None:
    by_town: dict[str, list[float]] = {}
    for record in records:
        if (value := record[method][key]) is not None:
            by_town.setdefault(record["town"], []).append(value)
    return float(np.mean([np.mean(values) for values in by_town.values()])) if by_town else None


def print_summary(rows: Sequence[dict[str, Any]], title: str) -> None:
    """The table: a line for each number of drives and method."""
    lines = [
        [str(row["drives"]), number(row["moves"], ".0f"), str(row["into_buildings"]), method]
        + [number(row[method][key], ".3f") for key in SCORES[:2]]
        for row in rows
        for method in METHODS
    ]
    columns = ["drives", "moves", "into buildings", "ranked by", "AUC", "average precision"]
    print_table(title, columns, lines, left=("ranked by",))


def figure(town: Maze, record: dict[str, Any]) -> Figure:
    """The drives of a record in the true town, and P(blocked) as learned from them with the buildings outlined."""
    drives = dict(draws(town, record["drives"], record["seed"] + 1))[record["seed"]]
    goals = np.unique(drives.goals, axis=0)
    known = Panel(f"{town.name}: {len(drives)} drives", town.truth, paths=list(drives), goals=goals)
    learned = Panel("learned from them", town.blank, blocked=np.asarray(record["blocked"]), truth=town.truth)
    picture = figure_learned([known, learned])
    for axes in picture.axes[:2]:
        axes.set(xlabel="x (blocks)", ylabel="y (blocks)")
    # no cell is surely blocked: the scale ends where the most probable one is
    picture.axes[1].images[0].set_clim(0.0, max(map(max, record["blocked"])))
    return picture


def _arguments() -> argparse.Namespace:
    parser = argument_parser("Buildings learned from people's drives, against the truth.", "one town, 14 drives")
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="town_*/ with drives and maps")
    parser.add_argument("--drives", type=int, nargs="+", default=[14, 56], metavar="N", help="how many to draw")
    parser.add_argument("--seeds", type=int, default=3, help="how many draws")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the first town, with the most drives")
    add_set_option(parser, Settings, OWN)
    arguments = parser.parse_args()
    if min(*arguments.drives, arguments.seeds) < 1:
        parser.error("--drives and --seeds: expected numbers above 0")
    if arguments.quick:
        arguments.drives, arguments.seeds = [14], 1
    return arguments


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints, draws and writes what the arguments ask for."""
    settings = changed(DRIVERS, arguments.set, OWN)
    folders = sorted(arguments.data.glob("town_*"))[: 1 if arguments.quick else None]
    if not folders:
        raise InputError("expected folders town_A, town_B, …; give the right folder with --data", source=arguments.data)
    towns = [read_town(folder, settings) for folder in folders]
    records = measure(towns, arguments.drives, arguments.seeds, settings)
    rows = summarise(records, arguments.drives)
    print_summary(rows, f"{len(towns)} towns, {described(settings)}")
    if not all(record["converged"] for record in records):
        complain("some fits have not converged; see the records")
    if arguments.picture:
        drawn = [record for record in records if record["town"] == towns[0].name]
        save(figure(towns[0], max(drawn, key=lambda record: record["drives_found"])), arguments.picture)
    write_records(arguments, records, learner=asdict(settings), means=rows)


if __name__ == "__main__":
    sys.exit(main(run, _arguments()))
