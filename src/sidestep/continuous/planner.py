"""Policies by gradients: for people who act optimally (Q*), and for those who act softly (Q≈, eq. 12).

People who act softly have π ∝ exp βQ^π. With q_λ the policy's advantages and Q̂_i what a roll-out says of Q^π(s_i, a_i),
the divergence between what they do and what π_λ does falls along

    −∇_λ = E [ Σ_i ∇_λ ln π_λ(a_i | s_i) γ^i ( Q̂_i − E_i − q_λ(s_i, a_i)/β ) ],

which is eq. 12 over −β with a control variate E_i, any function of s_i; what is taken off altogether is V_w(s_i) − b_i,
a critic's guess, for the b_i of roll-outs hold q_λ/β. It vanishes where q_λ/β are the advantages of Q^π. What Q^π is
depends on the backup: as printed, eq. 12 counts rewards only, and leads to the **Boltzmann average** (eqs. 3–5). The
divergence to Ziebart's trajectory distribution also counts the entropies to come, E[−Σ_{j>i} ln π_λ(a_j | s_j)]; with
these in Q̂_i (`Backup.bonus`) the same equation leads to the **log-sum-exp**. For the **hard maximum** 1/β is 0, and
what is left is the ordinary policy gradient.

At the first state of a roll-out all actions are tried (or several that the policy draws), and the sum over them is
taken exactly, with their probabilities.
"""

from typing import Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree, Shaped

from sidestep.continuous.critic import Critic, critic
from sidestep.continuous.dynamics import Dynamics
from sidestep.continuous.estimators import advantages, everywhere, shares_left, values_expected
from sidestep.continuous.policies import FinitePolicy, Policy
from sidestep.continuous.rollouts import RollOut, returns, roll_outs, said, spread_over, to_come
from sidestep.continuous.tasks import ContinuousTask, task_at
from sidestep.errors import InputError, check_count, check_positive
from sidestep.tabular.backups import Behavior, HardMax

SomePolicy = TypeVar("SomePolicy", bound=Policy)


class PlanProgress(NamedTuple):
    """How good a policy is.

    - `expected_return`: Σ γ^i R_i from the places it was tried at, on average.
    - `gradient`: the norm of the policy's gradient, in reward units.
    - `entropy`: at these places, in nats.
    - `lag`: by how much it falls short of acting on what its own roll-outs say. For soft people the divergence from
      exp βQ̂ in nats; for optimal ones what the best action would gain, in reward units. The share of noise is taken
      off, so that it is below 0 at times; near 0 for a policy that has been found.
    """

    iteration: int
    expected_return: float
    gradient: float
    entropy: float
    lag: float


class Planning(eqx.Module, Generic[SomePolicy]):
    """A policy on its way: what planning carries from step to step, and over to a changed model (a warm start)."""

    policy: SomePolicy
    critic: Critic
    policy_moments: PyTree
    critic_moments: PyTree


class Planner(eqx.Module):
    """How a policy is found.

    - `horizon`: how many moves a roll-out has at most.
    - `places`, `samples`: how many places are tried a step, and how many roll-outs each of their options gets; of
      these at least 2, for `PlanProgress.lag` compares halves of them. (The iterations of a fit try `Schedule.moves`
      places.)
    - `options`: how many choices are tried at a place where actions are vectors; from a finite set, all are.
    - `learning_rate`, `critic_rate`: of Adam.
    - `critic_width`: how many units each hidden layer of the critic has.
    - `critic_steps`: in how many parts the moves of a batch are dealt out, each for a step of the critic.
    """

    horizon: int = eqx.field(static=True)
    places: int = eqx.field(default=32, static=True)
    samples: int = eqx.field(default=4, static=True)
    options: int = eqx.field(default=8, static=True)
    learning_rate: float = eqx.field(default=3e-3, static=True)
    critic_rate: float = eqx.field(default=1e-2, static=True)
    critic_width: int = eqx.field(default=64, static=True)
    critic_steps: int = eqx.field(default=8, static=True)

    def begin(
        self,
        key: PRNGKeyArray,
        dynamics: Dynamics,
        policy: SomePolicy,
        tasks: ContinuousTask,
        behavior: Behavior,
        states: Shaped[Array, "places *state"],
    ) -> Planning[SomePolicy]:
        """Planning at its start, with a critic made from roll-outs of the first policy.

        `tasks` are those of each of the states.
        """
        check_planner(self)
        choosing, rolling, drawing, making = jax.random.split(key, 4)
        few = jax.random.choice(choosing, len(states), (min(len(states), 8 * self.places),), replace=False)
        tasks, states = task_at(tasks, few), states[few]
        choices, _ = self.tried(drawing, policy, tasks, states)
        rolled = self.roll(dynamics, policy, tasks, behavior, rolling, states, choices)
        over = spread_over(tasks, rolled)
        worths = to_come(rolled, over.discount)[..., :-1]
        seen = everywhere(lambda task, state: task.features(state), tasks, rolled)
        acting = np.asarray(rolled.acting)
        if not acting.any():
            raise InputError("expected places where a task has not ended", field="states")
        guess = critic(making, seen[acting], shares_left(rolled)[acting], worths[acting], width=self.critic_width)
        return Planning(
            policy,
            guess,
            self._adam(self.learning_rate).init(_learned(policy)),
            self._adam(self.critic_rate).init(_learned(guess)),
        )

    def tried(
        self, key: PRNGKeyArray, policy: Policy, tasks: ContinuousTask, states: Shaped[Array, "places *state"]
    ) -> tuple[Shaped[Array, "places options *choice"], Float[Array, "places options"]]:
        """The options of every place, and the probabilities by which a sum over them is an average by the policy."""
        seen = jax.vmap(lambda task, state: task.features(state))(tasks, states)
        if isinstance(policy, FinitePolicy):
            every = jnp.arange(len(policy.actions))
            choices = jnp.broadcast_to(every, (len(states), len(every)))
            return choices, jnp.exp(jax.vmap(policy.log_probs)(seen))
        keys = jax.random.split(key, (len(states), self.options))
        choices = jax.vmap(jax.vmap(policy.sample, (0, None)))(keys, seen)
        return choices, jnp.full(choices.shape[:2], 1 / self.options, seen.dtype)

    @eqx.filter_jit
    def roll(
        self,
        dynamics: Dynamics,
        policy: Policy,
        tasks: ContinuousTask,
        behavior: Behavior,
        key: PRNGKeyArray,
        states: Shaped[Array, "places *state"],
        choices: Shaped[Array, "places options *choice"],
    ) -> RollOut:
        """Roll-outs from (places, options, samples)."""
        return roll_outs(dynamics, policy, tasks, behavior, key, states, self.horizon, choices, self.samples)

    def improve(
        self,
        planning: Planning[SomePolicy],
        tasks: ContinuousTask,
        behavior: Behavior,
        rolled: RollOut,
        shares: Float[Array, "places options"],
    ) -> tuple[Planning[SomePolicy], PlanProgress]:
        """A step of the policy and of its critic, by roll-outs from (places, options, samples)."""
        policy, guess = planning.policy, planning.critic
        gradient = _policy_gradient(policy, guess, tasks, rolled, shares)
        step, policy_moments = self._adam(self.learning_rate).update(gradient, planning.policy_moments)
        guess, critic_moments = self._followed(guess, planning.critic_moments, tasks, rolled)
        progress = _progress(policy, tasks, behavior, rolled, shares, optax.tree.norm(gradient))
        return Planning(eqx.apply_updates(policy, step), guess, policy_moments, critic_moments), progress

    def _followed(
        self, guess: Critic, moments: PyTree, tasks: ContinuousTask, rolled: RollOut
    ) -> tuple[Critic, PyTree]:
        """A critic after steps towards what was to come, each by a part of the moves.

        First moves are left out, for their choices were not the policy's. With a horizon of 1 there are no others, and
        nothing is to come.
        """
        if rolled.acting.shape[-1] == 1:
            return guess, moments
        seen = everywhere(lambda task, state: task.features(state), tasks, rolled)
        worths = to_come(rolled, spread_over(tasks, rolled).discount)[..., :-1]
        moves = seen, shares_left(rolled), worths, rolled.acting
        parts = jax.tree.map(lambda leaf: dealt(leaf[:, :, :, 1:], self.critic_steps), moves)
        learned, fixed = eqx.partition(guess, eqx.is_inexact_array)

        def step(carry: tuple[PyTree, PyTree], part: tuple[Array, Array, Array, Array]) -> tuple[tuple, None]:
            learned, moments = carry
            slope = jax.grad(lambda learned: _critic_loss(eqx.combine(learned, fixed), *part))(learned)
            change, moments = self._adam(self.critic_rate).update(slope, moments)
            return (optax.apply_updates(learned, change), moments), None

        (learned, moments), _ = jax.lax.scan(step, (learned, moments), parts)
        return eqx.combine(learned, fixed), moments

    def _adam(self, rate: float) -> optax.GradientTransformation:
        return optax.adam(rate)


def _policy_gradient(
    policy: Policy,
    guess: Critic,
    tasks: ContinuousTask,
    rolled: RollOut,
    shares: Float[Array, "places options"],
) -> PyTree:
    """The mean of eq. 12 over −β, per roll-out; what it points away from is better."""
    discount = spread_over(tasks, rolled).discount
    beyond = said(rolled, discount) - values_expected(guess, tasks, rolled)
    # of the first move all options were tried, whatever their probability
    first = jnp.broadcast_to((shares * shares.shape[1])[..., None, None], (*rolled.acting.shape[:-1], 1))
    counts = jnp.concatenate([first, jnp.ones_like(beyond[..., 1:])], axis=-1)
    powers = discount[..., None] ** jnp.arange(beyond.shape[-1])
    credit = jax.lax.stop_gradient(jnp.where(rolled.acting, counts * powers * beyond, 0.0))

    def loss(policy: Policy) -> Array:
        def log_prob(task: ContinuousTask, state: Array, choice: Array) -> Array:
            return policy.log_prob(task.features(state), choice)

        log_probs = everywhere(log_prob, tasks, rolled, rolled.choices)
        return -jnp.sum(credit * log_probs) / credit[..., 0].size

    return eqx.filter_grad(loss)(policy)


def dealt(leaf: Shaped[Array, "places options samples moves *rest"], parts: int) -> Shaped[Array, "parts each *rest"]:
    """All moves, dealt out like cards, place after place, so that parts differ by places and not by moves.

    No more parts than cards; what is left over is left out.
    """
    flat = jnp.moveaxis(leaf, (3, 0), (0, 3)).reshape(-1, *leaf.shape[4:])
    parts = min(parts, len(flat))
    each = len(flat) // parts
    return jnp.swapaxes(flat[: each * parts].reshape(each, parts, *leaf.shape[4:]), 0, 1)


def _critic_loss(
    guess: Critic,
    seen: Float[Array, "moves features"],
    left: Float[Array, " moves"],
    worths: Float[Array, " moves"],
    acting: Bool[Array, " moves"],
) -> Float[Array, ""]:
    """The mean squared error, in units of the critic's spread."""
    squares = jnp.where(acting, (jax.vmap(guess)(seen, left) - worths) ** 2, 0.0) / guess.spread**2
    return squares.sum() / jnp.maximum(acting.sum(), 1)


def _progress(
    policy: Policy,
    tasks: ContinuousTask,
    behavior: Behavior,
    rolled: RollOut,
    shares: Float[Array, "places options"],
    gradient: Float[Array, ""],
) -> PlanProgress:
    discount = spread_over(tasks, rolled).discount
    earned = jnp.sum(shares * returns(rolled, discount).mean(axis=-1), axis=1).mean()
    states = rolled.states[:, 0, 0, 0]
    entropy = jax.vmap(lambda task, state: policy.entropy(task.features(state)))(tasks, states).mean()
    q = said(rolled, discount)[..., 0]
    own = advantages(policy, tasks, rolled)[..., 0, 0]
    return PlanProgress(0, earned, gradient, entropy, _lag(behavior, own, q, shares))  # pyright: ignore[reportArgumentType]


def _lag(
    behavior: Behavior,
    own: Float[Array, "places options"],
    q: Float[Array, "places options samples"],
    shares: Float[Array, "places options"],
) -> Float[Array, ""]:
    """By how much a policy falls short of what its roll-outs say; two independent halves tell how noisy they are."""
    half = q.shape[-1] // 2
    halves = q[..., :half].mean(axis=-1), q[..., -half:].mean(axis=-1)
    if isinstance(behavior.backup, HardMax):
        best = jnp.take_along_axis(halves[1], halves[0].argmax(axis=1)[:, None], axis=1)[:, 0]
        return (best - jnp.sum(shares * halves[1], axis=1)).mean()

    away = own - behavior.beta * (halves[0] + halves[1]) / 2
    # the divergence of π from exp βQ̂: with d = q_λ − βQ̂ it is E d + ln E exp(−d)
    far = jnp.sum(shares * away, axis=1) + jax.nn.logsumexp(-away, axis=1, b=shares)
    # noise in Q̂ adds half its variance under π, which the halves tell
    noise = behavior.beta * (halves[0] - halves[1]) / 2
    noise = noise - jnp.sum(shares * noise, axis=1, keepdims=True)
    return (far - 0.5 * jnp.sum(shares * noise**2, axis=1)).mean()


def check_planner(planner: Planner) -> None:
    """Raises `InputError` for settings below 1, fewer than 2 samples (halves are compared), or rates not above 0."""
    for name in ("horizon", "places", "samples", "options", "critic_width", "critic_steps"):
        check_count(getattr(planner, name), 2 if name == "samples" else 1, name)
    for name in ("learning_rate", "critic_rate"):
        check_positive(getattr(planner, name), name)


def _learned(module: eqx.Module) -> PyTree:
    return eqx.filter(module, eqx.is_inexact_array)
