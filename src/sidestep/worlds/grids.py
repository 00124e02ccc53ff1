"""The worlds of the paper's experiments: small grids with obstacles, and starts and goals around them.

The two maps of the paper's figure 1 are published as pictures only. `block` and `wall` are the two 9×9 maps of its
first author's later work; `rooms` is our own. The starts and goals of all three are ours, chosen so that optimal walks
between them pass on every side of the obstacles.
"""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sidestep.tabular.grid import Cell, Grid


@dataclass(frozen=True, eq=False)
class World:
    """A map that agents know, and the places that they walk between.

    Attributes:
        name: The key in `WORLDS`.
        truth: The map, fully known.
        starts: States; agents walk from every start to every goal.
        goals: States.
    """

    name: str
    truth: Grid
    starts: tuple[int, ...]
    goals: tuple[int, ...]


def block() -> World:
    """Return a 9×9 room with a 3×3 block in the middle (rows and columns 3–5)."""
    return _world(
        "block",
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
    """Return a 9×9 room with a thick wall (columns 3–5 in rows 0–5) between its left and its right side."""
    return _world(
        "wall",
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
    """Return a 9×9 flat of four rooms: walls one cell thick, and a door between each two neighbors."""
    return _world(
        "rooms",
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


def _world(name: str, *drawing: str) -> World:
    """Return the world of a drawing, top row first: `#` occupied, `S` start, `G` goal, anything else free."""
    signs = np.array([row.split() for row in drawing])
    truth = Grid(np.where(signs == "#", int(Cell.OCCUPIED), int(Cell.FREE)))
    starts, goals = (tuple(np.flatnonzero(signs == sign).tolist()) for sign in "SG")
    return World(name, truth, starts, goals)
