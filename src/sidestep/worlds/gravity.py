"""A world with gravity: one direction of four pulls, nobody moves against it, and coloured cells turn it.

After a later work of the paper's first author: a state is a cell and the direction in which gravity pulls. A move
against gravity, or off the map, stays put. Who enters a coloured cell meets gravity turned to the direction that the
colour stands for; by which rule, is what there is to learn. The rule is the same all over the map, so one colour's
effect in one place tells of all places.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.errors import InputError
from sidestep.tabular.graph import graph, straight_moves
from sidestep.tabular.grid import Grid
from sidestep.tabular.models import FIXED, IMPOSSIBLE, TiedModel

DIRECTIONS = ("up", "down", "left", "right")
_AGAINST = np.array([1, 0, 3, 2])
"""The move that each direction of gravity forbids."""
_SURE = 12.0


class Gravity(NamedTuple):
    """A coloured map. State `4 * cell + gravity` is being in that cell while gravity pulls in one of `DIRECTIONS`.

    - `colours`: 0 where gravity stays as it is, and 1…n for the colours.
    """

    colours: Int[np.ndarray, "rows columns"]

    def model(self, logits: Float[Array | np.ndarray, "colours 4"] | float = 0.0) -> TiedModel:
        """The model at the given logits: colour c turns gravity to direction g with the softmax of `logits[c - 1]`.

        Raises `InputError` for a map without colours.
        """
        count = int(self.colours.max())
        if self.colours.min() < 0 or count == 0:
            raise InputError("expected colours 0…n, and one above 0", field="colours")
        cells, gravity = np.divmod(np.arange(4 * self.colours.size), 4)
        target = straight_moves(Grid.unknown(*self.colours.shape))[cells]
        moved = (target != cells[:, None]) & (np.arange(4) != _AGAINST[gravity][:, None])
        target = np.where(moved, target, cells[:, None])
        colour = np.where(moved, self.colours.ravel()[target], 0)[..., None]
        turned = np.where(colour > 0, np.arange(4), gravity[:, None, None])
        index = np.where(colour > 0, 4 * (colour - 1) + np.arange(4), IMPOSSIBLE)
        index[..., 0] = np.where(colour[..., 0] > 0, index[..., 0], FIXED)
        flat = jnp.broadcast_to(jnp.asarray(logits, jnp.result_type(float)), (count, 4)).ravel()
        return TiedModel(graph(4 * target[..., None] + turned), index, flat)

    def ruled(self, rule: Int[np.ndarray, " colours"]) -> TiedModel:
        """The model of people who know that colour c turns gravity to direction `rule[c - 1]`."""
        return self.model(_SURE * np.eye(4)[np.asarray(rule)])


def rule_of(model: TiedModel) -> Int[np.ndarray, " colours"]:
    """The direction that each colour most probably stands for, under a model from `Gravity.model`."""
    return np.asarray(model.parameters).reshape(-1, 4).argmax(axis=1)
