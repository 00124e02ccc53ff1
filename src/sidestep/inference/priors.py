"""Priors over the parameters of a transition model.

`Normal` is the paper's, each parameter by itself. The others add to it what is known of how parameters go together:

    Smooth:  − s Σ_{i~j} (θ_i − θ_j)²                                  over pairs of neighbours
    Lines:   + s Σ_c p_c [1 − (1 − p_left p_right)(1 − p_up p_down)]   over cells, p = P(blocked)
    Stood:   + Σ_c n_c ln(1 − p_c)                                     over cells, n times seen to be stood in

The first is a Gaussian Markov random field. The second says that walls are lines: a blocked cell is more probable
between two others, in a row or in a column. So a gap one cell wide in a long wall, of which behavior says nothing, is
taken for wall. The third is evidence rather than prior knowledge, but of cells and not of moves: the likelihood of
demonstrations is that of moves, given where they begin. That somebody stood there counts as much as a move into it.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from sidestep.errors import InputError

NEAREST = 1 / 1020
"""How close to 0 or 1 a sensor's probability is taken to be at most: a quarter of a grey level of its image."""


class Prior(eqx.Module):
    """A density over parameters, up to a constant."""

    @abc.abstractmethod
    def log_density(self, parameters: PyTree[Float[Array, "..."]]) -> Float[Array, ""]:
        """The logarithm of the density of θ, in nats."""


class Normal(Prior):
    """The paper's prior θ ~ N(b, a), as its penalty: log prior(θ) = −Σ (θ − b)²/a, without the constant.

    - `mean`: b, one number for all parameters or an array that broadcasts to them (a value a cell, say).
    - `variance`: a, likewise, above 0.

    Raises `InputError` for a mean that is not finite or a variance not above 0.

    >>> float(Normal(mean=-2.0, variance=4.0).log_density(jnp.array([0.0])))
    -1.0
    """

    mean: Float[Array, "..."]
    variance: Float[Array, "..."]

    def __init__(self, mean: float | Float[Array, "..."] = -2.0, variance: float | Float[Array, "..."] = 4.0):
        self.mean = jnp.asarray(mean, jnp.result_type(float))
        self.variance = jnp.asarray(variance, jnp.result_type(float))
        if not np.isfinite(self.mean).all():
            raise InputError("expected finite numbers", field="prior mean")
        if not (np.isfinite(self.variance).all() and (np.asarray(self.variance) > 0).all()):
            raise InputError("expected numbers above 0", field="prior variance")

    def log_density(self, parameters: PyTree[Float[Array, "..."]]) -> Float[Array, ""]:
        """−Σ (θ − b)²/a over all parameters."""
        penalties = [
            jnp.sum((leaf - self.mean.astype(leaf.dtype)) ** 2 / self.variance.astype(leaf.dtype))
            for leaf in jax.tree.leaves(parameters)
        ]
        return -jnp.sum(jnp.stack(penalties))


def sensor_prior(
    probability: Float[np.ndarray, "rows columns"],
    variance: float | Float[np.ndarray, "rows columns"],
    elsewhere: Normal,
) -> Normal:
    """What a sensor's map says of each cell's logit: b = ln(p / (1 − p)), and so P(blocked) = p if nobody walks there.

    - `probability`: p of each cell, from 0 to 1; NaN where the sensor saw nothing. p closer to 0 or 1 than `NEAREST`
      counts as that close, for no finite logit is sure.
    - `variance`: a, how surely p is known: one number or one of each cell, above 0. Where it is NaN or infinite,
      nothing is known.
    - `elsewhere`: what is known of the logits of all other cells.

    Raises `InputError` for other probabilities and variances.
    """
    a = np.broadcast_to(np.asarray(variance, dtype=np.float64), probability.shape)
    if (a <= 0).any():
        raise InputError(f"expected numbers above 0, found {a[a <= 0][0]}", field="sensor variance")
    if ((probability < 0) | (probability > 1)).any():
        raise InputError("expected numbers from 0 to 1", field="sensor map")
    seen = ~np.isnan(probability) & np.isfinite(a)
    p = np.clip(np.where(seen, probability, 0.5), NEAREST, 1 - NEAREST)
    mean, spread = (jnp.broadcast_to(each, seen.size) for each in (elsewhere.mean, elsewhere.variance))
    seen, logit, a = seen.ravel(), (np.log(p) - np.log1p(-p)).ravel(), a.ravel()
    return Normal(jnp.where(seen, logit, mean), jnp.where(seen, a, spread))


class GaussianMRF(Prior):
    """A Gaussian Markov random field: parameters like those of their neighbours.

    - `each`: what is known of each parameter by itself.
    - `pairs`: which parameters are neighbours; of a grid's cells `borders(grid)`.
    - `strength`: s at least 0, in nats; neighbours differ by about 1/√(2s).
    """

    each: Normal
    pairs: Int[Array, "pairs 2"]
    strength: Float[Array, ""]

    def __init__(self, each: Normal, pairs: Int[Array | np.ndarray, "pairs 2"], strength: float):
        """Raises `InputError` for a strength below 0 or not finite."""
        self.each, self.pairs, self.strength = each, jnp.asarray(pairs), _strength(strength)

    def log_density(self, parameters: Float[Array, " parameters"]) -> Float[Array, ""]:
        """That of each, and −s Σ (θ_i − θ_j)²."""
        one, other = parameters[self.pairs].T
        return self.each.log_density(parameters) - self.strength.astype(parameters.dtype) * jnp.sum((one - other) ** 2)


class WallPrior(Prior):
    """Walls are lines: a cell between two blocked ones, in a row or in a column, is more probably blocked.

    - `each`: what is known of each cell's logit by itself.
    - `known`: what the map says of each cell, as in `ObstacleGrid`; known cells are part of lines.
    - `strength`: s at least 0, in nats: what a cell in a line is worth.
    """

    each: Normal
    known: Int[Array, "rows columns"]
    strength: Float[Array, ""]

    def __init__(self, each: Normal, known: Int[Array | np.ndarray, "rows columns"], strength: float):
        """Raises `InputError` for a strength below 0 or not finite."""
        self.each, self.known, self.strength = each, jnp.asarray(known), _strength(strength)

    def log_density(self, parameters: Float[Array, " cells"]) -> Float[Array, ""]:
        """That of each, and s Σ p [1 − (1 − p_left p_right)(1 − p_up p_down)]; off the map nothing is blocked."""
        blocked = jax.nn.sigmoid(parameters).reshape(self.known.shape)
        blocked = jnp.where(self.known == -1, blocked, (self.known == 1).astype(blocked.dtype))
        around = jnp.pad(blocked, 1)
        across = around[1:-1, :-2] * around[1:-1, 2:]
        along = around[:-2, 1:-1] * around[2:, 1:-1]
        lines = jnp.sum(blocked * (1 - (1 - across) * (1 - along)))
        return self.each.log_density(parameters) + self.strength.astype(parameters.dtype) * lines


class FreeCellEvidence(Prior):
    """Evidence that cells are free: somebody stood there, as those did whose walks begin in them.

    - `other`: what else is known of the cells' logits.
    - `times`: how often somebody was seen to stand in each cell, 0 or more; where a map knows the cell, 0.
    """

    other: Prior
    times: Float[Array, " cells"]

    def log_density(self, parameters: Float[Array, " cells"]) -> Float[Array, ""]:
        """That of the other, and Σ n ln(1 − p)."""
        free = jax.nn.log_sigmoid(-parameters)
        return self.other.log_density(parameters) + self.times.astype(free.dtype) @ free


def _strength(strength: float) -> Float[Array, ""]:
    if not (np.isfinite(strength) and strength >= 0):
        raise InputError(f"expected a finite number, at least 0, found {strength}", field="strength")
    return jnp.asarray(strength, jnp.result_type(float))
