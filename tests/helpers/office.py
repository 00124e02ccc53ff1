"""A small office: grids, walks in it, files on disk, and the command line called in-process.

. . # . .
. . # . .
. . # . .      one wall with a way around it, and an outer cell known beforehand
. . # . .
. . . . .
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.cli.app import main
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.io.maps import write_map
from sidestep.io.walks import Walks
from sidestep.maps.config import SimulationConfig
from sidestep.tabular.grid import Cell, Grid
from sidestep.worlds.walks import simulate_walks

WALL = np.zeros((5, 5), dtype=bool)
WALL[:4, 2] = True


OFFICE = Grid(WALL.astype(int) * int(Cell.OCCUPIED), resolution=0.5, origin=(-1.0, 2.0, 0.0))
BLANK = OFFICE.forget()


def write_office(folder: Path) -> Path:
    """Write `true.yaml`, `blank.yaml` and `half.yaml`, which knows the upper end of the wall and a free cell."""
    write_map(folder / "true.yaml", WALL.astype(float), OFFICE)
    half = np.full((5, 5), 0.5)
    write_map(folder / "blank.yaml", half, OFFICE)
    half[0, 2], half[4, 0] = 1.0, 0.0
    write_map(folder / "half.yaml", half, OFFICE)
    return folder


def simulated(grid: Grid = OFFICE, **settings: Any) -> Walks:
    """Return the walks that `sidestep simulate` writes with the settings of a `SimulationConfig`."""
    return walks_from_trajectories(*simulate_walks(grid, SimulationConfig(**settings)), grid)


def call(*arguments: object) -> int:
    """Return the exit code of `sidestep` with these arguments."""
    return main([str(argument) for argument in arguments])


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def written(folder: Path) -> list[str]:
    """Return the names of all files below a folder."""
    return sorted(path.name for path in folder.rglob("*") if path.is_file()) if folder.exists() else []
