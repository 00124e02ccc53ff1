"""The gap between a policy and its own Q estimates, without what noise adds to it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep.continuous.dynamics import PerCandidate, PerSample
from sidestep.tabular.backups import Behavior, HardMax


def policy_gaps(
    behavior: Behavior, advantages: PerCandidate, q: PerSample, probabilities: PerCandidate
) -> Float[Array, " starts"]:
    """Return the gap between a policy and its own Q estimates, for each start.

    For soft agents it is the divergence of π_λ from exp βQ̂ in nats, for optimal ones the gain of the best action in
    units of reward. Two independent halves of the samples give the noise of Q̂, which is subtracted.

    Args:
        behavior: The agent's backup and β.
        advantages: q_λ of every candidate, in nats.
        q: Q̂_0 of every sample, in units of reward.
        probabilities: Those of the candidates, which add up to 1 for each start.

    Returns:
        A number for each start, in nats or units of reward.
    """
    half = q.shape[-1] // 2
    halves = q[..., :half].mean(axis=-1), q[..., -half:].mean(axis=-1)
    if isinstance(behavior.backup, HardMax):
        best = jnp.take_along_axis(halves[1], halves[0].argmax(axis=1)[:, None], axis=1)[:, 0]
        return best - jnp.sum(probabilities * halves[1], axis=1)

    # with d = q_λ − βQ̂ the divergence is E d + ln E exp(−d)
    difference = advantages - behavior.beta * (halves[0] + halves[1]) / 2
    divergence = jnp.sum(probabilities * difference, axis=1)
    divergence = divergence + jax.nn.logsumexp(-difference, axis=1, b=probabilities)
    # noise in Q̂ adds half its variance under π
    noise = behavior.beta * (halves[0] - halves[1]) / 2
    noise = noise - jnp.sum(probabilities * noise, axis=1, keepdims=True)
    return divergence - 0.5 * jnp.sum(probabilities * noise**2, axis=1)
