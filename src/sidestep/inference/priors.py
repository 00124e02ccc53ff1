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
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Shaped

from sidestep._arguments import to_finite, to_floats, to_integers
from sidestep._repr import short_repr
from sidestep._typing import FloatTree, Tree
from sidestep.errors import InputError, check, check_instance, to_number
from sidestep.tabular.arrays import to_jax

Numbers = float | Float[Array | np.ndarray, "..."] | Sequence[float]
MIN_PROBABILITY = 1 / 1020
"""The least distance of a sensor's probability from 0 and 1: a quarter of a gray level of an 8-bit image."""


def _as_floats(numbers: Shaped[ArrayLike, "..."]) -> Float[Array, "..."]:
    return to_jax(np.asarray(numbers), jnp.result_type(float))


def _checked_strength(strength: float) -> Float[Array, ""]:
    return _as_floats(to_number(strength, "strength", least=0))


def _checked_pairs(pairs: Int[Array | np.ndarray, "pairs 2"] | Sequence[Sequence[int]]) -> Int[Array, "pairs 2"]:
    return to_jax(to_integers(pairs, "pairs", ("pairs", 2), least=0))


def _checked_known(known: Int[Array | np.ndarray, "rows columns"]) -> Int[Array, "rows columns"]:
    return to_jax(to_integers(known, "known", ("rows", "columns"), least=-1, most=1, what="cells"))


def _checked_counts(counts: Float[Array | np.ndarray, " cells"] | Sequence[float]) -> Float[Array, " cells"]:
    return to_jax(to_finite(counts, "counts", ("cells",), least=0))


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

    def scale(self, parameters: FloatTree) -> Tree:
        """Return the unit in which each parameter is optimized: 1, or less where the prior is tighter.

        Args:
            parameters: θ.

        Returns:
            Numbers in (0, 1], shaped as the parameters.
        """
        return jax.tree.map(lambda leaf: np.ones_like(np.asarray(leaf)), parameters)

    def check_parameters(self, parameters: FloatTree) -> None:
        """Raise `InputError` unless this is a density over parameters of such shapes.

        Args:
            parameters: The parameters of a model.
        """
        try:
            shape = jax.eval_shape(self.log_density, parameters).shape
        except (TypeError, ValueError, IndexError) as error:
            shapes = [np.shape(leaf) for leaf in jax.tree.leaves(parameters)]
            message = f"expected a density over the model's parameters, of shapes {shapes}, found another ({error})"
            raise InputError(message, field="prior") from error
        check(shape == (), f"expected a density that is one number, found shape {shape}", field="prior")


class Normal(Prior):
    """Independent normal parameters: log p(θ) = −Σ (θ − b)²/(2σ²), without the constant.

    The paper writes the penalty −Σ (θ − b)²/a; its a is twice the variance.

    Attributes:
        mean: b, one number for all parameters or an array that broadcasts to them.
        variance: σ², likewise, above 0.

    Raises:
        InputError: For a mean that is not finite, or a variance that is not finite and above 0; and where its density
            is needed, for numbers that do not broadcast to the parameters.

    Example:
        >>> float(Normal(mean=-2.0, variance=2.0).log_density(jnp.array([0.0])))
        -1.0
    """

    mean: Float[Array, "..."]
    variance: Float[Array, "..."]

    def __init__(self, mean: Numbers = -2.0, variance: Numbers = 2.0):
        self.mean = _as_floats(to_finite(mean, "prior mean"))
        self.variance = _as_floats(to_finite(variance, "prior variance", above=0))

    def check_parameters(self, parameters: FloatTree) -> None:
        """Raise `InputError` unless mean and variance broadcast to the shape of all parameters.

        Args:
            parameters: The parameters of a model.
        """
        for leaf in jax.tree.leaves(parameters):
            shape = np.shape(leaf)
            for field, own in (("prior mean", self.mean.shape), ("prior variance", self.variance.shape)):
                pairs = zip(reversed(own), reversed(shape), strict=False)
                fits = len(own) <= len(shape) and all(size in (1, axis) for size, axis in pairs)
                message = f"expected one number, or numbers that broadcast to parameters of shape {shape}"
                check(fits, f"{message}, found shape {own}", field=field)

    def log_density(self, parameters: FloatTree) -> Float[Array, ""]:
        """Return −Σ (θ − b)²/(2σ²) over all parameters."""
        self.check_parameters(parameters)
        penalties = [
            jnp.sum((leaf - self.mean.astype(leaf.dtype)) ** 2 / (2 * self.variance.astype(leaf.dtype)))
            for leaf in jax.tree.leaves(parameters)
        ]
        return -jnp.sum(jnp.stack(penalties))

    def scale(self, parameters: FloatTree) -> Tree:
        """Return the standard deviation where it is below 1."""
        self.check_parameters(parameters)
        deviation = np.minimum(np.sqrt(np.asarray(self.variance, np.float64)), 1.0)
        return jax.tree.map(lambda leaf: np.broadcast_to(deviation, np.shape(leaf)).astype(leaf.dtype), parameters)


def sensor_arrays(
    probability: Float[np.ndarray, "rows columns"] | Sequence[Sequence[float]],
    variance: float | Float[np.ndarray, "rows columns"] | Sequence[Sequence[float]],
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Return what a sensor saw as arrays: the probability and the variance of each cell.

    Args:
        probability: As for `sensor_prior`.
        variance: As for `sensor_prior`.

    Raises:
        InputError: For other shapes, probabilities outside [0, 1] and variances that are not above 0.
    """
    cells = np.asarray(to_floats(probability, "sensor map", ("rows", "columns")))
    variances = np.broadcast_to(to_floats(variance, "sensor variance", (), cells.shape), cells.shape)
    least = np.nanmin(variances, initial=np.inf)
    check(least > 0, f"expected numbers above 0, found {least}", field="sensor variance")
    to_finite(cells[~np.isnan(cells)], "sensor map", least=0, most=1)
    return cells, variances


def sensor_prior(
    probability: Float[np.ndarray, "rows columns"] | Sequence[Sequence[float]],
    variance: float | Float[np.ndarray, "rows columns"] | Sequence[Sequence[float]],
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
    check_instance(unobserved, Normal, "unobserved")
    cells, variances = sensor_arrays(probability, variance)
    observed = ~np.isnan(cells) & np.isfinite(variances)
    p = np.clip(np.where(observed, cells, 0.5), MIN_PROBABILITY, 1 - MIN_PROBABILITY)
    for each in (unobserved.mean, unobserved.variance):
        message = f"expected one number, or one for each of {p.size} cells, found shape {each.shape}"
        check(each.shape in ((), (p.size,)), message, field="unobserved")
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
    pairs: Int[Array, "pairs 2"] = eqx.field(converter=_checked_pairs)
    strength: Float[Array, ""] = eqx.field(converter=_checked_strength)

    def __check_init__(self) -> None:
        check_instance(self.independent, Normal, "independent")

    def check_parameters(self, parameters: FloatTree) -> None:
        """Raise `InputError` for parameters that are no vector, or too short for the pairs.

        Args:
            parameters: The parameters of a model.
        """
        shape, last = getattr(parameters, "shape", None), int(np.asarray(self.pairs).max(initial=-1))
        message = f"expected pairs of the model's parameters, of shape {shape}, found a pair with {last}"
        check(shape is not None and len(shape) == 1 and last < shape[0], message, field="prior")
        self.independent.check_parameters(parameters)

    def scale(self, parameters: Float[Array, "..."]) -> Tree:
        """Return the unit of `independent`."""
        return self.independent.scale(parameters)

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
    known: Int[Array, "rows columns"] = eqx.field(converter=_checked_known)
    strength: Float[Array, ""] = eqx.field(converter=_checked_strength)

    def __check_init__(self) -> None:
        check_instance(self.independent, Normal, "independent")

    def scale(self, parameters: Float[Array, "..."]) -> Tree:
        """Return the unit of `independent`."""
        return self.independent.scale(parameters)

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
    counts: Float[Array, " cells"] = eqx.field(converter=_checked_counts)

    def __check_init__(self) -> None:
        check_instance(self.prior, Prior, "prior")

    def scale(self, parameters: Float[Array, "..."]) -> Tree:
        """Return the unit of `prior`."""
        return self.prior.scale(parameters)

    def log_density(self, parameters: Float[Array, " cells"]) -> Float[Array, ""]:
        """Return the prior's log density + Σ n ln(1 − p)."""
        log_free = jax.nn.log_sigmoid(-parameters)
        return self.prior.log_density(parameters) + self.counts.astype(log_free.dtype) @ log_free
