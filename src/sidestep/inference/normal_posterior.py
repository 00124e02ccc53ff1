"""A normal distribution around the mode of a posterior: standard errors, intervals, samples.

Parameters are unconstrained (ln β, the logit of a lapse), where posteriors are closer to a normal distribution than on
the natural scale. So intervals are computed there, and their ends mapped.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arguments import to_floats, to_key
from sidestep._repr import short_repr
from sidestep.errors import check_count, check_function, to_number
from sidestep.inference.natural_scale import NaturalScale, natural_scale
from sidestep.inference.objective import Parameters
from sidestep.tabular.arrays import to_jax

if TYPE_CHECKING:
    from arviz import InferenceData

    from sidestep.inference.fit import Fit
    from sidestep.inference.pointwise import Unit
    from sidestep.tabular.demonstration_tables import Labels


@short_repr("parameters", "standard_errors", "neglected", "distance", "simulated")
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
    distance: float = 0.0
    simulated: float = 0.0

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Return the covariance of all parameters; it has the square of their number of entries."""
        inner = np.eye(len(self.scale)) + (self.vectors * (1 / self.eigenvalues - 1)) @ self.vectors.T
        return self.scale[:, None] * inner * self.scale

    def covariance_products(self, vectors: Float[np.ndarray, "n parameters"]) -> Float[np.ndarray, "n parameters"]:
        """Return the products of the covariance with vectors.

        Args:
            vectors: One a row.
        """
        scaled = to_floats(vectors, "vectors", ("n", len(self.scale))) * self.scale
        return self.scale * (scaled + (scaled @ self.vectors * (1 / self.eigenvalues - 1)) @ self.vectors.T)

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
        check_function(function, "function")
        flat, unravel = ravel_pytree(self.parameters)
        # compiled as a whole: the many small steps of a derivative take longer one by one
        jacobian = np.asarray(jax.jit(jax.jacrev(lambda x: function(unravel(x))))(flat), np.float64) * self.scale
        inner = np.sum(jacobian**2, axis=-1) + (jacobian @ self.vectors) ** 2 @ (1 / self.eigenvalues - 1)
        return to_jax(np.sqrt(inner), jnp.result_type(float))

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
        to_number(level, "level", above=0, below=1)
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
        white = np.asarray(jax.random.normal(to_key(key), (n, len(self.scale))), np.float64)
        inner = white + (white @ self.vectors * (1 / np.sqrt(self.eigenvalues) - 1)) @ self.vectors.T
        flat, unravel = ravel_pytree(self.parameters)
        return jax.vmap(unravel)(flat + jnp.asarray(inner * self.scale, flat.dtype))

    def to_arviz(
        self,
        key: PRNGKeyArray,
        n: int = 1_000,
        *,
        fit: "Fit[Any] | None" = None,
        unit: "Unit" = "walk",
        labels: "Labels | None" = None,
    ) -> "InferenceData":
        """Return samples as ArviZ's `InferenceData`, on their natural scales; needs `sidestep[samplers]`.

        β has the dimension `person`, costs of states have `state`, and reward weights `feature`.

        Args:
            key: Of the random numbers.
            n: The number of samples, at least 1.
            fit: The fit of a transition model that the approximation belongs to, for a group `log_likelihood`, which
                `arviz.loo` and `arviz.waic` need.
            unit: What that group has an entry for, and `loo` leaves out: "walk" or "move".
            labels: The names of persons and states, as coordinates; numbers by default.

        Raises:
            InputError: Where ArviZ is not installed, for n below 1, for another fit, and for another number of labels.
            NotConverged: If the values of a sample do not converge.
        """
        from sidestep.inference.arviz_data import inference_data
        from sidestep.inference.pointwise import pointwise_log_likelihood

        samples = jax.tree.map(lambda leaf: leaf[None], self.sample(key, n))
        pointwise = None if fit is None else pointwise_log_likelihood(fit, samples)
        return inference_data(natural_scale(samples), None, pointwise, unit, labels)

    def _tree(self, vector: Float[np.ndarray, " parameters"]) -> Parameters:
        flat, unravel = ravel_pytree(self.parameters)
        return unravel(jnp.asarray(vector, flat.dtype))
