"""Inverse reinforcement learning with simultaneous estimation of rewards and dynamics (Herman et al. 2016).

A cell that agents avoid may be costly or blocked, so both are learned from the same walks by maximizing

    Σ log π_{k,θ}(a | s)  +  Σ ln T_θ(s, a, s′)  +  priors,        R(s, a) = R₀(s, a) − ln(1 + exp k_c(s, a)),

in the costs' k and the logits θ of P(blocked) together. It differs from the published algorithm in three ways:
1. the reward R₀ is known, and there is one cost for each cell instead of linear features;
2. agents know the true dynamics, where Herman et al. also allow agents with other beliefs;
3. the priors of `fit_map` and of the costs (`sidestep.tabular.behavior_model`) are added.
Agents choose actions by maximum causal entropy as in `sidestep.baselines.maxent_irl`, but their moves may fail.

References:
    M. Herman, T. Gindele, J. Wagner, F. Schmitt and W. Burgard (2016). Inverse reinforcement learning with
    simultaneous estimation of rewards and dynamics. Artificial Intelligence and Statistics.
"""

import numpy as np

from sidestep.baselines.interface import ModelResult, model_result
from sidestep.baselines.maxent_irl import CostlyReward, cost_behavior_model
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import fit_map
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid


def joint_estimation(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """Learn a cost and P(blocked) of each cell; robots plan by P(blocked), as in any learned map."""
    model, agents = ObstacleGrid(grid, config.prior.mean), cost_behavior_model(grid, config)
    fit = fit_map(model, demonstrations, config, behavior=agents)
    result = model_result(fit.model, demonstrations, config)
    reward = CostlyReward(config.reward.discount, config.reward.step_cost, np.asarray(fit.behavior.costs))
    return result._replace(reward=reward, behavior=fit.behavior.behavior_of(), converged=fit.converged)
