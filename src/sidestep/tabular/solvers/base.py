"""The equations that a solver solves: the Bellman equation, its adjoint, and each state's own equation.

**Values.** With P the outcomes' probabilities and B a backup,

    Q(s, a) = R(s, a) + γ Σ_k P(s, a, k) V(succ(s, a, k)),      V(s) = B(Q(s, ·)),      V(terminal) = terminal reward.

An action that mostly fails leads mostly back to its own state, and the backups of value iteration then converge slowly.
So a sweep solves each state's own equation with its neighbors' values held. With p(a) the probability of staying,
c(a) = R + γ Σ_{elsewhere} P V the *exit value* and l(a) = 1 − γ p(a) the *exit weight*, the advantage of an action over
the state's value v is A(a) = c(a) − l(a) v, and since every backup moves with a constant, V = B(Q) reads B(A) = 0. A
Newton step on it is

    v ← v + B(A) / Σ_a w(a) l(a),          w = the backup's weights at A.

The *repeat-action value*, max_a c(a)/l(a), is the best that one action repeated for ever can give. It bounds the root:
from above for backups that never exceed the best action, from below for the log-sum-exp. Steps start and end on the
root's side of it; otherwise a state with too high a value would seem best off with an action that never leaves. A
state without a value yet starts from its repeat-action value. 1 − γp is summed as (1 − γ) + γ Σ_{elsewhere} P, so that
nothing cancels in a trapped state.

The Boltzmann average may have several fixed points. Dividing by no less than Σ π l keeps the steps short where B(A)
grows with v, so that the sweeps end in a stable one.

**Adjoint.** For a scalar function with gradient g with respect to V, λ solves λ = g + Wᵀλ, where
W(s, s′) = γ Σ_a w(a) Σ_{k → s′} P(s, a, k) and w are the weights of the gradient that is asked for (exact or fixed
policy). Self-loops are divided out as above. Both iterations have the same spectrum at the fixed point (for the exact
gradient), so the adjoint converges where the values did. This is implicit differentiation of a fixed point
(Christianson, *Reverse accumulation and attractive fixed points*, 1994).

**Region.** λ(s) is what a change of V(s) is worth. So a state s that has not been solved costs λ(s) (B(Q(s, ·)) − V(s))
to first order: nothing where λ is 0. A solve may leave out states that did not matter under a model nearby; λ, which is
solved over all states, shows afterwards what that has cost,

    Σ_{s left out} |λ(s) (B(Q(s, ·)) − V(s))|,

and that has to be within the tolerance of Σ |λ(s) V(s)|. This is to first order, and for the exact gradient. A path
that is not taken, because λ is 0 there, may have become the best one unseen: so leave states out only in trial points
that are solved again.

**Infinite values.** At discount 1 every action costs something, so the value of a state is −∞ unless some policy surely
reaches a terminal state from there (`reachability`). An action that may lead to such a state is worth −∞ and is never
taken. Both are masks: values of −∞ are compared with, and take part in no sum. The same −∞ stands for "not known yet"
in a start.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Scalar

from sidestep._arguments import to_finite
from sidestep.errors import to_count
from sidestep.tabular.backups import Backup, Gradient, finite_or_zero, zero_with_gradient
from sidestep.tabular.graph import available_mask

Beta = Float[Scalar, ""]
Values = Float[Array, " states"]
Tolerance = float | Float[Array, ""] | None
Region = Bool[Array, " states"]


class DecisionProcess(eqx.Module):
    """A Markov decision process: a task under a model (fields as in `Graph`, `TransitionModel` and `Task`)."""

    successors: Int[Array, "states actions outcomes"]
    probabilities: Float[Array, "states actions outcomes"]
    reward: Float[Array, "#states #actions"]
    terminal_reward: Float[Array, "#states"]
    terminal: Bool[Array, " states"]
    available: Bool[Array, "#states #actions"]
    discount: Float[Array, ""]

    def action_values(self, values: Float[Array, " states"]) -> Float[Array, "states actions"]:
        """Return Q(s, a) = R(s, a) + γ Σ T V (eq. 4) of all states."""
        return finite_or_zero(values)[:, None] + self.advantages(values)

    def advantages(self, values: Float[Array, " states"]) -> Float[Array, "states actions"]:
        """Return Q(s, a) − V(s) of all states; see `advantages`."""
        after = values[self.successors]
        return advantages(values, after, self.probabilities, self.reward, self.available, self.discount)

    def available_actions(self) -> Bool[Array, "states actions"] | None:
        """Return which actions are available; None where all are."""
        return available_mask(self.available, *self.successors.shape[:2])

    def with_terminal_rewards(self, values: Float[Array, " states"]) -> Float[Array, " states"]:
        """Return the values with those of terminal states put in."""
        return jnp.where(self.terminal, self.terminal_reward, values)


def advantages(
    values: Float[Array, " some"],
    values_after: Float[Array, "some actions outcomes"],
    probabilities: Float[Array, "some actions outcomes"],
    reward: Float[Array, "#some #actions"],
    available: Bool[Array, "#some #actions"],
    discount: Float[Array, "*#some"],
) -> Float[Array, "some actions"]:
    """Return A(s, a) = Q(s, a) − V(s) of some states, from their values and those of their successors.

    Summed as differences from V(s), so that the rounding of probabilities that are nearly 1 does not meet values that
    are large: where actions mostly fail it would exceed the gradient. A is −∞ for actions that are not available or may
    lead to a state of value −∞.
    """
    here, is_lost = finite_or_zero(values)[:, None], jnp.isneginf(values_after)
    differences = jnp.where(is_lost, 0, values_after - here[..., None])
    gained = reward + discount * jnp.sum(probabilities * differences, axis=-1) - (1 - discount) * here
    never = ~available | jnp.any(is_lost & (probabilities > 0), axis=-1)
    return jnp.where(never, -jnp.inf, gained)


class WarmStart(NamedTuple):
    """What a solve may start from: what an earlier one of the same task left, under a model nearby.

    Attributes:
        values: V; −∞ where unknown.
        adjoint: λ; 0 where unknown. The gradient of a solution with respect to it is the new λ (see `solve`).
        order: The states by their distance from where the task ends, for solvers that use one; −1 for none yet.
    """

    values: Float[Array, "*tasks states"]
    adjoint: Float[Array, "*tasks states"]
    order: Int[Array, "*tasks ordered"]

    @property
    def region(self) -> Bool[Array, "*tasks states"]:
        """The states that mattered to what the earlier solve was asked for, by its adjoint; all where it is unknown."""
        matters = self.adjoint != 0
        return matters | ~matters.any(axis=-1, keepdims=True)


class Cotangents(NamedTuple):
    """The gradient of a scalar by all that values depend on; shapes as in `DecisionProcess`."""

    probabilities: Float[Array, "states actions outcomes"]
    reward: Float[Array, "#states #actions"]
    terminal_reward: Float[Array, "#states"]
    discount: Float[Array, ""]
    beta: Float[Array, ""]


class BellmanEquation(NamedTuple):
    """The equation V = F(V; φ) of a decision process under a backup with inverse temperature β."""

    process: DecisionProcess
    backup: Backup
    beta: Beta

    @property
    def inputs(self) -> Cotangents:
        """Return φ, all that the values depend on."""
        process = self.process
        return Cotangents(process.probabilities, process.reward, process.terminal_reward, process.discount, self.beta)

    def at(self, inputs: Cotangents) -> "BellmanEquation":
        """Return the equation at another φ."""
        process = self.process
        arrays = process.successors, *inputs[:3], process.terminal, process.available
        return BellmanEquation(DecisionProcess(*arrays, inputs.discount), self.backup, inputs.beta)

    def is_live(self, values: Values) -> Bool[Array, " states"]:
        """Return whether each state has actions and finite values; the others have no part in a gradient."""
        return is_reachable(values) & ~self.process.terminal

    def backed_up(self, values: Values, gradient: Gradient = "exact") -> Values:
        """Return F(V, φ), 0 in states without finite values; differentiable by the gradient asked for."""
        live, process = self.is_live(values), self.process
        q = jnp.where(live[:, None], process.action_values(values), 0)
        if gradient == "exact":
            backed_up = self.backup.value(q, self.beta, process.available_actions())
        else:
            backed_up = at_fixed_policy(self.backup, self.beta, q, process.available_actions())
        return process.with_terminal_rewards(jnp.where(live, backed_up, 0))


class SolveResult(NamedTuple):
    """The result of a solver, and how the solve went.

    Attributes:
        values: V, or λ.
        order: As in `WarmStart`.
        sweeps: The number of times that a state was solved, on average.
        residual: The largest change in the last sweep relative to the value itself (or to what its actions are worth
            without staying, where that is larger), so that small values far from a goal count as much as large ones.
            Of the states that had to be solved; of an adjoint, it may be the cost of those left out.
        error: A bound of |V − V*| (see `bounds`), of the states that had to be solved; ∞ where none is known. Of an
            adjoint, an estimate, or 0 where the residual is one.
        converged: Whether the residual is within the tolerance, and the error within `largest_error` if it is known.
    """

    values: Float[Array, " states"]
    order: Int[Array, " ordered"]
    sweeps: Int[Array, ""]
    residual: Float[Array, ""]
    error: Float[Array, ""]
    converged: Bool[Array, ""]


class Solver(eqx.Module):
    """A method that solves for values and adjoints by sweeps over the states.

    Attributes:
        tolerance: The relative change at which to stop, from 0; by default 1e-10 in 64-bit and 1e-5 in 32-bit numbers.
        max_sweeps: When to stop without convergence, at least 1.

    Example:
        >>> import sidestep as ss
        >>> isinstance(ss.Jacobi(), ss.Solver)
        True
    """

    tolerance: eqx.AbstractVar[Tolerance]
    max_sweeps: eqx.AbstractVar[int]

    def check_settings(self) -> None:
        """Raise `InputError` for a tolerance below 0, or fewer sweeps than 1."""
        if self.tolerance is not None:
            to_finite(self.tolerance, "tolerance", (), least=0)
        to_count(self.max_sweeps, "max_sweeps")

    @abc.abstractmethod
    def cold_start(self, states: int, dtype: jnp.dtype) -> WarmStart:
        """Return the start when nothing is known."""

    @abc.abstractmethod
    def values(self, equation: BellmanEquation, start: WarmStart, region: Region) -> SolveResult:
        """Return V of the fixed point; outside the region it may be approximate if `start` is near it."""

    @abc.abstractmethod
    def vjp(
        self, equation: BellmanEquation, gradient: Gradient, cotangent: Values, start: WarmStart, region: Region
    ) -> tuple[Cotangents, SolveResult]:
        """Return λᵀ ∂F/∂φ for the adjoint λ of g = `cotangent` at the fixed point `start.values`, and λ as `values`.

        Both are NaN if λ did not converge, or if states outside the region matter that were left out.
        """

    def gather_rows(
        self, probabilities: Float[Array, "states actions outcomes"], visited: Int[Array, " visited"]
    ) -> Float[Array, "visited actions outcomes"]:
        """Return the probabilities of some states.

        Args:
            probabilities: Those of all states.
            visited: The states; negative numbers count from the end, and one beyond it means the last state.
        """
        return probabilities[visited]

    def tolerance_for(self, dtype: jnp.dtype) -> float | Float[Array, ""]:
        """Return the tolerance, or the default one for a dtype."""
        if self.tolerance is not None:
            return self.tolerance
        return 1e-10 if dtype == jnp.float64 else 1e-5


def finite_horizon(
    process: DecisionProcess, backup: Backup, beta: Beta, horizon: int, gradient: Gradient
) -> tuple[Values, Float[Array, "horizon states"]]:
    """Return V after `horizon` backups from zero, the value of acting that many times, and V after fewer backups.

    The latter are V after horizon − 1, …, 1, 0 backups. Q of an agent that looks n actions ahead is R + γ Σ T V with V
    after n − 1 backups. Differentiable by JAX itself; `gradient` chooses the exact one or that of the policies held
    fixed.
    """

    def back_up(values: Values, _: None) -> tuple[Values, Values]:
        q, available = process.action_values(values), process.available_actions()
        exact = gradient == "exact"
        new = backup.value(q, beta, available) if exact else at_fixed_policy(backup, beta, q, available)
        return process.with_terminal_rewards(new), values

    start = process.with_terminal_rewards(jnp.zeros(process.terminal.shape, process.probabilities.dtype))
    last, before = jax.lax.scan(back_up, start, length=horizon)
    return last, before[::-1]


def is_reachable(values: Float[Array, "*states"]) -> Bool[Array, "*states"]:
    """Return whether a terminal state can be reached, by values at discount 1: whether they are above −∞."""
    return values > -jnp.inf


def at_fixed_policy(
    backup: Backup, beta: Beta, q: Float[Array, "states actions"], available: Bool[Array, "states actions"] | None
) -> Float[Array, " states"]:
    """Return the backup's value with the gradient of the average under its policy, held fixed (eqs. 9 and 10)."""
    weights, value = jax.lax.stop_gradient((backup.fixed_policy_weights(q, beta), backup.value(q, beta, available)))
    return value + jnp.sum(weights * zero_with_gradient(q), axis=-1)
