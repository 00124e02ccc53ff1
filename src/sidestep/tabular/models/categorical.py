"""Categorical models, with a logit for every outcome or logits that outcomes share.

Every outcome k of action a in state s has a logit, and its probability is the softmax over the possible outcomes,

    T_θ(s, a, s′_k) = exp l(s, a, k) / Σ_j exp l(s, a, j).

In a `TabularModel` each l is a parameter of its own. In a `TiedModel` l(s, a, k) = θ[index(s, a, k)]: outcomes with the
same index share a parameter, so that observations in one place inform all others. An outcome that is not learned has
l = 0; the other one of two then has probability σ(θ).

The index decides what is shared: the rule that a color stands for, whether a machine enters a terrain, the slip of a
whole lake, the wall between two cells, a closed link of a road network.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import check
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph
from sidestep.tabular.models.base import TransitionModel

Logits = Float[Array | np.ndarray, "..."] | float
"""Logits of a model: one number for all of them, or one for each."""

FIXED, IMPOSSIBLE = -1, -2
"""Entries of an index: an outcome with a logit of 0 that is not learned, and an impossible outcome."""


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
    check(possible.any(axis=-1).all(), "expected a possible outcome for every state and action", field=field)


class TabularModel(TransitionModel):
    """A categorical model with a separate logit for every outcome of every state and action.

    Attributes:
        graph: The states that each action can lead to.
        parameters: Logits; the probabilities are their softmax over outcomes.
        possible: Whether each outcome can happen; the others have probability 0.

    Example:
        >>> from sidestep.tabular.graph import graph
        >>> TabularModel(graph(np.array([[[0, 1]], [[1, 0]]])), jnp.zeros((2, 1, 2))).probabilities()[0, 0].tolist()
        [0.5, 0.5]
    """

    graph: Graph
    parameters: Float[Array, "states actions outcomes"]
    possible: Bool[Array, "states actions outcomes"]

    def __init__(
        self,
        graph: Graph,
        logits: Float[Array, "states actions outcomes"],
        possible: Bool[Array, "states actions outcomes"] | None = None,
    ):
        """Raise `InputError` for shapes that differ from the graph's or an action without a possible outcome."""
        self.graph, self.parameters = graph, logits
        self.possible = to_jax(np.ones(logits.shape, dtype=bool)) if possible is None else possible
        same_shapes = logits.shape == self.possible.shape == graph.successors.shape
        check(same_shapes, f"expected the graph's shape {graph.successors.shape}", field="logits, possible")
        if not isinstance(self.possible, Tracer):
            _check_each_action_has_an_outcome(np.asarray(self.possible), "possible")

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """Return the softmax of the logits over the possible outcomes."""
        return jax.nn.softmax(jnp.where(self.possible, self.parameters, -jnp.inf), axis=-1)


class TiedModel(TransitionModel):
    """A categorical model in which outcomes share logits.

    Attributes:
        graph: The states that each action can lead to.
        parameters: θ, one logit for each index.
        index: The index of each outcome's logit; `FIXED` for a logit of 0, `IMPOSSIBLE` for an impossible outcome.

    Example:
        >>> from sidestep.tabular.graph import graph
        >>> slippery = TiedModel(graph(np.array([[[0, 1]], [[1, 0]]])), np.array([[[FIXED, 0]], [[FIXED, 0]]]))
        >>> slippery.probabilities()[:, 0, 1].tolist()  # both by the same logit, 0
        [0.5, 0.5]
    """

    graph: Graph
    parameters: Float[Array, " logits"]
    index: Int[Array, "states actions outcomes"]

    def __init__(self, graph: Graph, index: Int[Array | np.ndarray, "states actions outcomes"], logits: Logits = 0.0):
        """Make a model with logits: one number for all, or one for each index.

        Raises:
            InputError: For an index of another shape than the graph's, below `IMPOSSIBLE` or beyond the logits, and
                for an action without a possible outcome.
        """
        same_shape = index.shape == graph.successors.shape
        check(same_shape, f"expected the graph's shape {graph.successors.shape}, found {index.shape}", field="index")
        index = np.asarray(index)
        count = max(int(index.max(initial=FIXED)) + 1, 0)
        parameters = logit_array(logits, np.shape(logits) or (count,))
        in_range = index.min() >= IMPOSSIBLE and count <= len(parameters)
        check(in_range, f"expected {IMPOSSIBLE}…{len(parameters) - 1}", field="index")
        _check_each_action_has_an_outcome(index != IMPOSSIBLE, "index")
        self.graph, self.parameters, self.index = graph, parameters, to_jax(index, np.int32)

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """Return the softmax of the shared logits over the possible outcomes."""
        learned = jnp.where(self.index >= 0, self.parameters[jnp.maximum(self.index, 0)], 0.0)
        return jax.nn.softmax(jnp.where(self.index == IMPOSSIBLE, -jnp.inf, learned), axis=-1)
