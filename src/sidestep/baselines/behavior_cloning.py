"""Behavior cloning: a policy by supervised learning of actions (Pomerleau 1991), without a map and a reward.

The policy is a multinomial logistic regression on the state and the direction of the goal,

    π(a | s, g) ∝ exp w_a · φ(s, g),        φ = (direction, 1[s], 1[s] ⊗ compass),

where `direction` is the unit vector to the goal, the inverse distance, and one of 27 sectors between the straight and
diagonal lines through s (the lines are sectors too), and `compass` is one of 9 coarser sectors between the straight
lines. So the policy depends on the state where walks went, and on the direction alone elsewhere. The L2 penalty
maximizes the likelihood of held-out walks. Cells are not ranked, and a robot follows the policy greedily
(`sidestep.robots.planners`). It differs from Pomerleau's network in its features and its model.

References:
    D. A. Pomerleau (1991). Efficient training of artificial neural networks for autonomous navigation. Neural
    Computation 3(1), 88-97.
"""

import warnings
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, hstack, vstack

from sidestep.baselines.interface import check_arguments
from sidestep.errors import to_count
from sidestep.maps.config import MapConfig
from sidestep.robots.planners import PolicyPlanner
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid

_Index = Int[np.ndarray, " visits"]

MAX_ITERATIONS = 2000
"""The most iterations of the regression."""
_VARIANCES = (0.1, 1.0, 10.0)
"""The candidate variances of the weights; the middle one if there are too few walks to choose."""
_COMPASS, _SECTORS = 9, 27
_DIRECTION = 3 + _SECTORS
_FOLDS = 3


@dataclass(frozen=True, eq=False)
class ClonedPolicy:
    """A policy for every goal on a map.

    Attributes:
        grid: The known map.
        weights: W of every action.
        intercepts: The intercept of every action.
        converged: Whether the regression converged.
        ranking: None, since cells are not ranked.
        ranks_by_probability: False, for the same reason.
        heatmap: None, since cells are not ranked.
    """

    grid: Grid
    weights: Float[np.ndarray, "actions features"]
    intercepts: Float[np.ndarray, " actions"]
    converged: bool
    ranking: None = None
    ranks_by_probability: bool = False
    heatmap: None = None

    def policy(self, goal: int) -> Float[np.ndarray, "states actions"]:
        """Return π(a | s) for a goal (a state).

        Args:
            goal: The goal, a state.
        """
        return np.exp(self._log_policy(np.arange(self.grid.size), np.full(self.grid.size, goal)))

    @property
    def planner(self) -> PolicyPlanner:
        """The planner that follows the policy greedily."""
        return PolicyPlanner(self.grid, self.policy)

    def log_policies(self, demonstrations: Demonstrations) -> Float[np.ndarray, " moves"]:
        """Return log π(a | s) of every move in nats.

        Args:
            demonstrations: Moves on the same map.
        """
        states, actions, goals = _moves(demonstrations)
        return self._log_policy(states, goals)[np.arange(len(states)), actions]

    def _log_policy(self, states: _Index, goals: _Index) -> Float[np.ndarray, "visits actions"]:
        from scipy.special import log_softmax

        return log_softmax(_features(self.grid, states, goals) @ self.weights.T + self.intercepts, axis=-1)


def behavior_cloning(
    grid: Grid, demonstrations: Demonstrations, config: MapConfig, max_iterations: int = MAX_ITERATIONS
) -> ClonedPolicy:
    """Learn a policy from the actions; `config` is not used, since it has neither a reward nor a behavior model.

    Args:
        grid: The known map.
        demonstrations: The walks on it.
        config: Not used.
        max_iterations: The most iterations of the regression.

    Returns:
        A policy for every goal.
    """
    check_arguments(grid, demonstrations, config)
    max_iterations = to_count(max_iterations, "max_iterations")
    walks, weights = np.asarray(demonstrations.trajectory), np.asarray(demonstrations.weights)
    fold, everything = walks % _FOLDS, np.ones(len(walks), dtype=bool)

    learn = partial(_fit_policy, grid, demonstrations, max_iterations)

    def heldout_log_likelihood(variance: float) -> float:
        each = (learn(fold != own, variance).log_policies(demonstrations)[fold == own] for own in range(_FOLDS))
        return sum(float(weights[fold == own] @ nats) for own, nats in enumerate(each))

    enough = walks[-1] + 1 >= _FOLDS
    return learn(everything, max(_VARIANCES, key=heldout_log_likelihood) if enough else _VARIANCES[1])


def _fit_policy(
    grid: Grid, demonstrations: Demonstrations, max_iterations: int, used: Bool[np.ndarray, " moves"], variance: float
) -> ClonedPolicy:
    """Fit the regression to some moves, and to one move of each action without features so that none is impossible."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import LogisticRegression

    states, actions, goals = (part[used] for part in _moves(demonstrations))
    weights = np.asarray(demonstrations.weights)[used]
    features, all_actions = _features(grid, states, goals), np.arange(grid.connectivity)
    no_features = csr_array((len(all_actions), _DIRECTION + (1 + _COMPASS) * grid.size))
    regression = LogisticRegression(C=variance, max_iter=max_iterations)
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):
        regression.fit(
            vstack([features, no_features], format="csr"),
            np.append(actions, all_actions),
            np.append(weights, np.ones(len(all_actions))),
        )
    converged = bool((regression.n_iter_ < max_iterations).all())
    return ClonedPolicy(grid, regression.coef_, np.asarray(regression.intercept_), converged)


def _moves(demonstrations: Demonstrations) -> tuple[Int[np.ndarray, " moves"], ...]:
    """Return the state, the action and the goal of every move."""
    goals = np.asarray(demonstrations.tasks.terminal).argmax(axis=-1)[np.asarray(demonstrations.task)]
    return np.asarray(demonstrations.states), np.asarray(demonstrations.actions), goals


def _features(grid: Grid, states: _Index, goals: _Index) -> csr_array:
    """Return φ(s, g) of each visit, one in a row."""
    columns = grid.shape[1]
    offset = np.stack(np.divmod(goals, columns), axis=-1) - np.stack(np.divmod(states, columns), axis=-1)
    distance = np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1)
    down, right = np.sign(offset).T
    compass = 3 * (down + 1) + right + 1
    sector = 3 * compass + np.sign(np.abs(offset[:, 0]) - np.abs(offset[:, 1])) + 1
    direction = csr_array(np.concatenate([offset / distance, 1 / distance], axis=-1))
    indices = (sector, _SECTORS), (states, grid.size), (_COMPASS * states + compass, _COMPASS * grid.size)
    return csr_array(hstack([direction, *(_one_hot(index, size) for index, size in indices)]))


def _one_hot(index: _Index, size: int) -> csr_array:
    return csr_array((np.ones(len(index)), (np.arange(len(index)), index)), shape=(len(index), size))
