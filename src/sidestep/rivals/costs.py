"""Maximum-causal-entropy inverse reinforcement learning: a cost of every cell, on dynamics of free space.

The paper's section "Motivation": people's detours are explained by what places cost, not by what happens there. Every
cell has a cost c = ln(1 + exp θ), paid by a move that aims at it, beside what people pursue anyway; no move is taken to
fail. The costs maximise the likelihood of what people did, and are the same for all goals. Maximum causal entropy is
the log-sum-exp, whatever the settings say of how people value states; their β counts.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from sidestep.demonstrations import Demonstrations
from sidestep.errors import NotConverged
from sidestep.evaluation import Reward
from sidestep.inference.priors import Normal
from sidestep.rivals.learned import Learned
from sidestep.settings import Settings
from sidestep.tabular.backups import Behavior, LogSumExp
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import ObstacleGrid, true_model
from sidestep.tasks import Task

_PRIOR = Normal(-4.0, 8.0)
"""A cost of .02 in units of the goal's reward, give or take a factor of seven."""


@dataclass(frozen=True, eq=False)
class CostlyReward(Reward):
    """What people pursue when cells cost something; `costs` are of every cell, in units of reward."""

    costs: Float[np.ndarray, " cells"] | None = None

    def reach(self, grid: Grid, goal: int) -> Task:
        """The task of reaching a state, less what the cells cost that moves aim at."""
        task = super().reach(grid, goal)
        return task if self.costs is None else _with_costs(task, true_model(grid.passable()), jnp.asarray(self.costs))


def by_costs(grid: Grid, demonstrations: Demonstrations, settings: Settings) -> Learned:
    """A cost for every cell; the ranking is by costs."""
    model, people = true_model(grid.passable()), Behavior(LogSumExp(), settings.beta)

    @jax.jit
    @jax.value_and_grad
    def loss(logits: Array) -> Array:
        tasks = _with_costs(demonstrations.tasks, model, jax.nn.softplus(logits))
        moved = eqx.tree_at(lambda demos: demos.tasks, demonstrations, tasks)
        return -log_likelihood(model, moved, people, terms=("actions",)).actions - _PRIOR.log_density(logits)

    start = np.full(grid.size, float(_PRIOR.mean))
    found = minimize(lambda logits: jax.tree.map(np.asarray, loss(logits)), start, jac=True, method="L-BFGS-B")
    if not found.success:
        raise NotConverged(f"the costs of cells were not found: {found.message}")
    costs = np.asarray(jax.nn.softplus(found.x))
    reward = CostlyReward(settings.discount, settings.step_cost, costs)
    return Learned(model, reward, people, costs.reshape(grid.shape))


def _with_costs(tasks: Task, model: ObstacleGrid, costs: Float[Array, " cells"]) -> Task:
    """Tasks in which a move also pays the cost of the cell that it aims at."""
    aimed_at = model.graph.successors[..., 0]
    return Task(tasks.reward - costs[aimed_at], tasks.final_reward, tasks.terminal, tasks.discount)
