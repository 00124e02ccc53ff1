"""`sidestep learn`: from a map and a table of walks to a learned map."""

import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.errors import InputError
from sidestep.inference.fit import Fit
from sidestep.inference.maximize import Progress
from sidestep.inference.priors import Normal
from sidestep.io.gridding import Moves, grid_walks
from sidestep.io.maps import read_map
from sidestep.io.walks import Walks, read_walks
from sidestep.maps.annotations import NO_ANNOTATIONS, WalkAnnotations, fit_walks
from sidestep.maps.config import Settings
from sidestep.maps.learned_map import LearnedMap, write_learned_map
from sidestep.maps.selection import choose_behavior, told
from sidestep.maps.sensors import Known, Sensor, known_by
from sidestep.plotting.maps import figure_fit, save
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.tasks import Reward


def learn(
    walks: Path,
    map_file: Path,
    folder: Path,
    settings: Settings,
    report: Callable[[Progress], None] | None = None,
    resume: bool = False,
    sensor: Sensor | None = None,
    choosing: Callable[[str], None] | None = None,
    whose: WalkAnnotations = NO_ANNOTATIONS,
) -> dict[str, Any]:
    """Learns a map, writes it to a folder (see `sidestep.maps.learned_map`) and returns the summary.

    - `sensor`: what is known of unknown cells beforehand, where that is more than the settings' prior.
    - `choosing`: called with what is tried while it is chosen how people behave (`commands.behavior`); without it, they
      behave as the settings say.
    - `whose`: who walked, and after what.

    While it runs, `fit.checkpoint` in the folder is kept up to date; with `resume` an interrupted run goes on from
    there (not where goals are unknown). Raises `InputError` for anything wrong with the files or settings.
    """
    started = time.monotonic()
    grid = read_map(map_file, connectivity=settings.connectivity)
    whose.check(settings, choosing is not None, resume)
    shown = whose.without_goals(_sampled(read_walks(walks), settings))
    moves = grid_walks(shown, grid)
    known = known_by(sensor, grid, Normal(settings.prior_mean, settings.prior_variance))
    choice = choose_behavior(grid, moves, settings, known.prior, choosing) if choosing else None
    settings = choice.settings if choice else settings
    checkpoint = folder / "fit.checkpoint"
    resumed = resume and checkpoint.exists()
    model = ObstacleGrid(grid, np.broadcast_to(known.prior.mean, grid.size))
    how = {"report": report, "checkpoint": checkpoint, "resume": resume}
    found, settings, demonstrations, told_of_people = fit_walks(
        model, grid, shown, moves, whose, settings, known.prior, folder, **how
    )
    blocked = np.asarray(found.model.blocked, dtype=np.float64)
    reward = Reward(settings.discount, settings.step_cost)
    objective = np.array([progress.objective for progress in found.history])
    summary = {
        "command": "learn",
        "files": {"walks": str(walks), "map": str(map_file)},
        "sensor": sensor and sensor.told(),
        "settings": asdict(settings),
        "behavior": {**_learned_of(found.people), **told_of_people, **(told(choice) if choice else {})},
        "data": {**_counts(moves, demonstrations), **_cells(grid, known)},
        "resumed": resumed,
        "notes": _notes(demonstrations, settings, resume and not resumed),
        **_outcome(found),
        "seconds": round(time.monotonic() - started, 3),
        "peak_memory_bytes": peak_memory(),
    }
    seen = None if sensor is None else known.seen
    save(figure_fit(grid, demonstrations.paths(), blocked, objective, seen), folder / "learned.png")
    write_learned_map(folder, LearnedMap(grid, blocked, demonstrations.visited_state_goals(), reward), summary)
    checkpoint.unlink(missing_ok=True)
    return summary


def _counts(moves: Moves, demonstrations: Demonstrations) -> dict[str, int]:
    return {
        "walks": demonstrations.trajectories,
        "walks_left_out": len(moves.goals) - demonstrations.trajectories,
        "moves": len(demonstrations),
        "moves_left_out": len(moves.states) - len(demonstrations),
        "goals": len(np.unique(demonstrations.visited_state_goals()[:, 1])),
    }


def _cells(grid: Grid, known: Known) -> dict[str, int]:
    unknown = int((grid.known == Cell.UNKNOWN).sum())
    return {"unknown_cells": unknown, "sensed_cells": int(np.isfinite(known.seen).sum())}


def _learned_of(people: BehaviorModel) -> dict[str, float | None]:
    """How people are taken to behave in the end."""
    behavior = people.behavior_of()
    return {"beta": float(behavior.beta), "lapses": None if behavior.lapse is None else float(behavior.lapse)}


def peak_memory() -> int | None:
    """The most memory that this process has held, in bytes; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _sampled(walks: Walks, settings: Settings) -> Walks:
    if settings.sample is None:
        return walks
    if not 1 <= settings.sample <= len(walks):
        raise InputError(f"expected 1…{len(walks)} walks, found {settings.sample}", field="sample")
    drawn = np.random.default_rng(settings.seed).choice(len(walks), settings.sample, replace=False)
    return walks.select(np.sort(drawn))


def _notes(demonstrations: Demonstrations, settings: Settings, nothing_to_resume: bool) -> list[str]:
    """What a person should know before trusting the numbers."""
    notes = ["there was no checkpoint to resume from, so the fit began anew"] if nothing_to_resume else []
    moves = int(np.median(np.bincount(demonstrations.trajectory)))
    difference = settings.beta * (1 - settings.discount**2) * settings.discount**moves
    if settings.step_cost is None and difference < 0.05:
        notes.append(
            f"half of the walks have {moves} moves or more; so far from the goal a step towards it and one away "
            f"differ by {difference:.1g} in log-probability, and walks say next to nothing: "
            "consider --step-cost 1 --discount 1"
        )
    return notes


def _outcome(found: Fit[ObstacleGrid]) -> dict[str, Any]:
    final = found.final
    return {
        "objective": final.objective,
        "log_likelihood_actions": final.actions,
        "log_likelihood_transitions": final.transitions,
        "log_prior": final.prior,
        "largest_gradient": final.gradient,
        "iterations": final.iteration,
        "converged": found.converged,
        "message": found.message,
        "tasks": [
            {"sweeps": int(sweeps), "residual": float(residual), "converged": bool(converged)}
            for sweeps, residual, converged in zip(found.sweeps, found.residual, found.task_converged, strict=True)
        ],
    }
