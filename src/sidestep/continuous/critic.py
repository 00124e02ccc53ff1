"""Critics: estimates of the value of a state, which reduce the variance of rollouts and add no bias.

V_w(x, l) is a network fitted to the returns-to-go W_i of earlier rollouts; l = 1 − i/τ is the fraction of the horizon
that is left, because little can follow when little is left. It only serves as a baseline or control variate
(Greensmith, Bartlett and Baxter 2004): every term made from it has mean 0.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from sidestep.continuous.policies import Examples, Features, ScaledNetwork, scaled_network

PerExample = Float[Array, " examples"]


class Critic(eqx.Module):
    """A value estimate V_w(x, l) = center + spread · network(x, l)."""

    network: ScaledNetwork
    center: Float[Array, ""]
    spread: Float[Array, ""]

    def __call__(self, x: Features, left: Float[Scalar, ""]) -> Float[Scalar, ""]:
        """Return the estimate."""
        center, spread = jax.lax.stop_gradient((self.center, self.spread))
        return center + spread * self.network(jnp.append(x, left))[0]


def make_critic(
    key: PRNGKeyArray, examples: Examples, left: PerExample, returns: PerExample, *, width: int = 64, depth: int = 2
) -> Critic:
    """Return a critic that begins at the mean of observed returns-to-go.

    Args:
        key: draws the initial weights.
        examples: the features of states.
        left: the fraction of the horizon that was left there, in [0, 1].
        returns: the returns-to-go from there, in units of reward.
        width: units in each hidden layer.
        depth: hidden layers.

    Example:
        >>> critic = make_critic(jax.random.key(0), jnp.eye(2), jnp.ones(2), jnp.array([1.0, 3.0]))
        >>> float(critic.center), float(critic.spread)
        (2.0, 1.0)
    """
    network, spread = scaled_network(key, jnp.column_stack([examples, left]), 1, width, depth), returns.std()
    return Critic(network, returns.mean(), jnp.where(spread > 0, spread, 1.0))
