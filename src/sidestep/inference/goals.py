"""Goals that nobody named: a posterior over candidates for every walk, and dynamics learned with it.

Where a walk i does not say what it was after, the likelihood is a mixture over the candidate tasks g, with shares p_g,

    L(θ) = Π_i Σ_g p_g Π_t π_θ,g(a_t | s_t) T_θ(s_t, a_t, s_{t+1}),

and the posterior over what it was after is its share of the sum,

    P(g | walk i) ∝ p_g Π_t π_θ,g(a_t | s_t).

Expectation maximisation takes turns: the posterior under the present model; then shares p_g, the mean posterior, and a
fit in which every walk is a demonstration of every candidate, weighted by its posterior. Where each fit begins at the
model before, L and the prior never fall. A walk that goes on after it has reached a candidate was not after that one;
where it stops elsewhere, it was cut short.
"""

from collections.abc import Callable, Sequence
from typing import Generic

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Float

from sidestep.errors import InputError, NotConverged, check_count
from sidestep.inference.fit import Fit, Model
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, flat_moves, gather
from sidestep.tabular.likelihood import log_policies
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.tasks import Task, stack_tasks


class GoalFit(eqx.Module, Generic[Model]):
    """A model learned from walks without goals.

    - `fit`: the last fit. `posterior`: P(g | walk) by walks and candidates. `shares`: p_g.
    - `evidence`: log L(θ) without the transitions' part, before each round and at the end.
    - `converged`: whether the fits were, and the posterior changed by less than the tolerance in the last round.
    """

    fit: Fit[Model]
    posterior: Float[np.ndarray, "walks candidates"]
    shares: Float[np.ndarray, " candidates"]
    evidence: tuple[float, ...] = eqx.field(static=True)
    converged: bool = eqx.field(static=True)


def goal_posterior(
    model: TransitionModel,
    walks: Sequence[Trajectory],
    candidates: Sequence[Task],
    behavior: Behavior,
    shares: Float[np.ndarray, " candidates"] | None = None,
) -> tuple[Float[np.ndarray, "walks candidates"], float]:
    """P(g | walk) of every walk and candidate, and the actions' log-likelihood, Σ_i log Σ_g p_g Π_t π_g.

    - `walks`: their tasks do not matter. `shares`: p_g, by default all alike.

    Raises `InputError` for a walk that could not have been after any of the candidates, and as `gather` does;
    `NotConverged` where a candidate's values are not found.
    """
    if shares is None:
        shares = np.full(len(candidates), 1 / len(candidates))
    likelihoods = np.stack([_if_after(task, model, walks, behavior) for task in candidates], axis=1)
    with np.errstate(divide="ignore"):
        joint = np.log(shares) + likelihoods
    total = np.asarray(logsumexp(jnp.asarray(joint), axis=1))
    if not np.isfinite(total).all():
        raise InputError(
            "goes on after it has reached each of the candidates: expected one that it may have been after",
            source="walk",
            row=int(np.argmin(np.isfinite(total))) + 1,
        )
    return np.exp(joint - total[:, None]), float(total.sum())


def fit_goals(
    model: Model,
    walks: Sequence[Trajectory],
    candidates: Sequence[Task],
    behavior: Behavior,
    learn: Callable[[Model, Demonstrations], Fit[Model]],
    *,
    rounds: int = 20,
    tolerance: float = 1e-3,
) -> GoalFit[Model]:
    """The model and the goals that make walks most probable, by expectation maximisation from `model`.

    - `learn`: a fit of weighted demonstrations from a model, with the same behavior.
    - `rounds`: at most so many, one at least. `tolerance`: the largest change of a posterior that counts as none.

        found = fit_goals(model, walks, tasks, people, lambda model, shown: fit(model, shown, people))

    Raises `InputError` as `goal_posterior` does.
    """
    check_count(rounds, 1, "rounds")
    posterior, evidence = goal_posterior(model, walks, candidates, behavior)
    history = [evidence]
    while True:
        found = learn(model, weighted(walks, candidates, posterior))
        model, shares = found.model, posterior.mean(axis=0)
        before = posterior
        posterior, evidence = goal_posterior(model, walks, candidates, behavior, shares)
        history.append(evidence)
        change = float(np.abs(posterior - before).max())
        if change < tolerance or len(history) > rounds:
            return GoalFit(found, posterior, shares, tuple(history), found.converged and change < tolerance)


def weighted(
    walks: Sequence[Trajectory], candidates: Sequence[Task], posterior: Float[np.ndarray, "walks candidates"]
) -> Demonstrations:
    """Every walk as a demonstration of every candidate that it may have been after, weighted by the posterior."""
    # however improbable a candidate: while the pairs stay the same, nothing is compiled anew
    pairs = np.argwhere(posterior > 0)
    shown = gather([walks[walk]._replace(task=int(candidate)) for walk, candidate in pairs], candidates)
    lengths = [len(walks[walk].actions) for walk, _ in pairs]
    weight = np.repeat(posterior[posterior > 0], lengths)
    return Demonstrations(
        shown.states, shown.actions, shown.next_states, shown.task, shown.trajectory, shown.tasks, jnp.asarray(weight)
    )


def _if_after(
    task: Task, model: TransitionModel, walks: Sequence[Trajectory], behavior: Behavior
) -> Float[np.ndarray, " walks"]:
    """Σ_t log π(a_t | s_t) of every walk in pursuit of a task; −∞ for a walk that goes on after the task has ended."""
    lengths = np.array([len(walk.actions) for walk in walks])
    moves = Demonstrations(
        flat_moves([walk.states[:-1] for walk in walks]),
        flat_moves([walk.actions for walk in walks]),
        flat_moves([walk.states[1:] for walk in walks]),
        jnp.zeros(lengths.sum(), jnp.int32),
        jnp.asarray(np.repeat(np.arange(len(walks)), lengths), jnp.int32),
        stack_tasks([task]),
    )
    each = np.asarray(log_policies(model, moves, behavior))
    if np.isnan(each).any():
        raise NotConverged("the values of a candidate's task were not found: a smaller β may help")
    ended = np.asarray(task.terminal)[np.asarray(moves.states)]
    return np.bincount(np.asarray(moves.trajectory), np.where(ended, -np.inf, each), minlength=len(walks))
