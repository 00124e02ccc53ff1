"""Slippery grids: moves slip sideways, and cells may be blocked.

A move in a cell of terrain t goes ahead with probability 1 − p_t and slips at a right angle with p_t = σ(φ_t), to
either side equally often. In each direction, the move then succeeds or stays as in the obstacle grid. With
f(s, d) = Π_{c needed} (1 − σ(θ(c))), the probability that direction d is free, and l, r the directions beside a,

    T_θ(s, a, s + a) = (1 − p) f(s, a),    T_θ(s, a, s + l) = (p/2) f(s, l),    T_θ(s, a, s + r) = (p/2) f(s, r),

and s itself takes the rest. Cells of one terrain share the slip, so observations in one place inform all others.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._arguments import to_integers, to_logits
from sidestep.errors import check, check_instance, describe
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph, grid_successors
from sidestep.tabular.grid import STEPS, Grid
from sidestep.tabular.models.base import TransitionModel
from sidestep.tabular.models.categorical import Logits, logit_array
from sidestep.tabular.models.obstacle_grid import blocked_of, chances_of_moves

DIRECTIONS = np.array([[STEPS.tolist().index(way) for way in ([i, j], [j, -i], [-j, i])] for i, j in STEPS.tolist()])
"""Each direction, and the two at right angles to it."""


class SlipperyGrid(TransitionModel):
    """A grid with cells that may be blocked, and on which moves slip sideways, by the terrain.

    Attributes:
        graph: Outcomes are going ahead, to one side, to the other side, and staying.
        parameters: The logits θ of the cells, then the logits φ of the slips, one for each terrain.
        terrain: Of each cell, 0…n − 1; −1 where moves do not slip.
        known: As in `ObstacleGrid`.

    Example:
        >>> SlipperyGrid(Grid.unknown(2, 3), slip=0.0).slip.tolist()
        [0.5]
    """

    graph: Graph
    parameters: Float[Array, " logits"]
    terrain: Int[Array, " cells"]
    known: Int[Array, "rows columns"]

    def __init__(
        self,
        grid: Grid,
        logits: Logits = -2.0,
        slip: Logits = -2.0,
        terrain: Int[np.ndarray, "rows columns"] | Sequence[Sequence[int]] | None = None,
    ):
        """Make a model with logits of cells and of slips: one number for all, or one for each cell or terrain.

        By default the terrain is the same everywhere.

        Raises:
            InputError: For terrain of another shape than the grid, below −1, or with a gap in its numbers.
        """
        check_instance(grid, Grid, "grid")
        chosen = np.zeros(grid.shape, dtype=np.int64) if terrain is None else terrain
        of_cells = to_integers(chosen, "terrain", grid.shape, least=-1, what="terrains")
        kinds = np.unique(of_cells[of_cells >= 0])
        message = f"expected all the kinds 0…n−1, and −1 where moves do not slip, found {describe(kinds.tolist())}"
        check(len(kinds) and kinds[-1] == len(kinds) - 1, message, field="terrain")
        entered, staying = np.split(grid_successors(grid), [1], axis=-1)
        successors = np.concatenate([entered[:, DIRECTIONS[: grid.connectivity], 0], staying], axis=-1)
        self.graph = Graph(to_jax(successors, np.int32), to_jax(grid.lengths[None]))
        self.known, self.terrain = to_jax(grid.known), to_jax(of_cells.ravel(), np.int32)
        cells = logit_array(to_logits(logits, grid.size), (grid.size,))
        slips = logit_array(to_logits(slip, len(kinds), "slip"), (len(kinds),))
        self.parameters = jnp.concatenate([cells, slips.astype(cells.dtype)])

    @property
    def blocked(self) -> Float[Array, "rows columns"]:
        """Return P(blocked), as in `ObstacleGrid`."""
        return blocked_of(self.parameters[: self.known.size], self.known)

    @property
    def slip(self) -> Float[Array, " terrains"]:
        """Return P(slip) of each terrain, to both sides together."""
        return jax.nn.sigmoid(self.parameters[self.known.size :])

    def probabilities(self) -> Float[Array, "states actions 4"]:
        """Return the probabilities of going ahead, to one side, to the other, and of staying."""
        cells, slips = jnp.split(self.parameters, [self.known.size])
        slip = jnp.where(self.terrain < 0, -jnp.inf, slips[self.terrain])
        ahead, aside = jax.nn.sigmoid(-slip), jax.nn.sigmoid(slip) / 2
        directions = jnp.stack([ahead, aside, aside], axis=-1)[:, None, :, None]
        of_moves = chances_of_moves(cells, self.known, self.graph.actions)
        outcomes = directions * of_moves[:, DIRECTIONS[: self.graph.actions]]
        return jnp.concatenate([outcomes[..., 0], outcomes[..., 1].sum(axis=-1, keepdims=True)], axis=-1)
