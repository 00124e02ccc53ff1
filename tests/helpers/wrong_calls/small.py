"""Small right arguments, of which a wrong call has all but one."""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

import sidestep as ss
from sidestep.io.walks import walks_from_table
from sidestep.tabular.behavior_model import BehaviorParameters

Case = tuple[str, Callable[[], object], str]
"""A name, the wrong call, and a word of its error."""

NAN, INF = float("nan"), float("inf")
GRID = ss.Grid.unknown(4, 5)
OTHER_GRID = ss.Grid.unknown(2, 2)
TRUTH = ss.Grid(np.zeros((4, 5), int))
MODEL = ss.ObstacleGrid(GRID)
OTHER_MODEL = ss.ObstacleGrid(OTHER_GRID)
TASK = ss.reach(GRID, 3)
OTHER_TASK = ss.reach(OTHER_GRID, 1)
WALK = ss.Trajectory(np.array([0, 1, 2, 3]), np.array([3, 3, 3]), 0)
DEMOS = ss.gather([WALK, WALK], [TASK])
BEHAVIOR = ss.Behavior(ss.BoltzmannAverage())
KEY = jax.random.key(0)
PRIOR = ss.BinaryMRF(np.zeros(20), (4, 5))
TABLE = pa.table({
    "walk": [0, 0, 1, 1], "step": [0, 1, 0, 1], "x": [0.5, 1.5, 0.5, 2.5], "y": [0.5] * 4, "person": list("aabb"),
})  # fmt: skip
WALKS = walks_from_table(TABLE)
MAP = ss.LearnedMap(GRID, np.full((4, 5), 0.1), np.zeros((0, 2), int), ss.Reward())
PARAMETERS = ss.Parameters(jnp.zeros(2), BehaviorParameters())
LAPLACE = ss.Laplace(PARAMETERS, np.ones(2), np.zeros((2, 0)), np.zeros(0), 0.0)
MRF_FIT = ss.fit_mrf([ss.Grid(np.array([[0, 1, 0], [0, 0, 0]]))], ())
EMPTY = np.zeros(0)


@cache
def small_fit() -> ss.Fit:
    """A fit of two walks."""
    return ss.fit(MODEL, DEMOS, BEHAVIOR, terms=("transitions",))


def walk(states, actions, task=0) -> ss.Trajectory:
    """A trajectory of anything."""
    return ss.Trajectory(states, actions, task)


def labeled(group: str, rows: list[tuple[str, Callable[[], object], str]]) -> list[Case]:
    """The rows with names that say what is called."""
    return [(f"{group}: {name}", call, word) for name, call, word in rows]
