"""Laplace's approximation of a posterior: a normal distribution around its mode, and the standard errors that it gives.

    θ ~ N(θ̂, H⁻¹),        H = −∇² [log L(θ) + log p(θ)] at θ̂

H, the observed information, is exact (`information`). Where few parameters are learned it is computed as a whole. Where
many are, with D the prior's information of each parameter (the row sums of its Hessian),

    D^−½ H D^−½ = 1 + Σ_j λ_j v_j v_jᵀ

has few λ that differ from 0, because walks say little of most of a large map; the largest ones are computed by Lanczos
iterations (ARPACK), and the others left out. This is the low-rank approximation of Bui-Thanh, Ghattas, Martin and
Stadler (2013), in all but that D need not be the whole of the prior.

Parameters are unconstrained (ln β, the logit of a lapse), where posteriors are closer to a normal distribution than on
the natural scale. So intervals are computed there, and their ends mapped.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._typing import Tree
from sidestep.errors import InputError, NotConverged, SidestepError, check, check_count
from sidestep.inference.fit import Estimate, Fit
from sidestep.inference.information import Information
from sidestep.inference.objective import Parameters

if TYPE_CHECKING:
    from arviz import InferenceData

_FARTHEST = 0.1
"""The most standard errors that a fit may end from the maximum."""
_BOUND = 1e-6
"""The least distance of a learned lapse or discount from 0 and 1."""
_NAMED = 3
"""The number of parameters that an error message names."""
_SMALL = 200_000
"""The most parameters × states × tasks up to which a summary has standard errors: they take about a second."""


class NaturalScale(NamedTuple):
    """All that is learned, on the scales that people read; None for what is known.

    Attributes:
        model: The parameters of the transition model as they are: logits, mostly.
        beta: β of each person, or of all.
        lapse, discount: ε and γ.
        reward_weights: w of each feature.
        costs: The cost of aiming at each state, in units of reward.

    Example:
        >>> NaturalScale(model=0.5, beta=np.array([5.0])).beta.tolist()
        [5.0]
    """

    model: Tree
    beta: Float[Array | np.ndarray, "*draws persons"] | None = None
    lapse: Float[Array | np.ndarray, "*draws"] | None = None
    discount: Float[Array | np.ndarray, "*draws"] | None = None
    reward_weights: Float[Array | np.ndarray, "*draws features"] | None = None
    costs: Float[Array | np.ndarray, "*draws states"] | None = None


def natural_scale(parameters: Parameters) -> NaturalScale:
    """Return parameters on their natural scales; each is an increasing function of one parameter.

    Args:
        parameters: As a fit learns them, with any leading axes.
    """
    own = parameters.behavior
    scales = jnp.exp, jax.nn.sigmoid, jax.nn.sigmoid, lambda weights: weights, jax.nn.softplus
    mapped = (None if part is None else scale(jnp.asarray(part)) for scale, part in zip(scales, own, strict=True))
    return NaturalScale(parameters.model, *mapped)


@dataclass(frozen=True, eq=False)
class Laplace:
    """A normal approximation of the posterior of what a fit has learned; made by `laplace`.

    Its covariance is S (1 + V (M⁻¹ − 1) Vᵀ) S, with S a diagonal matrix, V orthonormal and M diagonal.

    Attributes:
        parameters: The mode θ̂; a vector of parameters has the entries of `ravel_pytree(parameters)`.
        scale: The diagonal of S, the standard deviations before the vectors count.
        vectors: V, in its columns.
        eigenvalues: M: the information in the direction of each vector, in units of `scale`.
        neglected: A bound of |λ| of what is left out; 0 where the information is complete. A variance is wrong by at
            most this fraction of it.
    """

    parameters: Parameters
    scale: Float[np.ndarray, " parameters"]
    vectors: Float[np.ndarray, "parameters vectors"]
    eigenvalues: Float[np.ndarray, " vectors"]
    neglected: float

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Return the covariance of all parameters; it has the square of their number of entries."""
        inner = np.eye(len(self.scale)) + (self.vectors * (1 / self.eigenvalues - 1)) @ self.vectors.T
        return self.scale[:, None] * inner * self.scale

    @property
    def standard_errors(self) -> Parameters:
        """Return the standard error of each parameter, unconstrained: of ln β, the logits of lapse and discount."""
        inner = 1 + self.vectors**2 @ (1 / self.eigenvalues - 1)
        return self._tree(self.scale * np.sqrt(inner))

    @property
    def natural_errors(self) -> NaturalScale:
        """Return the standard error of each number on its natural scale, by the delta method."""
        return jax.jvp(natural_scale, (self.parameters,), (self.standard_errors,))[1]

    def error_of(self, function: Callable[[Parameters], Float[Array, "*shape"]]) -> Float[Array, "*shape"]:
        """Return the standard error of a function of the parameters, by the delta method.

        Args:
            function: Differentiable by JAX, such as the slip of a model with these parameters.
        """
        flat, unravel = ravel_pytree(self.parameters)
        jacobian = np.asarray(jax.jacrev(lambda x: function(unravel(x)))(flat), np.float64) * self.scale
        inner = np.sum(jacobian**2, axis=-1) + (jacobian @ self.vectors) ** 2 @ (1 / self.eigenvalues - 1)
        return jnp.sqrt(jnp.asarray(inner))

    def interval(self, level: float = 0.95) -> tuple[NaturalScale, NaturalScale]:
        """Return the ends of an interval for each number, mapped from the unconstrained scale.

        So β is above 0, and a lapse between 0 and 1.

        Args:
            level: The probability of each interval, above 0 and below 1.

        Returns:
            The lower and the upper ends.

        Raises:
            InputError: For another level.
        """
        check(0 < level < 1, f"expected a probability above 0 and below 1, found {level}", field="level")
        width = float(jax.scipy.special.ndtri((1 + level) / 2))
        errors = self.standard_errors
        lower, upper = (
            natural_scale(jax.tree.map(lambda mode, error, by=by: mode + by * error, self.parameters, errors))
            for by in (-width, width)
        )
        return lower, upper

    def sample(self, key: PRNGKeyArray, n: int) -> Parameters:
        """Return samples from the normal distribution; `natural_scale` maps them to their natural scales.

        Args:
            key: Of the random numbers.
            n: The number of samples, at least 1.

        Returns:
            The parameters, each with a leading axis of samples.

        Raises:
            InputError: For n below 1.
        """
        check_count(n, 1, "n")
        white = np.asarray(jax.random.normal(key, (n, len(self.scale))), np.float64)
        inner = white + (white @ self.vectors * (1 / np.sqrt(self.eigenvalues) - 1)) @ self.vectors.T
        flat, unravel = ravel_pytree(self.parameters)
        return jax.vmap(unravel)(flat + jnp.asarray(inner * self.scale, flat.dtype))

    def to_arviz(self, key: PRNGKeyArray, n: int = 1_000) -> "InferenceData":
        """Return samples as ArviZ's `InferenceData`, on their natural scales; needs `sidestep[samplers]`.

        Args:
            key: Of the random numbers.
            n: The number of samples, at least 1.

        Raises:
            InputError: Where ArviZ is not installed, and for n below 1.
        """
        from sidestep.inference.arviz_data import inference_data

        return inference_data(natural_scale(jax.tree.map(lambda leaf: leaf[None], self.sample(key, n))))

    def _tree(self, vector: Float[np.ndarray, " parameters"]) -> Parameters:
        flat, unravel = ravel_pytree(self.parameters)
        return unravel(jnp.asarray(vector, flat.dtype))


def laplace(fit: Fit[Any], *, dense: int = 500, rank: int = 200) -> Laplace:
    """Return Laplace's approximation of the posterior of what a fit has learned.

    Args:
        fit: The fit; it must have converged, with the exact gradient.
        dense: The number of parameters up to which the information is computed as a whole.
        rank: With more of them, the number of directions in which demonstrations count.

    Returns:
        The normal distribution, with standard errors, intervals and samples.

    Raises:
        InputError: For a fit with values that did not converge, that ended before the maximum, at a bound, or where
            the posterior does not determine some direction; the message names the parameters.
        NotConverged: If the iterations for many parameters do not converge.

    Example:
        >>> import sidestep as ss
        >>> grid = ss.Grid.unknown(rows=1, columns=3)
        >>> shown = ss.gather([ss.Trajectory(np.array([0, 1, 2]), np.array([3, 3]), task=0)], [ss.reach(grid, 2)])
        >>> learned = ss.fit(ss.ObstacleGrid(grid, 0.0), shown, ss.Behavior(ss.HardMax()), terms=("transitions",))
        >>> [round(float(error), 2) for error in laplace(learned).standard_errors.model]  # √2 where no one went
        [1.41, 1.3, 1.3]

    References:
        Tierney and Kadane, "Accurate approximations for posterior moments and marginal densities" (1986). Bui-Thanh,
        Ghattas, Martin and Stadler, "A computational framework for infinite-dimensional Bayesian inverse problems"
        (2013), for the low rank.
    """
    check_count(rank, 1, "rank")
    parameters = Parameters(fit.model.parameters, fit.behavior.parameters)
    _check_bounds(parameters)
    converged = bool(np.asarray(fit.task_converged).all())
    check(converged, f"expected values that converged: {fit.message}", source="laplace", field="fit")
    information = Information(fit.problem, parameters)
    finite = np.isfinite(information.gradient).all()
    check(finite, "expected a finite gradient at the learned parameters", source="laplace", field="fit")
    parts = _whole(information) if information.size <= dense else _low_rank(information, rank)
    result = Laplace(parameters, *parts)
    _check_determined(result)
    _check_maximum(fit, result, information.gradient)
    return result


def behavior_estimates(fit: Fit[Any]) -> dict[str, Estimate]:
    """Return β (of a typical person), lapse and discount where they were learned, with standard errors.

    Args:
        fit: The fit.

    Returns:
        The estimates by name. They have no error where the problem is not small, by the product of its parameters,
        states and tasks, and where the posterior has no normal approximation.
    """
    parameters = Parameters(fit.model.parameters, fit.behavior.parameters)
    numbers, count = _typical(parameters), sum(leaf.size for leaf in jax.tree.leaves(parameters))
    errors: list[float | None] = [None] * len(numbers)
    if numbers and count * fit.problem.demonstrations.tasks.terminal.size <= _SMALL:
        with suppress(SidestepError):
            normal = laplace(fit, dense=count)
            errors = normal.error_of(lambda point: jnp.stack([*_typical(point).values()])).tolist()
    return {name: Estimate(float(numbers[name]), error) for name, error in zip(numbers, errors, strict=True)}


def _typical(parameters: Parameters) -> dict[str, Array]:
    """Return the learned numbers of a typical person's behavior."""
    own, numbers = parameters.behavior, {}
    if own.log_beta is not None:
        numbers["beta"] = jnp.exp(own.log_beta.mean())
    if own.logit_lapse is not None:
        numbers["lapse"] = jax.nn.sigmoid(own.logit_lapse)
    if own.logit_discount is not None:
        numbers["discount"] = jax.nn.sigmoid(own.logit_discount)
    return numbers


def _whole(information: Information) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return scale, vectors, eigenvalues and nothing neglected, of the whole information."""
    matrix = information.dense()
    diagonal = np.diag(matrix)
    message = f"expected finite second derivatives, found {np.count_nonzero(~np.isfinite(matrix))} that are not"
    check(np.isfinite(matrix).all(), message, source="laplace", field="fit")
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    return scale, vectors, eigenvalues, 0.0


def _low_rank(information: Information, rank: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return scale, vectors, eigenvalues and what is neglected, of the largest parts beside the prior."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    size = information.size
    rows = information.of_prior(np.ones((1, size)))[0]
    message = "expected a prior that says something of each parameter, where there are many"
    check((rows > 0).any() and np.isfinite(rows).all(), message, source="laplace", field="prior")
    scale = 1 / np.sqrt(np.where(rows > 0, rows, np.median(rows[rows > 0])))

    def beside_prior(vector: np.ndarray) -> np.ndarray:
        vector = vector.ravel()
        return scale * information.products((scale * vector)[None])[0] - vector

    operator = LinearOperator((size, size), matvec=beside_prior, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    start = np.random.default_rng(0).normal(size=size)
    try:
        largest, vectors = eigsh(operator, min(rank, size - 1), which="LM", v0=start)
    except ArpackNoConvergence as error:
        raise NotConverged(
            f"the information's eigenvalues did not converge: a smaller rank may help ({error})"
        ) from error
    return scale, vectors, 1 + largest, float(np.abs(largest).min())


def _check_bounds(parameters: Parameters) -> None:
    own = parameters.behavior
    for name, logit in (("lapse", own.logit_lapse), ("discount", own.logit_discount)):
        at = 0.5 if logit is None else float(jax.nn.sigmoid(logit))
        message = f"expected one between its bounds, found {at:.3g}: there is no normal approximation there"
        check(_BOUND < at < 1 - _BOUND, message, source="laplace", field=name)


def _check_determined(result: Laplace) -> None:
    """Raise unless the information is positive definite, up to the rounding of its products."""
    flat, _ = ravel_pytree(result.parameters)
    worst = int(result.eigenvalues.argmin())
    if result.eigenvalues[worst] > np.sqrt(jnp.finfo(flat.dtype).eps):
        return
    direction = result.vectors[:, worst] * result.scale
    largest = np.argsort(-np.abs(direction))[:_NAMED]
    weights = direction[largest] / np.abs(direction).max()
    named = zip(weights, _names(result.parameters, largest), strict=True)
    of_them = " ".join(f"{weight:+.2g} {name}" for weight, name in named)
    raise InputError(
        f"the demonstrations and the prior do not determine the direction {of_them} (information "
        f"{result.eigenvalues[worst]:.2g} of its scale): expected more demonstrations or a narrower prior",
        source="laplace",
    )


def _check_maximum(fit: Fit[Any], result: Laplace, gradient: np.ndarray) -> None:
    """Raise if a Newton step from the end of the fit is long, in standard errors."""
    scaled = result.scale * gradient
    inside = result.vectors.T @ scaled
    squared = scaled @ scaled + inside**2 @ (1 / result.eigenvalues - 1)
    distance = float(np.sqrt(max(squared, 0.0)))
    message = (
        f"expected a fit that ends at its maximum, found one that ends {distance:.2g} standard errors from it "
        f"({fit.message})"
    )
    check(distance <= _FARTHEST, message, source="laplace", field="fit")


def _names(parameters: Parameters, indices: np.ndarray) -> list[str]:
    """Return names of entries of the vector of parameters."""
    leaves, names = jax.tree_util.tree_flatten_with_path(parameters)[0], []
    ends = np.cumsum([leaf.size for _, leaf in leaves])
    for index in indices:
        which = int(np.searchsorted(ends, index, side="right"))
        path, leaf = leaves[which]
        at = np.unravel_index(int(index - ends[which] + leaf.size), leaf.shape)
        names.append(jax.tree_util.keystr(path).removeprefix(".") + (str([*map(int, at)]) if leaf.ndim else ""))
    return names
