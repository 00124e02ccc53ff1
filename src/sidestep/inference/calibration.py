"""Calibrate the actions' likelihood: how many independent steps the steps of a trajectory are worth.

The likelihood treats the steps of a trajectory as independent. They are not: after a wrong turn an agent takes many
steps of a long path. If each counts as a decision of its own, the fit changes the map to explain all of them: a large
β predicts actions better, and puts walls where there are none. Trajectories that the model was not learned from show
it. With

    u_t = ∂ log π(a_t | s_t) / ∂ log β  (at fixed Q),       I = Σ_t Σ_a π(a | s_t) u(s_t, a)²,

the score of a step and the information of independent steps drawn from π, the scores summed over trajectories should
vary by I too (the information matrix equality; White 1982). If they vary by J = Σ_trajectories (Σ_t (u_t − ū))², then

    κ = I / J

is the ratio of effective to actual steps. A composite likelihood is adjusted by it to log L^κ (Varin, Reid & Firth
2011). κ above 1 means that behavior is more regular than the model's.

With weights w of moves, sums over t and ū are weighted, and the square of a trajectory's sum is divided by its weight,
Σ w² / Σ w. So a trajectory of weight w counts in I and J as w copies of it would, a move of weight 0 is as if it were
not there, and equal weights change nothing. For independent steps κ is 1 whatever the weights, if these do not depend
on the information of the steps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import NotConverged, check, check_instance, to_list
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.demonstrations import Demonstrations, trajectory_weights
from sidestep.tabular.likelihood import check_likelihood, padded_for, visited_advantages
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions, solve


class ScoreStatistics(NamedTuple):
    """The score of each move with a positive weight.

    Attributes:
        score: u = ∂ log π(a | s) / ∂ log β.
        information: Σ_a π(a | s) u(s, a)².
        log_policy: log π(a | s), in nats.
        trajectory: The index of the move's trajectory.
        weight: How much the move counts.

    Example:
        >>> numbers = [1.0, -1.0], [0.5, 0.5], [-1.0, -1.0], [0, 1], [1.0, 1.0]
        >>> len(ScoreStatistics(*map(np.array, numbers)).score)
        2
    """

    score: Float[np.ndarray, " moves"]
    information: Float[np.ndarray, " moves"]
    log_policy: Float[np.ndarray, " moves"]
    trajectory: Int[np.ndarray, " moves"]
    weight: Float[np.ndarray, " moves"]


def score_statistics(
    model: TransitionModel,
    demonstrations: Demonstrations,
    behavior: Behavior | BehaviorModel,
    *,
    options: SolveOptions | None = None,
) -> ScoreStatistics:
    """Return the scores of moves under a model that was learned from other trajectories.

    Args:
        model: The learned transition model.
        demonstrations: Held-out trajectories; moves of weight 0 are left out.
        behavior: The behavior that the scores are of; a `BehaviorModel` has the β of each person.
        options: As for `solve`.

    Returns:
        The scores, one for each move that counts.

    Raises:
        NotConverged: If the values of a task do not converge.

    Example:
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.demonstrations import Trajectory, gather
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> shown = gather([Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [reach(grid, 2)])
        >>> scores = score_statistics(true_model(grid), shown, Behavior(HardMax(), 5.0))
        >>> scores.score.shape
        (2,)
    """
    check_instance(options, (SolveOptions, type(None)), "options")
    check_likelihood(model, demonstrations, behavior, SolveOptions() if options is None else options)
    deadline = options is not None and options.deadline
    check(not deadline, "expected options without a deadline, found one", field="options")
    padded, agents = padded_for(demonstrations, behavior)
    converged, *numbers = _scores(model, padded, agents, options)
    if not bool(converged):
        raise NotConverged("the values of a task did not converge: a smaller β may help")
    counts = np.asarray(padded.weights) > 0
    return ScoreStatistics(*(np.asarray(each)[counts] for each in (*numbers, padded.trajectory, padded.weights)))


@eqx.filter_jit
def _scores(
    model: TransitionModel, demonstrations: Demonstrations, agents: BehaviorModel, options: SolveOptions | None
) -> tuple[Bool[Array, ""], Float[Array, " moves"], Float[Array, " moves"], Float[Array, " moves"]]:
    """Return whether all values converged, and of each move: u, Σ_a π u² and log π(a | s)."""
    solution = solve(model, demonstrations.tasks, agents, options=options)
    moves = eqx.tree_at(lambda each: each.tasks, demonstrations, agents.tasks_of(demonstrations.tasks))
    q, behavior = visited_advantages(model, moves, solution.values_after), agents.behavior_of()
    available = jnp.broadcast_to(model.graph.available, (model.graph.states, model.graph.actions))[moves.states]
    betas = agents.betas(len(solution.values))[moves.task]

    def of_move(beta: Array, q: Array, available: Array) -> tuple[Array, Array]:
        return jax.jvp(
            lambda log_beta: Behavior(behavior.backup, jnp.exp(log_beta), behavior.lapse).log_policy(q, available),
            (jnp.log(beta),),
            (jnp.ones_like(beta),),
        )

    log_policy, scores = jax.vmap(of_move)(betas, q, available)
    information = jnp.sum(jnp.where(jnp.isneginf(log_policy), 0, jnp.exp(log_policy) * scores**2), axis=-1)
    chosen = jnp.arange(len(q)), demonstrations.actions
    return solution.converged.all(), scores[chosen], information, log_policy[chosen]


def effective_sample_ratio(held_out: Sequence[ScoreStatistics]) -> float:
    """Return κ = I/J, the ratio of effective to actual steps; infinite where scores do not vary.

    Args:
        held_out: Scores of trajectories that the models were not learned from, with distinct trajectory indices.

    Returns:
        κ, above 0.

    Example:
        >>> numbers = [1.0, -1.0], [0.5, 0.5], [-1.0, -1.0], [0, 1], [1.0, 1.0]
        >>> effective_sample_ratio([ScoreStatistics(*map(np.array, numbers))])
        0.5
    """
    pieces = to_list(held_out, ScoreStatistics, "held_out")
    score, information, _, trajectory, weight = (np.concatenate(part) for part in zip(*pieces, strict=True))
    check((weight > 0).any(), "expected at least one move that counts, found none", field="held_out")
    by_trajectory = np.bincount(trajectory, weight * (score - np.average(score, weights=weight)))
    own = trajectory_weights(trajectory, weight)
    variation = float(np.sum(by_trajectory[own > 0] ** 2 / own[own > 0]))
    return float(weight @ information) / variation if variation > 0 else float("inf")
