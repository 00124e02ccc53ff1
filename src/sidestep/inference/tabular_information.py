"""The observed information in a world of states, by products with vectors.

    H = −∇² [log L(θ) + log p(θ)]

A product H v is the directional derivative of the exact gradient, by automatic differentiation: one linear solve
forward and one for the adjoint, for each task and vector (`sidestep.tabular.implicit`). So no step size has to be
chosen, and the error is that of the solves. The gradient itself is evaluated once, and leaves the values and adjoints
at which all products are taken.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._programs import keep_program
from sidestep._typing import Tree
from sidestep.inference.batching import Batch
from sidestep.inference.information import Information, Vectors
from sidestep.inference.objective import (
    Objective,
    Parameters,
    Problem,
    actions_log_likelihood,
    transitions_and_prior,
)
from sidestep.inference.priors import Prior
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.behavior_model import BehaviorModel
from sidestep.tabular.likelihood import Arrivals
from sidestep.tabular.models import TransitionModel
from sidestep.tabular.solvers.base import WarmStart
from sidestep.tabular.solvers.known import Known

_TOGETHER = 32
"""The most vectors that are multiplied at a time."""
_PROBABILITIES = 2**23
"""The most probabilities that the vectors of all tasks together may have to do with at a time, for their memory."""


class TabularInformation(Information):
    """The observed information in a world of states.

    Args:
        problem: The problem.
        parameters: θ.
        message: How the fit ended.
    """

    def __init__(self, problem: Problem, parameters: Parameters, message: str = ""):
        self.objective: Objective = Objective(problem)
        evaluation, self.starts = self.objective.evaluate(parameters, self.objective.cold_starts())
        constants = self.objective.constants
        solved = self.objective.plan.keeps_warm_starts and constants.options.horizon is None
        self._at_solution: Problem = with_known_values(constants) if solved else constants
        self.parameters: Parameters = parameters
        self.message: str = message
        gradient = [-np.asarray(leaf).ravel() for leaf in jax.tree.leaves(evaluation.gradient)]
        self.gradient: Float[np.ndarray, " parameters"] = np.concatenate([np.zeros(0), *gradient])

    def products(self, vectors: Vectors) -> Vectors:
        """Return H v of each vector.

        Args:
            vectors: One a row.
        """
        return self._in_parts(self._whole, vectors)

    def of_prior(self, vectors: Vectors) -> Vectors:
        """Return the products with the prior's part of H alone.

        Args:
            vectors: One a row.
        """
        return self._in_parts(lambda directions: self._without_actions(directions, None), vectors)

    def _in_parts(self, multiply: Callable[[Parameters], Tree], vectors: Vectors) -> Vectors:
        each = self.objective.plan.size * self.objective.constants.model.graph.successors.size
        count = max(1, min(_TOGETHER, len(vectors), _PROBABILITIES // each))
        padded = np.pad(vectors, ((0, -len(vectors) % count), (0, 0)))
        parts = [self._flat(multiply(self._trees(part))) for part in np.split(padded, len(padded) // count)]
        return np.concatenate(parts)[: len(vectors)]

    def _whole(self, directions: Parameters) -> Tree:
        problem, parameters = self._at_solution, self.parameters
        total = self._without_actions(directions, self.objective.arrivals)
        for batch, starts in zip(self.objective.batches, self.starts, strict=True):
            total = jax.tree.map(np.add, total, _actions_products(problem, parameters, batch, starts, directions))
        return total

    def _without_actions(self, directions: Parameters, arrivals: Arrivals | None) -> Tree:
        constants, parameters = self.objective.constants, self.parameters
        return _other_products(constants.prior, constants.model, constants.behavior, arrivals, parameters, directions)

    def _trees(self, vectors: Vectors) -> Parameters:
        leaves, structure = jax.tree.flatten(self.parameters)
        parts = np.split(vectors, np.cumsum([leaf.size for leaf in leaves])[:-1], axis=1)
        shaped = zip(parts, leaves, strict=True)
        return structure.unflatten(
            [to_jax(part.reshape(len(vectors), *leaf.shape), leaf.dtype) for part, leaf in shaped]
        )

    def _flat(self, trees: Tree) -> Vectors:
        leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(trees)]
        return np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)


def with_known_values(problem: Problem) -> Problem:
    """Return a problem of which the solves take values and adjoints from their starts, without a sweep.

    Args:
        problem: The problem, at an infinite horizon.
    """
    solver = problem.options.solver
    known = Known(None if solver is None else solver.tolerance)
    return eqx.tree_at(lambda each: each.options.solver, problem, known, is_leaf=lambda leaf: leaf is None)


@keep_program
def _actions_products(
    problem: Problem, parameters: Parameters, batch: Batch, starts: WarmStart, directions: Parameters
) -> Tree:
    def loss(parameters: Parameters) -> Array:
        return -actions_log_likelihood(problem, parameters, batch, starts, jnp.ones(starts.values.shape, bool))[0]

    return jax.vmap(jax.linearize(jax.grad(loss), parameters)[1])(directions)


@keep_program
def _other_products(
    prior: Prior,
    model: TransitionModel,
    behavior: BehaviorModel,
    arrivals: Arrivals | None,
    parameters: Parameters,
    directions: Parameters,
) -> Tree:
    def loss(parameters: Parameters) -> Array:
        return -sum(transitions_and_prior(prior, model, behavior, arrivals, parameters), jnp.zeros(()))

    return jax.vmap(jax.linearize(jax.grad(loss), parameters)[1])(directions)
