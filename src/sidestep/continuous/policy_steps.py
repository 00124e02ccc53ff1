"""A step of a policy along its gradient (eq. 12 of the paper), and steps of its critic; `planner` has the theory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Shaped

from sidestep._typing import Tree
from sidestep.continuous.dynamics import PerCandidate, Real
from sidestep.continuous.policies import Critic, Policy
from sidestep.continuous.rollouts import Rollout, q_estimates, returns_to_go


def policy_gradient(policy: Policy, critic: Critic, rollouts: Rollout, probabilities: PerCandidate) -> Tree:
    """Return the mean of eq. 12 over −β, with the sign of a loss: the policy improves against it.

    Args:
        policy: π_λ.
        critic: V_w.
        rollouts: With axes (starts, candidates, samples).
        probabilities: Those of the candidates; a sum with them is a mean over the policy's first choices.

    Returns:
        The gradient, shaped as the policy.

    References:
        Eq. 12 of the paper, with the differences that the docstring of `planner` lists.
    """
    beyond = q_estimates(rollouts) - rollouts.action_baselines(critic)
    # all candidates of the first move were tried, whatever their probability
    first = jnp.broadcast_to((probabilities * probabilities.shape[1])[..., None, None], beyond[..., :1].shape)
    counts = jnp.concatenate([first, jnp.ones_like(beyond[..., 1:])], axis=-1)
    powers = rollouts.discount_powers(beyond.shape[-1])
    credit = jax.lax.stop_gradient(jnp.where(rollouts.acting, counts * powers * beyond, 0.0))

    def loss(policy: Policy) -> Array:
        return -jnp.sum(credit * rollouts.policy_log_probs(policy)) / credit[..., 0].size

    return eqx.filter_grad(loss)(policy)


def fit_critic(
    critic: Critic,
    optimizer: optax.GradientTransformation,
    moments: Tree,
    rollouts: Rollout,
    steps: int,
    fraction: Real | float = 1.0,
) -> tuple[Critic, Tree]:
    """Regress a critic on returns-to-go, one step of the optimizer for each of `steps` minibatches.

    First moves are left out, because their choices were not drawn from the policy. With a horizon of 1 no moves are
    left, and the critic stays the same.

    Args:
        critic: V_w.
        optimizer: The optimizer.
        moments: Its state.
        rollouts: One rollout or, with leading axes, many.
        steps: The number of steps, 1 or more.
        fraction: Of the learning rate, in (0, 1].

    Returns:
        The critic and the state of the optimizer.
    """
    if rollouts.acting.shape[-1] == 1:
        return critic, moments
    moves = rollouts.features(), rollouts.fraction_left, returns_to_go(rollouts)[..., :-1], rollouts.acting
    batches = jax.tree.map(lambda leaf: minibatches(leaf[:, :, :, 1:], steps), moves)
    learned, fixed = eqx.partition(critic, eqx.is_inexact_array)

    def loss(learned: Tree, features: Array, left: Array, returns: Array, acting: Array) -> Array:
        """Return the mean squared error, in units of the critic's spread, which is not learned."""
        errors = (jax.vmap(eqx.combine(learned, fixed))(features, left) - returns) / critic.spread
        return jnp.where(acting, errors**2, 0.0).sum() / jnp.maximum(acting.sum(), 1)

    def step(carry: tuple[Tree, Tree], batch: tuple[Array, Array, Array, Array]) -> tuple[tuple, None]:
        learned, moments = carry
        change, moments = optimizer.update(jax.grad(loss)(learned, *batch), moments)
        change = jax.tree.map(lambda leaf: fraction * leaf, change)
        return (optax.apply_updates(learned, change), moments), None

    (learned, moments), _ = jax.lax.scan(step, (learned, moments), batches)
    return eqx.combine(learned, fixed), moments


def minibatches(
    leaf: Shaped[Array, "starts candidates samples moves *rest"], count: int
) -> Shaped[Array, "batches size *rest"]:
    """Deal all moves out to minibatches, so that each holds all move numbers and different starts.

    There are at most as many minibatches as entries; a remainder is left out.

    Args:
        leaf: An array with an entry a move.
        count: The number of minibatches, 1 or more.

    Returns:
        The minibatches along the first axis.
    """
    flat = jnp.moveaxis(leaf, (3, 0), (0, 3)).reshape(-1, *leaf.shape[4:])
    count = min(count, len(flat))
    size = len(flat) // count
    return jnp.swapaxes(flat[: size * count].reshape(size, count, *leaf.shape[4:]), 0, 1)
