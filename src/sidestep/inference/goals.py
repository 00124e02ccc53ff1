"""Learn dynamics from trajectories with unknown goals, by expectation maximization (Dempster, Laird & Rubin 1977).

The likelihood of a trajectory i with an unknown goal is a mixture over candidate tasks g with probabilities p_g,

    L(θ) = Π_i Σ_g p_g Π_t π_θ,g(a_t | s_t) T_θ(s_t, a_t, s_{t+1}),

and the posterior of its goal is

    P(g | i) ∝ p_g Π_t π_θ,g(a_t | s_t).

The E-step computes the posterior under the present model. The M-step sets p_g to the mean posterior, and fits the model
to each trajectory as a demonstration of each candidate, weighted by the posterior. It differs from the textbook in that
the M-step is a fit that starts at the last model and may stop early; L and the prior never decrease all the same. A
trajectory that continues after a candidate's terminal state did not have this goal; it may stop short of its goal.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Generic

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Float

from sidestep._arguments import to_floats
from sidestep._repr import short_repr
from sidestep.errors import (
    InputError,
    NotConverged,
    check,
    check_count,
    check_function,
    check_instance,
    to_list,
    to_number,
)
from sidestep.inference.arguments import check_tasks
from sidestep.inference.fit import Fit, Model
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.checks import check_behavior
from sidestep.tabular.demonstrations import Demonstrations, Trajectory, flatten, gather, to_trajectories
from sidestep.tabular.distributions import check_distribution
from sidestep.tabular.likelihood import log_policies
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.tasks import Task, stack_tasks


@short_repr()
class GoalFit(eqx.Module, Generic[Model]):
    """A model learned from trajectories with unknown goals.

    Attributes:
        fit: The last fit; it has converged only if the goals have too.
        posterior: P(g | trajectory).
        goal_probabilities: p_g.
        log_likelihoods: The actions' log-likelihood, before each round and at the end.
        converged: Whether the last fit converged, and the posterior changed by less than the tolerance in the last
            round.

    Example:
        >>> from sidestep.inference.fit import fit
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.demonstrations import Trajectory
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.full((1, 3), -1))
        >>> walk = Trajectory(np.array([1, 2]), np.array([3]), task=0)
        >>> ends = [reach(grid, goal) for goal in (0, 2)]
        >>> agents = Behavior(HardMax(), 50.0)
        >>> def learn(model, shown):
        ...     return fit(model, shown, agents, terms=("transitions",))
        >>> fit_goals(ObstacleGrid(grid), [walk], ends, agents, learn).converged
        True
    """

    fit: Fit[Model]
    posterior: Float[np.ndarray, "trajectories candidates"]
    goal_probabilities: Float[np.ndarray, " candidates"]
    log_likelihoods: tuple[float, ...] = eqx.field(static=True)
    converged: bool = eqx.field(static=True)


def goal_posterior(
    model: TransitionModel,
    trajectories: Sequence[Trajectory],
    candidates: Sequence[Task],
    behavior: Behavior | BehaviorModel,
    goal_probabilities: Float[np.ndarray, " candidates"] | Sequence[float] | None = None,
    *,
    options: SolveOptions | None = None,
) -> tuple[Float[np.ndarray, "trajectories candidates"], float]:
    """Return the posterior of each trajectory's goal, and the actions' log-likelihood.

    Args:
        model: The transition model.
        trajectories: Their tasks do not matter.
        candidates: The tasks that may be the goals.
        behavior: The behavior of the agents; a `BehaviorModel` must not distinguish persons.
        goal_probabilities: p_g, which sum to 1; by default equal.
        options: How values are computed; after a fit, `fit.problem.options`.

    Returns:
        P(g | trajectory), and Σ_i log Σ_g p_g Π_t π_g in nats.

    Raises:
        InputError: For probabilities that are below 0 or do not sum to 1, for a trajectory that cannot have any of the
            goals, and as `gather` does.
        NotConverged: If the values of a candidate do not converge.

    Example:
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.demonstrations import Trajectory
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import true_model
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.zeros((1, 3), dtype=int))
        >>> walk = Trajectory(np.array([1, 2]), np.array([3]), task=0)
        >>> ends = [reach(grid, goal) for goal in (0, 2)]
        >>> posterior, _ = goal_posterior(true_model(grid), [walk], ends, Behavior(HardMax(), 50.0))
        >>> int(posterior[0].argmax())  # a walk to the right has the right end as its goal
        1
    """
    tasks, walks = check_tasks(model, candidates, "candidates"), _checked(trajectories, model)
    check_behavior(behavior, model.graph)
    alike = isinstance(behavior, Behavior) or behavior.person is None
    check(alike, "expected a behavior model that does not distinguish persons, found persons", field="behavior")
    if goal_probabilities is None:
        goal_probabilities = np.full(len(tasks), 1 / len(tasks))
    probabilities = np.asarray(to_floats(goal_probabilities, "goal_probabilities", (len(tasks),)))
    check_distribution(probabilities, field="goal_probabilities")
    check_instance(options, (SolveOptions, type(None)), "options")
    log_likelihood = [_trajectory_log_likelihoods(task, model, walks, behavior, options) for task in tasks]
    with np.errstate(divide="ignore"):
        joint = np.log(probabilities) + np.stack(log_likelihood, axis=1)
    total = np.asarray(logsumexp(jnp.asarray(joint), axis=1))
    if not np.isfinite(total).all():
        row = int(np.argmin(np.isfinite(total)))
        possible = [task for task, probability in zip(tasks, probabilities, strict=True) if probability > 0]
        raise InputError(_why_impossible(walks[row], possible), source="trajectory", row=row + 1)
    return np.exp(joint - total[:, None]), float(total.sum())


def fit_goals(
    model: Model,
    trajectories: Sequence[Trajectory],
    candidates: Sequence[Task],
    behavior: Behavior | BehaviorModel,
    learn: Callable[[Model, Demonstrations], Fit[Model]],
    *,
    options: SolveOptions | None = None,
    rounds: int = 40,
    tolerance: float = 1e-3,
) -> GoalFit[Model]:
    """Learn a model and the goals of trajectories by expectation maximization.

        result = fit_goals(model, trajectories, tasks, behavior, lambda model, demos: fit(model, demos, behavior))

    Args:
        model: The transition model to start from.
        trajectories: Their tasks do not matter.
        candidates: The tasks that may be the goals.
        behavior: The behavior of the agents. Of a `BehaviorModel`, goals have the posterior under what the last fit has
            learned.
        learn: A fit of weighted demonstrations that starts at a model, with the same behavior.
        options: How values are computed before the first fit; from then on, as each fit computes them.
        rounds: The largest number of rounds, at least 1.
        tolerance: The largest change of a posterior probability that counts as none.

    Returns:
        The model, and the posterior of each goal.

    Raises:
        InputError: As `goal_posterior` does, and for a function that does not return a fit.

    Example:
        >>> from sidestep.inference.fit import fit
        >>> from sidestep.tabular.backups import HardMax
        >>> from sidestep.tabular.demonstrations import Trajectory
        >>> from sidestep.tabular.grid import Grid
        >>> from sidestep.tabular.models import ObstacleGrid
        >>> from sidestep.tabular.tasks import reach
        >>> grid = Grid(np.full((1, 3), -1))
        >>> walk = Trajectory(np.array([1, 2]), np.array([3]), task=0)
        >>> ends = [reach(grid, goal) for goal in (0, 2)]
        >>> agents = Behavior(HardMax(), 50.0)
        >>> def learn(model, shown):
        ...     return fit(model, shown, agents, terms=("transitions",))
        >>> fit_goals(ObstacleGrid(grid), [walk], ends, agents, learn).posterior.shape
        (1, 2)
    """
    check_count(rounds, 1, "rounds")
    to_number(tolerance, "tolerance", least=0)
    check_function(learn, "learn")
    trajectories, candidates = _checked(trajectories, model), check_tasks(model, candidates, "candidates")
    posterior, log_likelihood = goal_posterior(model, trajectories, candidates, behavior, options=options)
    history = [log_likelihood]
    while True:
        result = learn(model, weighted_demonstrations(trajectories, candidates, posterior))
        check_instance(result, Fit, "learn", source="the result of a function")
        model, goal_probabilities, before = result.model, posterior.mean(axis=0), posterior
        behavior = result.behavior if isinstance(behavior, BehaviorModel) else behavior
        posterior, log_likelihood = goal_posterior(
            model, trajectories, candidates, behavior, goal_probabilities, options=result.problem.options
        )
        history.append(log_likelihood)
        change = float(np.abs(posterior - before).max())
        if change < tolerance or len(history) > rounds:
            if change >= tolerance:
                message = f"the goals still changed by up to {change:.2g} in the last of {rounds} rounds"
                result = replace(result, converged=False, message=message)
            return GoalFit(result, posterior, goal_probabilities, tuple(history), result.converged)


def weighted_demonstrations(
    trajectories: Sequence[Trajectory],
    candidates: Sequence[Task],
    posterior: Float[np.ndarray, "trajectories candidates"],
) -> Demonstrations:
    """Return each trajectory as a demonstration of each possible candidate, weighted by the posterior.

    Args:
        trajectories: Their tasks do not matter.
        candidates: The tasks that may be the goals.
        posterior: P(g | trajectory).
    """
    # improbable candidates too: while the pairs stay the same, no function is compiled anew
    pairs = np.argwhere(posterior > 0)
    demos = gather([trajectories[index]._replace(task=int(candidate)) for index, candidate in pairs], candidates)
    weights = np.repeat(posterior[posterior > 0], [len(trajectories[index].actions) for index, _ in pairs])
    return eqx.tree_at(lambda demos: demos.weights, demos, jnp.asarray(weights))


def _checked(trajectories: Sequence[Trajectory], model: TransitionModel) -> list[Trajectory]:
    """Return trajectories in the world of a model, for which their tasks do not matter."""
    walks = [walk._replace(task=0) for walk in to_list(trajectories, Trajectory, "trajectories")]
    return to_trajectories(walks, np.zeros((1, model.graph.states), bool), model.graph.actions)


def _trajectory_log_likelihoods(
    task: Task,
    model: TransitionModel,
    trajectories: Sequence[Trajectory],
    behavior: Behavior | BehaviorModel,
    options: SolveOptions | None,
) -> Float[np.ndarray, " trajectories"]:
    """Return Σ_t log π(a_t | s_t) of each trajectory for a task; −∞ if it continues after a terminal state."""
    moves = flatten([trajectory._replace(task=0) for trajectory in trajectories], stack_tasks([task]))
    terminal, states, actions = (np.asarray(each) for each in (task.terminal, moves.states, moves.actions))
    # as many moves for every candidate, so that no function is compiled anew; those after the end count as −∞
    ended, elsewhere = terminal[states], int(np.argmin(terminal))
    if terminal[elsewhere]:
        return np.full(len(trajectories), -np.inf)  # the task has ended wherever a trajectory begins
    shape = model.graph.states, model.graph.actions
    possible = int(np.argmax(np.broadcast_to(np.asarray(model.graph.available), shape)[elsewhere]))
    others = to_jax(np.where(ended, elsewhere, states)), to_jax(np.where(ended, possible, actions))
    moves = eqx.tree_at(lambda moves: (moves.states, moves.actions), moves, others)
    log_policy = np.asarray(log_policies(model, moves, behavior, options=options))
    if np.isnan(log_policy).any():
        raise NotConverged("the values of a candidate's task did not converge: a smaller β may help")
    return np.bincount(np.asarray(moves.trajectory), np.where(ended, -np.inf, log_policy), minlength=len(trajectories))


def _why_impossible(trajectory: Trajectory, candidates: Sequence[Task]) -> str:
    """Return why a trajectory cannot have any of the candidates with a probability above 0 as its goal."""
    passed = sum(bool(np.asarray(task.terminal)[trajectory.states[:-1]].any()) for task in candidates)
    expected = "expected one that it may have as its goal"
    if passed == len(candidates):
        return f"continues after the terminal states of all candidates: {expected}"
    after = f"; it continues after the terminal states of {passed} others" if passed else ""
    return (
        f"has an action of probability 0 for {len(candidates) - passed} of {len(candidates)} candidates, such as one "
        f"into a state from which the goal is out of reach{after}: {expected}"
    )
