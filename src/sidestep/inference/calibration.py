"""How much the steps of a walk say: what people do is less independent than the likelihood of single actions has it.

Who takes a long way because of a wrong turn takes many steps of it. If each counts as a decision of its own, the map is
bent until it explains them all: behavior that is taken to be sharp (a large β) predicts actions better and puts walls
where there are none. Whether it does shows in walks that were not learned from. With

    u_t = ∂ log π(a_t | s_t) / ∂ log β  (Q held),       I = Σ_t Σ_a π(a | s_t) u(s_t, a)²,

the score of a step and the information that the steps would have, were each drawn from π by itself, the sums of the
scores over walks would vary by I as well (the information matrix equality; White 1982). If they vary more, by
J = Σ_walks (Σ_{t in walk} (u_t − ū))², then

    κ = I / J

is the share of independent steps that theirs are worth. That is the adjustment of composite likelihoods (Varin, Reid
and Firth 2011): log L^κ. A share above 1 says that people are more regular than they are taken to be.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import NotConverged
from sidestep.tabular.backups import Behavior
from sidestep.tabular.demonstrations import Demonstrations, pad_to_power_of_two
from sidestep.tabular.likelihood import visited_action_values
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions, solve


class Scores(NamedTuple):
    """Of each move that counts: u, Σ_a π u², log π(a | s), and the trajectory that it belongs to."""

    score: Float[np.ndarray, " moves"]
    information: Float[np.ndarray, " moves"]
    log_policy: Float[np.ndarray, " moves"]
    trajectory: Int[np.ndarray, " moves"]


def scores(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior,
    *,
    options: SolveOptions | None = None,
) -> Scores:
    """The scores of the moves whose weight is not 0, under a model that should not have been learned from them.

    `options`: as for `solve`. Raises `NotConverged` if values are not found.
    """
    padded = pad_to_power_of_two(demonstrations)
    converged, *numbers = _scores(model, padded, behavior, options)
    if not bool(converged):
        raise NotConverged("the values of a task were not found: a smaller β may help")
    counts = np.asarray(padded.weights) > 0
    return Scores(*(np.asarray(each)[counts] for each in (*numbers, padded.trajectory)))


@eqx.filter_jit
def _scores(
    model: TransitionModel, demonstrations: Demonstrations, behavior: Behavior, options: SolveOptions | None
) -> tuple[Bool[Array, ""], Float[Array, " moves"], Float[Array, " moves"], Float[Array, " moves"]]:
    """Whether all values converged, and of each move: u, Σ_a π u² and log π(a | s)."""
    solution = solve(model, demonstrations.tasks, behavior, options=options)
    q = visited_action_values(model, demonstrations.tasks, solution.values, demonstrations.task, demonstrations.states)
    log_policy, by_log_beta = jax.jvp(
        lambda log_beta: Behavior(behavior.backup, jnp.exp(log_beta), behavior.lapse).log_policy(q),
        (jnp.log(behavior.beta),),
        (jnp.ones_like(behavior.beta),),
    )
    information = jnp.sum(jnp.exp(log_policy) * by_log_beta**2, axis=-1)
    taken = jnp.arange(len(q)), demonstrations.actions
    return solution.converged.all(), by_log_beta[taken], information, log_policy[taken]


def effective_sample_ratio(held_out: Sequence[Scores]) -> float:
    """κ, from the scores of walks that were not learned from; infinite where scores do not vary."""
    score, information, _, trajectory = (np.concatenate(part) for part in zip(*held_out, strict=True))
    of_walks = np.bincount(trajectory, score - score.mean())
    varies = float(np.sum(of_walks**2))
    return float(information.sum()) / varies if varies > 0 else float("inf")


def doubtful(share: float, walks: int, errors: float) -> tuple[bool, bool]:
    """Whether κ from so many walks is below 1, and whether it is above, by more than so many standard errors.

    A sum of n squares of normal numbers is off by the share √(2/n).
    """
    margin = errors * (2 / walks) ** 0.5
    return bool(np.log(share) < -margin), bool(np.log(share) > margin)
