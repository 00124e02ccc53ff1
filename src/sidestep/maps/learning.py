"""How a map was learned: a record, and its summary for `summary.json`."""

from dataclasses import asdict, dataclass
from typing import Any

from sidestep.inference.fit import Fit
from sidestep.maps.config import MapConfig
from sidestep.maps.goal_candidates import GoalPosterior
from sidestep.maps.selection import Selection
from sidestep.maps.sensors import SensorMap
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.models import ObstacleGrid


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
        config: The configuration, with what the selection chose.
        fit: The fit: model, behavior, history, convergence.
        demonstrations: The moves that counted.
        data: Their numbers.
        selection: The selection of the behavior, if there was one.
        persons: β of each person, where persons were named.
        goals: The posterior over goals, where walks did not name them.
        sensor: What sensors had seen.
        notes: What one should know before one trusts the numbers.
        resumed: Whether the fit continued from a checkpoint.
        seconds: The time it took.
        peak_memory_bytes: The most memory of the process; None where the system does not say.
    """

    config: MapConfig
    fit: Fit[ObstacleGrid]
    demonstrations: Demonstrations
    data: DataCounts
    selection: Selection | None
    persons: dict[str, float]
    goals: GoalPosterior | None
    sensor: SensorMap | None
    notes: tuple[str, ...]
    resumed: bool
    seconds: float
    peak_memory_bytes: int | None

    def summary(self) -> dict[str, Any]:
        """Return the content of `summary.json`: plain numbers, texts, lists and dictionaries."""
        final, behavior = self.fit.final, self.fit.behavior.behavior_of()
        return {
            "settings": asdict(self.config),
            "sensor": self.sensor.summary() if self.sensor else None,
            "behavior": {
                "beta": float(behavior.beta),
                "lapse": None if behavior.lapse is None else float(behavior.lapse),
                **({"persons": self.persons} if self.persons else {}),
                **({"goals": self.goals.summary()} if self.goals else {}),
                **(self.selection.summary() if self.selection else {}),
            },
            "data": asdict(self.data),
            "resumed": self.resumed,
            "notes": list(self.notes),
            "objective": final.objective,
            "log_likelihood_actions": final.actions,
            "log_likelihood_transitions": final.transitions,
            "log_prior": final.prior,
            "largest_gradient": final.gradient,
            "iterations": final.iteration,
            "converged": self.fit.converged,
            "message": self.fit.message,
            "tasks": [
                {"sweeps": int(sweeps), "residual": float(residual), "converged": bool(converged)}
                for sweeps, residual, converged in zip(
                    self.fit.sweeps.tolist(), self.fit.residual.tolist(), self.fit.task_converged.tolist(), strict=True
                )
            ],
            "seconds": self.seconds,
            "peak_memory_bytes": self.peak_memory_bytes,
        }
