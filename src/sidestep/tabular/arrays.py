"""NumPy arrays as JAX arrays, without a compilation, and whether arrays are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Shaped


def is_traced(*trees: Any) -> bool:
    """Return whether JAX is tracing any array of some trees, so that its numbers are not known.

    Args:
        trees: Of arrays and other things.
    """
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def to_jax(array: Shaped[ArrayLike, "..."], dtype: type | np.dtype | None = None) -> Shaped[Array, "..."]:
    """Return a NumPy array as a JAX array; unlike `jnp.asarray`, this compiles nothing, whatever the shape.

    Args:
        array: Anything that NumPy makes an array of, or a JAX array; do not change it afterwards, memory may be shared.
        dtype: The type of its numbers, by default that of `array` (32-bit unless `jax_enable_x64` is set).
    """
    if isinstance(array, jax.Array):
        return jnp.asarray(array, dtype)
    return jax.device_put(np.asarray(array, dtype))
