"""A small office for the tests of the commands: files on disk, and the command line called in-process.

. . # . .
. . # . .
. . # . .      one wall with a way around it, and an outer cell known beforehand
. . # . .
. . . . .
"""

import json
from pathlib import Path

import numpy as np

from sidestep.cli.app import main
from sidestep.io.maps import write_map
from sidestep.tabular.grid import Cell, Grid

WALL = np.zeros((5, 5), dtype=bool)
WALL[:4, 2] = True


def write_office(folder: Path) -> Path:
    """Writes `true.yaml`, `blank.yaml` and `half.yaml`, in which the upper end of the wall and a free cell are known;
    cells are half a metre wide.
    """
    grid = Grid(WALL.astype(int) * int(Cell.OCCUPIED), resolution=0.5, origin=(-1.0, 2.0, 0.0))
    write_map(folder / "true.yaml", WALL.astype(float), grid)
    half = np.full((5, 5), 0.5)
    write_map(folder / "blank.yaml", half, grid)
    half[0, 2], half[4, 0] = 1.0, 0.0
    write_map(folder / "half.yaml", half, grid)
    return folder


def call(*arguments: object) -> int:
    """The exit code of `sidestep` with these arguments."""
    return main([str(argument) for argument in arguments])


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def written(folder: Path) -> list[str]:
    """All files below a folder, by name."""
    return sorted(path.name for path in folder.rglob("*") if path.is_file()) if folder.exists() else []
