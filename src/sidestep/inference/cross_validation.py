"""Cross-validation: how well a model predicts the moves of walks, or of persons, that it has not learned from.

Walks or persons are divided into folds. For each fold a model is fitted to the others, and the fold's moves have their
log-likelihood under it. Their sum is the expected log predictive density of new ones (Vehtari, Gelman and Gabry 2017),
by the maximum of the posterior instead of the whole of it.

With S_f nats and n_f moves in fold f, the mean m = Σ S_f / Σ n_f is a ratio of sums over F folds. Its standard error is

    ( F/(F − 1) Σ (S_f − m n_f)² )^½ / Σ n_f,

as for cluster samples (Cochran 1977, section 6.12). It takes folds as independent, which is a little too few: any two
fits have walks in common.
"""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from sklearn.model_selection import KFold

from sidestep._arguments import to_integers
from sidestep._repr import short_repr
from sidestep.errors import check, check_count, check_instance, to_count
from sidestep.inference.fit import Estimate, Fit, fit
from sidestep.inference.optimizers import Optimizer
from sidestep.inference.pointwise import PointwiseLogLikelihood, pointwise_log_likelihood
from sidestep.tabular.arrays import to_jax

_NO_FOLD = -1
_LARGEST_SEED = 2**32 - 1


@short_repr("mean", "fold", "converged", "held_out")
class CrossValidation(NamedTuple):
    """The log-likelihood of held-out moves, by `cross_validate`.

    Attributes:
        held_out: The log-likelihood of each move, under the fit to the other folds.
        fold: The fold of each trajectory; −1 where none of its moves counts.
        converged: Whether the fit without each fold converged.

    Example:
        >>> each = PointwiseLogLikelihood(-np.array([1.0, 3.0]), np.zeros(2), np.array([0, 1]), np.ones(2))
        >>> CrossValidation(each, fold=np.array([0, 1]), converged=np.ones(2, bool)).mean
        Estimate(estimate=-2.0, standard_error=1.0)
    """

    held_out: PointwiseLogLikelihood
    fold: Int[np.ndarray, " trajectories"]
    converged: Bool[np.ndarray, " folds"]

    @property
    def of_folds(self) -> Float[np.ndarray, "folds 2"]:
        """Return the nats of each fold and its number of moves, each move by its weight."""
        each, counts = self.held_out, self.held_out.weights > 0
        fold, weights = self.fold[each.trajectory[counts]], each.weights[counts]
        columns = weights * each.total[counts], weights
        return np.stack([np.bincount(fold, column, len(self.converged)) for column in columns], axis=1)

    @property
    def mean(self) -> Estimate:
        """Return the nats of a held-out move, with their standard error over folds."""
        return _ratio(*self.of_folds.T)

    def difference(self, other: "CrossValidation") -> Estimate:
        """Return by how many nats a move this model predicts held-out moves better than another one.

        Both have the same folds, so what is easy or hard to predict for both does not count for the standard error.

        Args:
            other: Of the same demonstrations, with the same folds.

        Raises:
            InputError: For anything but a cross-validation, and for other folds or moves.
        """
        check_instance(other, CrossValidation, "other")
        pairs = zip((self.fold, *self.held_out[2:]), (other.fold, *other.held_out[2:]), strict=True)
        same = all(np.array_equal(one, another) for one, another in pairs)
        check(same, "expected the same moves and folds (of the same seed)", field="other")
        (nats, moves), (others, _) = self.of_folds.T, other.of_folds.T
        return _ratio(nats - others, moves)


def cross_validate(
    fit: Fit[Any],
    *,
    folds: int = 5,
    groups: Int[np.ndarray, " trajectories"] | None = None,
    seed: int = 0,
    warm_start: bool = False,
    optimizer: Optimizer | None = None,
) -> CrossValidation:
    """Fit a model again without each fold, and return the log-likelihood of the moves that were left out.

    Args:
        fit: The fit of all demonstrations; its model, prior and options are those of every fit.
        folds: The number of fits, at least 2.
        groups: A number for each trajectory; those with the same one, as of the same person, are held out together. By
            default each trajectory is a group of its own.
        seed: Of the division into folds.
        warm_start: Start every fit where the given one ended, not where it started. It takes less time; where the
            posterior has several maxima, every fit may stay at one that held-out walks have chosen.
        optimizer: As for `fit`.

    Returns:
        The log-likelihood of each move when its fold was left out. A person with all walks left out acts about as a
        typical person.

    Raises:
        InputError: For anything but a fit, for fewer groups than folds, and for folds, a seed and groups that are not
            whole numbers.
        NotConverged: As `fit` does.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)
        >>> walk = ss.Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)
        >>> shown = ss.gather([walk] * 4, [ss.reach(grid, 2)])
        >>> learned = ss.fit(ss.ObstacleGrid(grid, 0.0), shown, ss.Behavior(ss.HardMax()), terms=("transitions",))
        >>> cross_validate(learned, folds=2).mean.standard_error  # all walks are alike
        0.0

    References:
        Vehtari, Gelman and Gabry, "Practical Bayesian model evaluation using leave-one-out cross-validation and WAIC"
        (2017). Cochran, "Sampling techniques" (1977).
    """
    check_instance(fit, Fit, "fit")
    check_count(folds, 2, "folds")
    to_count(seed, "seed", 0, _LARGEST_SEED)
    check_instance(warm_start, bool, "warm_start")
    demos = fit.problem.demonstrations
    trajectory, weights = np.asarray(demos.trajectory), np.asarray(demos.weights)
    fold = _folds(demos.trajectories, trajectory[weights > 0], groups, folds, seed)
    actions, transitions = np.zeros((2, len(demos)))
    converged = np.zeros(folds, bool)
    for at in range(folds):
        held_out = fold[trajectory] == at
        part = _without(fit, np.where(held_out, 0, weights), warm_start, optimizer)
        each, converged[at] = pointwise_log_likelihood(part), part.converged
        actions[held_out], transitions[held_out] = each.actions[held_out], each.transitions[held_out]
    return CrossValidation(PointwiseLogLikelihood(actions, transitions, trajectory, weights), fold, converged)


def _folds(
    trajectories: int,
    counted: Int[np.ndarray, " moves"],
    groups: Int[np.ndarray, " trajectories"] | None,
    folds: int,
    seed: int,
) -> Int[np.ndarray, " trajectories"]:
    """Return the fold of each trajectory: −1 for those without a move in `counted`."""
    what = f"a whole number for each of the {trajectories} trajectories,"
    own = np.arange(trajectories) if groups is None else to_integers(groups, "groups", (trajectories,), what=what)
    some = np.unique(counted)
    distinct, which = np.unique(own[some], return_inverse=True)
    check(
        len(distinct) >= folds,
        f"expected at most {len(distinct)}, the number of groups with moves that count, found {folds}",
        field="folds",
    )
    of_group = np.zeros(len(distinct), np.int64)
    for at, (_, chosen) in enumerate(KFold(folds, shuffle=True, random_state=seed).split(distinct)):
        of_group[chosen] = at
    result = np.full(trajectories, _NO_FOLD)
    result[some] = of_group[which]
    return result


def _without(
    whole: Fit[Any], weights: Float[np.ndarray, " moves"], warm_start: bool, optimizer: Optimizer | None
) -> Fit[Any]:
    """Return the fit to demonstrations with other weights."""
    problem = whole.problem
    demos = problem.demonstrations
    demos = eqx.tree_at(lambda each: each.weights, demos, to_jax(weights.astype(demos.weights.dtype)))
    model, behavior = (whole.model, whole.behavior) if warm_start else (problem.model, problem.behavior)
    return fit(
        model,
        demos,
        behavior,
        prior=problem.prior,
        tempering=float(problem.tempering),
        terms=problem.terms,
        options=problem.options,
        optimizer=optimizer,
    )


def _ratio(nats: Float[np.ndarray, " folds"], moves: Float[np.ndarray, " folds"]) -> Estimate:
    """Return Σ nats / Σ moves with its standard error; without one where a move was impossible."""
    mean = nats.sum() / moves.sum()
    if not np.isfinite(nats).all():
        return Estimate(float(mean), None)
    squares = np.sum((nats - mean * moves) ** 2) * len(nats) / (len(nats) - 1)
    return Estimate(float(mean), float(np.sqrt(squares) / moves.sum()))
