"""Learned numbers on the scales that people read: β, lapse and discount instead of a logarithm and logits."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._repr import short_repr
from sidestep._typing import Tree
from sidestep.errors import check_instance
from sidestep.inference.objective import Parameters


@short_repr()
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
    check_instance(parameters, Parameters, "parameters")
    own = parameters.behavior
    scales = jnp.exp, jax.nn.sigmoid, jax.nn.sigmoid, lambda weights: weights, jax.nn.softplus
    mapped = (None if part is None else scale(jnp.asarray(part)) for scale, part in zip(scales, own, strict=True))
    return NaturalScale(parameters.model, *mapped)
