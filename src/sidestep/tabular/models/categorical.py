"""Models whose parameters are the logits of outcomes: each its own, or tied to others.

Every outcome k of action a in state s has a logit, and its probability is the softmax over the possible outcomes,

    T_θ(s, a, s′_k) = exp l(s, a, k) / Σ_j exp l(s, a, j).

In a `TabularModel` each l is a parameter of its own. In a `TiedModel` l(s, a, k) = θ[index(s, a, k)]: outcomes with the
same index share a parameter, so that what is seen in one place teaches everywhere. An outcome that is not learned has
l = 0; beside it, the other one of two has probability σ(θ).

What is shared is a matter of the index: the rule that a colour stands for, whether a machine enters a terrain, the slip
of a whole lake, the wall between two cells, a closed link of a road network.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from sidestep.errors import InputError
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph
from sidestep.tabular.models.base import TransitionModel

FIXED, IMPOSSIBLE = -1, -2
"""In an index: an outcome whose logit is 0 and not learned, and one that cannot happen."""


def logit_array(logits: Float[Array | np.ndarray, "..."] | float, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Return logits of the given shape, from one number for all or one for each; arrays keep their precision."""
    if isinstance(logits, jax.Array):
        return jnp.broadcast_to(logits, shape)
    array = np.asarray(logits)
    if not (isinstance(logits, np.ndarray) and array.dtype.kind == "f"):
        array = array.astype(jnp.result_type(float))
    return to_jax(np.broadcast_to(array, shape))


class TabularModel(TransitionModel):
    """A categorical model with a logit of its own for every outcome of every state and action.

    - `parameters`: logits; the probabilities are their softmax over outcomes.
    - `possible`: outcomes that can happen at all; the others have probability 0 whatever their logit.
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
        """Raises `InputError` for shapes that differ from the graph's or an action without a possible outcome."""
        self.graph, self.parameters = graph, logits
        self.possible = to_jax(np.ones(logits.shape, dtype=bool)) if possible is None else possible
        if not logits.shape == self.possible.shape == graph.successors.shape:
            raise InputError(f"expected the graph's shape {graph.successors.shape}", field="logits, possible")
        if not isinstance(self.possible, Tracer) and not np.asarray(self.possible).any(axis=-1).all():
            raise InputError("expected a possible outcome for every state and action", field="possible")

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """The softmax of the logits over the possible outcomes."""
        return jax.nn.softmax(jnp.where(self.possible, self.parameters, -jnp.inf), axis=-1)


class TiedModel(TransitionModel):
    """A categorical model in which outcomes share logits.

    - `parameters`: θ, one logit for each index.
    - `index`: which of them is the logit of each outcome; `FIXED` for 0, `IMPOSSIBLE` for an outcome that is none.

    >>> from sidestep.tabular.graph import graph
    >>> slippery = TiedModel(graph(np.array([[[0, 1]], [[1, 0]]])), np.array([[[FIXED, 0]], [[FIXED, 0]]]))
    >>> slippery.probabilities()[:, 0, 1].tolist()  # both by the same logit, 0
    [0.5, 0.5]
    """

    graph: Graph
    parameters: Float[Array, " logits"]
    index: Int[Array, "states actions outcomes"]

    def __init__(
        self,
        graph: Graph,
        index: Int[Array | np.ndarray, "states actions outcomes"],
        logits: Float[Array | np.ndarray, " logits"] | float = 0.0,
    ):
        """A model at the given logits (one number for all, or one for each index).

        Raises `InputError` for an index of another shape than the graph's, below `IMPOSSIBLE` or beyond the logits, and
        for an action without a possible outcome.
        """
        if index.shape != graph.successors.shape:
            raise InputError(f"expected the graph's shape {graph.successors.shape}, found {index.shape}", field="index")
        index = np.asarray(index)
        count = max(int(index.max(initial=FIXED)) + 1, 0)
        parameters = logit_array(logits, np.shape(logits) or (count,))
        if index.min() < IMPOSSIBLE or count > len(parameters):
            raise InputError(f"expected {IMPOSSIBLE}…{len(parameters) - 1}", field="index")
        if (index == IMPOSSIBLE).all(axis=-1).any():
            raise InputError("expected a possible outcome for every state and action", field="index")
        self.graph, self.parameters, self.index = graph, parameters, to_jax(index, np.int32)

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """The softmax of the shared logits over the possible outcomes."""
        learned = jnp.where(self.index >= 0, self.parameters[jnp.maximum(self.index, 0)], 0.0)
        return jax.nn.softmax(jnp.where(self.index == IMPOSSIBLE, -jnp.inf, learned), axis=-1)
