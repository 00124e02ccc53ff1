"""Rewards and dynamics at once: a cost of every cell, and the probability that it is blocked (Herman et al. 2016).

What people avoid may cost something or not be passable, and from their walks both are learned together, "inverse
reinforcement learning with simultaneous estimation of rewards and dynamics": the likelihood of what they did and of
what came of it,

    Σ log π_{k,θ}(a | s)  +  Σ ln T_θ(s, a, s′),        R(s, a) = R₀(s, a) − ln(1 + exp k_c(s, a)),

is climbed in the costs' k and the cells' logits θ together, with the prior of the costs (`tabular.people`) and, of the
logits, the settings' own and what the walks' first cells say (`fit_map`). As there, people act by maximum causal
entropy, whatever backup the settings name: they differ from those of `costs` in that their moves may fail. And as
there people know the true dynamics; Herman et al. also have people whose beliefs differ from them.
"""

import numpy as np

from sidestep.baselines.interface import ModelResult, model_result
from sidestep.baselines.maxent_irl import CostlyReward, who_pay
from sidestep.maps.config import MapConfig
from sidestep.maps.fit import fit_map
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid


def joint_estimation(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """A cost of every cell and P(blocked) of every unknown one; the ranking is by P(blocked).

    What cells cost people is no concern of robots: they plan as with any learned map.
    """
    model, walkers = ObstacleGrid(grid, config.prior.mean), who_pay(grid, config)
    found = fit_map(model, demonstrations, config, behavior=walkers)
    learned = model_result(found.model, demonstrations, config)
    reward = CostlyReward(config.reward.discount, config.reward.step_cost, np.asarray(found.people.costs))
    return learned._replace(reward=reward, behavior=found.people.behavior_of(), converged=found.converged)
