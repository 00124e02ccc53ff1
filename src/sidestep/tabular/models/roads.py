"""Road networks: states are links, an action is one of the turns out of a link, and some may be closed.

A turn from link l onto link m succeeds unless m (or the turn itself) is closed, with P(closed) = σ(θ); who meets a
closed one stays on l. Links differ in how many turns they have; what is not there stays put, and is as long as all
links together, so that nobody tries it who pays by length.
"""

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.errors import InputError
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph
from sidestep.tabular.models.categorical import FIXED, IMPOSSIBLE, TiedModel, logit_array


def road_network(
    turns: Int[np.ndarray, "turns 2"],
    lengths: Float[np.ndarray, " links"],
    logits: Float[Array | np.ndarray, " _"] | float = -2.0,
    *,
    by_turn: bool = False,
) -> TiedModel:
    """The model of a road network in which links may be closed, or turns.

    - `turns`: from which link to which, each once.
    - `lengths`: of every link; a turn is as long as the link that it leads onto.
    - `logits`: θ, one number for all, or one for each link (with `by_turn`, for each turn in the order of `turns`).

    Action k of a link is the k-th of its turns, in the order of `turns`. Raises `InputError` for turns that repeat, or
    between links that are not there, and lengths that are not finite and above 0.
    """
    links = len(lengths)
    if not (np.isfinite(lengths).all() and (lengths > 0).all()):
        raise InputError("expected finite numbers above 0", field="lengths")
    if len(turns) == 0 or turns.min() < 0 or turns.max() >= links or len(np.unique(turns, axis=0)) < len(turns):
        raise InputError(f"expected different turns between links 0…{links - 1}", field="turns")
    order = np.argsort(turns[:, 0], kind="stable")
    begin, onto = turns[order].T
    first = np.searchsorted(begin, begin)
    action = np.arange(len(turns)) - first
    successors = np.repeat(np.arange(links), (action.max() + 1) * 2).reshape(links, -1, 2)
    successors[begin, action, 0] = onto
    index = np.full(successors.shape, IMPOSSIBLE)
    index[..., 1] = FIXED
    index[begin, action, 0] = FIXED
    index[begin, action, 1] = order if by_turn else onto
    costs = np.full(successors.shape[:2], lengths.sum())
    costs[begin, action] = lengths[onto]
    graph = Graph(to_jax(successors, np.int32), to_jax(costs))
    count = len(turns) if by_turn else links
    return TiedModel(graph, index, logit_array(logits, (count,)))


def closed(model: TiedModel) -> Float[Array, " logits"]:
    """P(closed) of every link, turn or border: σ(θ)."""
    return jax.nn.sigmoid(model.parameters)
