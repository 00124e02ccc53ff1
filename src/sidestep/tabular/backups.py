"""Backups: how agents value a state by its actions, V(s) = B(Q(s, ·)).

| backup             | V(s)                           | weights ∂V/∂Q(a)      | fixed-policy weights |
|--------------------|--------------------------------|-----------------------|----------------------|
| `HardMax`          | max_a Q(a)                     | uniform over the ties | the same (eq. 10)    |
| `BoltzmannAverage` | Σ_a π(a) Q(a) (eq. 5)          | π(1 + β(Q − V)), eq. 8| π, eq. 9             |
| `LogSumExp`        | (1/β) log Σ_a exp βQ(a)        | π                     | π                    |
| `Mellowmax`        | (1/β) log mean_a exp βQ(a)     | π                     | π                    |

with π(a) ∝ exp βQ(a), which is the policy under every backup (eqs. 2 and 3). Weights always sum to one. An action with
Q(a) = −∞ has the weight 0, and sums leave it out; so do derivatives. The mean of the mellowmax is over the available
actions, those with Q(a) = −∞ among them that are available.
Equation numbers are those of the behavior-aware modeling paper; mellowmax is from Asadi & Littman (2017), the
log-sum-exp from Ziebart's maximum causal entropy (2010).
"""

import abc
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Scalar

from sidestep._arguments import to_finite
from sidestep._repr import short_repr
from sidestep.errors import InputError, describe, to_number
from sidestep.tabular.arrays import to_jax

Gradient = Literal["exact", "fixed_policy"]
"""The derivative of a backup: its own, or that of the average under the policy held fixed (eqs. 9 and 10)."""

Values = Float[Array, "*states"]
ActionValues = Float[Array, "*states actions"]
Available = Bool[Array, "*#states actions"]
Number = float | Float[Array, ""]


class Backup(eqx.Module):
    """The value of a state as a function of the values of its actions, at inverse temperature β.

    Attributes:
        above_maximum: Whether the backup is never below the best action's value; otherwise it is never above.

    Example:
        >>> isinstance(HardMax(), Backup)
        True
    """

    above_maximum: ClassVar[bool] = False

    @abc.abstractmethod
    def value(self, q: ActionValues, beta: Float[Scalar, ""], available: Available | None = None) -> Values:
        """Return V = B(q) over the last axis, differentiable in both arguments with the exact gradient.

        Args:
            q: Q of the actions, on the last axis; −∞ for actions that are never taken, but not for all of a state.
            beta: The inverse temperature β, above 0.
            available: Whether each action is available; by default all are. Q of the others is −∞.

        Returns:
            V of each state, in units of reward.
        """

    @abc.abstractmethod
    def weights(self, q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
        """Return the exact gradient ∂V/∂q; it sums to one over the last axis.

        Args:
            q: Q of the actions, on the last axis.
            beta: The inverse temperature β, above 0.

        Returns:
            ∂V/∂Q of each action.
        """

    def fixed_policy_weights(self, q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
        """Return the weights of the average under the policy held fixed: π for the soft backups (eq. 9).

        Args:
            q: Q of the actions, on the last axis.
            beta: The inverse temperature β, above 0.

        Returns:
            The weight of each action, at least 0; they sum to one.
        """
        return jax.nn.softmax(_exponents(q, beta), axis=-1)

    def bonus(self, entropy: Values, actions: int | None, beta: Float[Scalar, ""]) -> Values:
        """Return V − Σ_a π(a) Q(a), from the policy's entropy; 0 by default.

        `actions` is the number of actions, `None` where an action is a vector.

        Args:
            entropy: The entropy of the policy in each state, in nats.
            actions: The number of actions; None where an action is a vector.
            beta: The inverse temperature β, above 0.

        Returns:
            V − Σ_a π(a) Q(a) of each state.
        """
        del actions, beta
        return jnp.zeros_like(entropy)


class HardMax(Backup):
    """V = max_a Q(a): agents with an optimal policy (eq. 2).

    Attributes:
        tie: Actions within this relative difference of the best value (or within rounding) are ties and have equal
            parts of the gradient (eq. 10). It is small, because in a nearly trapped state values are far larger than
            the differences that matter.

    Example:
        >>> float(HardMax().value(jnp.array([1.0, 3.0]), jnp.array(10.0)))
        3.0
    """

    tie: float = eqx.field(default=4e-12, static=True)

    def __check_init__(self) -> None:
        to_number(self.tie, "tie", least=0)

    def value(self, q: ActionValues, beta: Float[Scalar, ""], available: Available | None = None) -> Values:
        """Return the best action's value."""
        del available
        best = jax.lax.stop_gradient(q.max(axis=-1))
        weights = jax.lax.stop_gradient(self.weights(q, beta))
        return best + jnp.sum(weights * zero_with_gradient(q), axis=-1)

    def weights(self, q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
        """Return one over the number of best actions, for each of them."""
        del beta
        best = q.max(axis=-1, keepdims=True)
        tolerance = jnp.maximum(self.tie, 64 * jnp.finfo(q.dtype).eps) * jnp.abs(best)
        # the first of the best counts even if a compiler, rounding twice, makes none equal to the best
        first = jax.nn.one_hot(q.argmax(axis=-1), q.shape[-1], dtype=bool)
        ties = ((q >= best - tolerance) | first).astype(q.dtype)
        return ties / ties.sum(axis=-1, keepdims=True)

    def fixed_policy_weights(self, q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
        """Return the optimal policy, uniform over ties (eq. 10), which is also the gradient of the maximum."""
        return self.weights(q, beta)


class BoltzmannAverage(Backup):
    """V = Σ_a π(a) Q(a): the expected value of acting by π (eqs. 3–5), the paper's choice.

    It lies below the maximum and is neither monotone nor in general a contraction, so a solve may fail to converge.

    Example:
        >>> bool(BoltzmannAverage().value(jnp.array([1.0, 3.0]), jnp.array(1.0)) < 3)
        True
    """

    def value(self, q: ActionValues, beta: Float[Scalar, ""], available: Available | None = None) -> Values:
        """Return the average of the actions' values under π."""
        del available
        return jnp.sum(self.fixed_policy_weights(q, beta) * finite_or_zero(q), axis=-1)

    def weights(self, q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
        """Return π(1 + β(Q − V)), eq. 8: the effect of an action's value directly and through its probability."""
        policy, q = self.fixed_policy_weights(q, beta), finite_or_zero(q)
        value = jnp.sum(policy * q, axis=-1, keepdims=True)
        return policy * (1 + beta * (q - value))


class LogSumExp(Backup):
    """V = (1/β) log Σ_a exp βQ(a): maximum causal entropy; every further action adds to the value of a state.

    Example:
        >>> bool(LogSumExp().value(jnp.array([1.0, 3.0]), jnp.array(1.0)) > 3)
        True

    References:
        Ziebart, "Modeling purposeful adaptive behavior with the principle of maximum causal entropy" (2010).
    """

    above_maximum: ClassVar[bool] = True

    def value(self, q: ActionValues, beta: Float[Scalar, ""], available: Available | None = None) -> Values:
        """Return the soft maximum, above the maximum by at most log(actions)/β."""
        del available
        best = jax.lax.stop_gradient(q.max(axis=-1))
        return best + jax.nn.logsumexp(_exponents(q, beta), axis=-1) / beta

    def weights(self, q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
        """Return π: eq. 9 is exact here."""
        return self.fixed_policy_weights(q, beta)

    def bonus(self, entropy: Values, actions: int | None, beta: Float[Scalar, ""]) -> Values:
        """Return the entropy over β."""
        del actions
        return entropy / beta


class Mellowmax(Backup):
    """V = (1/β) log mean_a exp βQ(a): the log-sum-exp without its bonus of log(actions)/β for every step.

    Example:
        >>> bool(Mellowmax().value(jnp.array([1.0, 3.0]), jnp.array(1.0)) < 3)
        True

    References:
        Asadi and Littman, "An alternative softmax operator for reinforcement learning" (2017).
    """

    def value(self, q: ActionValues, beta: Float[Scalar, ""], available: Available | None = None) -> Values:
        """Return a soft maximum between the mean and the maximum."""
        best = jax.lax.stop_gradient(q.max(axis=-1))
        # log mean exp, without adding 1 to what may be far smaller
        excess = jnp.expm1(_exponents(q, beta))
        mean = jnp.mean(excess, axis=-1) if available is None else jnp.mean(excess, axis=-1, where=available)
        return best + jnp.log1p(mean) / beta

    def weights(self, q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
        """Return π, as for the log-sum-exp."""
        return self.fixed_policy_weights(q, beta)

    def bonus(self, entropy: Values, actions: int | None, beta: Float[Scalar, ""]) -> Values:
        """Return the policy's entropy minus that of acting at random, over β.

        Raises:
            InputError: Where an action is a vector.
        """
        if actions is None:
            raise InputError("the mellowmax needs a finite number of actions: expected another", field="backup")
        return (entropy - jnp.log(actions)) / beta


BACKUPS: Mapping[str, Callable[[], Backup]] = MappingProxyType(
    {"boltzmann": BoltzmannAverage, "max": HardMax, "logsumexp": LogSumExp, "mellowmax": Mellowmax}
)
"""The backups by the names that settings and the command line use."""


@short_repr()
class Behavior(eqx.Module):
    """How agents act: the backup that they value states with, their inverse temperature and their lapses.

    The probability of an action is ∝ exp(β Q(s, a)) (eqs. 2 and 3). With probability `lapse` agents take a uniformly
    random available action instead; the values of states do not account for that.

    Attributes:
        backup: The value of a state from the values of its actions: a `Backup`, its class, or a name in `BACKUPS`.
        beta: The inverse temperature β, above 0, in units of one over reward.
        lapse: The fraction of random actions, at least 0 and below 1; None for none.

    Raises:
        InputError: For something else than a backup, for β ≤ 0 or not finite, and for a lapse out of its range.

    Example:
        >>> float(Behavior("boltzmann", beta=5.0).beta)
        5.0

    References:
        Equations 2 and 3 of the behavior-aware modeling paper. Lapses are those of psychometrics (Wichmann and Hill,
        2001).
    """

    backup: Backup
    beta: Float[Array, ""]
    lapse: Float[Array, ""] | None

    def __init__(self, backup: Backup | type[Backup] | str, beta: Number = 10.0, lapse: Number | None = None):
        self.backup = backup_of(backup)
        dtype = jnp.result_type(float)
        self.beta = to_jax(to_finite(beta, "beta", (), above=0), dtype)
        self.lapse = None if lapse is None else to_jax(to_finite(lapse, "lapse", (), least=0, below=1), dtype)

    def log_policy(self, q: ActionValues, available: Available | None = None) -> ActionValues:
        """Return log π(a | s) from action values; −∞ for actions that are never taken.

        Args:
            q: Q(s, a), with actions on the last axis; −∞ for actions that are never taken. Where all of a state are,
                all available ones are equally probable.
            available: Whether each action is available; by default all are.

        Returns:
            Log-probabilities, of the shape of `q`.
        """
        exponents = _exponents(tied_where_lost(q, available), self.beta.astype(q.dtype))
        chosen = jax.nn.log_softmax(exponents, axis=-1)
        if self.lapse is None:
            return chosen
        lapse = self.lapse.astype(q.dtype)
        count = q.shape[-1] if available is None else available.sum(axis=-1, keepdims=True)
        with_lapse = jnp.logaddexp(chosen + jnp.log1p(-lapse), jnp.log(lapse / count))
        return with_lapse if available is None else jnp.where(available, with_lapse, -jnp.inf)


def tied_where_lost(q: ActionValues, available: Available | None = None) -> ActionValues:
    """Return q, but 0 for the available actions of a state in which no action has a finite value: all are as good.

    Args:
        q: Q(s, a), with actions on the last axis.
        available: Whether each action is available; by default all are.
    """
    tied = jnp.zeros_like(q) if available is None else jnp.where(available, jnp.zeros_like(q), -jnp.inf)
    return jnp.where(jnp.isneginf(q).all(axis=-1, keepdims=True), tied, q)


def backup_of(backup: Backup | type[Backup] | str) -> Backup:
    """Return a backup from an instance, its class, or its name in `BACKUPS`.

    Args:
        backup: One of these.

    Raises:
        InputError: For anything else.
    """
    if isinstance(backup, str) and backup in BACKUPS:
        return BACKUPS[backup]()
    made = backup() if isinstance(backup, type) and issubclass(backup, Backup) else backup
    if isinstance(made, Backup):
        return made
    raise InputError(f"expected a Backup, or one of {', '.join(BACKUPS)}, found {describe(backup)}", field="backup")


def _exponents(q: ActionValues, beta: Float[Scalar, ""]) -> ActionValues:
    """Return β (q − max q), with the gradient of βq; −∞ for actions that are never taken, without a gradient.

    All backups move with a constant. Were q multiplied by β before the maximum is subtracted, large values could be
    rounded once with and once without a fused multiply-add, and the exponential of the difference would overflow.
    """
    best = jax.lax.stop_gradient(q.max(axis=-1, keepdims=True))
    # NaN stays: it is no mask
    never = jnp.isneginf(q)
    return jnp.where(never, -jnp.inf, beta * jnp.where(never, 0, q - best))


def finite_or_zero(numbers: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return numbers, and 0 instead of −∞: an infinite number times a weight of 0 would be NaN.

    Args:
        numbers: Values, or action values.
    """
    return jnp.where(jnp.isneginf(numbers), 0, numbers)


def zero_with_gradient(q: ActionValues) -> ActionValues:
    """Return zeros that have the gradient of q, where it is finite.

    Args:
        q: Q of the actions.
    """
    finite = finite_or_zero(q)
    return finite - jax.lax.stop_gradient(finite)
