"""Learning a map from walks: the one function that makes learned maps, and the record of how it made one.

The command line, the comparison, the demo and the benchmarks call `learn_map`.
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sidestep.errors import check, check_function, check_instance
from sidestep.inference.coordinate_ascent import AscentProgress
from sidestep.inference.maximize import Progress
from sidestep.inference.sampler import BarrierPosterior, SweepProgress
from sidestep.io.gridding import Moves, grid_walks
from sidestep.io.walks import Walks
from sidestep.maps.annotations import NO_ANNOTATIONS, WalkAnnotations, persons_of
from sidestep.maps.config import MapConfig, PosteriorMethod
from sidestep.maps.fit import MapPosterior, behavior_model_of, demonstrations_of, infer_map, method_of
from sidestep.maps.goal_candidates import GoalPosterior, fit_with_unknown_goals
from sidestep.maps.information import map_information
from sidestep.maps.learned_map import LearnedMap
from sidestep.maps.sensors import SensorMap, first_logits, seen_cells
from sidestep.tabular.demonstrations import Demonstrations, split_by_person
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models import ObstacleGrid

_KEPT_SAMPLES = 400
"""The most samples of a learned map."""
_NEGLIGIBLE_PREFERENCE = 0.05
"""A difference of two actions' log-probabilities (nats) that says next to nothing."""


@dataclass(frozen=True)
class DataCounts:
    """The size of what a map was learned from.

    Attributes:
        walks, moves: What counted.
        walks_left_out: Walks that start at their goal.
        moves_left_out: Moves after the arrival at the goal.
        goals: Different goals.
        unknown_cells: Cells that had to be learned.
        sensed_cells: Of these, cells that sensors have seen.
    """

    walks: int
    walks_left_out: int
    moves: int
    moves_left_out: int
    goals: int
    unknown_cells: int
    sensed_cells: int


@dataclass(frozen=True, eq=False)
class Learning:
    """How a map was learned.

    Attributes:
        config: The configuration; with persons, β is learned.
        fit: The posterior, as samples, a mean field or a fit: model, behavior, history, convergence.
        demonstrations: The moves that counted.
        data: Their numbers.
        persons: β of each person, where persons were named.
        goals: The posterior over goals, where walks did not name them.
        sensor: What sensors had seen.
        notes: What one should know before one trusts the numbers.
        resumed: Whether the fit continued from a checkpoint.
        seconds: The time it took.
        peak_memory_bytes: The most memory of the process; None where the system does not say.
    """

    config: MapConfig
    fit: MapPosterior
    demonstrations: Demonstrations
    data: DataCounts
    persons: dict[str, float]
    goals: GoalPosterior | None
    sensor: SensorMap | None
    notes: tuple[str, ...]
    resumed: bool
    seconds: float
    peak_memory_bytes: int | None

    @property
    def method(self) -> PosteriorMethod:
        """How the posterior was found."""
        return method_of(self.fit, self.config)

    def summary(self) -> dict[str, Any]:
        """Return the content of `summary.json`: plain numbers, texts, lists and dictionaries."""
        behavior = self.fit.behavior.behavior_of()
        return {
            "settings": asdict(self.config),
            "sensor": self.sensor.summary() if self.sensor else None,
            "behavior": {
                "beta": float(behavior.beta),
                "lapse": None if behavior.lapse is None else float(behavior.lapse),
                **({"persons": self.persons} if self.persons else {}),
                **({"goals": self.goals.summary()} if self.goals else {}),
            },
            "data": asdict(self.data),
            "posterior": self.method,
            "resumed": self.resumed,
            "notes": list(self.notes),
            **self.fit.summary(),
            "seconds": self.seconds,
            "peak_memory_bytes": self.peak_memory_bytes,
        }


def learn_map(
    grid: Grid,
    walks: Walks,
    config: MapConfig | None = None,
    *,
    sensor: SensorMap | None = None,
    annotations: WalkAnnotations = NO_ANNOTATIONS,
    callback: Callable[[Progress | AscentProgress | SweepProgress], None] | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
) -> LearnedMap:
    """Learn the obstacles of a map from walks.

    Args:
        grid: The geometry, the moves, and what is known of each cell.
        walks: Positions and goals in metres in the map's frame.
        config: The reward, behavior, prior and fit; by default those of `sidestep learn`.
        sensor: What sensors saw of unknown cells.
        annotations: The persons of the walks, and candidates for goals that walks do not name.
        callback: Called with the progress of every iteration of a fit, or every sweep of a sampler.
        checkpoint: A file that is kept up to date while the fit runs.
        resume: Continue from the checkpoint. The result is that of an uninterrupted run.

    Returns:
        The learned map, with a record of how it was learned.

    Raises:
        InputError: For walks, settings or a checkpoint that do not fit the map or each other.
        ImproperTask: For a reward without finite values.
        NotConverged: Where values do not converge.

    Example:
        >>> import numpy as np, pyarrow as pa
        >>> from sidestep.io.walks import walks_from_table
        >>> table = pa.table({"walk": [0, 0], "step": [0, 1], "x": [0.5, 2.5], "y": [0.5, 0.5]})
        >>> learned = learn_map(Grid.unknown(rows=1, columns=3), walks_from_table(table))
        >>> bool((learned.blocked < 0.5).all())
        True

    References:
        `docs/equations.md`, equations (1) and (6).
    """
    started = time.monotonic()
    config = config or MapConfig()
    arguments = {"grid": (grid, Grid), "walks": (walks, Walks), "config": (config, MapConfig)}
    arguments |= {"sensor": (sensor, (SensorMap, type(None))), "annotations": (annotations, WalkAnnotations)}
    for name, (value, kinds) in arguments.items():
        check_instance(value, kinds, name)
    if callback is not None:
        check_function(callback, "callback")
    annotations.check(config.behavior, resume)
    config = with_annotations(config, annotations)
    walks = annotations.without_goals(sample_walks(walks, config))
    moves = grid_walks(walks, grid)
    resumed = resume and checkpoint is not None and Path(checkpoint).exists()
    run: dict[str, Any] = {"callback": callback, "checkpoint": checkpoint, "resume": resume}
    inferred = _infer(grid, walks, moves, config, sensor, annotations, run)
    fit, demonstrations, names = inferred.fit, inferred.demonstrations, inferred.names
    nats = map_information(fit, config)
    learning = Learning(
        config=config,
        fit=fit,
        demonstrations=demonstrations,
        data=_counts(grid, moves, demonstrations, sensor),
        persons={str(name): float(fit.behavior.behavior_of(index).beta) for index, name in enumerate(names)},
        goals=inferred.goals,
        sensor=sensor,
        notes=_notes(grid, demonstrations, config, resume and not resumed),
        resumed=resumed,
        seconds=round(time.monotonic() - started, 3),
        peak_memory_bytes=peak_memory(),
    )
    return _learned_map(grid, learning, nats)


class _Inferred(NamedTuple):
    """A posterior of a map, the moves that counted, and the names of persons and the goals where these are learned."""

    fit: MapPosterior
    demonstrations: Demonstrations
    names: Sequence[object]
    goals: GoalPosterior | None


def _infer(
    grid: Grid,
    walks: Walks,
    moves: Moves,
    config: MapConfig,
    sensor: SensorMap | None,
    annotations: WalkAnnotations,
    run: dict[str, Any],
) -> _Inferred:
    """Return the posterior of a map; `run` has the callback, the checkpoint, and whether to resume from it."""
    model = ObstacleGrid(grid, first_logits(sensor, grid.known, config.prior))
    candidates = annotations.goal_candidates
    if candidates is not None:
        message = "maps are not sampled where goals are unknown: expected mean_field, or none for the default"
        check(config.posterior.method != "sample", message, field="posterior")
        goals = fit_with_unknown_goals(model, grid, moves, candidates, walks.labels, config, sensor, run["callback"])
        return _Inferred(goals.fit.fit, demonstrations_of(goals.moves, grid, config), [], goals)
    demonstrations, names, person = demonstrations_of(moves, grid, config), [], None
    if annotations.person_column is not None:
        names, person_of_walk = persons_of(walks, moves, annotations.person_column)
        demonstrations, person = split_by_person(demonstrations, person_of_walk)
    behavior = behavior_model_of(config, person)
    return _Inferred(
        infer_map(model, demonstrations, config, sensor=sensor, behavior=behavior, **run), demonstrations, names, None
    )


def _learned_map(grid: Grid, learning: Learning, nats: Float[np.ndarray, "rows columns"]) -> LearnedMap:
    """Return the map of a posterior, with its samples where it has some, and what walks say of each cell in nats."""
    fit, config = learning.fit, learning.config
    samples = fit.thinned(_KEPT_SAMPLES).reshape(-1, *grid.shape) if isinstance(fit, BarrierPosterior) else None
    return LearnedMap(
        grid,
        np.asarray(fit.model.blocked, dtype=np.float64),
        learning.demonstrations.visited_state_goals(),
        config.reward,
        learning,
        samples,
        information=nats,
        unknown_below=config.unknown_below,
    )


def sample_walks(walks: Walks, config: MapConfig) -> Walks:
    """Return the walks, or `config.max_walks` of them drawn by the seed.

    Args:
        walks: All walks.
        config: The configuration.

    Raises:
        InputError: For a number of walks below 1 or above all.
    """
    if config.max_walks is None:
        return walks
    in_range = 1 <= config.max_walks <= len(walks)
    check(in_range, f"expected 1…{len(walks)} walks, found {config.max_walks}", field="max_walks")
    drawn = np.random.default_rng(config.seed).choice(len(walks), config.max_walks, replace=False)
    return walks.select(np.sort(drawn))


def peak_memory() -> int | None:
    """Return the most memory that this process has held in bytes; None where the system does not say."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _counts(grid: Grid, moves: Moves, demonstrations: Demonstrations, sensor: SensorMap | None) -> DataCounts:
    return DataCounts(
        walks=demonstrations.trajectories,
        walks_left_out=len(moves.goals) - demonstrations.trajectories,
        moves=len(demonstrations),
        moves_left_out=len(moves.states) - len(demonstrations),
        goals=len(np.unique(demonstrations.visited_state_goals()[:, 1])),
        unknown_cells=int((grid.known == Cell.UNKNOWN).sum()),
        sensed_cells=int(np.isfinite(seen_cells(sensor, grid.known)).sum()),
    )


def with_annotations(config: MapConfig, annotations: WalkAnnotations) -> MapConfig:
    """Return the configuration with the numbers of its agents.

    The β of persons is learned, and the actions of walks with unknown goals count in full. So both have the agents
    `SOFT` where nothing else is set.

    Args:
        config: The configuration.
        annotations: What walks tell beside positions.
    """
    behavior = config.behavior
    if annotations.goal_candidates is not None:
        behavior = replace(behavior, tempering=1.0)
    if annotations.person_column is not None:
        behavior = replace(behavior, learn=tuple(dict.fromkeys((*behavior.learn, "beta"))))
    return replace(config, behavior=behavior).completed()


def _notes(grid: Grid, demonstrations: Demonstrations, config: MapConfig, nothing_to_resume: bool) -> tuple[str, ...]:
    """Return what one should know before one trusts the numbers."""
    notes = ["there was no checkpoint to resume from, so the fit started anew"] if nothing_to_resume else []
    if not (grid.known == Cell.UNKNOWN).any():
        notes.append(
            "the map knows every cell, so there are none to learn; a gray pixel of 205 is unknown only if "
            "free_thresh in the map's YAML is .196 or less (many mappers write .25)"
        )
    moves = int(np.median(np.bincount(np.asarray(demonstrations.trajectory))))
    discount = config.reward.discount
    preference = config.agents.beta * (1 - discount**2) * discount**moves
    if config.reward.step_cost is None and preference < _NEGLIGIBLE_PREFERENCE:
        notes.append(
            f"half of the walks have {moves} moves or more; so far from the goal a step towards it and one away "
            f"differ by {preference:.1g} in log-probability, and walks say next to nothing: "
            "consider a step cost of 1 and a discount of 1"
        )
    return tuple(notes)
