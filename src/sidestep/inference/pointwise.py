"""The log-likelihood of each move, at what a fit has learned or at draws from its posterior.

The objective of a fit is linear in the counts of its choices and arrivals (`sidestep.tabular.likelihood`), so its
derivative by a count is the log-likelihood of one move. That is how it is computed here: by the objective itself.
"""

import math
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._repr import short_repr
from sidestep._typing import Tree
from sidestep.errors import NotConverged, check, check_choice, check_instance
from sidestep.inference.batching import Batch
from sidestep.inference.fit import Fit
from sidestep.inference.objective import Objective, Parameters, Problem, actions_log_likelihood
from sidestep.inference.tabular_information import with_known_values
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.demonstrations import Demonstrations, trajectory_weights
from sidestep.tabular.likelihood import Arrivals, arrival_log_likelihood, move_times
from sidestep.tabular.solve import SMALL_PROBLEM
from sidestep.tabular.solvers.base import WarmStart

Unit = Literal["walk", "move"]
"""What is left out or counted as one observation: a whole walk, or a move."""

_NUMBERS = 2**24
"""About how many probabilities the draws that are solved together have."""
_TOGETHER = 32
"""The most draws that are solved together."""

_Data = tuple[list[Batch], list[WarmStart], Arrivals | None]


@short_repr("total", "trajectory", "weights")
class PointwiseLogLikelihood(NamedTuple):
    """The log-likelihood of each move in nats, by `pointwise_log_likelihood`; with leading axes for draws.

    Attributes:
        actions: log π(a | s); 0 where actions do not count.
        transitions: ln T(s, a, s′); 0 where transitions do not count.
        trajectory: The trajectory of each move.
        weights: How much each move counts.

    Example:
        >>> each = PointwiseLogLikelihood(-np.ones(3), -np.ones(3), np.array([0, 0, 1]), np.ones(3))
        >>> each.of("walk").tolist()
        [-4.0, -2.0]
    """

    actions: Float[np.ndarray, "*draws moves"]
    transitions: Float[np.ndarray, "*draws moves"]
    trajectory: Int[np.ndarray, " moves"]
    weights: Float[np.ndarray, " moves"]

    @property
    def total(self) -> Float[np.ndarray, "*draws moves"]:
        """Return the sum of both terms."""
        return self.actions + self.transitions

    def numbers_of(self, unit: Unit) -> Int[np.ndarray, " units"]:
        """Return the numbers of the trajectories or of the moves that count.

        Args:
            unit: "walk" or "move".
        """
        check_choice(unit, ("walk", "move"), "unit")
        counts = self.weights > 0
        return np.unique(self.trajectory[counts]) if unit == "walk" else np.flatnonzero(counts)

    def weights_of(self, unit: Unit) -> Float[np.ndarray, " units"]:
        """Return how much each walk or move that counts does: for a walk, Σ w² / Σ w over its moves.

        Args:
            unit: "walk" or "move".
        """
        each = self.weights if unit == "move" else trajectory_weights(self.trajectory, self.weights)
        return each[self.numbers_of(unit)]

    def of(self, unit: Unit) -> Float[np.ndarray, "*draws units"]:
        """Return the log-likelihood of each walk or move that counts: the weighted sum over its moves.

        The moves of a walk are independent given all that is learned, but a walk is what a new observation would be:
        leave out walks to ask how well the next one is predicted.

        Args:
            unit: "walk" or "move".
        """
        numbers, counts = self.numbers_of(unit), self.weights > 0
        each = self.total[..., counts] * self.weights[counts]
        if unit == "move":
            return each
        first = np.searchsorted(self.trajectory[counts], numbers)
        return np.add.reduceat(each, first, axis=-1)


def pointwise_log_likelihood(fit: Fit[Any], parameters: Parameters | None = None) -> PointwiseLogLikelihood:
    """Return the log-likelihood of each move, under what a fit has learned or under draws from its posterior.

    Moves of weight 0 have one too. Tempering does not count.

    Args:
        fit: The fit.
        parameters: Draws with any leading axes, such as `Draws.parameters` or `Laplace.sample(key, n)`; by default what
            the fit has learned.

    Returns:
        Both terms, as far as the fit has them, with the leading axes of the parameters.

    Raises:
        InputError: For anything but a fit, and parameters of another model or with different leading axes.
        NotConverged: If values do not converge.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [ss.reach(grid, 2)])
        >>> learned = ss.fit(ss.ObstacleGrid(grid, 0.0), shown, ss.Behavior(ss.HardMax()), terms=("transitions",))
        >>> [f"{each:.2f}" for each in pointwise_log_likelihood(learned).transitions]  # P(blocked) is about a tenth
        ['-0.11', '-0.11']
    """
    check_instance(fit, Fit, "fit")
    learned = Parameters(fit.model.parameters, fit.behavior.parameters)
    return moves_log_likelihood(fit.problem, learned if parameters is None else parameters)


def moves_log_likelihood(problem: Problem, parameters: Parameters) -> PointwiseLogLikelihood:
    """Return the log-likelihood of each move of a problem, at parameters with any leading axes.

    Args:
        problem: The problem.
        parameters: θ, as for `pointwise_log_likelihood`.
    """
    draws, stacked = _stack(parameters, problem.parameters)
    objective = _unweighted(problem)
    constants, starts = objective.constants, objective.cold_starts()
    if not draws and problem.model.graph.states <= SMALL_PROBLEM and constants.options.horizon is None:
        # after a fit, the program that evaluates the objective is compiled, and one without sweeps is quickly
        constants, starts = with_known_values(constants), _solved(objective, parameters)
    data = objective.batches, starts, objective.arrivals
    size = problem.model.graph.successors.size * objective.plan.size
    choices, arrivals = _terms(constants, data, stacked, max(1, min(_TOGETHER, _NUMBERS // size)))
    demos = problem.demonstrations
    shape = (*draws, len(demos))
    by_action = by_transition = np.zeros(shape)
    if choices:
        by_action = _of_choices(objective, demos, [np.asarray(part) for part in choices]).reshape(shape)
    if objective.arrivals is not None:
        by_transition = _of_arrivals(objective.arrivals, demos, np.asarray(arrivals)).reshape(shape)
    failed = np.isnan(by_action).any(axis=-1)
    if failed.any():
        raise NotConverged(f"values did not converge for {failed.sum()} of {failed.size} draws: more sweeps may help")
    return PointwiseLogLikelihood(by_action, by_transition, np.asarray(demos.trajectory), np.asarray(demos.weights))


def _solved(objective: Objective, parameters: Parameters) -> list[WarmStart]:
    """Return the values of all tasks as starts; NaN where they have not converged."""
    evaluation, starts = objective.evaluate(parameters, objective.cold_starts())
    values = [
        np.where(np.asarray(solves.converged)[:, None], np.asarray(start.values), np.nan)
        for solves, start in zip(evaluation.solves, starts, strict=True)
    ]
    return [start._replace(values=to_jax(own)) for start, own in zip(starts, values, strict=True)]


def _unweighted(problem: Problem) -> Objective:
    """Return the objective in which every move counts 1, without tempering."""
    weights, tempering = jnp.ones_like(problem.demonstrations.weights), jnp.ones_like(problem.tempering)
    changes = weights, tempering
    return Objective(eqx.tree_at(lambda each: (each.demonstrations.weights, each.tempering), problem, changes))


def _stack(parameters: Parameters, learned: Parameters) -> tuple[tuple[int, ...], Parameters]:
    """Return the leading axes of draws, and the draws with one leading axis."""
    same = jax.tree.structure(parameters) == jax.tree.structure(learned)
    check(same, "expected draws of the parameters that the fit has learned", field="parameters")
    pairs = list(zip(jax.tree.leaves(parameters), jax.tree.leaves(learned), strict=True))
    axes = {np.shape(draw)[: np.ndim(draw) - np.ndim(one)] for draw, one in pairs}
    shapes = all(np.shape(draw)[np.ndim(draw) - np.ndim(one) :] == np.shape(one) for draw, one in pairs)
    check(
        len(axes) == 1 and shapes, "expected draws with the same leading axes, of the fit's shapes", field="parameters"
    )
    (draws,) = axes
    count = math.prod(draws)
    flat = jax.tree.map(lambda draw, one: to_jax(np.asarray(draw).reshape(count, *one.shape)), parameters, learned)
    return draws, flat


@eqx.filter_jit
def _terms(
    problem: Problem, data: _Data, parameters: Parameters, together: int
) -> tuple[list[Float[Array, "draws tasks choices"]], Float[Array, "draws arrivals"] | None]:
    """Return log π of each choice of each batch, and ln T of each arrival, for each draw."""
    batches, starts, arrivals = data

    def of_choices(parameters: Parameters, batch: Batch, start: WarmStart) -> Array:
        def total(counts: Array) -> Array:
            counted = batch._replace(choices=batch.choices._replace(counts=counts))
            everywhere = jnp.ones(start.values.shape, bool)
            return actions_log_likelihood(problem, parameters, counted, start, everywhere)[0]

        return jax.grad(total)(batch.choices.counts)

    def one(parameters: Parameters) -> Tree:
        choices = [of_choices(parameters, *each) for each in zip(batches, starts, strict=True)]
        if arrivals is None:
            return choices, None
        model = problem.model.with_parameters(parameters.model)
        moves = arrivals
        of_counts = jax.grad(lambda counts: arrival_log_likelihood(model, moves._replace(counts=counts)))
        return choices, of_counts(moves.counts)

    return jax.lax.map(one, parameters, batch_size=together)


def _of_choices(
    objective: Objective, demos: Demonstrations, choices: list[Float[np.ndarray, "draws tasks choices"]]
) -> Float[np.ndarray, "draws moves"]:
    """Return the log-likelihood of the action of each move, from that of each choice."""
    graph, batches, options = objective.problem.model.graph, objective.batches, objective.problem.options
    # with a deadline, choices after different numbers of moves are distinct
    timed, moments = (("times",), (options.horizon or 1,)) if options.deadline else ((), ())
    counts, *parts = (
        np.concatenate([np.asarray(getattr(batch.choices, name)) for batch in batches])
        for name in ("counts", "states", "actions", *timed)
    )
    task = np.broadcast_to(np.arange(len(counts))[:, None], counts.shape)
    shape, places = (len(counts), graph.states, graph.actions, *moments), np.flatnonzero(counts.ravel() > 0)
    of_choice = np.ravel_multi_index((task, *parts), shape).ravel()[places]
    times = [move_times(demos.trajectory)] if timed else []
    own = map(np.asarray, (demos.task, demos.states, demos.actions, *times))
    of_move = np.ravel_multi_index(tuple(own), shape)
    values = np.concatenate(choices, axis=1)
    return _values_at(of_choice, of_move, values.reshape(len(values), -1)[:, places])


def _of_arrivals(
    arrivals: Arrivals, demos: Demonstrations, values: Float[np.ndarray, "draws arrivals"]
) -> Float[np.ndarray, "draws moves"]:
    """Return the log-likelihood of the transition of each move, from that of each distinct one."""
    parts = tuple(map(np.asarray, (arrivals.states, arrivals.actions, arrivals.next_states)))
    shape = tuple(1 + int(part.max()) for part in parts)
    places = np.flatnonzero(np.asarray(arrivals.counts) > 0)
    of_arrival = np.ravel_multi_index(parts, shape)[places]
    of_move = np.ravel_multi_index(tuple(map(np.asarray, (demos.states, demos.actions, demos.next_states))), shape)
    return _values_at(of_arrival, of_move, values[:, places])


def _values_at(
    keys: Int[np.ndarray, " keys"], wanted: Int[np.ndarray, " moves"], values: Float[np.ndarray, "draws keys"]
) -> Float[np.ndarray, "draws moves"]:
    """Return the values of wanted keys."""
    order = np.argsort(keys)
    return values[:, order[np.searchsorted(keys[order], wanted)]]
