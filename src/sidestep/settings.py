"""Settings: how a map is learned, in one place, and the fit that they describe."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.demonstrations import Demonstrations
from sidestep.errors import InputError
from sidestep.inference.batches import LARGE
from sidestep.inference.climb import Progress
from sidestep.inference.fit import Fit, fit
from sidestep.inference.objective import MEMORY
from sidestep.inference.optimisers import LBFGS, Ascent, Optimiser, Resilient
from sidestep.inference.priors import Lines, Normal, Prior, Stood
from sidestep.tabular.backups import BACKUPS, Behavior, Gradient
from sidestep.tabular.grid import Cell, Connectivity
from sidestep.tabular.likelihood import Term
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.people import People, people

Terms = Literal["both", "actions", "transitions"]
TERMS: dict[Terms, tuple[Term, ...]] = {
    "both": ("actions", "transitions"),
    "actions": ("actions",),
    "transitions": ("transitions",),
}


@dataclass(frozen=True)
class Settings:
    """How a map is learned; `docs/real-people.md` tells how the defaults were chosen.

    - `backup`: a name in `BACKUPS`; `beta`: β above 0. `lapse`: the share of actions at random.
    - `unknown`: what is learned of people with the map, of `TRAITS`. `tempering`: how much actions count, as in `fit`.
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
    lapse: float | None = None
    unknown: tuple[str, ...] = ()
    tempering: float = 1.0
    discount: float = 0.95
    step_cost: float | None = None
    prior_mean: float = -1.5
    prior_variance: float = 16.0
    lines: float = 1.0
    connectivity: Connectivity = 4
    terms: Terms = "both"
    gradient: Gradient = "exact"
    horizon: int | None = None
    iterations: int | None = None
    memory: float = MEMORY / 2**30
    sample: int | None = None
    seed: int = 0

    def behavior(self) -> Behavior:
        """How people behave, as far as it is known."""
        if self.backup not in BACKUPS:
            raise InputError(f"expected one of {', '.join(BACKUPS)}, found {self.backup!r}", field="backup")
        return Behavior(BACKUPS[self.backup](), self.beta, self.lapse)

    def people(self, person: Int[np.ndarray, " tasks"] | None = None) -> People:
        """People of whom is known what the settings say; `person`: whose each task is, where they differ (`apart`)."""
        discount = self.discount if "discount" in self.unknown else None
        return people(self.behavior(), self.unknown, discount=discount, person=person)


def fit_map(
    model: ObstacleGrid,
    demonstrations: Demonstrations,
    settings: Settings,
    report: Callable[[Progress], None] | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    each: Normal | None = None,
    walkers: People | None = None,
    afresh: bool = True,
) -> Fit[ObstacleGrid]:
    """The fit that `settings` describe. Where transitions count, so do the cells in which walks begin (`Stood`).

    - `each` is the prior of cells' logits and `walkers` are the people, where they are not the settings' own.
    - `afresh`: begin where transitions and first cells lead, rather than at `model`.
    """
    if not (np.isfinite(settings.memory) and settings.memory > 0):
        raise InputError(f"expected GiB above 0, found {settings.memory}", field="memory")
    walkers = walkers or settings.people()
    counted = np.asarray(demonstrations.counted)
    prior = _prior_of(settings, model, each)
    if settings.terms != "actions":
        prior = Stood(prior, jnp.asarray(_begun(model, demonstrations, counted)))
    optimiser = optimiser_of(settings, model.graph.states, round(float(counted.sum())))
    if afresh and settings.terms == "both":
        # where people walked is known without a solve: begin there
        model = fit(model, demonstrations, walkers, prior=prior, terms=("transitions",)).model
    if afresh and isinstance(optimiser, Resilient):
        model = _taken_as_blocked(model, demonstrations, counts=counted > 0)
    return fit(
        model,
        demonstrations,
        walkers,
        prior=prior,
        tempering=settings.tempering,
        terms=TERMS[settings.terms],
        gradient=settings.gradient,
        horizon=settings.horizon,
        optimiser=optimiser,
        memory=settings.memory * 2**30,
        report=report,
        checkpoint=checkpoint,
        resume=resume,
    )


def _begun(
    model: ObstacleGrid, demonstrations: Demonstrations, counted: Float[np.ndarray, " moves"]
) -> Float[np.ndarray, " cells"]:
    """How many walks begin in each unknown cell, each by how much it counts."""
    first = demonstrations.firsts()
    begun = np.bincount(np.asarray(demonstrations.states)[first], counted[first], minlength=model.graph.states)
    return np.where(np.asarray(model.known).ravel() == Cell.UNKNOWN, begun, 0.0)


def _prior_of(settings: Settings, model: ObstacleGrid, each: Normal | None) -> Prior:
    each = each or Normal(settings.prior_mean, settings.prior_variance)
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


def _taken_as_blocked(
    model: ObstacleGrid, demonstrations: Demonstrations, counts: Bool[np.ndarray, " moves"]
) -> ObstacleGrid:
    """The model, with all unknown cells that nobody visited, in moves that count, as good as blocked.

    Then nobody could have taken another way, and the prior pulls cells down until people would have. From below it is a
    long climb: of all the gaps in a wall, the likelihood only sees the one that people would take next.
    """
    visited = np.zeros(model.graph.states, dtype=bool)
    for states in (demonstrations.states, demonstrations.next_states):
        visited[np.asarray(states)[counts]] = True
    unseen = jnp.asarray(~visited & (np.asarray(model.known).ravel() == Cell.UNKNOWN))
    return model.with_parameters(jnp.where(unseen, _CLOSED, model.parameters))
