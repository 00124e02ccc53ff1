"""Behavior cloning: a policy fitted to the actions alone (Pomerleau 1991), with neither a map nor a reward.

What people do is taken to depend on where they are and which way their goal lies: multinomial logistic regression,

    π(a | s, g) ∝ exp w_a · φ(s, g),        φ = (1[s], direction, 1[s] ⊗ compass),

where `direction` is all that is said of the way to the goal: the unit vector, the inverse distance, and in which of
the sectors it lies that the straight and diagonal lines through s part the map into, these lines being sectors of their
own; the coarser `compass` knows the straight lines only. So the policy is particular to places where people have been,
and elsewhere, and to goals that nobody had, it goes by the direction. How much the weights are held down (L2) is what
makes the actions of other walks most probable.

Nothing is learned of cells, so they are not ranked. A robot follows the policy greedily, see
`sidestep.robots.planners`.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, hstack, vstack
from scipy.special import log_softmax

from sidestep.maps.config import MapConfig
from sidestep.robots.planners import PolicyPlanner
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid

_FREEDOM = (0.1, 1.0, 10.0)
"""The weights' variances that are tried; the middle one where there are too few walks to try them on."""
_COMPASS, _SECTORS = 9, 27
_DIRECTION = 3 + _SECTORS
"""How many kinds of direction there are, coarsely and finely (some never occur), and how many features of it."""
_FOLDS = 3
_ITERATIONS = 2000


@dataclass(frozen=True, eq=False)
class Cloned:
    """A policy for every goal on a map.

    - `weights`: w of every action, and `intercepts`. `converged`: as in `BaselineResult`.
    """

    grid: Grid
    weights: Float[np.ndarray, "actions features"]
    intercepts: Float[np.ndarray, " actions"]
    converged: bool
    ranking: None = None
    shares: None = None

    def policy(self, goal: int) -> Float[np.ndarray, "states actions"]:
        """The probability of each action, for who is to reach a state."""
        states = np.arange(self.grid.size)
        return np.exp(self._log_policy(states, np.full(self.grid.size, goal)))

    @property
    def planner(self) -> PolicyPlanner:
        """The most probable action everywhere."""
        return PolicyPlanner(self.grid, self.policy)

    def log_policies(self, demonstrations: Demonstrations) -> Float[np.ndarray, " moves"]:
        """How probable every action is, in nats."""
        states, actions, goals = _moves(demonstrations)
        return self._log_policy(states, goals)[np.arange(len(states)), actions]

    def _log_policy(
        self, states: Int[np.ndarray, " visits"], goals: Int[np.ndarray, " visits"]
    ) -> Float[np.ndarray, "visits actions"]:
        return log_softmax(_features(self.grid, states, goals) @ self.weights.T + self.intercepts, axis=-1)


def behavior_cloning(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> Cloned:
    """A policy from the actions, whatever the settings say of people."""
    del config
    walks = np.asarray(demonstrations.trajectory)
    fold = walks % _FOLDS
    if walks[-1] + 1 < _FOLDS:
        return _fitted(grid, demonstrations, np.ones(len(walks), dtype=bool), _FREEDOM[1])

    def elsewhere(freedom: float) -> float:
        """The log-likelihood of the actions of each fold's walks by the policy from the others."""
        return sum(
            float(_fitted(grid, demonstrations, fold != own, freedom).log_policies(demonstrations)[fold == own].sum())
            for own in range(_FOLDS)
        )

    return _fitted(grid, demonstrations, np.ones(len(walks), dtype=bool), max(_FREEDOM, key=elsewhere))


def _fitted(grid: Grid, demonstrations: Demonstrations, counts: Bool[np.ndarray, " moves"], freedom: float) -> Cloned:
    """The regression on the moves that count, and on one of each action, nowhere, lest one be thought impossible."""
    # a second to load, and few need it
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import LogisticRegression

    states, actions, goals = (part[counts] for part in _moves(demonstrations))
    features, every = _features(grid, states, goals), np.arange(grid.connectivity)
    nowhere = csr_array((len(every), _DIRECTION + (1 + _COMPASS) * grid.size))
    regression = LogisticRegression(C=freedom, max_iter=_ITERATIONS)
    with warnings.catch_warnings(record=True, category=ConvergenceWarning) as complaints:
        warnings.simplefilter("always", ConvergenceWarning)
        regression.fit(vstack([features, nowhere], format="csr"), np.append(actions, every))
    return Cloned(grid, regression.coef_, np.asarray(regression.intercept_), converged=not complaints)


def _moves(demonstrations: Demonstrations) -> tuple[Int[np.ndarray, " moves"], ...]:
    """The state, the action and the goal of every move."""
    goals = np.asarray(demonstrations.tasks.terminal).argmax(axis=-1)[np.asarray(demonstrations.task)]
    return np.asarray(demonstrations.states), np.asarray(demonstrations.actions), goals


def _features(grid: Grid, states: Int[np.ndarray, " visits"], goals: Int[np.ndarray, " visits"]) -> csr_array:
    """φ of the visits, one a row."""
    columns = grid.shape[1]
    way = np.stack(np.divmod(goals, columns), axis=-1) - np.stack(np.divmod(states, columns), axis=-1)
    distance = np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1)
    down, right = np.sign(way).T
    compass = 3 * (down + 1) + right + 1
    sector = 3 * compass + np.sign(np.abs(way[:, 0]) - np.abs(way[:, 1])) + 1
    parts = [
        csr_array(np.concatenate([way / distance, 1 / distance], axis=-1)),
        _one_hot(sector, _SECTORS),
        _one_hot(states, grid.size),
        _one_hot(_COMPASS * states + compass, _COMPASS * grid.size),
    ]
    return csr_array(hstack(parts))


def _one_hot(which: Int[np.ndarray, " visits"], kinds: int) -> csr_array:
    visits = np.arange(len(which))
    return csr_array((np.ones(len(which)), (visits, which)), shape=(len(which), kinds))
