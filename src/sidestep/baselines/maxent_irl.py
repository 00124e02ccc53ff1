"""Maximum-causal-entropy inverse reinforcement learning: a cost of every cell, on dynamics of free space.

The paper's section "Motivation": people's detours are explained by what places cost, not by what happens there. Every
cell has a cost ln(1 + exp k), paid by a move that aims at it, beside what people pursue anyway; no move is taken to
fail. The costs maximise the likelihood of what people did, and are the same for all goals (see `tabular.people`).
Maximum causal entropy is the log-sum-exp, whatever the settings say of how people value states; their β counts.
"""

from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.baselines.interface import ModelResult
from sidestep.errors import NotConverged
from sidestep.inference.fit import fit
from sidestep.inference.optimizers import LBFGS
from sidestep.maps.config import MapConfig
from sidestep.robots.planners import ModelPlanner
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.graph import Graph, grid_graph
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import true_model
from sidestep.tabular.reward import Reward
from sidestep.tabular.tasks import Task, with_state_costs

_ITERATIONS = 5000
_FLAT = 1e-3
"""The largest slope where costs count as found (nats per unit of k); on some maps no step gains anything at 3e-4."""


@dataclass(frozen=True, eq=False)
class CostlyReward(Reward):
    """What people pursue when cells cost something; `costs` are of every cell, in units of reward."""

    costs: Float[np.ndarray, " cells"] | None = None

    def reach(self, world: Grid | Graph, goal: int | tuple[float, float]) -> Task:
        """The task of reaching a state, less what the cells cost that moves aim at."""
        task = super().reach(world, goal)
        if self.costs is None or isinstance(world, Graph):
            return task
        return with_state_costs(task, jnp.asarray(self.costs), grid_graph(world).successors[..., 0])


def maxent_irl(grid: Grid, demonstrations: Demonstrations, config: MapConfig) -> ModelResult:
    """A cost for every cell; the ranking is by costs. Robots pursue what people do, costs with it."""
    model, walkers = true_model(grid.passable()), who_pay(grid, config)
    optimizer = LBFGS(iterations=_ITERATIONS, tolerance=_FLAT)
    found = fit(model, demonstrations, walkers, terms=("actions",), optimizer=optimizer)
    if not found.converged:
        raise NotConverged(f"the costs of cells were not found: {found.message}")
    costs = np.asarray(found.people.costs)
    reward = CostlyReward(config.reward.discount, config.reward.step_cost, costs)
    planner = ModelPlanner(model, partial(reward.reach, model.blank))
    return ModelResult(model, reward, found.people.behavior_of(), costs.reshape(grid.shape), planner, found.converged)


def who_pay(grid: Grid, config: MapConfig) -> BehaviorModel:
    """People of maximum causal entropy whom it costs something to aim at cells."""
    return behavior_model(
        Behavior(LogSumExp(), config.behavior.beta), aimed_at=np.asarray(grid_graph(grid).successors[..., 0])
    )
