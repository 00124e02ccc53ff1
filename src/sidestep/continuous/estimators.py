"""Estimates of ∇_θ Q^π by roll-outs (eq. 11), for a policy that is held fixed.

With Q̂_i = R_i − z_i + γ W_{i+1}, what a roll-out says of Q^π(s_i, a_i) (see `rollouts`), the **score** estimate is

    ∇_θ Q^π(s_0, a_0) = E [ Σ_i ∇_θ ln T_θ(s_i, a_i, s_{i+1}) γ^i (Q̂_i + z_i − E_i) ].

It is eq. 11 without the terms that average to nothing: rewards that were paid before a transition do not depend on it.
E_i may be any function of s_i and a_i, for ∇_θ ln T_θ averages to nothing given these; here it is the critic's guess of
Q^π, that is V_w(s_i) − b_i. What a move led to is what its own score is about, so its surprise z_i is put back.

The **pathwise** estimate is the derivative of Q̂_0 along the path, with the random numbers held fixed. It needs dynamics
that are reparameterised and smooth rewards, and is far less noisy then. Where the policy draws from a finite set, its
draws jump; their share is added as a score, Σ_{i≥1} ∇_θ ln π(a_i | s_i(θ)) γ^i (Q̂_i − V_w(s_i) + b_i).

Both are written as *surrogates*, numbers whose derivative by θ is the estimate.
"""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, Shaped

from sidestep.continuous.critic import Critic
from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.policies import Policy
from sidestep.continuous.rollouts import RollOut, roll_outs, said, spread_over
from sidestep.continuous.tasks import ContinuousTask
from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior

Estimator = Literal["score", "pathwise"]

Weigh = Callable[[Float[Array, "places options"]], Float[Array, "places options"]]
"""What ∇Q of every option counts, by estimates of Q."""


def everywhere(function: Callable, tasks: ContinuousTask, rolled: RollOut, *more: Array) -> Array:
    """A function of (task, state, …) at every move of roll-outs.

    `tasks` have an axis of places, `more` all axes of the moves.
    """
    along_moves = jax.vmap(function, (None, *(0,) * (1 + len(more))))
    for _ in rolled.acting.shape[:-1]:
        along_moves = jax.vmap(along_moves)
    return along_moves(spread_over(tasks, rolled), rolled.leaving, *more)


def values_expected(critic: Critic | None, tasks: ContinuousTask, rolled: RollOut) -> Float[Array, "*batch moves"]:
    """V_w(s_i) − b_i, what is expected of the choice in s_i; V_w is 0 without a critic."""
    if critic is None:
        return -rolled.bonuses
    return guesses(critic, tasks, rolled) - rolled.bonuses


def guesses(critic: Critic, tasks: ContinuousTask, rolled: RollOut) -> Float[Array, "*batch moves"]:
    """V_w of every state that a move leaves."""

    def guess(task: ContinuousTask, state: Array, left: Array) -> Array:
        return critic(task.features(state), left)

    return everywhere(guess, tasks, rolled, shares_left(rolled))


def surprised(dynamics: Dynamics, policy: Policy, tasks: ContinuousTask, rolled: RollOut, critic: Critic) -> RollOut:
    """Roll-outs with the surprises that a critic sees in them; no gradients pass through these."""
    left_after = shares_left(rolled) - 1 / rolled.acting.shape[-1]

    def surprise(task: ContinuousTask, state: Array, choice: Array, following: Array, left: Array) -> Array:
        def value(state: Array) -> Array:
            going_on = jnp.where(left > 0.5 / rolled.acting.shape[-1], critic(task.features(state), left), 0.0)
            return jnp.where(task.terminal(state), task.terminal_reward(state), going_on)

        return task.discount * dynamics.surprise(value, state, policy.action(choice), following)

    seen = everywhere(surprise, tasks, rolled, rolled.choices, rolled.following, left_after)
    surprises = jax.lax.stop_gradient(jnp.where(rolled.acting, seen, 0.0))
    return eqx.tree_at(lambda rolled: rolled.surprises, rolled, surprises.astype(rolled.rewards.dtype))


def shares_left(rolled: RollOut) -> Float[Array, "*batch moves"]:
    """1 − i/τ for every move."""
    moves = rolled.acting.shape[-1]
    return jnp.broadcast_to(1 - jnp.arange(moves) / moves, rolled.acting.shape).astype(rolled.rewards.dtype)


def advantages(policy: Policy, tasks: ContinuousTask, rolled: RollOut) -> Float[Array, "*batch moves"]:
    """q_λ(s_i, a_i)."""

    def advantage(task: ContinuousTask, state: Array, choice: Array) -> Array:
        x = task.features(state)
        return policy.log_prob(x, choice) + policy.entropy(x)

    return everywhere(advantage, tasks, rolled, rolled.choices)


def score_surrogate(
    dynamics: Dynamics,
    policy: Policy,
    tasks: ContinuousTask,
    rolled: RollOut,
    critic: Critic | None = None,
) -> Float[Array, "*batch"]:
    """Numbers whose derivative by θ is the score estimate of each roll-out."""
    discount = spread_over(tasks, rolled).discount
    expected = values_expected(critic, tasks, rolled)
    # what a move led to is what its own score is about: its surprise belongs to the credit
    beyond = said(rolled, discount) + rolled.surprises - expected
    credit = _powers(discount, rolled) * jnp.where(rolled.acting, beyond, 0.0)

    def log_prob(task: ContinuousTask, state: Array, choice: Array, following: Array) -> Array:
        del task
        return dynamics.log_prob(state, policy.action(choice), following)

    log_probs = everywhere(log_prob, tasks, rolled, rolled.choices, rolled.following)
    return jnp.sum(log_probs * jax.lax.stop_gradient(credit), axis=-1)


def path_surrogate(
    policy: Policy, tasks: ContinuousTask, rolled: RollOut, critic: Critic | None = None
) -> Float[Array, "*batch"]:
    """Numbers whose derivative by θ is the pathwise estimate, for roll-outs that are functions of θ."""
    discount = spread_over(tasks, rolled).discount
    q = said(rolled, discount)
    if policy.reparameterised:
        return q[..., 0]

    def log_prob(task: ContinuousTask, state: Array, choice: Array) -> Array:
        return policy.log_prob(task.features(state), choice)

    credit = jax.lax.stop_gradient(_powers(discount, rolled) * (q - values_expected(critic, tasks, rolled)))
    drawn = jnp.where(rolled.acting, everywhere(log_prob, tasks, rolled, rolled.choices) * credit, 0.0)
    return q[..., 0] + drawn[..., 1:].sum(axis=-1)


def value_gradient(
    dynamics: Dynamics,
    policy: Policy,
    tasks: ContinuousTask,
    behavior: Behavior,
    key: PRNGKeyArray,
    states: Shaped[Array, "places *state"],
    choices: Shaped[Array, "places options *choice"],
    weigh: Weigh,
    *,
    horizon: int,
    samples: int,
    critic: Critic | None = None,
    estimator: Estimator = "score",
) -> tuple[PyTree[Float[Array, "..."]], RollOut]:
    """An estimate of Σ_places Σ_options weight · ∇_θ Q^π(s, c), and the roll-outs that it comes from.

    - `tasks`: the task of each place. `choices`: the options of each place.
    - `weigh`: the weights, by the means of Q̂_0 over samples. With two samples or more each half is weighed by what the
      other half says, so that the noise of weights and of gradients is independent.
    - `samples`: roll-outs an option. `estimator`: which estimate; both are unbiased where they apply.

    Raises `InputError` for a horizon or samples below 1, and an estimator that does not apply (`check_estimator`).
    """
    check_estimator(estimator, dynamics, tasks)

    def total(parameters: PyTree[Float[Array, "..."]]) -> tuple[Array, RollOut]:
        moved = dynamics.with_parameters(parameters)
        along = moved if estimator == "pathwise" else dynamics
        rolled = roll_outs(along, policy, tasks, behavior, key, states, horizon, choices, samples)
        if critic is not None:
            rolled = surprised(dynamics, policy, tasks, rolled, critic)
        if estimator == "pathwise":
            surrogates = path_surrogate(policy, tasks, rolled, critic)
        else:
            surrogates = score_surrogate(moved, policy, tasks, rolled, critic)
        rolled = jax.lax.stop_gradient(rolled)
        weights = jax.lax.stop_gradient(_weights(said(rolled, spread_over(tasks, rolled).discount)[..., 0], weigh))
        return jnp.sum(weights * surrogates) / samples, rolled

    gradient, rolled = jax.grad(total, has_aux=True)(dynamics.parameters)
    return gradient, rolled


def check_estimator(estimator: Estimator, dynamics: Dynamics, tasks: ContinuousTask) -> None:
    """Raises `InputError` for an estimator that does not exist, or is biased for these dynamics or tasks."""
    if estimator not in ("score", "pathwise"):
        raise InputError(f"expected 'score' or 'pathwise', found {estimator!r}", field="estimator")
    if estimator == "pathwise" and not (dynamics.reparameterised and tasks.smooth):
        what = "these dynamics jump" if not dynamics.reparameterised else "the returns of these tasks jump"
        raise InputError(f"{what}, and gradients along the path do not see that: expected 'score'", field="estimator")


def _weights(q: Float[Array, "places options samples"], weigh: Weigh) -> Float[Array, "places options samples"]:
    """The weight of every roll-out, by what the other half of the roll-outs says."""
    samples = q.shape[-1]
    if samples < 2:
        return jnp.broadcast_to(weigh(q.mean(axis=-1))[..., None], q.shape)
    half = samples // 2
    first, second = weigh(q[..., :half].mean(axis=-1)), weigh(q[..., half:].mean(axis=-1))
    return jnp.where(jnp.arange(samples) < half, second[..., None], first[..., None])


def _powers(discount: Float[Array, "*batch"], rolled: RollOut) -> Float[Array, "*batch moves"]:
    return discount[..., None] ** jnp.arange(rolled.acting.shape[-1])
