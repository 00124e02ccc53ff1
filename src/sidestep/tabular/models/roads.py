"""Road networks: states are links, actions are the turns out of a link, and links or turns may be closed.

A turn from link l onto link m succeeds unless m (or the turn itself) is closed, with P(closed) = σ(θ); otherwise the
agent stays on l. Links have different numbers of turns; a missing turn is an action that is not available. A link
without any turn has one action, which stays there and is as long as all links together.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Shaped

from sidestep._arguments import to_finite, to_integers, to_logits
from sidestep.errors import check, check_instance
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph, with_available
from sidestep.tabular.models.categorical import FIXED, IMPOSSIBLE, TiedModel, logit_array


def road_network(
    turns: Shaped[ArrayLike, "..."] | Sequence[Any],
    lengths: Shaped[ArrayLike, "..."] | Sequence[float],
    logits: Shaped[ArrayLike, "..."] | Sequence[float] = -2.0,
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
    sizes = np.asarray(to_finite(lengths, "lengths", ("links",), above=0))
    links = len(sizes)
    pairs = np.asarray(to_integers(turns, "turns", ("turns", 2), least=0, most=links - 1, what="links"))
    message = f"expected at least one turn, and each once, found {len(pairs)} turns"
    check(len(pairs) and len(np.unique(pairs, axis=0)) == len(pairs), message, field="turns")
    order = np.argsort(pairs[:, 0], kind="stable")
    begin, onto = pairs[order].T
    first = np.searchsorted(begin, begin)
    action = np.arange(len(pairs)) - first
    successors = np.repeat(np.arange(links), (action.max() + 1) * 2).reshape(links, -1, 2)
    successors[begin, action, 0] = onto
    index = np.full(successors.shape, IMPOSSIBLE)
    index[..., 1] = FIXED
    index[begin, action, 0] = FIXED
    index[begin, action, 1] = order if by_turn else onto
    costs, available = np.full(successors.shape[:2], sizes.sum()), np.zeros(successors.shape[:2], bool)
    costs[begin, action] = sizes[onto]
    available[begin, action] = True
    available[~available.any(axis=1), 0] = True
    graph = with_available(Graph(to_jax(successors, np.int32), to_jax(costs)), available)
    count = len(pairs) if by_turn else links
    return TiedModel(graph, index, logit_array(to_logits(logits, count), (count,)))


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
    check_instance(model, TiedModel, "model")
    return jax.nn.sigmoid(model.parameters)
