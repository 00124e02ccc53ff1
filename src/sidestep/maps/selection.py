"""Selection of the behavior by cross-validation: the reward, β, and the weight of the actions.

Maps are learned from two thirds of the walks at a time and scored by the others.

1. **Reward.** Two kinds are compared: a goal that pays 1 with the discount of the configuration, and a cost of 1 a cell
   without one. Each has its own first β or four times that, whichever is better. A kind without values is passed over,
   unless it is the configuration's own. The configured reward stays unless the other makes held-out actions and
   transitions more probable, by more than .2 nats a move and by more than three standard errors (over walks) of the
   gain: better prediction of actions does not always find walls better.
2. **Inverse temperature.** β starts at the first β of the selected kind. It is doubled while agents are more regular
   than the model expects (κ above 1, see `sidestep.inference.calibration`) and held-out walks become more probable, by
   any gain; at most six times. A β without values ends the doubling.
3. **Tempering.** Where actions say less than independent ones would (κ below 1), their likelihood is raised to the
   power κ. Walls then do not explain errors that the walks have in common.

κ counts as above or below 1 where |ln κ| is more than three standard errors, 3 √(2/n) for n walks. Lapses are learned
with every map.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.errors import ImproperTask, NotConverged, check
from sidestep.inference.calibration import Dispersion, dispersion, effective_sample_ratio, score_statistics
from sidestep.io.gridding import Moves
from sidestep.maps.config import BehaviorConfig, MapConfig
from sidestep.maps.fit import demonstrations_of, fit_map
from sidestep.maps.sensors import SensorMap
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Grid
from sidestep.tabular.likelihood import transition_probabilities
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.reward import Reward
from sidestep.tabular.solve import SolveOptions

Notify = Callable[[str], None] | None
"""Called with a line of text at each stage."""

FOLDS = 3
"""The number of folds of the cross-validation."""
_BETA_FACTOR = 4.0
"""The kinds of reward are compared with the first β and with this many times it."""
_STANDARD_ERRORS = 3.0
"""The number of standard errors beyond which a difference counts."""
_WORTH = 0.2
"""The gain in nats a move that another kind of reward must have."""
_MAX_DOUBLINGS = 6
"""The most doublings of β."""
_STEP_COST_BETA = 0.5
"""The first β where a cell costs 1 and the configuration has another reward."""


@dataclass(frozen=True)
class Trial:
    """The score of one configuration by held-out walks.

    Attributes:
        config: The configuration.
        actions: The log-likelihood of the actions of each walk, in nats.
        transitions: The log-likelihood of the transitions of each walk, in nats.
        moves: The number of moves.
        ratio: κ; infinite where the walks do not vary.
        lapse: The learned probability of a random action, averaged over folds.
        converged: The number of folds with a fit that converged.
    """

    config: MapConfig
    actions: Float[np.ndarray, " walks"]
    transitions: Float[np.ndarray, " walks"]
    moves: int
    ratio: float
    lapse: float
    converged: int

    @property
    def log_likelihood(self) -> Float[np.ndarray, " walks"]:
        """The log-likelihood of each walk, in nats."""
        return self.actions + self.transitions

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `summary.json`."""
        reward = self.config.reward
        return {
            "beta": self.config.behavior.beta,
            "discount": reward.discount,
            "step_cost": reward.step_cost,
            "heldout_actions": float(self.actions.sum() / self.moves),
            "heldout_transitions": float(self.transitions.sum() / self.moves),
            "effective_sample_ratio": self.ratio if np.isfinite(self.ratio) else None,
            "lapse": self.lapse,
            "converged_folds": self.converged,
        }


@dataclass(frozen=True)
class Selection:
    """A selected configuration.

    Attributes:
        config: What was selected.
        reasons: Why, in words.
        trials: The score of every configuration that was tried.
    """

    config: MapConfig
    reasons: list[str]
    trials: list[Trial]

    def summary(self) -> dict[str, Any]:
        """Return the entries of `summary.json`."""
        return {"reasons": self.reasons, "trials": [trial.summary() for trial in self.trials]}


def select_behavior(
    grid: Grid, moves: Moves, config: MapConfig, sensor: SensorMap | None = None, notify: Notify = None
) -> Selection:
    """Select the reward, β and tempering that held-out walks support.

    Args:
        grid: The grid.
        moves: The moves of at least two walks.
        config: The configuration from which the selection starts.
        sensor: What sensors saw of unknown cells.
        notify: Called with a line of text for every fit.

    Returns:
        The selected configuration, and why.

    Raises:
        InputError: For fewer than two walks, for settings that are selected here and set too, and as a fit does.
        ImproperTask: If the tasks of the given configuration have no values.
        NotConverged: If the values of the given configuration do not converge.
    """
    for field, is_set in (("learn", config.behavior.learn), ("tempering", config.behavior.tempering != 1)):
        check(not is_set, "cannot be set where the behavior is selected by held-out walks", field=field)
    config = replace(config, behavior=replace(config.behavior, learn=("lapse",), select=False))
    trials: list[Trial] = []
    passed_over: list[str] = []

    def attempt(candidate: MapConfig) -> list[Trial]:
        """Return the trial; nothing where the task has no values, unless it is the configuration's own."""
        try:
            model, shown = ObstacleGrid(grid, candidate.prior.first_logit), demonstrations_of(moves, grid, candidate)
            trials.append(_cross_validate(model, shown, candidate, sensor, notify))
            return trials[-1:]
        except (ImproperTask, NotConverged) as error:
            if candidate is config:
                raise
            name, beta = _reward_name(candidate.reward), candidate.behavior.beta
            passed_over.append(f"{name} with β = {beta:g} was passed over: {error}")
            return []

    own, other = (
        [*attempt(kind), *attempt(_with_beta(kind, _BETA_FACTOR * kind.behavior.beta))]
        for kind in (config, _other_reward(config))
    )
    trial, gains, least = own[0], None, 0.0
    if other:
        gains = _best(other).log_likelihood - _best(own).log_likelihood
        least = max(_STANDARD_ERRORS * _standard_error(gains), _WORTH * trial.moves)
        trial = other[0] if gains.sum() > least else trial
    trial = _raise_beta(trial, attempt)
    below = dispersion(trial.ratio, len(trial.log_likelihood), _STANDARD_ERRORS) is Dispersion.OVERDISPERSED
    behavior = replace(trial.config.behavior, tempering=trial.ratio if below else 1.0)
    selected = replace(trial.config, behavior=behavior)
    return Selection(selected, [*_reasons(selected, trial, gains, least, config), *passed_over], trials)


def _with_beta(config: MapConfig, beta: float) -> MapConfig:
    return replace(config, behavior=replace(config.behavior, beta=beta))


def _raise_beta(trial: Trial, attempt: Callable[[MapConfig], list[Trial]]) -> Trial:
    """Double β for as long as κ is above 1 and held-out walks become more probable."""
    for _ in range(_MAX_DOUBLINGS):
        if dispersion(trial.ratio, len(trial.log_likelihood), _STANDARD_ERRORS) is not Dispersion.UNDERDISPERSED:
            break
        doubled = attempt(_with_beta(trial.config, 2 * trial.config.behavior.beta))
        if not doubled or doubled[0].log_likelihood.sum() <= trial.log_likelihood.sum():
            break
        trial = doubled[0]
    return trial


def _standard_error(differences: Float[np.ndarray, " walks"]) -> float:
    """Return the standard error of a sum over walks."""
    return float(differences.std(ddof=1) * len(differences) ** 0.5)


def _best(trials: list[Trial]) -> Trial:
    return max(trials, key=lambda trial: trial.log_likelihood.sum())


def _other_reward(config: MapConfig) -> MapConfig:
    if config.reward.step_cost is None:
        return _with_beta(replace(config, reward=Reward(1.0, 1.0)), _STEP_COST_BETA)
    return _with_beta(replace(config, reward=Reward()), BehaviorConfig.beta)


def _cross_validate(
    model: ObstacleGrid, demonstrations: Demonstrations, config: MapConfig, sensor: SensorMap | None, notify: Notify
) -> Trial:
    """Learn from the complement of each fold, and score the fold."""
    count = demonstrations.trajectories
    check(count >= 2, f"expected at least 2 walks to select by, found {count}", field="select_behavior")
    fold_of = np.random.default_rng(config.seed).permutation(count) % min(FOLDS, count)
    actions, transitions, statistics, lapse_values, converged = np.zeros(count), np.zeros(count), [], [], 0
    for fold in range(fold_of.max() + 1):
        if notify:
            kind, beta = "goal reward" if config.reward.step_cost is None else "step cost", config.behavior.beta
            notify(f"selecting: {kind}, β = {beta:g}, fold {fold + 1} of {fold_of.max() + 1}")
        fit = fit_map(model, demonstrations.with_only(fold_of != fold), config, sensor=sensor)
        held_out, behavior = demonstrations.with_only(fold_of == fold), fit.behavior.behavior_of()
        of_fold = score_statistics(fit.model, held_out, behavior, options=SolveOptions(horizon=config.behavior.horizon))
        statistics.append(of_fold)
        converged += fit.converged
        lapse_values.append(0.0 if behavior.lapse is None else float(behavior.lapse))
        weights = np.asarray(held_out.weights)
        log_transitions = np.log(np.asarray(transition_probabilities(fit.model, held_out)))[weights > 0]
        actions += np.bincount(of_fold.trajectory, of_fold.log_policy, minlength=count)
        transitions += np.bincount(of_fold.trajectory, log_transitions, minlength=count)
    ratio, moves = effective_sample_ratio(statistics), len(demonstrations)
    return Trial(config, actions, transitions, moves, ratio, float(np.mean(lapse_values)), converged)


def _reward_name(reward: Reward) -> str:
    return "a goal that pays 1" if reward.step_cost is None else "a cost of every cell"


def _reasons(
    selected: MapConfig, trial: Trial, gains: Float[np.ndarray, " walks"] | None, least: float, configured: MapConfig
) -> list[str]:
    """Say what was selected and why; `gains` are those of the other kind of reward, which counts above `least`."""
    kind, other = _reward_name(selected.reward), _reward_name(_other_reward(configured).reward)
    against = (
        f"{other} has no values"
        if gains is None
        else f"with {other} the log-probability of a held-out move is higher by {gains.sum() / trial.moves:.2g} ± "
        f"{_standard_error(gains) / trial.moves:.1g}; it would be selected from {least / trial.moves:.2g} on"
    )
    beta, tempering = selected.behavior.beta, selected.behavior.tempering
    reasons = [
        f"the reward is {kind}: {against}",
        f"β = {beta:g}: 100 held-out actions say as much about it as {100 * trial.ratio:.3g} independent ones"
        if np.isfinite(trial.ratio)
        else f"β = {beta:g}: held-out walks do not vary",
    ]
    if tempering < 1:
        reasons.append(f"actions count by {tempering:.2g}, because those of one walk depend on each other")
    return reasons
