"""A first look: an office nobody mapped, learned from the walks of those who work there.

Walkers who know the office cross it between a few places. The map is forgotten, learned again from their walks alone,
and used to plan to goals that nobody had.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from sidestep._files import write_json
from sidestep.cli.simulate import Walkers, walk
from sidestep.evaluation.evaluate import evaluate, plan_paths
from sidestep.io.demonstrations import demonstrations_from_walks
from sidestep.io.maps import write_map
from sidestep.io.trajectories import walks_from_trajectories
from sidestep.io.walks import write_walks
from sidestep.maps.config import Settings, fit_map
from sidestep.maps.learned_map import LearnedMap, write_learned_map
from sidestep.plotting.maps import Panel, figure_learned, save
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import Reward
from sidestep.worlds.offices import office, places

ROWS, COLUMNS = 14, 24
WALKERS = Walkers(walks=400, goals=12)
SETTINGS = Settings(beta=20.0, discount=0.97)
NEW_PLACES = 4


def demo(folder: Path, seed: int = 0, report: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Runs the demonstration, writes `demo.png`, the true map, the walks and the learned map to a folder, and returns
    the summary. `seed` draws the office, its walkers and the new goals; `report` is told what is being done.
    """
    truth = office(ROWS, COLUMNS, seed)
    report("walkers cross the office")
    trajectories, goals = walk(truth, replace(WALKERS, seed=seed))
    walks = walks_from_trajectories(trajectories, goals, truth)
    write_map(folder / "truth.yaml", truth.known.astype(np.float64), truth)
    write_walks(folder / "walks.csv", walks)

    report("learning the map from their walks")
    blank = truth.forget()
    reward = Reward(SETTINGS.discount, SETTINGS.step_cost)
    shown = demonstrations_from_walks(walks, blank, discount=reward.discount, step_cost=reward.step_cost)
    found = fit_map(ObstacleGrid(blank, SETTINGS.prior_mean), shown, SETTINGS)
    blocked = np.asarray(found.model.blocked)

    report("planning between all pairs of places")
    learned = LearnedMap(blank, blocked, shown.visited_state_goals(), reward)
    scores = evaluate(learned.robot(), blocked, truth, np.ones(truth.shape, bool), learned.visited)
    elsewhere = places(truth, NEW_PLACES + len(goals), seed + 1)
    new = elsewhere[~np.isin(elsewhere, goals)][:NEW_PLACES]
    paths, _ = plan_paths(learned.robot(), new[:1], new[1:])
    panels = [
        Panel(f"{len(walks)} walks in an office", truth, paths=shown.paths(), goals=goals),
        Panel(
            "what they say of its walls, and new plans",
            blank,
            blocked,
            truth,
            paths,
            new[:1].tolist(),
            new[1:].tolist(),
        ),
    ]
    save(figure_learned(panels), folder / "demo.png")
    summary = {
        "command": "demo",
        "settings": asdict(SETTINGS),
        "walkers": asdict(replace(WALKERS, seed=seed)),
        "objective": found.final.objective,
        "converged": found.converged,
        "message": found.message,
        "scores": scores.to_dict(),
    }
    write_learned_map(folder / "learned", learned, summary)
    write_json(folder / "summary.json", summary)
    return summary
