"""Large fits end to end: hide part of a map's walls, simulate walks of people who know them, learn, score.

    python benchmarks/fits.py
    python benchmarks/fits.py --maps ../shared/data/maps/depot.yaml --goals 32 --walks 320
    python benchmarks/fits.py --quick

A share of the wall cells, drawn at random, is hidden from the learner, and as many times `--free` free cells with them:
all of these are unknown to it, the rest of the map is known. Walkers take shortest ways (ties at random) at a step cost
of 1 and no discount. Scored are the unknown cells: how well P(blocked) ranks the hidden walls that matter (those whose
opening alone would have shortened somebody's way) above the free cells, beside the ranking by how rarely they were
visited. `--lines` is what it is worth to a blocked cell, in nats, to lie between two others: walls are lines.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from measuring import argument_parser, main, note, number, peak_bytes, print_table, write_records
from sidestep.cli.simulate import Walkers, walk
from sidestep.evaluation.metrics import score_map, visit_ranking
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.inference.maximize import Progress
from sidestep.io.maps import read_map
from sidestep.maps.config import Settings, fit_map
from sidestep.tabular.demonstrations import Demonstrations, gather
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import reach
from sidestep.worlds.offices import office

MAPS = Path(__file__).parents[2] / "shared" / "data" / "maps"


def hidden(truth: Grid, share: float, free: float, seed: int) -> Grid:
    """The map that a learner is given; what the truth itself does not know is blocked to walkers, and told to be."""
    random = np.random.default_rng(seed)
    known = np.where(truth.known == Cell.FREE, Cell.FREE, Cell.OCCUPIED).astype(np.int64)
    walls = np.flatnonzero(truth.known == Cell.OCCUPIED)
    walls = random.choice(walls, int(share * len(walls)), replace=False)
    others = random.choice(np.flatnonzero(truth.known == Cell.FREE), int(free * len(walls)), replace=False)
    known.flat[walls] = known.flat[others] = Cell.UNKNOWN
    return replace(truth, known=known)


def walks_in(truth: Grid, given: Grid, arguments: argparse.Namespace) -> Demonstrations:
    """Shortest walks of people who know the truth, as the learner sees them."""
    walkers = Walkers(arguments.walks, arguments.goals, discount=1.0, step_cost=1.0, seed=arguments.seed)
    trajectories, goals = walk(truth, walkers)
    return gather(trajectories, [reach(given, goal, discount=1.0, step_cost=1.0) for goal in goals])


def measure(name: str, truth: Grid, arguments: argparse.Namespace) -> dict[str, Any]:
    """The record of one map."""
    given = hidden(truth, arguments.share, arguments.free, arguments.seed)
    demonstrations = walks_in(truth, given, arguments)
    settings = Settings(
        backup=arguments.backup,
        beta=arguments.beta,
        discount=1.0,
        step_cost=1.0,
        prior_mean=arguments.prior_mean,
        prior_variance=arguments.prior_variance,
        lines=arguments.lines,
        iterations=arguments.iterations,
        memory=arguments.memory,
    )

    def report(progress: Progress) -> None:
        seconds = time.perf_counter() - started
        note(f"{name}: {progress.iteration} after {seconds:.0f} s, objective {progress.objective:.2f}")

    started = time.perf_counter()
    found = fit_map(ObstacleGrid(given, settings.prior_mean), demonstrations, settings, report)
    seconds = time.perf_counter() - started
    visited = demonstrations.visited_state_goals()
    unknown, relevant = given.known == Cell.UNKNOWN, relevant_obstacles(truth, visited[:, 0], visited[:, 1])
    scores = score_map(np.asarray(found.model.blocked), truth, unknown, relevant)
    visit_counts = score_map(visit_ranking(visited[:, 0], truth), truth, unknown, relevant)
    return {
        "name": name,
        "backup": arguments.backup,
        "cells": truth.size,
        "tasks": arguments.goals,
        "cold_seconds": seconds,
        "warm_seconds": None,
        "dijkstra_seconds": None,
        "peak_bytes": peak_bytes(),
        "walks": arguments.walks,
        "moves": len(demonstrations),
        "hidden_walls": int((unknown & (truth.known == Cell.OCCUPIED)).sum()),
        "hidden_walls_that_matter": int((unknown & relevant).sum()),
        "iterations": found.final.iteration,
        "converged": found.converged,
        "largest_gradient": found.final.gradient,
        "objective": found.final.objective,
        "average_precision_relevant": scores.average_precision_relevant,
        "by_visits": visit_counts.average_precision_relevant,
    }


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes what the arguments ask for."""
    maps = {path.stem: read_map(path) for path in arguments.maps}
    if arguments.quick:
        maps = {"office": office(40, 60, seed=0)}
        arguments.goals, arguments.walks = 4, 40
    records = [measure(name, truth, arguments) for name, truth in maps.items()]
    print_table(
        f"{arguments.backup}, β={arguments.beta:g}, prior N({arguments.prior_mean:g}, {arguments.prior_variance:g}), "
        f"lines {arguments.lines:g}; "
        f"{arguments.share:.0%} of the wall cells hidden",
        ("map", "cells", "goals", "walks", "that matter", "AP", "by visits", "iterations", "converged", "s", "GiB"),
        [
            (
                record["name"],
                str(record["cells"]),
                str(record["tasks"]),
                str(record["walks"]),
                str(record["hidden_walls_that_matter"]),
                number(record["average_precision_relevant"], ".3f"),
                number(record["by_visits"], ".3f"),
                str(record["iterations"]),
                str(record["converged"]),
                number(record["cold_seconds"], ".0f"),
                number(record["peak_bytes"] / 2**30, ".2f"),
            )
            for record in records
        ],
        left=("map",),
    )
    write_records(arguments, records)


def _arguments() -> argparse.Namespace:
    parser = argument_parser("Large fits end to end.", "a small office only")
    add = parser.add_argument
    add("--maps", type=Path, nargs="+", default=[MAPS / "depot.yaml"], metavar="MAP.yaml")
    add("--goals", type=int, default=32)
    add("--walks", type=int, default=320)
    add("--share", type=float, default=0.25, help="of the wall cells that is hidden")
    add("--free", type=float, default=3.0, help="how many free cells are hidden for each wall cell")
    add("--backup", default="logsumexp")
    add("--beta", type=float, default=5.0)
    add("--prior-mean", type=float, default=0.0)
    add("--prior-variance", type=float, default=4.0)
    add("--lines", type=float, default=1.0)
    add("--iterations", type=int, help="at most this many")
    add("--memory", type=float, default=2.0, help="GiB for the fit's arrays")
    add("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main(run, _arguments()))
