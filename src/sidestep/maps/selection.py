"""`--behavior auto`: what people pursue and how sharply, chosen by walks that were not learned from.

Maps are learned from two thirds of the walks at a time and judged by the others.

1. **Reward.** A goal that pays 1 with the discount of the settings, or a cost of 1 a cell without one, each with the β
   to begin with or four times that, whichever suits it better. Where no values are found for one of them, other than
   the settings' own, it is passed over. The reward of the settings stays unless the other makes held-out actions and
   transitions more probable by a fifth of a nat a move: what predicts actions a little better may find walls worse.
2. **Sharpness.** β is doubled as long as people are more regular than they are taken to be (κ above 1, see
   `sidestep.inference.calibration`) and held-out walks become more probable by it.
3. **Tempering.** Where their steps say less than as many independent ones (κ below 1), the actions' likelihood counts
   by the share κ, so that walls are not put where people were only wrong together.

What differs counts beyond three standard errors, so that the settings stay unless the walks speak against them. Lapses
are learned with every map.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.errors import ImproperTask, InputError, NotConverged
from sidestep.inference.calibration import doubtful, effective_sample_ratio, scores
from sidestep.inference.priors import Normal
from sidestep.io.demonstrations import demonstrations_from_moves
from sidestep.io.gridding import Moves
from sidestep.maps.config import Settings, fit_map
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import transition_probabilities
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions

FOLDS = 3
"""Into how many parts the walks are cut."""
_SHARPER = 4.0
"""Kinds of reward are compared by the β to begin with and by so many times that."""
_SURELY = 3.0
"""How many standard errors a difference must have to count."""
_WORTH = 0.2
"""By how many nats a move another kind of reward must be better."""
_DOUBLINGS = 6
"""How often β is doubled at most."""
_SHARPNESS_BY_STEPS = 0.5
"""β to begin with where a cell costs 1 and the settings say something else."""


@dataclass(frozen=True)
class Trial:
    """What held-out walks say of settings: the nats of every walk's actions and transitions, κ, the share of lapses.

    κ is infinite where the walks do not vary.
    """

    settings: Settings
    actions: Float[np.ndarray, " walks"]
    transitions: Float[np.ndarray, " walks"]
    moves: int
    share: float
    lapse: float

    @property
    def nats(self) -> Float[np.ndarray, " walks"]:
        """Of actions and transitions."""
        return self.actions + self.transitions

    def told(self) -> dict[str, Any]:
        """For a summary."""
        names = ("beta", "discount", "step_cost")
        return {
            **{name: getattr(self.settings, name) for name in names},
            "heldout_actions": float(self.actions.sum() / self.moves),
            "heldout_transitions": float(self.transitions.sum() / self.moves),
            "effective_share": self.share if np.isfinite(self.share) else None,
            "lapses": self.lapse,
        }


@dataclass(frozen=True)
class Choice:
    """Settings that were chosen, why, and all trials."""

    settings: Settings
    reasons: list[str]
    trials: list[Trial]


def choose_behavior(
    grid: Grid,
    moves: Moves,
    settings: Settings,
    prior: Normal | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Choice:
    """The settings with the reward, the β and the tempering that held-out walks speak for; lapses are to be learned.

    `prior` is that of cells' logits where it is not the settings' own. Raises `InputError` for fewer than two walks,
    for what is chosen here and given too, and as a fit does.
    """
    for field, given in (("unknown", settings.unknown), ("tempering", settings.tempering != 1)):
        if given:
            raise InputError("cannot be given where behavior is chosen by held-out walks", field=field)
    settings = replace(settings, unknown=("lapses",))
    trials: list[Trial] = []
    passed_over: list[str] = []

    def tried(some: Settings) -> Trial:
        shown = demonstrations_from_moves(moves, grid, discount=some.discount, step_cost=some.step_cost)
        trials.append(_tried(ObstacleGrid(grid, some.prior_mean), shown, some, prior, report))
        return trials[-1]

    def attempted(some: Settings) -> list[Trial]:
        """The trial, where there is one: what people would do of whom no values are found, cannot be told."""
        try:
            return [tried(some)]
        except (ImproperTask, NotConverged) as error:
            passed_over.append(f"{_named(some)} with β = {some.beta:g} was passed over: {error}")
            return []

    own = [tried(settings), *attempted(replace(settings, beta=_SHARPER * settings.beta))]
    kind = _of_the_other_kind(settings)
    other = [*attempted(kind), *attempted(replace(kind, beta=_SHARPER * kind.beta))]
    gains = _best(other).nats - _best(own).nats if other else None
    found = (other if gains is not None and _is_worth_it(gains, own[0].moves) else own)[0]
    found = _sharpened(found, attempted)
    below, _ = doubtful(found.share, len(found.nats), _SURELY)
    chosen = replace(found.settings, tempering=found.share if below else 1.0)
    return Choice(chosen, [*_reasons(chosen, found, gains, settings), *passed_over], trials)


def _sharpened(found: Trial, attempted: Callable[[Settings], list[Trial]]) -> Trial:
    """The trial with β doubled for as long as that is called for."""
    for _ in range(_DOUBLINGS):
        if not doubtful(found.share, len(found.nats), _SURELY)[1]:
            break
        after = attempted(replace(found.settings, beta=2 * found.settings.beta))
        if not after or after[0].nats.sum() <= found.nats.sum():
            break
        found = after[0]
    return found


def _is_worth_it(gains: Float[np.ndarray, " walks"], moves: int) -> bool:
    return bool(gains.sum() > max(_SURELY * _error(gains), _WORTH * moves))


def _error(differences: Float[np.ndarray, " walks"]) -> float:
    """The standard error of a sum over walks."""
    return float(differences.std(ddof=1) * len(differences) ** 0.5)


def _best(trials: list[Trial]) -> Trial:
    return max(trials, key=lambda trial: trial.nats.sum())


def _of_the_other_kind(settings: Settings) -> Settings:
    if settings.step_cost is None:
        return replace(settings, discount=1.0, step_cost=1.0, beta=_SHARPNESS_BY_STEPS)
    return replace(settings, discount=Settings.discount, step_cost=None, beta=Settings.beta)


def _tried(
    model: ObstacleGrid,
    shown: Demonstrations,
    settings: Settings,
    prior: Normal | None,
    report: Callable[[str], None],
) -> Trial:
    """Learns from each part's complement, and looks at how probable the part is."""
    count = shown.trajectories
    if count < 2:
        raise InputError(f"expected at least 2 walks to choose by, found {count}", field="behavior")
    part = np.random.default_rng(settings.seed).permutation(count) % min(FOLDS, count)
    actions, transitions, held_out, lapses = np.zeros(count), np.zeros(count), [], []
    for fold in range(part.max() + 1):
        kind = "goal reward" if settings.step_cost is None else "step cost"
        report(f"choosing: {kind}, β = {settings.beta:g}, part {fold + 1} of {part.max() + 1}")
        found = fit_map(model, shown.with_only(part != fold), settings, each=prior)
        others, people = shown.with_only(part == fold), found.people.behavior_of()
        of_fold = scores(found.model, others, people, options=SolveOptions(horizon=settings.horizon))
        held_out.append(of_fold)
        lapses.append(0.0 if people.lapse is None else float(people.lapse))
        arrived = np.log(np.asarray(transition_probabilities(found.model, others)))[np.asarray(others.weights) > 0]
        actions += np.bincount(of_fold.trajectory, of_fold.log_policy, minlength=count)
        transitions += np.bincount(of_fold.trajectory, arrived, minlength=count)
    return Trial(settings, actions, transitions, len(shown), effective_sample_ratio(held_out), float(np.mean(lapses)))


def _named(settings: Settings) -> str:
    return "a goal that pays 1" if settings.step_cost is None else "a cost of every cell"


def _reasons(chosen: Settings, found: Trial, gains: Float[np.ndarray, " walks"] | None, given: Settings) -> list[str]:
    """What was chosen and why, for people; `gains` are those of the other kind of reward, if it has values."""
    kind, other = _named(chosen), _named(_of_the_other_kind(given))
    against = (
        f"with {other} no values were found"
        if gains is None
        else f"{other} makes held-out moves more probable by {gains.sum() / found.moves:.2g} ± "
        f"{_error(gains) / found.moves:.1g} nats each, and {_WORTH:g} would be worth it"
    )
    reasons = [
        f"people pursue {kind}: {against}",
        f"β = {chosen.beta:g}: held-out steps are worth {found.share:.3g} times as many independent ones"
        if np.isfinite(found.share)
        else f"β = {chosen.beta:g}: held-out walks do not vary",
    ]
    if chosen.tempering < 1:
        reasons.append(
            f"actions count by {chosen.tempering:.2g}, for steps are less independent than they are taken to be"
        )
    return reasons


def told(choice: Choice) -> dict[str, Any]:
    """A choice, for a summary."""
    return {"reasons": choice.reasons, "trials": [trial.told() for trial in choice.trials]}
