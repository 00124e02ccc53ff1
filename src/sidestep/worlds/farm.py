"""A farm: terrain is entered only with the right machine, and machines are swapped where they stand.

After a later work of the paper's first author. A state is a cell and the machine that is driven. A move into terrain
that the machine cannot enter stays in place; the machine for each terrain is learned. On entering a cell where a
machine stands, an agent drives that one from there on.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import sidestep as ss
from sidestep._arguments import to_floats, to_integers
from sidestep.errors import check, check_instance
from sidestep.tabular.graph import straight_moves

_CERTAIN_LOGIT = 12.0


class Farm(NamedTuple):
    """A map of terrain and machines. State `machines * cell + machine` is driving that machine in that cell.

    Attributes:
        terrain: 0 for ground that every machine enters, 1…n for terrain.
        machine: The machine that stands in each cell, 0…m−1, or −1 for none.
    """

    terrain: Int[np.ndarray, "rows columns"]
    machine: Int[np.ndarray, "rows columns"]

    @property
    def machines(self) -> int:
        """The number of machines."""
        return int(self.machine.max()) + 1

    def model(self, logits: Float[Array | np.ndarray, "terrains machines"] | float = 0.0) -> ss.TiedModel:
        """Return the model in which terrain t stops machine m with probability σ(logits[t − 1, m]).

        Args:
            logits: A logit for each terrain and machine, or one for all.

        Raises:
            InputError: For maps of different shapes, or without terrain or machines.
        """
        check_instance(self.terrain, np.ndarray, "terrain")
        check_instance(self.machine, np.ndarray, "machine")
        shape = to_integers(self.terrain, "terrain", ("rows", "columns"), least=0, what="terrains").shape
        to_integers(self.machine, "machine", shape, least=-1, what="machines")
        count, terrains = self.machines, int(self.terrain.max())
        message = f"expected terrain above 0 and machines from 0, found {terrains} and {count}"
        check(terrains >= 1 and count >= 1, message, field="terrain")
        to_floats(logits, "logits", (), (terrains, count))
        cells, driven = np.divmod(np.arange(count * self.terrain.size), count)
        target = straight_moves(ss.Grid.unknown(*self.terrain.shape))[cells]
        moves = target != cells[:, None]
        terrain, standing = self.terrain.ravel()[target], self.machine.ravel()[target]
        after = count * target + np.where(moves & (standing >= 0), standing, driven[:, None])
        staying = np.broadcast_to(np.arange(len(cells))[:, None], after.shape)
        stopped = np.where(moves & (terrain > 0), count * (terrain - 1) + driven[:, None], ss.IMPOSSIBLE)
        index = np.stack([np.full_like(stopped, ss.FIXED), stopped], axis=-1)
        flat = jnp.broadcast_to(jnp.asarray(logits, jnp.result_type(float)), (terrains, count)).ravel()
        return ss.TiedModel(ss.graph(np.stack([after, staying], axis=-1)), index, flat)

    def known_model(self, enters: Bool[np.ndarray, "terrains machines"]) -> ss.TiedModel:
        """Return the model of an agent that knows which machine enters which terrain.

        Args:
            enters: Whether each machine enters each terrain.
        """
        return self.model(np.where(enters, -_CERTAIN_LOGIT, _CERTAIN_LOGIT))

    def stop_probabilities(self, model: ss.TiedModel) -> Float[Array, "terrains machines"]:
        """Return the probability that each terrain stops each machine, under a model from `model`.

        Args:
            model: A model from `model`.
        """
        return jax.nn.sigmoid(model.parameters).reshape(-1, self.machines)
