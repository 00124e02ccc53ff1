"""Who walked, and after what: fits for walks that say more of it in a column, or less."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sidestep.errors import InputError
from sidestep.inference.fit import Fit
from sidestep.inference.maximize import Progress
from sidestep.inference.priors import Normal
from sidestep.io.demonstrations import demonstrations_from_moves
from sidestep.io.gridding import Moves
from sidestep.io.walks import Walks
from sidestep.maps.config import Settings, fit_map
from sidestep.maps.goal_candidates import fit_candidates, read_candidates, write_posterior
from sidestep.tabular.demonstrations import Demonstrations, split_by_person
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import ObstacleGrid


@dataclass(frozen=True)
class WalkAnnotations:
    """What walks say in a column of their own of who walked, and what they do not say of their goals.

    - `person`: the column that names who walked; then each has a β of their own, and people are pooled.
    - `candidates`: a table of the goals that walks may have had, which then do not name their own.
    """

    person: str | None = None
    candidates: Path | None = None

    def check(self, settings: Settings, choosing: bool, resume: bool) -> None:
        """Raises `InputError` for what does not go together.

        Where goals are unknown, people are taken to be known and alike and to look all the way ahead, and nothing is
        kept to resume from.
        """
        if self.candidates is None:
            return
        refused = {
            "person": self.person is not None,
            "behavior": choosing,
            "resume": resume,
            "unknown": bool(settings.unknown),
            "tempering": settings.tempering != 1,
            "horizon": settings.horizon is not None,
        }
        for field, given in refused.items():
            if given:
                raise InputError("cannot be had together with candidates for goals", field=field)

    def without_goals(self, walks: Walks) -> Walks:
        """The walks, without goals of their own where these are to be found among candidates: each ends at its last."""
        return walks if self.candidates is None else replace(walks, goals=walks.positions[walks.offsets[1:] - 1])


NO_ANNOTATIONS = WalkAnnotations()
"""Walks name their goals, and people are alike."""


class Found(NamedTuple):
    """A fit, by which settings and from what it was made, and what else it tells of people."""

    fit: Fit[ObstacleGrid]
    settings: Settings
    demonstrations: Demonstrations
    told: dict[str, Any]


def fit_walks(
    model: ObstacleGrid,
    grid: Grid,
    walks: Walks,
    moves: Moves,
    whose: WalkAnnotations,
    settings: Settings,
    prior: Normal,
    folder: Path,
    report: Callable[[Progress], None] | None = None,
    **how: Any,
) -> Found:
    """The fit of a map to walks, by whoever they are and whatever they were after.

    `moves` are those of `walks`; `report` and `how` are for `fit_map`. Where goals are unknown, writes
    `posterior.csv` to the folder.
    """
    if whose.candidates is not None:
        candidates = read_candidates(whose.candidates, grid, moves)
        guessed = fit_candidates(model, grid, moves, candidates, settings, prior, report)
        write_posterior(folder / "posterior.csv", guessed, walks.labels, grid)
        return Found(guessed.fit, settings, _demonstrations(guessed.moves, grid, settings), {"goals": guessed.told()})
    demonstrations = _demonstrations(moves, grid, settings)
    if whose.person is None:
        found = fit_map(model, demonstrations, settings, report, each=prior, **how)
        return Found(found, settings, demonstrations, {})
    said = walks.per_walk(whose.person)
    names = [said[walk] for walk in np.unique(moves.before_goal().walk).tolist()]
    persons = list(dict.fromkeys(names))
    demonstrations, person = split_by_person(demonstrations, np.array([persons.index(name) for name in names]))
    settings = replace(settings, unknown=tuple(dict.fromkeys((*settings.unknown, "sharpness"))))
    found = fit_map(model, demonstrations, settings, report, each=prior, walkers=settings.people(person), **how)
    betas = {str(name): float(found.people.behavior_of(index).beta) for index, name in enumerate(persons)}
    return Found(found, settings, demonstrations, {"persons": betas})


def _demonstrations(moves: Moves, grid: Grid, settings: Settings) -> Demonstrations:
    return demonstrations_from_moves(moves, grid, discount=settings.discount, step_cost=settings.step_cost)
