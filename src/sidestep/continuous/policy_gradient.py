"""The policy gradient (eq. 12 of the paper), the critic's regression, and the gap that is left.

A soft agent has π ∝ exp βQ^π. With the policy's advantages q_λ and the Q estimate Q̂_i of a rollout, the divergence
between the agent's choices and those of π_λ falls along

    −∇_λ = E [ Σ_i ∇_λ ln π_λ(a_i | s_i) γ^i ( Q̂_i − E_i − q_λ(s_i, a_i)/β ) ].

This is a variational policy gradient with a baseline (Williams 1992). It differs from eq. 12 as printed in four points.

1. It is divided by −β, and discounted.
2. The baseline E_i, any function of s_i, is subtracted. The whole of what is subtracted is V_w(s_i) − b_i, a critic's
   value, because the bonuses b_i of rollouts hold q_λ/β.
3. Q̂_i may hold bonuses of later moves (`Backup.bonus`). As printed, eq. 12 counts rewards only, and leads to the
   **Boltzmann average** (eqs. 3–5). The divergence to Ziebart's trajectory distribution also counts the entropies of
   later moves, E[−Σ_{j>i} ln π_λ(a_j | s_j)]; with these the same equation leads to the **log-sum-exp**. For the
   **hard maximum** 1/β is 0, and the ordinary policy gradient is left.
4. At the first state of a rollout all actions are tried (or several draws of the policy), and the sum over them is
   taken exactly, with their probabilities.

The gradient is 0 where q_λ/β are the advantages of Q^π.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Shaped

from sidestep._typing import Tree
from sidestep.continuous.critic import Critic
from sidestep.continuous.estimators import action_baselines, features_at_moves, policy_log_probs
from sidestep.continuous.policies import PerCandidate, PerSample, Policy
from sidestep.continuous.rollouts import Rollout, discount_powers, q_estimates, returns_to_go
from sidestep.tabular.backups import Behavior, HardMax


def policy_gradient(policy: Policy, critic: Critic, rollouts: Rollout, probabilities: PerCandidate) -> Tree:
    """Return the mean of eq. 12 over −β, with the sign of a loss: the policy improves against it.

    Args:
        policy: π_λ.
        critic: V_w.
        rollouts: with axes (starts, candidates, samples).
        probabilities: of the candidates; a sum with them is a mean over the policy's first choices.

    References:
        Eq. 12 of the paper, with the differences that the module's docstring lists.
    """
    beyond = q_estimates(rollouts) - action_baselines(critic, rollouts)
    # all candidates of the first move were tried, whatever their probability
    first = (probabilities * probabilities.shape[1])[..., None, None]
    first = jnp.broadcast_to(first, (*rollouts.acting.shape[:-1], 1))
    counts = jnp.concatenate([first, jnp.ones_like(beyond[..., 1:])], axis=-1)
    powers = discount_powers(rollouts, beyond.shape[-1])
    credit = jax.lax.stop_gradient(jnp.where(rollouts.acting, counts * powers * beyond, 0.0))

    def loss(policy: Policy) -> Array:
        return -jnp.sum(credit * policy_log_probs(policy, rollouts)) / credit[..., 0].size

    return eqx.filter_grad(loss)(policy)


def fit_critic(
    critic: Critic, optimizer: optax.GradientTransformation, moments: Tree, rollouts: Rollout, steps: int
) -> tuple[Critic, Tree]:
    """Regress a critic on returns-to-go, one step of the optimizer for each of `steps` minibatches.

    First moves are left out, because their choices were not drawn from the policy. With a horizon of 1 no moves are
    left, and the critic stays the same.
    """
    if rollouts.acting.shape[-1] == 1:
        return critic, moments
    returns = returns_to_go(rollouts)[..., :-1]
    moves = features_at_moves(rollouts), rollouts.fraction_left, returns, rollouts.acting
    batches = jax.tree.map(lambda leaf: minibatches(leaf[:, :, :, 1:], steps), moves)
    learned, fixed = eqx.partition(critic, eqx.is_inexact_array)

    def loss(learned: Tree, features: Array, left: Array, returns: Array, acting: Array) -> Array:
        """Return the mean squared error, in units of the critic's spread."""
        critic = eqx.combine(learned, fixed)
        squares = jnp.where(acting, (jax.vmap(critic)(features, left) - returns) ** 2, 0.0) / critic.spread**2
        return squares.sum() / jnp.maximum(acting.sum(), 1)

    def step(carry: tuple[Tree, Tree], batch: tuple[Array, Array, Array, Array]) -> tuple[tuple, None]:
        learned, moments = carry
        slope = jax.grad(loss)(learned, *batch)
        change, moments = optimizer.update(slope, moments)
        return (optax.apply_updates(learned, change), moments), None

    (learned, moments), _ = jax.lax.scan(step, (learned, moments), batches)
    return eqx.combine(learned, fixed), moments


def minibatches(
    leaf: Shaped[Array, "starts candidates samples moves *rest"], count: int
) -> Shaped[Array, "batches size *rest"]:
    """Deal all moves out to minibatches, so that each holds all move numbers and different starts.

    There are at most as many minibatches as entries; a remainder is left out.
    """
    flat = jnp.moveaxis(leaf, (3, 0), (0, 3)).reshape(-1, *leaf.shape[4:])
    count = min(count, len(flat))
    size = len(flat) // count
    return jnp.swapaxes(flat[: size * count].reshape(size, count, *leaf.shape[4:]), 0, 1)


def policy_gap(
    behavior: Behavior, advantages: PerCandidate, q: PerSample, probabilities: PerCandidate
) -> Float[Array, ""]:
    """Return the mean gap between a policy and its own Q estimates.

    For soft agents it is the divergence of π_λ from exp βQ̂ in nats, for optimal ones the gain of the best action in
    units of reward. Two independent halves of the samples give the noise of Q̂, which is subtracted.
    """
    half = q.shape[-1] // 2
    halves = q[..., :half].mean(axis=-1), q[..., -half:].mean(axis=-1)
    if isinstance(behavior.backup, HardMax):
        best = jnp.take_along_axis(halves[1], halves[0].argmax(axis=1)[:, None], axis=1)[:, 0]
        return (best - jnp.sum(probabilities * halves[1], axis=1)).mean()

    # with d = q_λ − βQ̂ the divergence is E d + ln E exp(−d)
    difference = advantages - behavior.beta * (halves[0] + halves[1]) / 2
    divergence = jnp.sum(probabilities * difference, axis=1)
    divergence = divergence + jax.nn.logsumexp(-difference, axis=1, b=probabilities)
    # noise in Q̂ adds half its variance under π
    noise = behavior.beta * (halves[0] - halves[1]) / 2
    noise = noise - jnp.sum(probabilities * noise, axis=1, keepdims=True)
    return (divergence - 0.5 * jnp.sum(probabilities * noise**2, axis=1)).mean()
