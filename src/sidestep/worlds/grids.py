"""The worlds of the paper's experiments: small grids with obstacles, and starts and goals all around them.

The two maps of the paper's figure 1 survive only as pictures that we do not have. `block` and `wall` are the
two 9×9 maps of its first author's later work; `rooms` is our own. The starts and goals of all three are ours,
chosen so that optimal walks between them pass on every side of the obstacles.
"""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sidestep.tabular.grid import Cell, Grid

_LATER_WORK = "a map of the first author's later work; starts and goals are our own"


@dataclass(frozen=True, eq=False)
class World:
    """A map that walkers know, and the places that they walk between.

    - `truth`: the map, fully known.
    - `starts`, `goals`: states; walkers go from every start to every goal.
    - `source`: where the map comes from.
    """

    name: str
    truth: Grid
    starts: tuple[int, ...]
    goals: tuple[int, ...]
    source: str


def block() -> World:
    """A 9×9 room with a 3×3 block in the middle (rows and columns 3–5)."""
    return _world(
        "block",
        _LATER_WORK,
        "S . . . G . . . G",
        ". . . . . . . . .",
        ". . . . . . . . .",
        ". . . # # # . . .",
        "S . . # # # . . G",
        ". . . # # # . . .",
        ". . . . . . . . .",
        ". . . . . . . . .",
        "G . . . S . . . G",
    )


def wall() -> World:
    """A 9×9 room with a thick wall (columns 3–5 in rows 0–5) between its left and its right side."""
    return _world(
        "wall",
        _LATER_WORK,
        "S . G # # # G . S",
        ". . . # # # . . .",
        ". . . # # # . . .",
        "G . S # # # S . G",
        ". . . # # # . . .",
        ". . . # # # . . .",
        ". . . . . . . . .",
        ". . . . . . . . .",
        "S . . . G . . . S",
    )


def rooms() -> World:
    """A 9×9 flat of four rooms: walls one cell thick, and a door between each two neighbours."""
    return _world(
        "rooms",
        "our own",
        "S . . G # S . . G",
        ". . . . # . . . .",
        ". . . . . . . . .",
        ". . . S # G . . .",
        "# # . # # # . # #",
        "G . . . # . . . S",
        ". . . . # . . . .",
        ". . . . . . . . .",
        "S . . G # S . . G",
    )


WORLDS = MappingProxyType({"block": block, "wall": wall, "rooms": rooms})
"""The worlds by name; each is a function without arguments that returns a `World`."""


def _world(name: str, source: str, *drawing: str) -> World:
    """A world from a drawing, top row first: `#` occupied, `S` start, `G` goal, anything else free."""
    signs = np.array([row.split() for row in drawing])
    truth = Grid(np.where(signs == "#", int(Cell.OCCUPIED), int(Cell.FREE)))
    starts, goals = (tuple(np.flatnonzero(signs == sign).tolist()) for sign in "SG")
    return World(name, truth, starts, goals, source)
