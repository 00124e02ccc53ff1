"""The mean-field approximation of the posterior of barriers.

Barriers are taken as independent, q(z) = Π_i Bernoulli(σ(θ_i)), and θ maximizes

    log L(σ(θ)) + E_q[log p(z)] + H(q),                H(q) = Σ_i H(σ(θ_i)),

with L the likelihood of a model with these probabilities as its dynamics. With E_q[log L(z)] instead this would be
variational inference (Jordan et al. 1999); L at the means is what `sidestep.fit` computes with one solve a task. Both
sums over q are exact, because every shape term is a product of different barriers. So the approximation is a prior:
`fit(..., prior=MeanField(prior, known))` finds θ, and its P(closed) is σ(θ).

Strong shape terms have several optima, and where one of several barriers explains a detour, one is chosen or all are
half closed. `sample_barriers` has neither fault. `coordinate_ascent` has the difference of log L between closed and
open instead of its slope, and is nearer the posterior; this module is for sizes and agents that it does not take.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._arguments import to_integers
from sidestep.errors import check, check_instance
from sidestep.inference.mrf import BinaryMRF, expected_shapes
from sidestep.inference.priors import Prior
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.grid import Cell


class MeanField(Prior):
    """E_q[log p(z)] + H(q) of a binary Markov random field, as a log density of the logits of an obstacle grid.

    Attributes:
        field: η of each barrier (see `BinaryMRF`).
        weights: Those of lines, pairs, blocks and isolated cells.
        known: The state of each cell as in `Grid.known`, or of each barrier; known ones are part of the shapes.

    Example:
        >>> from sidestep.inference.mrf import BinaryMRF
        >>> prior = MeanField(BinaryMRF(np.zeros(3), (1, 3)), np.array([[-1, 0, 1]]))
        >>> round(float(prior.log_density(jnp.zeros(3))), 3)  # the entropy of one cell, ln 2
        0.693
    """

    field: Float[Array, " barriers"]
    weights: Float[Array, " 4"]
    known: Int[Array, "*shape"]

    def __init__(self, prior: BinaryMRF, known: Int[Array | np.ndarray, "*shape"]):
        """Raise `InputError` for another prior, and barriers that are not its own."""
        check_instance(prior, BinaryMRF, "prior")
        cells = to_integers(known, "known", least=-1, most=1, what="barriers")
        shape = prior.field.shape if prior.shape is None else prior.shape
        fits = cells.shape == shape or (prior.shape is None and cells.size == len(prior.field))
        check(fits, f"expected barriers of shape {shape}, found shape {cells.shape}", field="known")
        self.field, self.weights = (
            to_jax(prior.field, jnp.result_type(float)),
            to_jax(prior.weights, jnp.result_type(float)),
        )
        self.known = to_jax(cells)

    def log_density(self, parameters: Float[Array, " parameters"]) -> Float[Array, ""]:
        """Return E_q[log p(z)] + H(q) in nats, over unknown barriers and the shapes that they are part of."""
        logits = parameters[: self.known.size]
        unknown = self.known.reshape(-1) == Cell.UNKNOWN
        closed = jnp.where(
            unknown, jax.nn.sigmoid(logits), (self.known.reshape(-1) == Cell.OCCUPIED).astype(logits.dtype)
        )
        # H = ln(1 + exp θ) − θ σ(θ)
        entropy = jax.nn.softplus(logits) - logits * jax.nn.sigmoid(logits)
        independent = jnp.sum(jnp.where(unknown, self.field.astype(logits.dtype) * closed + entropy, 0.0))
        if self.known.ndim != 2:
            return independent
        shapes = jnp.stack(expected_shapes(jnp.pad(closed.reshape(self.known.shape), 1)))
        return independent + self.weights.astype(logits.dtype) @ shapes
