"""A world with gravity: it pulls in one of four directions, forbids moves against it, and colored cells turn it.

After a later work of the paper's first author. A state is a cell and the direction of gravity. A move against gravity,
or off the map, stays in place. Entering a colored cell turns gravity to the direction of the color. This rule is
learned. It is the same all over the map, so that one color's effect in one place is evidence
for all places.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import sidestep as ss
from sidestep._arguments import to_floats, to_integers
from sidestep.errors import check, check_instance
from sidestep.tabular.graph import straight_moves

DIRECTIONS = ("up", "down", "left", "right")
_OPPOSITE = np.array([1, 0, 3, 2])
"""The move that each direction of gravity forbids."""
_CERTAIN_LOGIT = 12.0


class Gravity(NamedTuple):
    """A colored map. State `4 * cell + gravity` is that cell with gravity in one of `DIRECTIONS`.

    Attributes:
        colors: 0 where gravity stays the same, and 1…n for the colors.
    """

    colors: Int[np.ndarray, "rows columns"]

    def model(self, logits: Float[Array | np.ndarray, "colors 4"] | float = 0.0) -> ss.TiedModel:
        """Return the model in which color c turns gravity to direction g with the softmax of `logits[c - 1]`.

        Args:
            logits: A logit for each color and direction, or one for all.

        Raises:
            InputError: For a map without colors.
        """
        check_instance(self.colors, np.ndarray, "colors")
        to_integers(self.colors, "colors", ("rows", "columns"), least=0, what="colors")
        count = int(np.max(self.colors, initial=0))
        check(count > 0, "expected colors 0…n, and one above 0, found none", field="colors")
        to_floats(logits, "logits", (), (count, 4))
        cells, gravity = np.divmod(np.arange(4 * self.colors.size), 4)
        target = straight_moves(ss.Grid.unknown(*self.colors.shape))[cells]
        moved = (target != cells[:, None]) & (np.arange(4) != _OPPOSITE[gravity][:, None])
        target = np.where(moved, target, cells[:, None])
        color = np.where(moved, self.colors.ravel()[target], 0)[..., None]
        turned = np.where(color > 0, np.arange(4), gravity[:, None, None])
        index = np.where(color > 0, 4 * (color - 1) + np.arange(4), ss.IMPOSSIBLE)
        index[..., 0] = np.where(color[..., 0] > 0, index[..., 0], ss.FIXED)
        flat = jnp.broadcast_to(jnp.asarray(logits, jnp.result_type(float)), (count, 4)).ravel()
        return ss.TiedModel(ss.graph(4 * target[..., None] + turned), index, flat)

    def known_model(self, rule: Int[np.ndarray, " colors"]) -> ss.TiedModel:
        """Return the model of an agent that knows that color c turns gravity to direction `rule[c - 1]`.

        Args:
            rule: The index of the direction of each color.
        """
        return self.model(_CERTAIN_LOGIT * np.eye(4)[np.asarray(rule)])


def most_probable_rule(model: ss.TiedModel) -> Int[np.ndarray, " colors"]:
    """Return the most probable direction of each color, under a model from `Gravity.model`.

    Args:
        model: A model from `model`.

    Returns:
        The index of the direction of each color.
    """
    return np.asarray(model.parameters).reshape(-1, 4).argmax(axis=1)
