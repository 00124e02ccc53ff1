"""What a table of walks says of its persons in a column, and candidates for goals that it does not name."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from sidestep.errors import check, check_instance
from sidestep.io.gridding import Moves
from sidestep.io.walks import Walks
from sidestep.maps.config import BehaviorConfig
from sidestep.maps.goal_candidates import GoalCandidates


@dataclass(frozen=True, eq=False)
class WalkAnnotations:
    """What is known of the walks beside their positions.

    Attributes:
        person_column: The column that names the person of each walk. Each person then has their own β, and all are
            pooled.
        goal_candidates: The goals that walks may have had. The walks then do not name their own.

    Example:
        >>> WalkAnnotations(person_column="person").goal_candidates is None
        True
    """

    person_column: str | None = None
    goal_candidates: GoalCandidates | None = None

    def __post_init__(self) -> None:
        check_instance(self.person_column, (str, type(None)), "person_column")
        check_instance(self.goal_candidates, (GoalCandidates, type(None)), "goal_candidates")

    def check(self, config: BehaviorConfig, resume: bool) -> None:
        """Check that settings do not exclude each other.

        With unknown goals the behavior is known and the same for all walks, and there is no checkpoint.

        Args:
            config: The behavior to learn with.
            resume: Whether a checkpoint is resumed.

        Raises:
            InputError: If they do.
        """
        if self.goal_candidates is None:
            return
        refused = {
            "person_column": self.person_column is not None,
            "resume": resume,
            "learn": bool(config.learn),
            "tempering": config.tempering not in (None, 1),
            "horizon": config.horizon is not None,
        }
        for field, is_set in refused.items():
            check(not is_set, "expected none beside candidates for goals, found one", field=field)

    def without_goals(self, walks: Walks) -> Walks:
        """Return the walks; with candidates for goals, each walk's own goal is its last position.

        Args:
            walks: The walks.
        """
        if self.goal_candidates is None:
            return walks
        return replace(walks, goals=walks.positions[walks.offsets[1:] - 1])


NO_ANNOTATIONS = WalkAnnotations()
"""The walks name their goals, and all persons are alike."""


def persons_of(walks: Walks, moves: Moves, column: str) -> tuple[list[object], Int[np.ndarray, " trajectories"]]:
    """Return the names of the persons, and the index of the person of each trajectory.

    Args:
        walks: The walks.
        moves: Their moves.
        column: The column that names the person of each walk.

    Raises:
        InputError: As `Walks.per_walk` does.
    """
    names = walks.per_walk(column)
    of_trajectory = [names[walk] for walk in np.unique(moves.before_goal().walk).tolist()]
    persons = list(dict.fromkeys(of_trajectory))
    return persons, np.array([persons.index(name) for name in of_trajectory])
