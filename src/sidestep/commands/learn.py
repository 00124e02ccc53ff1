"""`sidestep learn`: from a map and a table of walks to a learned map."""

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from sidestep.demonstrations import Demonstrations
from sidestep.errors import InputError
from sidestep.evaluation import Reward
from sidestep.inference.batches import LARGE
from sidestep.inference.climb import Progress
from sidestep.inference.fit import Fit, fit
from sidestep.inference.objective import MEMORY
from sidestep.inference.optimisers import LBFGS, Ascent, Optimiser, Resilient
from sidestep.inference.priors import Lines, Normal, Prior
from sidestep.io.demonstrations import demonstrations_of_moves
from sidestep.io.gridding import grid_walks
from sidestep.io.maps import read_map
from sidestep.io.walks import Walks, read_walks
from sidestep.plotting.maps import figure_fit, save
from sidestep.runs import LearnedMap, write_learned_map
from sidestep.tabular.backups import BACKUPS, Behavior, Gradient
from sidestep.tabular.grid import Cell, Connectivity
from sidestep.tabular.likelihood import Term
from sidestep.tabular.models import ObstacleGrid

Terms = Literal["both", "actions", "transitions"]
TERMS: dict[Terms, tuple[Term, ...]] = {
    "both": ("actions", "transitions"),
    "actions": ("actions",),
    "transitions": ("transitions",),
}


@dataclass(frozen=True)
class Settings:
    """How a map is learned; `docs/real-people.md` tells how the defaults were chosen.

    - `backup`: a name in `BACKUPS`; `beta`: β above 0.
    - `discount`, `step_cost`: the walkers' reward, as in `reach`.
    - `prior_mean`, `prior_variance`: of every unknown cell's logit. `lines`: how many nats it is worth, beside that, if
      a blocked cell lies between two others (`Lines`).
    - `connectivity`: 4 or 8. `terms`: which parts of the likelihood count. `gradient`: "exact" climbs by L-BFGS
      (on large maps by `Resilient`), "fixed_policy" by first-order ascent. `horizon`: how many moves walkers look
      ahead (None: all).
    - `iterations`: at most this many (None: the optimiser's own limit). `memory`: about how many GiB the fit's arrays
      may take.
    - `sample`: learn from that many walks only, drawn by `seed` (None: from all).
    """

    backup: str = "boltzmann"
    beta: float = 7.0
    discount: float = 0.95
    step_cost: float | None = None
    prior_mean: float = 0.5
    prior_variance: float = 8.0
    lines: float = 0.0
    connectivity: Connectivity = 4
    terms: Terms = "both"
    gradient: Gradient = "exact"
    horizon: int | None = None
    iterations: int | None = None
    memory: float = MEMORY / 2**30
    sample: int | None = None
    seed: int = 0


def learn(
    walks: Path,
    map_file: Path,
    folder: Path,
    settings: Settings,
    report: Callable[[Progress], None] | None = None,
    resume: bool = False,
) -> dict[str, Any]:
    """Learns a map, writes it to a folder (see `sidestep.runs`) and returns the summary.

    While it runs, `fit.checkpoint` in the folder is kept up to date; with `resume` an interrupted run goes on from
    there. Raises `InputError` for anything wrong with the files or settings.
    """
    started = time.monotonic()
    grid = read_map(map_file, connectivity=settings.connectivity)
    moves = grid_walks(_sampled(read_walks(walks), settings), grid)
    demonstrations = demonstrations_of_moves(moves, grid, discount=settings.discount, step_cost=settings.step_cost)
    checkpoint = folder / "fit.checkpoint"
    resumed = resume and checkpoint.exists()
    found = fit_map(ObstacleGrid(grid, settings.prior_mean), demonstrations, settings, report, checkpoint, resume)
    blocked = np.asarray(found.model.blocked, dtype=np.float64)
    reward = Reward(settings.discount, settings.step_cost)
    counts = {
        "walks": demonstrations.trajectories,
        "walks_left_out": len(moves.goals) - demonstrations.trajectories,
        "moves": len(demonstrations),
        "moves_left_out": len(moves.states) - len(demonstrations),
        "goals": len(demonstrations.tasks.terminal),
        "unknown_cells": int((grid.known == -1).sum()),
    }
    objective = np.array([progress.objective for progress in found.history])
    summary = {
        "command": "learn",
        "files": {"walks": str(walks), "map": str(map_file)},
        "settings": asdict(settings),
        "data": counts,
        "resumed": resumed,
        "notes": _notes(demonstrations, settings, resume and not resumed),
        **_outcome(found),
        "seconds": round(time.monotonic() - started, 3),
        "peak_memory_bytes": peak_memory(),
    }
    save(figure_fit(grid, demonstrations.paths(), blocked, objective), folder / "learned.png")
    write_learned_map(folder, LearnedMap(grid, blocked, demonstrations.visited(), reward), summary)
    checkpoint.unlink(missing_ok=True)
    return summary


def fit_map(
    model: ObstacleGrid,
    demonstrations: Demonstrations,
    settings: Settings,
    report: Callable[[Progress], None] | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
) -> Fit[ObstacleGrid]:
    """The fit that `settings` describe."""
    if settings.backup not in BACKUPS:
        raise InputError(f"expected one of {', '.join(BACKUPS)}, found {settings.backup!r}", field="backup")
    if not (np.isfinite(settings.memory) and settings.memory > 0):
        raise InputError(f"expected GiB above 0, found {settings.memory}", field="memory")
    people = Behavior(BACKUPS[settings.backup](), settings.beta)
    prior = _prior_of(settings, model)
    optimiser = optimiser_of(settings, model.graph.states, len(demonstrations))
    if settings.terms == "both":
        # where people walked is known without a solve: begin there
        model = fit(model, demonstrations, people, prior=prior, terms=("transitions",)).model
    if isinstance(optimiser, Resilient):
        model = _taken_as_blocked(model, demonstrations)
    return fit(
        model,
        demonstrations,
        people,
        prior=prior,
        terms=TERMS[settings.terms],
        gradient=settings.gradient,
        horizon=settings.horizon,
        optimiser=optimiser,
        memory=settings.memory * 2**30,
        report=report,
        checkpoint=checkpoint,
        resume=resume,
    )


def _prior_of(settings: Settings, model: ObstacleGrid) -> Prior:
    each = Normal(settings.prior_mean, settings.prior_variance)
    return Lines(each, model.known, settings.lines) if settings.lines else each


_CLOSED = 8.0
"""The logit of a cell that is taken as blocked: some 3,000 tries, longer than most ways round."""
_A_MOVE = 1e-3
"""A large map is learned when the next step promises less than this for each of people's moves (nats)."""


def optimiser_of(settings: Settings, cells: int, moves: int) -> Optimiser:
    """L-BFGS for the exact gradient, `Resilient` for what people do on large maps; ascent for the fixed-policy one.

    `docs/design.md` says why. A map is large where solves are loose at first and tasks come in small batches.
    """
    if settings.iterations is not None and settings.iterations < 1:
        raise InputError(f"expected at least 1, found {settings.iterations}", field="iterations")
    limit = {} if settings.iterations is None else {"iterations": settings.iterations}
    if settings.gradient == "fixed_policy":
        return Ascent(**limit)
    if cells < LARGE or settings.terms == "transitions":
        return LBFGS(**limit)
    return Resilient(tolerance=_A_MOVE * moves, **limit)


def most_iterations(settings: Settings) -> int:
    """How many iterations a fit takes at the latest, whatever the map."""
    return max(optimiser_of(settings, cells, moves=1).iterations for cells in (0, LARGE))


def _taken_as_blocked(model: ObstacleGrid, demonstrations: Demonstrations) -> ObstacleGrid:
    """The model, with all unknown cells that nobody visited as good as blocked.

    Then nobody could have taken another way, and the prior pulls cells down until people would have. From below it is a
    long climb: of all the gaps in a wall, the likelihood only sees the one that people would take next.
    """
    visited = np.zeros(model.graph.states, dtype=bool)
    visited[np.asarray(demonstrations.states)] = visited[np.asarray(demonstrations.next_states)] = True
    unseen = jnp.asarray(~visited & (np.asarray(model.known).ravel() == Cell.UNKNOWN))
    return model.with_parameters(jnp.where(unseen, _CLOSED, model.parameters))


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
