"""Road networks: states are links, actions are the turns out of a link, and links or turns may be closed.

A turn from link l onto link m succeeds unless m (or the turn itself) is closed, with P(closed) = σ(θ); otherwise the
agent stays on l. Links have different numbers of turns; a missing turn is an action that is not available. A link
without any turn has one action, which stays there and is as long as all links together.
"""

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.errors import check
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph, with_available
from sidestep.tabular.models.categorical import FIXED, IMPOSSIBLE, Logits, TiedModel, logit_array


def road_network(
    turns: Int[np.ndarray, "turns 2"],
    lengths: Float[np.ndarray, " links"],
    logits: Logits = -2.0,
    *,
    by_turn: bool = False,
) -> TiedModel:
    """Return the model of a road network in which links or turns may be closed.

    Args:
        turns: The link before and the link after each turn, each once.
        lengths: Of every link, above 0; a turn is as long as the link that it leads onto.
        logits: θ, one number for all, or one for each link (with `by_turn`, for each turn in the order of `turns`).
        by_turn: Whether turns may be closed rather than links.

    Returns:
        The model; action k of a link is the k-th of its turns, in the order of `turns`, and the only available ones
        are these (`model.graph.available`).

    Raises:
        InputError: For turns that repeat or between links that do not exist, and for lengths out of range.

    Example:
        >>> road_network(np.array([[0, 1], [1, 0]]), np.ones(2)).graph.states
        2
    """
    links = len(lengths)
    check(np.isfinite(lengths).all() and (lengths > 0).all(), "expected finite numbers above 0", field="lengths")
    between_links = len(turns) and turns.min() >= 0 and turns.max() < links
    different = between_links and len(np.unique(turns, axis=0)) == len(turns)
    check(different, f"expected different turns between links 0…{links - 1}", field="turns")
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
    costs, available = np.full(successors.shape[:2], lengths.sum()), np.zeros(successors.shape[:2], bool)
    costs[begin, action] = lengths[onto]
    available[begin, action] = True
    available[~available.any(axis=1), 0] = True
    graph = with_available(Graph(to_jax(successors, np.int32), to_jax(costs)), available)
    count = len(turns) if by_turn else links
    return TiedModel(graph, index, logit_array(logits, (count,)))


def closed(model: TiedModel) -> Float[Array, " logits"]:
    """Return P(closed) of every link, turn or border: σ(θ).

    Args:
        model: Made by `road_network` or `walled_grid`.

    Returns:
        One probability for each logit.

    Example:
        >>> closed(road_network(np.array([[0, 1], [1, 0]]), np.ones(2), logits=0.0)).tolist()
        [0.5, 0.5]
    """
    return jax.nn.sigmoid(model.parameters)
