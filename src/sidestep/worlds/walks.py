"""Simulated walks of agents that know a map."""

import jax
import numpy as np

import sidestep as ss
from sidestep.errors import check, check_instance
from sidestep.maps.config import SimulationConfig
from sidestep.tabular.backups import BACKUPS
from sidestep.worlds.offices import connected_cells, places


def simulate_walks(grid: ss.Grid, config: SimulationConfig) -> tuple[list[ss.Trajectory], list[int]]:
    """Simulate agents that walk from random cells to goals that lie well apart.

    Args:
        grid: The map that the agents know; unknown cells count as blocked.
        config: The agents.

    Returns:
        The trajectories, and the goals (states) in the order of their tasks.

    Raises:
        InputError: For a map with fewer connected free cells than goals, or agents that do not arrive.
    """
    check_instance(grid, ss.Grid, "grid")
    check_instance(config, SimulationConfig, "config")
    candidates = connected_cells(grid)
    needed = max(2, config.goals)
    message = f"expected at least {needed} free cells that can reach one another, found {len(candidates)}"
    check(len(candidates) >= needed, message, field="map")
    goals = places(grid, config.goals, config.seed).tolist()[: config.walks]
    random = np.random.default_rng(config.seed)
    goal_of_walk = np.arange(config.walks) % len(goals)
    starts = [random.choice(candidates[candidates != goal], (goal_of_walk == i).sum()) for i, goal in enumerate(goals)]
    behavior = None if config.beta is None else ss.Behavior(BACKUPS[config.backup](), config.beta)
    tasks = [config.reward.reach(grid, goal) for goal in goals]
    return ss.simulate(jax.random.key(config.seed), ss.true_model(grid), tasks, starts, behavior), goals
