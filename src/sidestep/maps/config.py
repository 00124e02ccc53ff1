"""Settings: how a map is learned, in one place, and the fit that they describe."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep.errors import InputError
from sidestep.inference.batching import LARGE
from sidestep.inference.fit import Fit, fit
from sidestep.inference.maximize import Progress
from sidestep.inference.objective import MEMORY
from sidestep.inference.optimizers import LBFGS, Adam, Optimizer, Rprop
from sidestep.inference.priors import FreeCellEvidence, Normal, Prior, WallPrior
from sidestep.tabular.backups import BACKUPS, Behavior, Gradient
from sidestep.tabular.behavior_model import BehaviorModel, behavior_model
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Connectivity
from sidestep.tabular.likelihood import Term
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions

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
    - `unknown`: what is learned of people with the map, of `LEARNABLE`. `tempering`: how much actions count, as in
      `fit`.
    - `discount`, `step_cost`: the walkers' reward, as in `reach`.
    - `prior_mean`, `prior_variance`: of every unknown cell's logit. `lines`: how many nats it is worth, beside that, if
      a blocked cell lies between two others (`WallPrior`).
    - `connectivity`: 4 or 8. `terms`: which parts of the likelihood count. `gradient`: "exact" climbs by L-BFGS
      (on large maps by `Rprop`), "fixed_policy" by first-order ascent. `horizon`: how many moves walkers look
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
    prior_variance: float = 8.0
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

    def people(self, person: Int[np.ndarray, " tasks"] | None = None) -> BehaviorModel:
        """People of whom is known what the settings say; `person`: whose each task is, where they differ
        (`split_by_person`)."""
        discount = self.discount if "discount" in self.unknown else None
        return behavior_model(self.behavior(), self.unknown, discount=discount, person=person)


def fit_map(
    model: ObstacleGrid,
    demonstrations: Demonstrations,
    settings: Settings,
    report: Callable[[Progress], None] | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    each: Normal | None = None,
    walkers: BehaviorModel | None = None,
    afresh: bool = True,
) -> Fit[ObstacleGrid]:
    """The fit that `settings` describe. Where transitions count, so do the cells in which walks begin
    (`FreeCellEvidence`).

    - `each` is the prior of cells' logits and `walkers` are the people, where they are not the settings' own.
    - `afresh`: begin where transitions and first cells lead, rather than at `model`.
    """
    if not (np.isfinite(settings.memory) and settings.memory > 0):
        raise InputError(f"expected GiB above 0, found {settings.memory}", field="memory")
    walkers = walkers or settings.people()
    weights = np.asarray(demonstrations.weights)
    prior = _prior_of(settings, model, each)
    if settings.terms != "actions":
        prior = FreeCellEvidence(prior, jnp.asarray(_begun(model, demonstrations, weights)))
    optimizer = optimizer_for(settings, model.graph.states, round(float(weights.sum())))
    if afresh and settings.terms == "both":
        # where people walked is known without a solve: begin there
        model = fit(model, demonstrations, walkers, prior=prior, terms=("transitions",)).model
    if afresh and isinstance(optimizer, Rprop):
        model = _taken_as_blocked(model, demonstrations, counts=weights > 0)
    return fit(
        model,
        demonstrations,
        walkers,
        prior=prior,
        tempering=settings.tempering,
        terms=TERMS[settings.terms],
        options=SolveOptions(gradient=settings.gradient, horizon=settings.horizon),
        optimizer=optimizer,
        memory=settings.memory * 2**30,
        report=report,
        checkpoint=checkpoint,
        resume=resume,
    )


def _begun(
    model: ObstacleGrid, demonstrations: Demonstrations, weights: Float[np.ndarray, " moves"]
) -> Float[np.ndarray, " cells"]:
    """How many walks begin in each unknown cell, each by how much it counts."""
    first = demonstrations.first_moves()
    begun = np.bincount(np.asarray(demonstrations.states)[first], weights[first], minlength=model.graph.states)
    return np.where(np.asarray(model.known).ravel() == Cell.UNKNOWN, begun, 0.0)


def _prior_of(settings: Settings, model: ObstacleGrid, each: Normal | None) -> Prior:
    each = each or Normal(settings.prior_mean, settings.prior_variance)
    return WallPrior(each, model.known, settings.lines) if settings.lines else each


_CLOSED = 8.0
"""The logit of a cell that is taken as blocked: some 3,000 tries, longer than most ways round."""
_A_MOVE = 1e-3
"""A large map is learned when the next step promises less than this for each of people's moves (nats)."""


def optimizer_for(settings: Settings, cells: int, moves: int) -> Optimizer:
    """L-BFGS for the exact gradient, `Rprop` for what people do on large maps; ascent for the fixed-policy one.

    `docs/design.md` says why. A map is large where solves are loose at first and tasks come in small batches.
    """
    if settings.iterations is not None and settings.iterations < 1:
        raise InputError(f"expected at least 1, found {settings.iterations}", field="iterations")
    limit = {} if settings.iterations is None else {"iterations": settings.iterations}
    if settings.gradient == "fixed_policy":
        return Adam(**limit)
    if cells < LARGE or settings.terms == "transitions":
        return LBFGS(**limit)
    return Rprop(tolerance=_A_MOVE * moves, **limit)


def most_iterations(settings: Settings) -> int:
    """How many iterations a fit takes at the latest, whatever the map."""
    return max(optimizer_for(settings, cells, moves=1).iterations for cells in (0, LARGE))


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
