"""Barriers: binary variables, each open or closed, by which moves succeed or stay.

A cell that may be blocked, a border between cells that may be a wall, and a link that may be closed are barriers. An
action attempts outcome k with probability w(s, a, k). The attempt succeeds if every barrier that it needs is open; an
attempt that fails stays. With o(i) the probability that barrier i lets an agent pass,

    T(s, a, s′_k) = w(s, a, k) Π_{i needed} o(i),    T(s, a, s) = 1 − Σ_k T(s, a, s′_k).

This is the structure of `ObstacleGrid`, `SlipperyGrid`, `walled_grid` and `road_network`; `barriers_of` reads it from
these models, so that binary variables can be sampled for all of them by the same code.
"""

from functools import singledispatch
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from sidestep.errors import InputError, check, describe
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.graph import moves_into
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.models.base import TransitionModel
from sidestep.tabular.models.categorical import FIXED, IMPOSSIBLE, TiedModel
from sidestep.tabular.models.obstacle_grid import ObstacleGrid
from sidestep.tabular.models.slippery_grid import DIRECTIONS, SlipperyGrid

Model = TypeVar("Model", bound=TransitionModel)

NO_BARRIER = -1
"""The entry of `Barriers.needed` for no barrier."""


class Barriers(NamedTuple):
    """The barriers of a transition model.

    Attributes:
        successors: The state s′_k that each attempt leads to; the state itself where it leads nowhere.
        attempts: w(s, a, k), each in [0, 1].
        needed: The barriers that each attempt needs, `NO_BARRIER` in unused places.
        known: The `Cell` value of each barrier: whether it is known to be open (free) or closed (occupied).
        shape: The rows and columns where barriers are the cells of a grid, one each in the order of states.

    Example:
        >>> barriers_of(ObstacleGrid(Grid.unknown(1, 2))).needed[0, 3].tolist()  # to the right of the left cell
        [[1, -1, -1]]
    """

    successors: Int[np.ndarray, "states actions attempts"]
    attempts: Float[np.ndarray, "states actions attempts"]
    needed: Int[np.ndarray, "states actions attempts barriers"]
    known: Int[np.ndarray, " barriers"]
    shape: tuple[int, int] | None = None


@singledispatch
def barriers_of(model: TransitionModel) -> Barriers:
    """Return the barriers of a transition model.

    Args:
        model: An `ObstacleGrid`, a `SlipperyGrid` (with its present slips), a `walled_grid` or a `road_network`.

    Returns:
        The barriers, in the order of the model's logits.

    Raises:
        InputError: For a model of another kind.

    Example:
        >>> from sidestep.tabular.models import walled_grid
        >>> barriers_of(walled_grid(Grid.unknown(1, 3))).known.tolist()  # two borders
        [-1, -1]
    """
    message = "expected a model of barriers: an ObstacleGrid, SlipperyGrid, walled_grid or road_network"
    raise InputError(f"{message}, found {describe(model)}", field="model")


@barriers_of.register
def _(model: ObstacleGrid) -> Barriers:
    return _barriers_of_cells(model.blank, np.asarray(model.known))


@barriers_of.register
def _(model: SlipperyGrid) -> Barriers:
    rows, columns = model.known.shape
    cells = _barriers_of_cells(
        Grid.unknown(rows, columns, 4 if model.graph.actions == 4 else 8), np.asarray(model.known)
    )
    terrain = np.asarray(model.terrain)
    slip = np.where(terrain < 0, 0.0, np.asarray(model.slip, np.float64)[np.maximum(terrain, 0)])[:, None, None]
    ways = DIRECTIONS[: model.graph.actions]
    attempts = np.concatenate([1 - slip, slip / 2, slip / 2], axis=-1) * cells.attempts[:, ways, 0]
    return cells._replace(successors=cells.successors[:, ways, 0], attempts=attempts, needed=cells.needed[:, ways, 0])


@barriers_of.register
def _(model: TiedModel) -> Barriers:
    index, successors = np.asarray(model.index), np.asarray(model.graph.successors)
    states = np.arange(len(index))[:, None]
    check(not np.asarray(model.fixed).any(), "expected fixed logits of 0, found others", field="model")
    message = "expected outcomes of a `walled_grid` or `road_network`, a move and staying, found others"
    check(index.shape[-1] == 2 and (successors[..., 1] == states).all(), message, field="model")
    move, stay = index[..., 0], index[..., 1]
    passable = (move == FIXED) & (stay != FIXED)
    check((passable | ((move == IMPOSSIBLE) & (stay == FIXED))).all(), message, field="model")
    needed = np.where(passable & (stay >= 0), stay, NO_BARRIER)[..., None, None]
    attempts = passable.astype(np.float64)[..., None]
    known = np.full(model.parameters.shape, Cell.UNKNOWN)
    return Barriers(np.where(passable, successors[..., 0], states)[..., None], attempts, needed, known)


def _barriers_of_cells(blank: Grid, known: Int[np.ndarray, "rows columns"]) -> Barriers:
    cells, states = moves_into(blank), np.arange(blank.size)[:, None]
    inside = cells[..., 0] < blank.size
    successors = np.where(inside, cells[..., 0], states)[..., None]
    needed = np.where((cells < blank.size) & inside[..., None], cells, NO_BARRIER)[:, :, None]
    return Barriers(successors, inside.astype(np.float64)[..., None], needed, known.ravel(), known.shape)


def with_closed(model: Model, closed: Float[np.ndarray, " barriers"]) -> Model:
    """Return a model with other probabilities that its barriers are closed.

    Args:
        model: As for `barriers_of`.
        closed: P(closed) of each barrier, in (0, 1).

    Returns:
        The same model with the logits of these probabilities; its other parameters stay.
    """
    logits = np.log(closed) - np.log1p(-closed)
    parameters = np.array(model.parameters)
    parameters[: len(logits)] = logits
    return model.with_parameters(to_jax(parameters))
