"""Prior densities over the parameters of a transition model.

`Normal` is the paper's prior, with independent parameters. The others add a term to it:

    GaussianMRF:      − s Σ_{i~j} (θ_i − θ_j)²                                  over pairs of neighbors
    WallPrior:        + s Σ_c p_c [1 − (1 − p_left p_right)(1 − p_up p_down)]   over cells, p = P(blocked)
    FreeCellEvidence: + Σ_c n_c ln(1 − p_c)                                     over cells, occupied n times by an agent

`GaussianMRF` is a Gaussian Markov random field (Rue & Held 2005). `WallPrior` makes a cell between two blocked cells of
its row or column more probably blocked, so a gap one cell wide in a long wall counts as wall where behavior does not
test it. `FreeCellEvidence` is a likelihood: that of demonstrations is conditional on the states where they begin, and
an agent in a cell is as much evidence that the cell is free as a move into it.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._repr import short_repr
from sidestep._typing import FloatTree
from sidestep.errors import check, check_not_negative

Numbers = float | Float[Array | np.ndarray, "..."]
MIN_PROBABILITY = 1 / 1020
"""The least distance of a sensor's probability from 0 and 1: a quarter of a gray level of an 8-bit image."""


def _as_floats(numbers: Numbers) -> Float[Array, "..."]:
    # `jnp.asarray` would compile a function for each shape
    return jax.device_put(np.asarray(numbers, jnp.result_type(float)))


def _checked_strength(strength: float) -> Float[Array, ""]:
    check_not_negative(strength, "strength")
    return _as_floats(strength)


@short_repr()
class Prior(eqx.Module):
    """A density over parameters, up to a constant.

    To add a prior, subclass it and write `log_density` in JAX.

    Example:
        >>> isinstance(Normal(), Prior)
        True
    """

    @abc.abstractmethod
    def log_density(self, parameters: FloatTree) -> Float[Array, ""]:
        """Return the logarithm of the density of θ.

        Args:
            parameters: θ, the parameters of the transition model.

        Returns:
            log p(θ) in nats, up to a constant.
        """


class Normal(Prior):
    """Independent normal parameters: log p(θ) = −Σ (θ − b)²/(2σ²), without the constant.

    The paper writes the penalty −Σ (θ − b)²/a; its a is twice the variance.

    Attributes:
        mean: b, one number for all parameters or an array that broadcasts to them.
        variance: σ², likewise, above 0.

    Raises:
        InputError: For a mean that is not finite, or a variance that is not finite and above 0.

    Example:
        >>> float(Normal(mean=-2.0, variance=2.0).log_density(jnp.array([0.0])))
        -1.0
    """

    mean: Float[Array, "..."]
    variance: Float[Array, "..."]

    def __init__(self, mean: Numbers = -2.0, variance: Numbers = 2.0):
        self.mean, self.variance = _as_floats(mean), _as_floats(variance)
        check(np.isfinite(self.mean).all(), "expected finite numbers", field="prior mean")
        positive = np.isfinite(self.variance) & (np.asarray(self.variance) > 0)
        check(positive.all(), "expected numbers above 0", field="prior variance")

    def log_density(self, parameters: FloatTree) -> Float[Array, ""]:
        """Return −Σ (θ − b)²/(2σ²) over all parameters."""
        penalties = [
            jnp.sum((leaf - self.mean.astype(leaf.dtype)) ** 2 / (2 * self.variance.astype(leaf.dtype)))
            for leaf in jax.tree.leaves(parameters)
        ]
        return -jnp.sum(jnp.stack(penalties))


def sensor_prior(
    probability: Float[np.ndarray, "rows columns"],
    variance: float | Float[np.ndarray, "rows columns"],
    unobserved: Normal,
) -> Normal:
    """Return the prior of the cells' logits after a sensor: the mean of an observed cell is ln(p / (1 − p)).

    Args:
        probability: p = P(blocked) of each cell, from 0 to 1; NaN for a cell that the sensor did not observe. It is
            clipped to [`MIN_PROBABILITY`, 1 − `MIN_PROBABILITY`].
        variance: The variance of the logit, above 0: one number or one per cell; NaN or infinite for unobserved cells.
        unobserved: The prior of the logits of unobserved cells.

    Returns:
        A prior with one mean and one variance per cell.

    Raises:
        InputError: For probabilities outside [0, 1] or variances that are not above 0.

    Example:
        >>> sensor_prior(np.array([[0.5, np.nan]]), 1.0, Normal(-2.0, 4.0)).mean.tolist()
        [0.0, -2.0]
    """
    variances = np.broadcast_to(np.asarray(variance, dtype=np.float64), probability.shape)
    least = np.nanmin(variances, initial=np.inf)
    check(least > 0, f"expected numbers above 0, found {least}", field="sensor variance")
    check(not ((probability < 0) | (probability > 1)).any(), "expected numbers from 0 to 1", field="sensor map")
    observed = ~np.isnan(probability) & np.isfinite(variances)
    p = np.clip(np.where(observed, probability, 0.5), MIN_PROBABILITY, 1 - MIN_PROBABILITY)
    mean, spread = (np.broadcast_to(each, p.size) for each in (unobserved.mean, unobserved.variance))
    observed, logit = observed.ravel(), (np.log(p) - np.log1p(-p)).ravel()
    return Normal(np.where(observed, logit, mean), np.where(observed, variances.ravel(), spread))


class GaussianMRF(Prior):
    """A Gaussian Markov random field: neighboring parameters are similar.

    Attributes:
        independent: The prior of each parameter without its neighbors.
        pairs: The indices of neighboring parameters; `borders(grid)` for the cells of a grid.
        strength: s, in nats, at least 0; neighbors differ by about 1/√(2s).

    Raises:
        InputError: For a strength below 0 or not finite.

    Example:
        >>> prior = GaussianMRF(Normal(0.0, 1.0), np.array([[0, 1]]), strength=2.0)
        >>> float(prior.log_density(jnp.array([0.0, 1.0])))
        -2.5
    """

    independent: Normal
    pairs: Int[Array, "pairs 2"] = eqx.field(converter=jnp.asarray)
    strength: Float[Array, ""] = eqx.field(converter=_checked_strength)

    def log_density(self, parameters: Float[Array, " parameters"]) -> Float[Array, ""]:
        """Return the independent prior's log density − s Σ (θ_i − θ_j)²."""
        one, other = parameters[self.pairs].T
        penalty = self.strength.astype(parameters.dtype) * jnp.sum((one - other) ** 2)
        return self.independent.log_density(parameters) - penalty


class WallPrior(Prior):
    """Walls are lines: a cell between two blocked cells of its row or column is more probably blocked.

    Attributes:
        independent: The prior of each cell's logit without its neighbors.
        known: The state of each cell as in `Grid.known`; known cells are part of lines.
        strength: s, in nats, at least 0: the gain of one blocked cell in a line.

    Raises:
        InputError: For a strength below 0 or not finite.

    Example:
        >>> prior = WallPrior(Normal(0.0, 1.0), np.array([[1, -1, 1]]), strength=1.0)  # between two walls
        >>> float(prior.log_density(jnp.zeros(3)))
        0.5
    """

    independent: Normal
    known: Int[Array, "rows columns"] = eqx.field(converter=jnp.asarray)
    strength: Float[Array, ""] = eqx.field(converter=_checked_strength)

    def log_density(self, parameters: Float[Array, " cells"]) -> Float[Array, ""]:
        """Return the independent prior's log density + s Σ p [1 − (1 − p_left p_right)(1 − p_up p_down)].

        Cells outside the map count as free.
        """
        blocked = jax.nn.sigmoid(parameters).reshape(self.known.shape)
        blocked = jnp.where(self.known == -1, blocked, (self.known == 1).astype(blocked.dtype))
        padded = jnp.pad(blocked, 1)
        in_row = padded[1:-1, :-2] * padded[1:-1, 2:]
        in_column = padded[:-2, 1:-1] * padded[2:, 1:-1]
        in_lines = jnp.sum(blocked * (1 - (1 - in_row) * (1 - in_column)))
        return self.independent.log_density(parameters) + self.strength.astype(parameters.dtype) * in_lines


class FreeCellEvidence(Prior):
    """Evidence that cells are free: an agent was observed in them, at the start of a trajectory for example.

    Attributes:
        prior: The prior without this evidence.
        counts: The number of observations of an agent in each cell, 0 or more; 0 for known cells.

    Example:
        >>> prior = FreeCellEvidence(Normal(0.0, 1.0), jnp.array([1.0, 0.0]))
        >>> round(float(prior.log_density(jnp.zeros(2))), 3)  # ln(1/2)
        -0.693
    """

    prior: Prior
    counts: Float[Array, " cells"]

    def log_density(self, parameters: Float[Array, " cells"]) -> Float[Array, ""]:
        """Return the prior's log density + Σ n ln(1 − p)."""
        log_free = jax.nn.log_sigmoid(-parameters)
        return self.prior.log_density(parameters) + self.counts.astype(log_free.dtype) @ log_free
