"""Critics: a guess of what a state is worth, which makes estimates less noisy and never biased.

V_w(x, l) is a network that follows the worth W_i of what was to come from the states of earlier roll-outs; l = 1 − i/τ
is the share of the roll-out that is left, for what is to come is little where little is left. It only ever serves as a
control variate: it is subtracted where what is subtracted averages to nothing.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from sidestep.continuous.policies import Features, Scaled, scaled_network


class Critic(eqx.Module):
    """V_w(x, l) = centre + spread · network(x, l)."""

    network: Scaled
    centre: Float[Array, ""]
    spread: Float[Array, ""]

    def __call__(self, x: Features, left: Float[Scalar, ""]) -> Float[Scalar, ""]:
        """The guess."""
        centre, spread = jax.lax.stop_gradient((self.centre, self.spread))
        return centre + spread * self.network(jnp.append(x, left))[0]


def critic(
    key: PRNGKeyArray,
    examples: Float[Array, "examples features"],
    left: Float[Array, " examples"],
    worths: Float[Array, " examples"],
    *,
    width: int = 64,
    depth: int = 2,
) -> Critic:
    """A critic that begins at the mean of `worths`, what states with these features and so much left were worth."""
    spread = worths.std()
    return Critic(
        scaled_network(key, jnp.column_stack([examples, left]), 1, width, depth),
        worths.mean(),
        jnp.where(spread > 0, spread, 1.0),
    )
