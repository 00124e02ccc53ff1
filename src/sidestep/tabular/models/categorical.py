"""Categorical models, with a logit for every outcome or logits that outcomes share.

Every outcome k of action a in state s has a logit, and its probability is the softmax over the possible outcomes,

    T_θ(s, a, s′_k) = exp l(s, a, k) / Σ_j exp l(s, a, j).

In a `TabularModel` each l is a parameter of its own; the outcomes of *known* actions are not learned. In a `TiedModel`
l(s, a, k) = θ[index(s, a, k)]: outcomes with the same index share a parameter, so that observations in one place inform
all others. An outcome that is not learned has a fixed logit, 0 by default; the other one of two then has probability
σ(θ).

The index decides what is shared: the rule that a color stands for, whether a machine enters a terrain, the slip of a
whole lake, the wall between two cells, a closed link of a road network.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from sidestep._arguments import to_finite, to_floats, to_integers, to_logits, to_mask
from sidestep.errors import check, check_instance
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.distributions import check_distributions
from sidestep.tabular.graph import Graph
from sidestep.tabular.models.base import TransitionModel

Logits = Float[Array | np.ndarray, "..."] | float
"""Logits of a model: one number for all of them, or one for each."""

FIXED, IMPOSSIBLE = -1, -2
"""Entries of an index: an outcome with a fixed logit, which is not learned, and an impossible outcome."""


def logit_array(logits: Logits, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Return logits of the given shape, from one number for all or one for each; arrays keep their precision.

    Args:
        logits: One number, or an array of that shape.
        shape: Of the result.
    """
    if isinstance(logits, jax.Array):
        return jnp.broadcast_to(logits, shape)
    array = np.asarray(logits)
    if not (isinstance(logits, np.ndarray) and array.dtype.kind == "f"):
        array = array.astype(jnp.result_type(float))
    return to_jax(np.broadcast_to(array, shape))


def _check_each_action_has_an_outcome(possible: Bool[np.ndarray, "states actions outcomes"], field: str) -> None:
    without = np.argwhere(~possible.any(axis=-1))[:1].tolist()
    check(not without, f"expected a possible outcome of every action, found none at {without}", field=field)


class TabularModel(TransitionModel):
    """A categorical model with a separate logit for every outcome of every state and action.

    Attributes:
        graph: The states that each action can lead to.
        parameters: Logits; the probabilities are their softmax over outcomes. Where some actions are known, those of
            the others only, one row for each, in the order of states and actions.
        possible: Whether each outcome can happen; the others have probability 0.
        known: Whether the probabilities of an action are known, and so not learned; None where none are.
        fixed: The logits of all outcomes where some are known; those of known actions count.

    Example:
        >>> from sidestep.tabular.graph import graph
        >>> TabularModel(graph([[[0, 1]], [[1, 0]]]), jnp.zeros((2, 1, 2))).probabilities()[0, 0].tolist()
        [0.5, 0.5]
        >>> TabularModel(graph([[[0, 1]], [[1, 0]]]), jnp.zeros((2, 1, 2)), known=[[True], [False]]).parameters.shape
        (1, 2)
    """

    graph: Graph
    parameters: Float[Array, "states actions outcomes"] | Float[Array, "learned outcomes"]
    possible: Bool[Array, "states actions outcomes"]
    known: Bool[Array, "states actions"] | None
    fixed: Float[Array, "states actions outcomes"] | None

    def __init__(
        self,
        graph: Graph,
        logits: Shaped[ArrayLike, "..."] | Sequence[Any],
        possible: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
        known: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
    ):
        """Make a model with logits and masks of the graph's shape.

        Raises:
            InputError: For other shapes and types, NaN, and an action without a possible outcome.
        """
        check_instance(graph, Graph, "graph")
        shape = tuple(graph.successors.shape)
        mask = np.ones(shape, bool) if possible is None else to_mask(possible, "possible", shape)
        if not isinstance(mask, Tracer):
            _check_each_action_has_an_outcome(np.asarray(mask), "possible")
        self.graph, self.possible = graph, to_jax(mask)
        own = to_floats(logits, "logits", shape)
        if not isinstance(own, Tracer):
            missing = np.argwhere(np.isnan(np.asarray(own)))[:1].tolist()
            check(not missing, f"expected numbers, found nan at {missing}", field="logits")
        every = logit_array(own, shape)
        if known is None:
            self.parameters, self.known, self.fixed = every, None, None
        else:
            rows = np.asarray(to_mask(known, "known", shape[:2]))
            self.parameters, self.known, self.fixed = every[~rows], to_jax(rows), every

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """Return the softmax of the logits over the possible outcomes."""
        logits = self.parameters
        if self.known is not None and self.fixed is not None:
            # the number of each learned action among them
            row = jnp.cumsum(~self.known.ravel()).reshape(self.known.shape) - 1
            learned = logits[row] if len(logits) else self.fixed
            logits = jnp.where(self.known[..., None], self.fixed, learned)
        return jax.nn.softmax(jnp.where(self.possible, logits, -jnp.inf), axis=-1)


def tabular_model(
    world: Graph,
    probabilities: Shaped[ArrayLike, "..."] | Sequence[Any],
    known: Shaped[ArrayLike, "..."] | Sequence[Any] | bool = False,
) -> TabularModel:
    """Return a model with these probabilities of outcomes.

    Args:
        world: The graph.
        probabilities: T(s, a, s′ₖ) of each outcome k of the graph; outcomes with 0 are impossible, also for a fit.
        known: Whether each action's probabilities are known, and so not learned; one boolean for all. With True there
            is nothing to learn but the behavior.

    Raises:
        InputError: For another shape, numbers below 0, and rows that do not sum to one.

    Example:
        >>> from sidestep.tabular.graph import graph
        >>> model = tabular_model(graph([[[0, 1]], [[1, 0]]]), [[[0.5, 0.5]], [[1.0, 0.0]]], known=True)
        >>> model.probabilities().tolist(), model.parameters.shape
        ([[[0.5, 0.5]], [[1.0, 0.0]]], (0, 2))
    """
    check_instance(world, Graph, "world")
    shape = tuple(world.successors.shape)
    table = np.asarray(to_finite(probabilities, "probabilities", shape, least=0))
    check_distributions(table, ("state", "action"), field="probabilities")
    mask = np.full(shape[:2], known) if isinstance(known, bool) else known
    logits = np.log(np.where(table > 0, table, 1))
    return TabularModel(world, logits, table > 0, known=None if known is False else mask)


class TiedModel(TransitionModel):
    """A categorical model in which outcomes share logits.

    Attributes:
        graph: The states that each action can lead to.
        parameters: θ, one logit for each index.
        index: The index of each outcome's logit; `FIXED` for a logit that is not learned, `IMPOSSIBLE` for an
            impossible outcome.
        fixed: The logits of fixed outcomes; an axis of length 1 holds for all.

    Example:
        >>> from sidestep.tabular.graph import graph
        >>> slippery = TiedModel(graph([[[0, 1]], [[1, 0]]]), [[[FIXED, 0]], [[FIXED, 0]]])
        >>> slippery.probabilities()[:, 0, 1].tolist()  # both by the same logit, 0
        [0.5, 0.5]
    """

    graph: Graph
    parameters: Float[Array, " logits"]
    index: Int[Array, "states actions outcomes"]
    fixed: Float[Array, "#states #actions #outcomes"]

    def __init__(
        self,
        graph: Graph,
        index: Shaped[ArrayLike, "..."] | Sequence[Any],
        logits: Shaped[ArrayLike, "..."] | Sequence[float] = 0.0,
        fixed: Shaped[ArrayLike, "..."] | Sequence[Any] = 0.0,
    ):
        """Make a model with logits: one number for all, or one for each index; and likewise those that are fixed.

        Raises:
            InputError: For an index of another shape than the graph's, below `IMPOSSIBLE` or beyond the logits, NaN,
                and for an action without a possible outcome.
        """
        check_instance(graph, Graph, "graph")
        shape = tuple(graph.successors.shape)
        numbers = np.asarray(to_integers(index, "index", shape, least=IMPOSSIBLE))
        count = max(int(numbers.max(initial=FIXED)) + 1, 0)
        own = logits if isinstance(logits, Tracer) else to_floats(logits, "logits", (), ("logits",))
        parameters = logit_array(to_logits(own, max(count, *np.shape(own), 0)), np.shape(own) or (count,))
        message = f"expected {IMPOSSIBLE}…{len(parameters) - 1}, found {count - 1}"
        check(count <= len(parameters), message, field="index")
        _check_each_action_has_an_outcome(numbers != IMPOSSIBLE, "index")
        constants = np.asarray(to_finite(fixed, "fixed", (), shape))
        self.graph, self.parameters, self.index = graph, parameters, to_jax(numbers, np.int32)
        self.fixed = to_jax(constants.reshape(constants.shape or (1, 1, 1)), jnp.result_type(float))

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """Return the softmax of the shared logits over the possible outcomes."""
        fixed = self.fixed.astype(self.parameters.dtype)
        learned = jnp.where(self.index >= 0, self.parameters[jnp.maximum(self.index, 0)], fixed)
        return jax.nn.softmax(jnp.where(self.index == IMPOSSIBLE, -jnp.inf, learned), axis=-1)
