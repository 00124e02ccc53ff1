"""Priors over the parameters of a transition model."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from sidestep.errors import InputError


class Normal(eqx.Module):
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
