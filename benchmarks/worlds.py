"""The world that the benchmarks share: an office whose walls are nearly certain, and walks in it to one or more goals.

Every wall cell is blocked with a probability of about .98, every free one of about .02 (logits ±3.9, with noise of .3),
as in a map that has been learned from many walks. The learner is told nothing of it: all cells have a parameter.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sidestep.tabular.demonstrations import Demonstrations, Trajectory, gather
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import Task, reach
from sidestep.worlds.offices import connected_cells, office

SURE, NOISE = 3.9, 0.3


class World(NamedTuple):
    """An office of size × size cells: logits of P(blocked), and shortest walks to goals.

    - `goals`: a state for each task.
    - `walks`: the states along all walks, one after another; `ends` is where each ends in that, `pursued` its task.
    """

    size: int
    logits: Float[np.ndarray, " cells"]
    goals: Int[np.ndarray, " tasks"]
    walks: Int[np.ndarray, " steps"]
    ends: Int[np.ndarray, " walks"]
    pursued: Int[np.ndarray, " walks"]

    @property
    def grid(self) -> Grid:
        """The map, of which nothing is known."""
        return Grid.unknown(self.size, self.size)

    @property
    def model(self) -> ObstacleGrid:
        """The half-learned model."""
        return ObstacleGrid(self.grid, self.logits)

    def tasks(self, discount: float, step_cost: float | None) -> list[Task]:
        """Reaching each of the goals."""
        return [reach(self.grid, int(goal), discount=discount, step_cost=step_cost) for goal in self.goals]

    def demonstrations(self, discount: float, step_cost: float | None) -> Demonstrations:
        """The walks, and what was pursued."""
        steps = [tuple(step) for step in self.grid.steps.tolist()]
        found = []
        for states, task in zip(np.split(self.walks, self.ends[:-1]), self.pursued.tolist(), strict=True):
            places = np.stack(np.divmod(states, self.size), axis=-1)
            actions = [steps.index(tuple(change)) for change in np.diff(places, axis=0).tolist()]
            found.append(Trajectory(states, np.asarray(actions), task))
        return gather(found, self.tasks(discount, step_cost))

    def save(self, path: Path) -> None:
        """Writes the world for another process."""
        np.savez(path, **self._asdict())


def load(path: Path) -> World:
    """A world that another process wrote."""
    with np.load(path) as saved:
        return World(**{name: saved[name] for name in saved.files})._replace(size=int(saved["size"]))


def half_learned_office(size: int, seed: int, walks: int = 10, goals: int = 1) -> World:
    """An office at random, with `walks` shortest walks to each of some goals, from free cells at random."""
    truth = office(size, size, seed)
    random = np.random.default_rng(seed)
    wall = truth.known.reshape(-1) == Cell.OCCUPIED
    logits = np.where(wall, SURE, -SURE) + NOISE * random.normal(size=truth.size)
    ways, free = walkable_graph(truth), connected_cells(truth)
    ends = random.choice(free, goals, replace=False)
    found = []
    for goal in ends.tolist():
        before = dijkstra(ways, indices=goal, return_predecessors=True)[1]
        found += [_walk(before, int(start), goal) for start in random.choice(np.setdiff1d(free, [goal]), walks)]
    lengths = [len(states) for states in found]
    return World(size, logits, ends, np.concatenate(found), np.cumsum(lengths), np.repeat(np.arange(goals), walks))


def _walk(before: Int[np.ndarray, " states"], start: int, goal: int) -> Int[np.ndarray, " steps"]:
    """The walk from a start by the predecessors of a search from the goal."""
    states = [start]
    while states[-1] != goal:
        states.append(int(before[states[-1]]))
    return np.asarray(states)


def expected_costs(model: ObstacleGrid) -> csr_array:
    """The moves backwards, at the cost of trying each until it succeeds (1/P), as rows of a sparse matrix.

    A shortest-path search over it from a goal finds the expected cost from every cell to the goal; it is the unit that
    times are told in.
    """
    successors = np.asarray(model.graph.successors)[:, :, 0]
    chances = np.asarray(model.probabilities())[:, :, 0]
    moves = successors != np.arange(len(successors))[:, None]
    first = np.concatenate([[0], np.cumsum(moves.sum(axis=1))]).astype(np.int32)
    shape = (len(successors), len(successors))
    return csr_array((1 / chances[moves], successors[moves], first), shape=shape).T.tocsr()
