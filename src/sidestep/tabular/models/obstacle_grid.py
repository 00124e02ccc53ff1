"""Grids on which cells, or the borders between them, may be blocked.

The **obstacle grid** has one logit θ(s) for each cell, P(blocked at s) = σ(θ(s)). A move succeeds if every cell that
it needs is free, and otherwise stays (the paper's experiments):

    T_θ(s, a, s′) = Π_{c needed} (1 − σ(θ(c))),    T_θ(s, a, s) = 1 − T_θ(s, a, s′).

In a **featured grid** the logits are a function of features of each cell, θ(s) = f_w(features(s)), and its weights w
are learned. In a **walled grid** it is the border between two cells that may be closed, P(closed) = σ(θ(border)).
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._arguments import to_finite, to_logits
from sidestep._programs import keep_program
from sidestep._typing import FloatTree
from sidestep.errors import check, check_function, check_instance
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import Graph, grid_graph, grid_successors
from sidestep.tabular.grid import STEPS, Cell, Grid
from sidestep.tabular.models.base import TransitionModel
from sidestep.tabular.models.categorical import FIXED, IMPOSSIBLE, TiedModel, logit_array

Network = Callable[[Float[Array, " features"]], Float[Array, ""]]
"""The logit of a cell, as a function of its features."""


class ObstacleGrid(TransitionModel):
    """A grid with cells that may be blocked; moves into a blocked cell stay.

    Attributes:
        graph: Outcomes are the cell moved into, and staying.
        parameters: The logit θ(s) of each cell, P(blocked) = σ(θ(s)); those of known cells have no effect.
        known: The `Cell` value of each cell on the map; known cells have P(blocked) 0 or 1.

    Example:
        >>> ObstacleGrid(Grid.unknown(2, 3)).blocked.shape
        (2, 3)
    """

    graph: Graph
    parameters: Float[Array, " cells"]
    known: Int[Array, "rows columns"]

    def __init__(self, grid: Grid, logits: Float[Array | np.ndarray, " cells"] | Sequence[float] | float = -2.0):
        """Make a model of a grid with logits: one number for all, or one for each cell.

        Raises:
            InputError: For anything but a grid and such numbers.
        """
        check_instance(grid, Grid, "grid")
        self.graph = grid_graph(grid)
        self.known = to_jax(grid.known)
        self.parameters = logit_array(to_logits(logits, grid.size), (grid.size,))

    @property
    def blocked(self) -> Float[Array, "rows columns"]:
        """Return P(blocked) of each cell, row 0 at the top; exactly 0 or 1 for known cells."""
        return blocked_of(self.parameters, self.known)

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """Return the probabilities that each move succeeds, and that it fails."""
        return chances_of_moves(self.parameters, self.known, self.graph.actions)

    @property
    def blank(self) -> Grid:
        """Return the grid, with nothing known of its cells."""
        rows, columns = self.known.shape
        return Grid.unknown(rows, columns, 4 if self.graph.actions == 4 else 8)


class FeaturedGrid(TransitionModel):
    """A grid with cells that are blocked with a probability that is a function of their features.

    Features may be a floor type, a color in an image of the site or a sensor's reading. What is learned of one cell
    holds for all with the same features.

    Attributes:
        graph: Outcomes are the cell moved into, and staying.
        parameters: w, the floating-point arrays of a network.
        network: The rest of the network.
        features: Of each cell, in the order of states.
        known: As in `ObstacleGrid`.

    Example:
        >>> import equinox as eqx
        >>> network = eqx.nn.Linear(2, "scalar", key=jax.random.key(0))
        >>> FeaturedGrid(Grid.unknown(2, 3), jnp.ones((6, 2)), network).blocked.shape
        (2, 3)
    """

    graph: Graph
    parameters: FloatTree
    network: Network
    features: Float[Array, "cells features"]
    known: Int[Array, "rows columns"]

    def __init__(self, grid: Grid, features: Float[Array | np.ndarray, "cells features"], network: Network):
        """Make a model from a network (an Equinox module) that maps the features of a cell to its logit.

        Raises:
            InputError: For features that are not finite or not those of every cell, and for a network without
                parameters or with another output.
        """
        check_instance(grid, Grid, "grid")
        check_function(network, "network")
        features = to_jax(to_finite(features, "features", (grid.size, "features")))
        self.graph, self.known, self.features = grid_graph(grid), to_jax(grid.known), features
        self.parameters, self.network = eqx.partition(network, eqx.is_inexact_array)
        check(jax.tree.leaves(self.parameters), "expected parameters to learn, found none", field="network")
        shape = jax.eval_shape(network, features[0]).shape
        check(shape == (), f"expected one number for each cell, found shape {shape}", field="network")

    @property
    def logits(self) -> Float[Array, " cells"]:
        """Return f_w of every cell."""
        return jax.vmap(eqx.combine(self.parameters, self.network))(self.features)

    @property
    def blocked(self) -> Float[Array, "rows columns"]:
        """P(blocked), as in `ObstacleGrid`."""
        return blocked_of(self.logits, self.known)

    def probabilities(self) -> Float[Array, "states actions outcomes"]:
        """Return the probabilities that each move succeeds, and that it fails."""
        return chances_of_moves(self.logits, self.known, self.graph.actions)


def borders(grid: Grid) -> Int[np.ndarray, "borders 2"]:
    """Return the two cells beside every border inside a grid: borders between columns, then between rows.

    Args:
        grid: The cells.

    Returns:
        The two states of each border, the left or upper one first.

    Example:
        >>> borders(Grid.unknown(1, 3)).tolist()
        [[0, 1], [1, 2]]
    """
    check_instance(grid, Grid, "grid")
    cells = np.arange(grid.size).reshape(grid.shape)
    sides = (cells[:, :-1], cells[:, 1:]), (cells[:-1], cells[1:])
    return np.concatenate([np.stack([one.ravel(), other.ravel()], axis=1) for one, other in sides])


def walled_grid(
    grid: Grid, logits: Float[Array | np.ndarray, " borders"] | Sequence[float] | float = -2.0
) -> TiedModel:
    """Return a model of a grid in which the borders between cells may be closed, P(closed) = σ(θ).

    A border is the same from both sides. Known obstacles stay blocked.

    Args:
        grid: 4-connected.
        logits: θ, one number for all, or one for each border in the order of `borders(grid)`.

    Returns:
        The model, with one logit for each border.

    Raises:
        InputError: For 8-connected grids, because a diagonal crosses no border, and for anything but such logits.

    Example:
        >>> walled_grid(Grid.unknown(1, 3)).parameters.shape
        (2,)
    """
    check_instance(grid, Grid, "grid")
    message = f"expected 4, found {grid.connectivity}: a diagonal crosses no border"
    check(grid.connectivity == 4, message, field="connectivity")
    graph, between = grid_graph(grid), borders(grid)
    number = {(int(a), int(b)): index for index, pair in enumerate(between) for a, b in (pair, pair[::-1])}
    index = np.full(graph.successors.shape, IMPOSSIBLE)
    for state, targets in enumerate(grid_successors(grid)[..., 0]):
        for action, target in enumerate(targets):
            if target == state or grid.known.flat[target] == Cell.OCCUPIED:
                index[state, action, 1] = FIXED
            else:
                index[state, action] = FIXED, number[state, int(target)]
    return TiedModel(graph, index, logit_array(to_logits(logits, len(between)), (len(between),)))


@keep_program
def blocked_of(logits: Float[Array, " cells"], known: Int[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """Return P(blocked), exactly 0 or 1 for known cells.

    Args:
        logits: θ of each cell.
        known: The `Cell` value of each cell.
    """
    learned = jax.nn.sigmoid(logits).reshape(known.shape)
    return jnp.where(known == Cell.UNKNOWN, learned, (known == Cell.OCCUPIED).astype(learned.dtype))


@keep_program
def chances_of_moves(
    logits: Float[Array, " cells"], known: Int[Array, "rows columns"], actions: int
) -> Float[Array, "states actions outcomes"]:
    """Return the probabilities that each move succeeds, and that it fails, from the logits of the cells.

    Args:
        logits: θ of each cell.
        known: The `Cell` value of each cell.
        actions: 4, or 8 with diagonals.
    """
    certain = jnp.where(known == Cell.OCCUPIED, jnp.inf, -jnp.inf)
    logits = jnp.where(known == Cell.UNKNOWN, logits.reshape(known.shape), certain)
    # off the map nothing is blocked
    free = jnp.pad(jax.nn.sigmoid(-logits), 1, constant_values=1)
    blocked = jnp.pad(jax.nn.sigmoid(logits), 1)
    # without a barrier the compiler computes these again for every move
    free, blocked = jax.lax.optimization_barrier((free, blocked))
    outcomes = [_outcomes(free, blocked, down, right) for down, right in STEPS[:actions].tolist()]
    return jnp.stack([chance for chances in outcomes for chance in chances], axis=-1).reshape(-1, actions, 2)


def _outcomes(free: Array, blocked: Array, down: int, right: int) -> tuple[Array, Array]:
    """Return the probabilities that a move from each cell succeeds, and that it fails, from those of the padded map.

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
    """Return the deterministic model of a map; unknown cells count as blocked.

    Args:
        grid: The map.

    Returns:
        The model, with P(blocked) 0 or 1 everywhere.

    Example:
        >>> true_model(Grid(np.array([[0, 1]]))).blocked.tolist()
        [[0.0, 1.0]]
    """
    check_instance(grid, Grid, "grid")
    known = np.where(grid.known == Cell.FREE, Cell.FREE, Cell.OCCUPIED)
    return ObstacleGrid(Grid(known, grid.resolution, grid.origin, grid.connectivity))
