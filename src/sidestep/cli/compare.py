"""`sidestep compare`: behavior-aware modeling beside its rivals, on the same walks and by the same scores."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sidestep._files import write_json
from sidestep.baselines.behavior_cloning import behavior_cloning
from sidestep.baselines.constraint_inference import constraint_inference
from sidestep.baselines.interface import (
    BaselineResult,
    Method,
    behavior_aware,
    transitions_only,
    visit_counts,
)
from sidestep.baselines.joint import joint_estimation
from sidestep.baselines.maxent_irl import maxent_irl
from sidestep.errors import ImproperTask, InputError, NotConverged
from sidestep.evaluation.evaluate import evaluate
from sidestep.evaluation.study import mean_log_likelihood
from sidestep.io.demonstrations import demonstrations_from_moves
from sidestep.io.gridding import Moves, grid_walks
from sidestep.io.maps import read_map, read_map_like
from sidestep.io.walks import read_walks
from sidestep.maps.config import Settings
from sidestep.maps.selection import choose_behavior, told
from sidestep.plotting.maps import Panel, figure_learned, save
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid

METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "behavior": behavior_aware,
        "transitions": transitions_only,
        "visits": visit_counts,
        "constraints": constraint_inference,
        "costs": maxent_irl,
        "joint": joint_estimation,
        "cloning": behavior_cloning,
    }
)
"""The methods by name: behavior-aware modeling first, then its rivals."""
_SCORES = ("auc", "average_precision", "legal_fraction", "regret", "heldout_log_likelihood", "seconds", "converged")
"""What is told of every method, null where it failed."""


def compare(
    walks_file: Path,
    map_file: Path,
    truth_file: Path,
    folder: Path,
    settings: Settings,
    hold_out: float = 0.2,
    report: Callable[[str], None] = lambda _: None,
    auto: bool = False,
) -> dict[str, Any]:
    """Learns by every method from some of the walks, scores all, and writes `compare.png` and `summary.json`.

    - `hold_out`: the share of walks, drawn by the settings' seed, that are not learned from. How probable their actions
      are under what was learned, in nats a move, is `heldout_log_likelihood`.
    - `auto`: how people behave is chosen by the walks that are learned from (`commands.behavior`) before any method
      learns. All but cloning take over the reward and β, those who learn from actions by `fit_map` the tempering.
      Lapses are learned by behavior-aware modeling; the transitions alone keep the share that learning begins with.

    The summary has `methods.<name>` with the scores of `evaluate`, that (null if a held-out goal's values are not
    found), `seconds`, and whether it `converged`; with nothing but the reason, `failed`, for a method that finds no
    values at all. Raises `InputError` for files that do not fit, and a share that leaves no walk to learn from or none
    to score; with `auto` also what `choose_behavior` does.
    """
    given = read_map(map_file, connectivity=settings.connectivity)
    truth = read_map_like(truth_file, given)
    walks = read_walks(walks_file)
    held = round(hold_out * len(walks))
    if not 0 < held < len(walks):
        raise InputError(f"expected a share of the {len(walks)} walks, found {hold_out}", field="hold_out")
    drawn = np.random.default_rng(settings.seed).permutation(len(walks))
    parts = [grid_walks(walks.select(np.sort(some)), given) for some in (drawn[held:], drawn[:held])]
    own, others = (_shown(moves, given, settings) for moves in parts)
    choice = choose_behavior(given, parts[0], settings, report=report) if auto else None
    if choice:
        settings = choice.settings
        own, others = (_shown(moves, given, settings) for moves in parts)
    methods, pictures = {}, []
    for name, learn in METHODS.items():
        report(f"learning by {name}")
        started = time.monotonic()
        try:
            learned = learn(given, own, settings)
            seconds = time.monotonic() - started
            report(f"scoring {name}")
            scored = given.known == Cell.UNKNOWN
            scores = evaluate(learned.planner, learned.ranking, truth, scored, own.visited_state_goals(), settings.seed)
        except (ImproperTask, NotConverged) as error:
            # what one method cannot do is no reason to say nothing of the others
            methods[name] = {**dict.fromkeys(_SCORES), "failed": str(error)}
            continue
        heldout = mean_log_likelihood(learned, others)
        methods[name] = {
            **scores.to_dict(),
            "heldout_log_likelihood": heldout,
            "seconds": round(seconds, 3),
            "converged": learned.converged,
        }
        pictures.append(_panel(name, learned, given, truth, own))
    summary = {
        "command": "compare",
        "files": {"walks": str(walks_file), "map": str(map_file), "truth": str(truth_file)},
        "settings": asdict(settings),
        "behavior": told(choice) if choice else {},
        "data": {"walks": len(walks) - held, "heldout_walks": held, "moves": len(own), "heldout_moves": len(others)},
        "methods": methods,
    }
    paths = own.paths()
    panels = [Panel(f"{len(paths)} walks", truth, paths=paths), *pictures]
    save(figure_learned(panels, columns=3, label="P(blocked), or costs, from least to most"), folder / "compare.png")
    write_json(folder / "summary.json", summary)
    return summary


def _shown(moves: Moves, grid: Grid, settings: Settings) -> Demonstrations:
    return demonstrations_from_moves(moves, grid, discount=settings.discount, step_cost=settings.step_cost)


def _panel(name: str, learned: BaselineResult, given: Grid, truth: Grid, shown: Demonstrations) -> Panel:
    """What was learned of cells; where that is nothing, the ways that it means to go from where people set out."""
    if learned.shares is not None:
        return Panel(name, given, learned.shares, truth)
    goals = np.asarray(shown.tasks.terminal).argmax(axis=-1)
    first = shown.first_moves()
    ends = np.unique(np.stack([np.asarray(shown.states)[first], goals[np.asarray(shown.task)[first]]]), axis=1)
    paths = [
        path
        for goal in np.unique(ends[1])
        for path in learned.planner.plan_to(int(goal)).paths_from(ends[0, ends[1] == goal])
    ]
    return Panel(f"{name}: its {len(paths)} ways", truth, paths=paths)
