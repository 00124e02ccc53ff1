"""Maps from a prior with walks on them, and the quantities of a map that simulation-based calibration ranks.

`calibration` describes the model.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

import sidestep as ss
from sidestep.errors import InputError, check, check_count
from sidestep.evaluation.metrics import shortest_lengths
from sidestep.inference.chain_evidence import PASSING
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.prior_chains import sample_prior
from sidestep.maps.config import SHAPE_WEIGHTS, PosteriorConfig, PosteriorMethod, PriorConfig
from sidestep.maps.fit import barrier_prior, behavior_of
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.models.barriers import with_closed

QUANTITIES = {"path_length": "path length from A to B", "log_likelihood": "log-likelihood", "door": "the door is open"}
"""The quantities of a map and their titles, in their order in arrays."""
_LOG_ODDS, _WEIGHT = -2.25, 0.7
"""η of the prior of maps, and the factor of the default weights of shapes."""

_MOST_DRAWS = 100
"""The most draws of a map with walks that cross no closed cell."""
Closed = Bool[np.ndarray, " cells"]


def _prior() -> PriorConfig:
    weights: dict[str, Any] = {name: _WEIGHT * weight for name, weight in SHAPE_WEIGHTS["sample"].items()}
    return PriorConfig(log_odds=_LOG_ODDS, **weights)


@dataclass(frozen=True)
class CalibrationConfig:
    """The size of the experiment, and the model of maps and agents.

    Attributes:
        maps: The number of maps, at least 1.
        rows: The rows and columns of a map, at least 3.
        walks: The number of walks on a map, at least 2.
        moves: The number of moves after which an agent stops, at least 1.
        sweeps: The sweeps of each of two chains, at least 12.
        draws: The number of draws from each posterior, an even number, at least 8.
        prior: The prior of maps.
        behavior: The behavior of the agents.
        reward: The reward that they pursue.

    Raises:
        InputError: For numbers out of range.
    """

    maps: int = 100
    rows: int = 12
    walks: int = 20
    moves: int = 24
    sweeps: int = 1500
    draws: int = 60
    prior: PriorConfig = field(default_factory=_prior)
    behavior: ss.BehaviorConfig = field(default_factory=lambda: ss.BehaviorConfig(beta=7.0))
    reward: ss.Reward = field(default_factory=ss.Reward)

    def __post_init__(self) -> None:
        least = {"maps": 1, "rows": 3, "walks": 2, "moves": 1, "sweeps": 12, "draws": 8}
        for name, number in least.items():
            check_count(getattr(self, name), number, name)
        check(self.draws % 2 == 0, f"expected an even number, found {self.draws}", field="draws")
        tempering = self.learning("sample").agents.tempering
        check(tempering == 1, f"actions are drawn with weight 1: expected 1, found {tempering}", field="tempering")

    @property
    def places(self) -> Int[np.ndarray, " places"]:
        """Return the cells (states) in which walks start; the first two are their goals."""
        near, far = self.rows // 6, self.rows - 1 - self.rows // 6
        return np.array([near, far, near, far]) * self.rows + np.array([near, far, far, near])

    @property
    def path_ends(self) -> Int[np.ndarray, " ends"]:
        """Return A and B (states)."""
        return np.array([0, self.rows - 1]) * self.rows + self.rows // 2

    @property
    def door(self) -> int:
        """Return the door (a state)."""
        return self.rows // 2 * (self.rows + 1)

    @property
    def grid(self) -> ss.Grid:
        """Return what the learner knows of a map."""
        known = np.full(self.rows**2, int(ss.Cell.UNKNOWN))
        known[[*self.places, *self.path_ends]] = ss.Cell.FREE
        return ss.Grid(known.reshape(self.rows, self.rows))

    @property
    def barrier_prior(self) -> BinaryMRF:
        """Return the prior of maps."""
        return barrier_prior(self.prior, self.grid.known, "sample")

    def learning(self, method: PosteriorMethod, seed: int = 0) -> ss.MapConfig:
        """Return how a map is learned.

        Args:
            method: How the posterior is found.
            seed: The seed of the chains.
        """
        posterior = PosteriorConfig(method, self.sweeps)
        return ss.MapConfig(self.reward, self.behavior, self.prior, posterior, seed=seed)


class Case(NamedTuple):
    """A map from the prior, and walks on it.

    Attributes:
        closed: Whether each cell is closed.
        walks: The moves of the agents.
    """

    closed: Closed
    walks: ss.Demonstrations


def draw_case(config: CalibrationConfig, random: np.random.Generator) -> Case:
    """Draw a map from the prior and walks on it, both again where a walk crossed a closed cell.

    Args:
        config: The model.
        random: The generator.

    Raises:
        InputError: Where walks crossed a closed cell in each of 100 draws, as many long walks do.
    """
    prior, known = config.barrier_prior, config.grid.known.ravel()
    for _ in range(_MOST_DRAWS):
        [closed] = sample_prior(prior, known, 1, seed=draw_seed(random))
        walks = simulate_walks(config, closed, draw_seed(random))
        if not closed[np.asarray(walks.next_states)].any():
            return Case(closed, walks)
    raise InputError(f"walks crossed a closed cell in {_MOST_DRAWS} draws; expected fewer walks", field="walks")


def simulate_walks(config: CalibrationConfig, closed: Closed, seed: int) -> ss.Demonstrations:
    """Simulate agents that know a map, and walk from three places to each goal.

    Args:
        config: The agents.
        closed: Whether each cell is closed.
        seed: The seed of their choices and of the moves that fail.
    """
    world, behavior = world_of(config, closed), behavior_of(config.learning("sample"))
    goals = config.places[:2].tolist()
    tasks, keys = [config.reward.reach(config.grid, goal) for goal in goals], jax.random.split(jax.random.key(seed))
    trajectories = []
    for index, goal in enumerate(goals):
        starts = np.resize(config.places[config.places != goal], len(range(index, config.walks, 2)))
        made = ss.plan(world, tasks[index], behavior)
        walks = ss.roll_out(keys[index], world, made.policy, made.terminal, to_jax(starts, np.int32), config.moves)
        for states, actions, arrived in zip(*map(np.asarray, walks), strict=True):
            taken = int((actions >= 0).sum())
            trajectories.append(ss.Trajectory(states[: taken + 1], actions[:taken], index, not arrived))
    return ss.gather(trajectories, tasks)


def world_of(config: CalibrationConfig, closed: Closed) -> ss.ObstacleGrid:
    """Return the world of a map, in which closed cells and open ones let an agent pass with `PASSING`.

    Args:
        config: The known cells, which are certain.
        closed: Whether each cell is closed.
    """
    of_open, of_closed = PASSING
    return with_closed(ss.ObstacleGrid(config.grid), np.where(closed, 1 - of_closed, 1 - of_open))


def quantities_of(
    config: CalibrationConfig, walks: ss.Demonstrations, maps: Bool[np.ndarray, "maps cells"]
) -> Float[np.ndarray, "maps quantities"]:
    """Return the `QUANTITIES` of maps.

    Args:
        config: The model.
        walks: The walks for the likelihood.
        maps: Whether each cell is closed, in each map.

    Returns:
        The length of the shortest path from A to B in cell sides, infinite if there is none; the log-likelihood of the
        walks in nats; 1 where the door is open, else 0.
    """
    distinct, which = np.unique(maps, axis=0, return_inverse=True)
    of_distinct = [(_path_length(config, each), _log_likelihood(config, each, walks)) for each in distinct]
    return np.column_stack([np.array(of_distinct)[which.ravel()], ~maps[:, config.door]])


def draw_seed(random: np.random.Generator) -> int:
    """Draw a seed.

    Args:
        random: The generator.
    """
    return int(random.integers(2**31))


def _path_length(config: CalibrationConfig, closed: Closed) -> float:
    cells = np.where(closed, int(ss.Cell.OCCUPIED), int(ss.Cell.FREE)).reshape(config.rows, config.rows)
    start, end = config.path_ends
    return float(shortest_lengths(walkable_graph(ss.Grid(cells)), np.array([start]), np.array([end]))[0])


def _log_likelihood(config: CalibrationConfig, closed: Closed, walks: ss.Demonstrations) -> float:
    return float(ss.log_likelihood(world_of(config, closed), walks, behavior_of(config.learning("sample"))).total)
