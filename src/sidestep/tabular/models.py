"""Transition models: T_θ(s, a, s′) as probabilities of a graph's outcomes.

A model is a graph and parameters θ; it turns θ into `probabilities[s, a, k]`. Nothing else in the library knows what
θ means: solvers, likelihood and planner read the graph and the probabilities alone.

The **obstacle grid** has one logit θ(s) a cell, P(blocked at s) = σ(θ(s)). A move succeeds if every cell that it needs
is free, and otherwise stays put (the paper's experiments):

    T_θ(s, a, s′) = Π_{c needed} (1 − σ(θ(c))),    T_θ(s, a, s) = 1 − T_θ(s, a, s′).
"""

import abc
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PyTree

from sidestep.errors import InputError
from sidestep.tabular.graph import Graph, grid_graph
from sidestep.tabular.grid import STEPS, Cell, Grid

_Model = TypeVar("_Model", bound="TransitionModel")


class TransitionModel(eqx.Module):
    """Probabilities T_θ on a graph.

    - `graph`: where each action can lead.
    - `parameters`: θ, a pytree of floating-point arrays, all of which are learned.

    A new family is a subclass with `probabilities`.
    """

    graph: eqx.AbstractVar[Graph]
    parameters: eqx.AbstractVar[PyTree[Float[Array, "..."]]]

    @abc.abstractmethod
    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """T_θ(s, a, s′) for each outcome s′ = `graph.successors[s, a, k]`; sums to one over k."""

    def with_parameters(self: _Model, parameters: PyTree[Float[Array, "..."]]) -> _Model:
        """The same family at another θ."""
        return eqx.tree_at(lambda model: model.parameters, self, parameters)


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
        self.possible = jnp.ones(logits.shape, dtype=bool) if possible is None else possible
        if not logits.shape == self.possible.shape == graph.successors.shape:
            raise InputError(f"expected the graph's shape {graph.successors.shape}", field="logits, possible")
        if not isinstance(self.possible, Tracer) and not self.possible.any(axis=-1).all():
            raise InputError("expected a possible outcome for every state and action", field="possible")

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """The softmax of the logits over the possible outcomes."""
        return jax.nn.softmax(jnp.where(self.possible, self.parameters, -jnp.inf), axis=-1)


class ObstacleGrid(TransitionModel):
    """A grid whose cells may be blocked; moves into a blocked cell stay put.

    - `parameters`: one logit a cell, θ(s), P(blocked) = σ(θ(s)); those of known cells have no effect.
    - `known`: what the map says of each cell (a `Cell` value); known cells are held at 0 or 1.

    >>> ObstacleGrid(Grid.unknown(2, 3)).blocked.shape
    (2, 3)
    """

    graph: Graph
    parameters: Float[Array, " cells"]
    known: Int[Array, "rows columns"]

    def __init__(self, grid: Grid, logits: Float[Array | np.ndarray, " cells"] | float = -2.0):
        """A model of a grid at the given logits (one number for all, or one a cell)."""
        self.graph = grid_graph(grid)
        self.known = jnp.asarray(grid.known)
        dtype = logits.dtype if isinstance(logits, (jax.Array, np.ndarray)) else jnp.result_type(float)
        self.parameters = jnp.broadcast_to(jnp.asarray(logits, dtype), (grid.size,))

    @property
    def blocked(self) -> Float[Array, "rows columns"]:
        """P(blocked), one value a cell, row 0 at the top; exactly 0 or 1 where the map knows."""
        learned = jax.nn.sigmoid(self.parameters).reshape(self.known.shape)
        return jnp.where(self.known == Cell.UNKNOWN, learned, (self.known == Cell.OCCUPIED).astype(learned.dtype))

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """(success, failure) of every move."""
        unknown = self.parameters.reshape(self.known.shape)
        known = jnp.where(self.known == Cell.OCCUPIED, jnp.inf, -jnp.inf)
        logits = jnp.where(self.known == Cell.UNKNOWN, unknown, known)
        # off the map nothing is blocked
        free = jnp.pad(jax.nn.sigmoid(-logits), 1, constant_values=1)
        blocked = jnp.pad(jax.nn.sigmoid(logits), 1)
        # without a barrier the compiler works these out anew for every move
        free, blocked = jax.lax.optimization_barrier((free, blocked))
        outcomes = [
            outcome
            for down, right in STEPS[: self.graph.actions].tolist()
            for outcome in _outcomes(free, blocked, down, right)
        ]
        return jnp.stack(outcomes, axis=-1).reshape(-1, self.graph.actions, 2)


def _outcomes(
    free: Float[Array, "padded_rows padded_columns"],
    blocked: Float[Array, "padded_rows padded_columns"],
    down: int,
    right: int,
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """The probabilities that a move from each cell succeeds, and that it fails, from those of the padded map's cells.

    Slices of the map rather than look-ups: their derivatives are slices too.
    """
    rows, columns = free.shape[0] - 2, free.shape[1] - 2

    def beside(cells: Array, i: int, j: int) -> Array:
        return cells[1 + i : 1 + i + rows, 1 + j : 1 + j + columns]

    success, failure = beside(free, down, right), beside(blocked, down, right)
    for i, j in ((down, 0), (0, right)) if down and right else ():
        # 1 − Π free, summed without cancellation where obstacles are improbable
        failure = failure + success * beside(blocked, i, j)
        success = success * beside(free, i, j)
    return success, failure


def true_model(grid: Grid) -> ObstacleGrid:
    """The deterministic model of a map that is taken at its word; what it does not know counts as blocked."""
    known = np.where(grid.known == Cell.FREE, Cell.FREE, Cell.OCCUPIED)
    return ObstacleGrid(Grid(known, grid.resolution, grid.origin, grid.connectivity))
