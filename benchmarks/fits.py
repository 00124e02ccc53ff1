"""Large fits end to end: hide a part of a map's walls, simulate walks of agents that know them, learn, score.

    python -m benchmarks fits --set wall_prior=0
    python -m benchmarks fits --maps ../shared/data/maps/warehouse.yaml --goals 32 --walks 320

A fraction of the wall cells, drawn at random, is hidden from the learner, and `--free` times as many free cells: all of
these are unknown to it, and it knows the rest of the map. Walks are shortest ones (ties at random) at a step cost of 1
and no discount. Scored are the unknown cells: how well P(blocked) ranks the relevant hidden walls (those that would
have shortened a walk if they alone were open) above the free cells, beside the ranking by how rarely they were visited;
and how well P(blocked) of all unknown cells is calibrated, of which the picture has a reliability diagram for each map.

Records: those of `people.py`, with `cells`, `goals`, `walks`, `hidden_walls`, `relevant_walls`, `peak_bytes` (of the
whole process up to then).

Settings are those of `CONFIG`, with the normal prior and its mode.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks import SHARED_DATA, Record, changed, described, flat, groups, option, peak_bytes, print_table
from benchmarks.people import CALIBRATION, Maze, learn_by, pool
from sidestep.evaluation.relevance import relevant_obstacles
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.io.gridding import grid_walks
from sidestep.io.maps import read_map
from sidestep.maps.config import BehaviorConfig, MapConfig, PriorConfig, SimulationConfig
from sidestep.maps.fit import demonstrations_of
from sidestep.plotting.reliability import figure_reliability
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.reward import Reward
from sidestep.worlds.offices import office
from sidestep.worlds.walks import simulate_walks

SHORTEST = Reward(discount=1.0, step_cost=1.0)
CONFIG = MapConfig(
    SHORTEST, BehaviorConfig("logsumexp", beta=5.0), PriorConfig("normal", mean=0.0, variance=4.0, wall_prior=1.0)
)


@dataclass
class Options:
    """The options of this benchmark."""

    maps: list[Path] = option([SHARED_DATA / "maps" / "depot.yaml"], "maps; none for a small office", quick=[])
    goals: int = option(32, "different goals", quick=4)
    walks: int = option(320, "walks", quick=40)
    hidden: float = option(0.25, "the fraction of wall cells that is hidden")
    free: float = option(3.0, "hidden free cells for each hidden wall cell")
    seed: int = option(0, "draws what is hidden, goals and walks", least=0)
    set: list[str] = option([], f"FIELD=VALUE, of {', '.join(flat(CONFIG))}")


def hide(truth: Grid, options: Options) -> Grid:
    """Return what a learner knows; cells that the true map does not know are blocked to walkers, and known to be."""
    random = np.random.default_rng(options.seed)
    known = np.where(truth.known == Cell.FREE, Cell.FREE, Cell.OCCUPIED).astype(np.int64)
    walls = np.flatnonzero(truth.known == Cell.OCCUPIED)
    walls = random.choice(walls, int(options.hidden * len(walls)), replace=False)
    others = random.choice(np.flatnonzero(truth.known == Cell.FREE), int(options.free * len(walls)), replace=False)
    known.flat[walls] = known.flat[others] = Cell.UNKNOWN
    return replace(truth, known=known)


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each map and method."""
    maps = {path.stem: read_map(path) for path in options.maps} or {"office": office(40, 60, seed=0)}
    config = changed(CONFIG, options.set)
    for name, truth in maps.items():
        blank = hide(truth, options)
        walking = SimulationConfig(options.walks, options.goals, reward=SHORTEST, seed=options.seed)
        walks = walks_from_trajectories(*simulate_walks(truth, walking), truth)
        visited = demonstrations_of(grid_walks(walks, blank), blank, config).visited_state_goals()
        unknown = blank.known == Cell.UNKNOWN
        relevant = unknown & relevant_obstacles(truth, visited[:, 0], visited[:, 1])
        sizes = {"cells": truth.size, "goals": options.goals, "walks": options.walks, "relevant_walls": relevant.sum()}
        sizes["hidden_walls"] = (unknown & (truth.known == Cell.OCCUPIED)).sum()
        for record, *_ in learn_by(("behavior", "visits"), Maze(name, blank, truth, walks), config):
            yield {**record, **sizes, "peak_bytes": peak_bytes()}


def show(records: Sequence[Record], options: Options) -> None:
    """Print the table."""
    columns = {"map": "problem", "cells": "cells", "goals": "goals", "walks": "walks", "moves": "moves"}
    columns |= {"relevant": "relevant_walls", "method": "method", "average precision": "average_precision_relevant .3f"}
    columns |= {name: column for name, column in CALIBRATION.items() if name != "pooled"}
    columns |= {"iterations": "iterations", "converged": "converged", "s": "seconds .0f", "GiB": "peak_bytes GiB"}
    settings = described(changed(CONFIG, options.set))
    print_table(f"{options.hidden:.0%} of the wall cells hidden, {settings}", records, columns)


def draw(records: Sequence[Record], options: object = None) -> Figure:
    """Return the reliability diagrams of `behavior`."""
    del options
    pooled = {label["problem"]: pool(own) for label, own in groups(records, "problem")}
    return figure_reliability({name: bins for name, bins in pooled.items() if bins is not None})
