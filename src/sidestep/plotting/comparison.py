"""A picture of what several methods learned from the same walks."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sidestep.baselines.comparison import Comparison
from sidestep.evaluation.study import Problem
from sidestep.plotting.maps import Panel, figure_learned


def figure_comparison(comparison: Comparison) -> Figure:
    """Draw the walks, and beside them what each method learned.

    Args:
        comparison: The walks and what each method learned from them.

    Returns:
        A figure with at most three maps in a row.
    """
    problem = comparison.problem
    paths = problem.demonstrations.paths()
    panels = [Panel(f"{len(paths)} walks", problem.truth, paths=paths)]
    panels += [_panel(each.method, each.result, problem) for each in comparison.records if each.result is not None]
    return figure_learned(panels, columns=3, label="P(blocked), or costs, from least to most")


def _panel(name: str, result: Any, problem: Problem) -> Panel:
    """Draw what was learned of cells, or where that is nothing, the paths planned from the starts of the walks."""
    demonstrations = problem.demonstrations
    if result.heatmap is not None:
        return Panel(name, problem.grid, result.heatmap, problem.truth)
    goals = np.asarray(demonstrations.tasks.terminal).argmax(axis=-1)
    first = demonstrations.first_moves()
    starts, tasks = np.asarray(demonstrations.states)[first], np.asarray(demonstrations.task)[first]
    ends = np.unique(np.stack([starts, goals[tasks]]), axis=1)
    paths = [
        path
        for goal in np.unique(ends[1])
        for path in result.planner.plan_to(int(goal)).paths_from(ends[0, ends[1] == goal])
    ]
    return Panel(f"{name}: {len(paths)} planned paths", problem.truth, paths=paths)
