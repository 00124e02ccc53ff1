"""Small worlds of barriers with walks, for the tests of samplers; at most eight barriers of each are open questions.

. ? ? .        A room, walked from the upper left to the upper right through the third row: '.' cells that walks
. ? # .        passed, '#' a known obstacle, '?' unknown cells that no walk passed. The last cell is known to be free.
. . . .
? ? ? _
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from helpers.problems import TURNS
from helpers.walled import follow
from sidestep.inference.chain_evidence import PASSING
from sidestep.inference.mrf import BinaryMRF
from sidestep.tabular.backups import Backup, Behavior, BoltzmannAverage
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.grid import Cell, Connectivity, Grid
from sidestep.tabular.models import ObstacleGrid, SlipperyGrid, TransitionModel, road_network, walled_grid
from sidestep.tabular.models.barriers import barriers_of, with_closed
from sidestep.tabular.reward import Reward

KINDS = ("4 moves", "8 moves", "slips", "borders", "turns")
UP, RIGHT = 0, 3
ROOM = np.full((4, 4), int(Cell.UNKNOWN))
ROOM[1, 2], ROOM[3, 3] = Cell.OCCUPIED, Cell.FREE
SHAPES = {"lines": 0.5, "pairs": 0.3, "blocks": -1.0, "isolated": -0.4}
DISCOUNTED, COSTLY = Reward(0.9), Reward(1.0, 1.0)


@dataclass(frozen=True, eq=False)
class BarrierWorld:
    """A model with barriers, walks in it, and a prior."""

    model: TransitionModel
    demonstrations: Demonstrations
    behavior: Behavior
    prior: BinaryMRF

    @property
    def problem(self) -> tuple[TransitionModel, Demonstrations, Behavior]:
        """The first arguments of functions that infer."""
        return self.model, self.demonstrations, self.behavior


def room(connectivity: Connectivity = 4) -> Grid:
    return Grid(ROOM, connectivity=connectivity)


def model_of(kind: str) -> TransitionModel:
    if kind == "borders":
        return walled_grid(Grid.unknown(2, 4))
    if kind == "turns":
        # as many actions as on grids, for which there is native code already
        return road_network(np.append(TURNS, [[1, 0], [1, 4]], axis=0), np.arange(1.0, 6.0), by_turn=True)
    if kind == "slips":
        return SlipperyGrid(room(), slip=np.array([-1.5]), terrain=np.where(np.arange(16).reshape(4, 4) % 3, 0, -1))
    return ObstacleGrid(room(8 if kind == "8 moves" else 4))


def walks_of(kind: str) -> list[Trajectory]:
    """Walks to two goals; on grids one of them bumps into what it cannot pass, and where moves slip one slips."""
    if kind == "turns":
        return [
            Trajectory(np.array([4, 1, 2, 0]), np.array([1, 0, 0]), task=0),
            Trajectory(np.array([1, 3]), np.array([1]), task=1),
        ]
    grid, moves, start = (Grid.unknown(2, 4), "DRRRU", 5) if kind == "borders" else (room(), "DDRRRUU", 9)
    there, (states, actions) = Trajectory(*follow(0, moves, grid), 0), follow(start, "L" + "U" * (start // 4), grid)
    bumps = Trajectory(np.append(start, states), np.append(UP, actions), task=1)
    slips = Trajectory(np.array([8, 9, 8, 4, 0]), np.array([UP, 2, UP, UP]), task=1)
    return [there, there, bumps, *([slips] if kind == "slips" else [])]


def world(
    kind: str = "4 moves",
    reward: Reward = DISCOUNTED,
    backup: Backup | None = None,
    beta: float = 6.0,
    lapse: float | None = None,
) -> BarrierWorld:
    model = model_of(kind)
    barriers = barriers_of(model)
    tasks = [reward.reach(model.graph, goal) for goal in ((0, 3) if kind == "turns" else (3, 0))]
    prior = BinaryMRF(np.full(len(barriers.known), -0.8), barriers.shape, **(SHAPES if barriers.shape else {}))
    return BarrierWorld(
        model, gather(walks_of(kind), tasks), Behavior(backup or BoltzmannAverage(), beta, lapse), prior
    )


def exact_model(model: TransitionModel, closed: np.ndarray) -> TransitionModel:
    """The model whose likelihood is that of a map."""
    return with_closed(model, 1 - np.where(closed, PASSING[1], PASSING[0]))


def all_maps(count: int) -> np.ndarray:
    """All maps of some barriers, one a row."""
    return np.array(list(product((False, True), repeat=count)))


def corridor() -> BarrierWorld:
    """A corridor of four cells along which one walks to the right end, from the second."""
    grid = Grid.unknown(1, 4)
    shown = gather([Trajectory(np.array([1, 2, 3]), np.array([RIGHT] * 2), task=0)], [DISCOUNTED.reach(grid, 3)])
    return BarrierWorld(ObstacleGrid(grid), shown, Behavior(BoltzmannAverage()), BinaryMRF(np.zeros(4), (1, 4)))
