"""A cost of each cell: maximum causal entropy inverse reinforcement learning, and costs together with obstacles.

`maxent_irl` (Ziebart et al. 2010) is the method that the paper's section "Motivation" argues against: costs of cells
explain detours, and no transition model does. Agents choose actions by maximum causal entropy, π(a | s) ∝ exp βQ(s, a)
with the log-sum-exp backup, whatever the configuration says of backups. It differs from the published algorithm in
four ways:
1. the reward that agents pursue anyway is known, and the costs add to it;
2. there is one cost for each cell, ln(1 + exp k) ≥ 0, paid by moves that aim at the cell, instead of linear features;
3. the costs are the same for all goals and have a prior (`sidestep.tabular.behavior_model`);
4. the likelihood of actions is maximized by L-BFGS with the exact gradient.

A cell that agents avoid may be costly or blocked. So `joint_estimation` (Herman et al. 2016) learns both from the same
walks by maximizing

    Σ log π_{k,θ}(a | s)  +  Σ ln T_θ(s, a, s′)  +  priors,        R(s, a) = R₀(s, a) − ln(1 + exp k_c(s, a)),

in the costs' k and the logits θ of P(blocked) together. Moves of its agents may fail; otherwise they behave as above.
It differs from the published algorithm in three ways:
1. the reward R₀ is known, and there is one cost for each cell instead of linear features;
2. agents know the true dynamics, where Herman et al. also allow agents with other beliefs;
3. the priors of `fit_map` and of the costs are added.

References:
    B. D. Ziebart, J. A. Bagnell and A. K. Dey (2010). Modeling interaction via the principle of maximum causal
    entropy. International Conference on Machine Learning.
    M. Herman, T. Gindele, J. Wagner, F. Schmitt and W. Burgard (2016). Inverse reinforcement learning with
    simultaneous estimation of rewards and dynamics. Artificial Intelligence and Statistics.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.baselines.interface import ModelResult, check_arguments, model_result, with_normal_prior
from sidestep.errors import NotConverged, SidestepWarning
from sidestep.inference.fit import fit
from sidestep.inference.optimizers import LBFGS
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import fit_map
from sidestep.robots.planners import ModelPlanner
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.graph import Graph, grid_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tabular.reward import Reward
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.tasks import Task, with_state_costs

_ITERATIONS = 5000
_TOLERANCE = 1e-3
"""The largest gradient at convergence in nats per unit of k; on some maps no step gains anything below 3e-4."""


@dataclass(frozen=True, eq=False)
class CostlyReward(Reward):
    """A reward with a cost of each cell.

    Attributes:
        costs: The cost of a move that aims at each cell, in units of reward.
    """

    costs: Float[np.ndarray, " cells"] = field(kw_only=True)

    def reach(self, world: Grid | Graph, goal: int | tuple[float, float]) -> Task:
        """Return the task of reaching a goal, with the costs of cells.

        Args:
            world: A grid, or the graph of any discrete world.
            goal: A state; on a grid also a position (x, y) in metres.
        """
        graph = world if isinstance(world, Graph) else grid_graph(world)
        return with_state_costs(super().reach(world, goal), jnp.asarray(self.costs), graph.successors[..., 0])


def maxent_irl(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Learn a cost of each cell, by which cells are ranked; robots plan by the agents' reward and these costs.

    Args:
        grid: The known map.
        demonstrations: The walks on it.
        config: The reward that agents pursue beside the costs, and their β.

    Returns:
        The known map, with the costs in the reward and as the ranking.

    Raises:
        NotConverged: Where the costs do not converge.
    """
    check_arguments(grid, demonstrations, config)
    model, agents = true_model(grid.passable()), cost_behavior_model(grid, config)
    optimizer, options = LBFGS(_ITERATIONS, _TOLERANCE), SolveOptions(horizon=config.behavior.horizon)
    with _agents_may_wander():
        result = fit(model, demonstrations, agents, terms=("actions",), optimizer=optimizer, options=options)
    if not result.converged:
        raise NotConverged(f"the costs of cells did not converge: {result.message}")
    costs = np.asarray(result.behavior.costs)
    reward = CostlyReward(config.reward.discount, config.reward.step_cost, costs=costs)
    planner = ModelPlanner(model, partial(reward.reach, model.blank))
    return ModelResult(model, reward, result.behavior.behavior_of(), costs.reshape(grid.shape), planner, True, options)


@contextmanager
def _agents_may_wander() -> Iterator[None]:
    """Say nothing of agents that avoid their goal: the method has the log-sum-exp, and others need not know."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SidestepWarning)
        yield


def cost_behavior_model(grid: Grid, config: MapConfig) -> BehaviorModel:
    """Return the behavior of maximum causal entropy with a cost of each cell, which is to be learned.

    Args:
        grid: The known map.
        config: The configuration, for β.
    """
    behavior = Behavior(LogSumExp(), config.agents.beta)
    return behavior_model(behavior, aimed_at=np.asarray(grid_graph(grid).successors[..., 0]))


def joint_estimation(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Learn a cost and P(blocked) of each cell; robots plan by P(blocked), as in any learned map.

    Args:
        grid: The known map.
        demonstrations: The walks on it.
        config: The configuration of the fit.

    Returns:
        The learned map, with the costs in the reward.
    """
    check_arguments(grid, demonstrations, config)
    config = with_normal_prior(config)
    model, agents = ObstacleGrid(grid, config.prior.first_logit), cost_behavior_model(grid, config)
    with _agents_may_wander():
        fit = fit_map(model, demonstrations, config, behavior=agents)
    result = model_result(fit.model, demonstrations, config)
    reward = CostlyReward(config.reward.discount, config.reward.step_cost, costs=np.asarray(fit.behavior.costs))
    return result._replace(reward=reward, behavior=fit.behavior.behavior_of(), converged=fit.converged)
