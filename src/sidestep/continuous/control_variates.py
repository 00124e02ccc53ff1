"""Control variates of Gaussian mixtures: what a value function explains of the noise of next states, less its mean.

A value jumps where a task ends: at the edge of a goal, a little noise decides whether more moves have to be paid for.
So the value is taken as linear around the mean of each outcome, but for its end,

    v_k(s′) = v(m_k) + ∇v(m_k)·(s′ − m_k) + r_k(s′).

r_k is 0 where the task goes on in m_k and in s′. Where it ends in s′, r_k is the reward of ending there less the linear
part; where it ends in m_k only, r_k is the value of going on, taken as linear, less the linear part. The linear part
has a known mean. That of r_k is estimated by independent draws of the noise, which keeps the mean of the control
variate at 0. Draws of one move are shared by the candidates of a start, as its other random numbers are.

References:
    Greensmith, Bartlett and Baxter, "Variance reduction techniques for gradient estimates in reinforcement learning"
    (2004). Glynn and Szechtman, "Some new perspectives on the method of control variates" (2002), for estimated means.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Scalar, Shaped

State = Shaped[Array, "*state"]
Real = Float[Scalar, ""]
Vector = Float[Array, " dimensions"]

_DRAWS = 16
"""The draws of r_k for its mean."""


def zero(state: State) -> Real:
    """Return 0, the value of any state.

    Args:
        state: The state.
    """
    return jnp.zeros((), jnp.result_type(float, state))


class ValueFunction(NamedTuple):
    """A value of a state, in units of reward, which may jump where a task ends.

    Attributes:
        going_on: The value of states where the task goes on; smooth.
        ends: Whether the task ends in a state; None for a task without an end.
        at_end: The value of states where the task ends.

    Example:
        >>> value = ValueFunction(lambda state: -state, ends=lambda state: state > 1, at_end=lambda state: 5.0)
        >>> float(value(jnp.asarray(0.5))), float(value(jnp.asarray(2.0)))
        (-0.5, 5.0)
    """

    going_on: Callable[[State], Real]
    ends: Callable[[State], Bool[Scalar, ""]] | None = None
    at_end: Callable[[State], Real] = zero

    def __call__(self, state: State) -> Real:
        """Return the value of a state.

        Args:
            state: The state.
        """
        if self.ends is None:
            return self.going_on(state)
        return jnp.where(self.ends(state), self.at_end(state), self.going_on(state))

    def times(self, factor: Real, plus: Real) -> "ValueFunction":
        """Return the value times a factor, plus a number.

        Args:
            factor: The factor.
            plus: The number, in units of reward.
        """

        def changed(function: Callable[[State], Real]) -> Callable[[State], Real]:
            return lambda state: plus + factor * function(state)

        return ValueFunction(changed(self.going_on), self.ends, changed(self.at_end))


class Mixture(NamedTuple):
    """The next states of an action: a mixture of normal distributions.

    Attributes:
        log_probabilities: ln p_k of every outcome.
        means: m_k of every outcome.
        noise: The standard deviations around them.
    """

    log_probabilities: Float[Array, " outcomes"]
    means: Float[Array, "outcomes dimensions"]
    noise: Vector

    def log_joint(self, next_state: Vector) -> Float[Array, " outcomes"]:
        """Return ln p_k + ln N(s′; m_k, diag(noise²)).

        Args:
            next_state: The next state s′.
        """
        return self.log_probabilities + norm.logpdf(next_state, self.means, self.noise).sum(axis=-1)


def transition_variate(value: ValueFunction, mixture: Mixture, next_state: Vector, key: PRNGKeyArray) -> Real:
    """Return Σ_k P(k | s′) v_k(s′) − Σ_k p_k E[v_k], with the mean of r_k by draws; its mean is 0.

    Args:
        value: The value function.
        mixture: The distribution of next states.
        next_state: The next state s′.
        key: Draws everything random.
    """
    near = _near_means(value, mixture, next_state, key)
    expected = jnp.exp(mixture.log_probabilities) @ (near.values + near.jumps.mean(axis=1))
    return jax.nn.softmax(mixture.log_joint(next_state)) @ near.of_next - expected


def score_variate(value: ValueFunction, mixture: Mixture, next_state: Vector, key: PRNGKeyArray) -> Real:
    """Return a number with the derivative Σ_k P(k | s′) ∇ ln (p_k N_k(s′)) v_k(s′) − ∇ Σ_k p_k E[v_k], of mean 0.

    N_k(s′) is the density of outcome k. The mean of r_k has the score estimate of its draws as derivative.

    Args:
        value: The value function; no derivatives pass through it.
        mixture: The distribution of next states, as a function of θ.
        next_state: The next state s′.
        key: Draws everything random.
    """
    fixed = jax.lax.stop_gradient
    near, joint = fixed(_near_means(value, fixed(mixture), next_state, key)), mixture.log_joint(next_state)
    probabilities = jnp.exp(mixture.log_probabilities)
    linear = probabilities @ near.values + jnp.sum(fixed(probabilities)[:, None] * near.slopes * mixture.means)
    densities = norm.logpdf(near.draws, mixture.means[:, None], mixture.noise).sum(axis=-1)
    densities = densities + mixture.log_probabilities[:, None]
    of_jumps = fixed(probabilities) @ (near.jumps * densities).mean(axis=1)
    return fixed(jax.nn.softmax(joint) * near.of_next) @ joint - linear - of_jumps


class _NearMeans(NamedTuple):
    """v_k of every outcome: value and slope at its mean, its value in the next state, and r_k of draws."""

    values: Float[Array, " outcomes"]
    slopes: Float[Array, "outcomes dimensions"]
    of_next: Float[Array, " outcomes"]
    draws: Float[Array, "outcomes draws dimensions"]
    jumps: Float[Array, "outcomes draws"]


def _near_means(value: ValueFunction, mixture: Mixture, next_state: Vector, key: PRNGKeyArray) -> _NearMeans:
    means, ends = mixture.means, value.ends
    if ends is None:  # r_k is 0 everywhere
        values, slopes = jax.vmap(jax.value_and_grad(value.going_on))(means)
        of_next = values + jnp.sum(slopes * (next_state - means), axis=-1)
        return _NearMeans(values, slopes, of_next, means[:, None], jnp.zeros_like(means[:, :1]))
    noise = mixture.noise * jax.random.normal(key, (len(means), _DRAWS, means.shape[1]), means.dtype)

    def of_outcome(mean: Vector, draws: Float[Array, "draws dimensions"]) -> tuple[Array, ...]:
        going_on, at_end = (jax.value_and_grad(part)(mean) for part in (value.going_on, value.at_end))
        here = jax.tree.map(partial(jnp.where, ends(mean)), at_end, going_on)

        def jump(state: Vector) -> Real:
            along = jnp.where(ends(state), value.at_end(state), going_on[0] + going_on[1] @ (state - mean))
            return along - here[0] - here[1] @ (state - mean)

        of_next = here[0] + here[1] @ (next_state - mean) + jump(next_state)
        return (*here, of_next, draws, jax.vmap(jump)(draws))

    return _NearMeans(*jax.vmap(of_outcome)(means, means[:, None] + noise))
