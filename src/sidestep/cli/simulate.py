"""`sidestep simulate`: walkers on a known map."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sidestep._files import write_json
from sidestep.errors import InputError
from sidestep.io.maps import read_map
from sidestep.io.tables import write_table
from sidestep.io.trajectories import walks_from_trajectories
from sidestep.io.walks import table_from_walks
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.demonstrations import Trajectory
from sidestep.tabular.grid import Connectivity, Grid
from sidestep.tabular.models import true_model
from sidestep.tabular.simulation import simulate
from sidestep.tabular.tasks import reach
from sidestep.worlds.offices import connected_cells, places


@dataclass(frozen=True)
class Walkers:
    """Who walks.

    - `walks`: how many; `goals`: how many different goals they have in turn.
    - `beta`: how sharply they act (∝ exp βQ); None for optimal walkers who break ties at random.
    - `backup`, `discount`, `step_cost`, `connectivity`: as in `commands.learn.Settings`.
    - `seed`: draws goals, starts and choices.
    """

    walks: int = 100
    goals: int = 4
    beta: float | None = None
    backup: str = "boltzmann"
    discount: float = 0.95
    step_cost: float | None = None
    connectivity: Connectivity = 4
    seed: int = 0


def simulate_walks(map_file: Path, out: Path, walkers: Walkers) -> dict[str, Any]:
    """Simulates walkers on a map, writes their walks to `out` (.csv or .parquet) and a summary beside it; returns that.

    What the map does not know counts as blocked. Raises `InputError` for a map without enough free cells.
    """
    grid = read_map(map_file, connectivity=walkers.connectivity)
    trajectories, goals = walk(grid, walkers)
    write_table(out, table_from_walks(walks_from_trajectories(trajectories, goals, grid)))
    summary = {
        "command": "simulate",
        "map": str(map_file),
        "walks": str(out),
        "settings": asdict(walkers),
        "moves": sum(len(trajectory.actions) for trajectory in trajectories),
        "goals": grid.centres(np.array(goals)).tolist(),
    }
    write_json(out.with_suffix(".summary.json"), summary)
    return summary


def walk(grid: Grid, walkers: Walkers) -> tuple[list[Trajectory], list[int]]:
    """Walks of walkers who know `grid`, from random places to goals that lie well apart; and the goals (states)."""
    for name in ("walks", "goals"):
        if getattr(walkers, name) < 1:
            raise InputError(f"expected at least 1, found {getattr(walkers, name)}", field=name)
    if walkers.backup not in BACKUPS:
        raise InputError(f"expected one of {', '.join(BACKUPS)}, found {walkers.backup!r}", field="backup")
    candidates = connected_cells(grid)
    if len(candidates) < max(2, walkers.goals):
        raise InputError(
            f"expected at least {max(2, walkers.goals)} free cells that can reach one another, found {len(candidates)}",
            field="map",
        )
    goals = places(grid, walkers.goals, walkers.seed).tolist()[: walkers.walks]
    random = np.random.default_rng(walkers.seed)
    own = np.arange(walkers.walks) % len(goals)
    starts = [random.choice(candidates[candidates != goal], (own == i).sum()) for i, goal in enumerate(goals)]
    behavior = None if walkers.beta is None else Behavior(BACKUPS[walkers.backup](), walkers.beta)
    tasks = [reach(grid, goal, discount=walkers.discount, step_cost=walkers.step_cost) for goal in goals]
    key = jax.random.key(walkers.seed)
    return simulate(key, true_model(grid), tasks, starts, behavior), goals
