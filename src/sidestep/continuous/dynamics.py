"""Dynamics of continuous worlds: the transition model T_θ(s, a, s′) as a density that can be sampled.

A family of dynamics draws a next state and evaluates its density,

    s′ ~ T_θ(s, a, ·),        ln T_θ(s, a, s′).

States and actions are arrays of any shape; most are vectors. Most families are Gaussian mixtures: an action leads to
outcome k with probability p_k, and noise is added to the mean of the outcome,

    T_θ(s, a, s′) = Σ_k p_k N(s′; m_k, diag(noise²)),      p = p_θ(s, a),  m = m_θ(s, a).

With one outcome, s′ = m_θ(s, a) + noise · ε, and ε can be held fixed while θ moves. Such dynamics are *reparameterized*
(Kingma and Welling 2014): gradients may pass along the path.
"""

import abc
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from sidestep._arguments import to_finite, to_integers
from sidestep._repr import short_repr
from sidestep._typing import ArrayTree, FloatTree, Tree
from sidestep.continuous.control_variates import (
    Mixture,
    Real,
    State,
    ValueFunction,
    Vector,
    score_variate,
    transition_variate,
)
from sidestep.errors import InputError, check, check_instance
from sidestep.tabular.arrays import is_traced
from sidestep.tabular.models import TransitionModel

Action = Shaped[Array, "*action"]
Rows = Float[Array, "dimensions _"]
PerCandidate = Float[Array, "starts candidates"]
PerSample = Float[Array, "starts candidates samples"]

_Family = TypeVar("_Family", bound="Dynamics")


@short_repr()
class Dynamics(eqx.Module):
    """A density T_θ(s, a, ·) over next states.

    A new family is a subclass with `sample` and `log_prob`, or of `GaussianDynamics` with `outcomes`. Its methods take
    one state and one action; `jax.vmap` makes many of them.

    Attributes:
        parameters: θ, a pytree of floating-point arrays, all of which are learned.
    """

    parameters: eqx.AbstractVar[FloatTree]

    @property
    @abc.abstractmethod
    def reparameterized(self) -> bool:
        """Whether `sample` is smooth in θ and the state while the key is held fixed."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, state: State, action: Action) -> State:
        """Draw a next state s′ ~ T_θ(s, a, ·).

        Args:
            key: Draws everything random.
            state: The state s.
            action: The action a.

        Returns:
            A next state, shaped as `state`.
        """

    @abc.abstractmethod
    def log_prob(self, state: State, action: Action, next_state: State) -> Real:
        """Return ln T_θ(s, a, s′), in nats.

        Args:
            state: The state s.
            action: The action a.
            next_state: The next state s′.
        """

    def transition_control_variate(
        self, value: ValueFunction, state: State, action: Action, next_state: State, key: PRNGKeyArray
    ) -> Real:
        """Return v(s′) − E[v(s′)] for a function v close to `value`; its mean over next states is 0.

        Rollouts subtract it to reduce their variance. It is 0 unless a family defines it.

        Args:
            value: The value of next states, in units of reward.
            state: The state s.
            action: The action a.
            next_state: The next state s′.
            key: Draws everything random.
        """
        return jnp.zeros((), jnp.result_type(float))

    def score_control_variate(
        self, value: ValueFunction, state: State, action: Action, next_state: State, key: PRNGKeyArray
    ) -> Real:
        """Return a number with the derivative ∇ ln T(s, a, s′) v(s′) − ∇E[v(s′)] by θ, which has mean 0.

        Score estimates subtract it; v is a function close to `value`. It is 0 unless a family defines it.

        Args:
            value: The value of next states, in units of reward; gradients by θ do not pass through it.
            state: The state s.
            action: The action a.
            next_state: The next state s′.
            key: Draws everything random.
        """
        return jnp.zeros((), jnp.result_type(float))

    def with_parameters(self: _Family, parameters: FloatTree) -> _Family:
        """Return the same family at another θ.

        Args:
            parameters: θ, shaped as the present parameters.
        """
        return eqx.tree_at(lambda dynamics: dynamics.parameters, self, parameters)


class Outcomes(NamedTuple):
    """The outcomes of an action.

    Attributes:
        log_probabilities: The logarithm ln p_k of every outcome k.
        means: The mean next state m_k of every outcome k.
    """

    log_probabilities: Float[Array, " outcomes"]
    means: Float[Array, "outcomes dimensions"]

    @classmethod
    def single(cls, mean: Vector) -> "Outcomes":
        """Return the outcomes of an action with a single one.

        Args:
            mean: The mean next state.
        """
        return cls(jnp.zeros(1, mean.dtype), mean[None])


class GaussianDynamics(Dynamics):
    """Gaussian noise around one or several outcomes.

    A new family is a subclass with `outcomes`, and with `example_action` where actions do not have the state's shape.
    A subclass that replaces `sample` or `log_prob` must replace both control variates too, to keep their means 0.

    Attributes:
        noise: The standard deviation of every component of the state, above 0; it is not learned.
    """

    noise: eqx.AbstractVar[Vector]

    @abc.abstractmethod
    def outcomes(self, state: Vector, action: Float[Array, " inputs"]) -> Outcomes:
        """Return the outcomes of an action.

        Args:
            state: The state s.
            action: The action a.

        Returns:
            ln p_k and the mean next state of each outcome k.
        """

    @property
    def reparameterized(self) -> bool:
        """Whether there is a single outcome: the draw of one among several is not smooth in θ."""
        return jax.eval_shape(self.outcomes, jnp.zeros_like(self.noise), self.example_action()).means.shape[0] == 1

    def example_action(self) -> Float[Array, " inputs"]:
        """Return an action of the right shape; that of the state, unless a family differs."""
        return jnp.zeros_like(self.noise)

    def sample(self, key: PRNGKeyArray, state: State, action: Action) -> State:
        """Draw an outcome by its probability, and the noise around it.

        Args:
            key: Draws everything random.
            state: The state s.
            action: The action a.

        Returns:
            A next state, shaped as `state`.
        """
        outcome_key, noise_key = jax.random.split(key)
        log_probabilities, means = self.outcomes(state, action)
        outcome = 0 if len(means) == 1 else jax.random.categorical(outcome_key, log_probabilities)
        return means[outcome] + self.noise * jax.random.normal(noise_key, means.shape[1:], means.dtype)

    def log_prob(self, state: State, action: Action, next_state: State) -> Real:
        """Return the logarithm of the mixture's density.

        Args:
            state: The state s.
            action: The action a.
            next_state: The next state s′.

        Returns:
            ln T_θ(s, a, s′), in nats.
        """
        return jax.nn.logsumexp(self._mixture(state, action).log_joint(next_state))

    def transition_control_variate(
        self, value: ValueFunction, state: State, action: Action, next_state: State, key: PRNGKeyArray
    ) -> Real:
        """Return Σ_k P(k | s′) v_k(s′) − Σ_k p_k E[v_k], with v_k near v around outcome k (`control_variates`).

        Args:
            value: The value of next states, in units of reward.
            state: The state s.
            action: The action a.
            next_state: The next state s′.
            key: Draws everything random.
        """
        return transition_variate(value, self._mixture(state, action), next_state, key)

    def score_control_variate(
        self, value: ValueFunction, state: State, action: Action, next_state: State, key: PRNGKeyArray
    ) -> Real:
        """Return a number with the derivative Σ_k P(k | s′) ∇ ln (p_k N_k(s′)) v_k(s′) − ∇ Σ_k p_k E[v_k].

        N_k(s′) is the density of outcome k, and v_k is near v around it, as in `transition_control_variate`.

        Args:
            value: The value of next states, in units of reward; gradients by θ do not pass through it.
            state: The state s.
            action: The action a.
            next_state: The next state s′.
            key: Draws everything random.
        """
        return score_variate(value, self._mixture(state, action), next_state, key)

    def _mixture(self, state: Vector, action: Float[Array, " inputs"]) -> Mixture:
        return Mixture(*self.outcomes(state, action), self.noise)


class LinearGaussian(GaussianDynamics):
    """Linear dynamics s′ = A s + B a + noise · ε.

    Args:
        state: A, of shape (dimensions, dimensions).
        action: B, of shape (dimensions, inputs).
        noise: The standard deviation of every component, above 0.

    Attributes:
        parameters: {"state": A, "action": B}, both learned.

    Raises:
        InputError: For numbers that are not finite, noise not above 0, or shapes that do not fit.

    Example:
        >>> dynamics = LinearGaussian(jnp.eye(2), jnp.ones((2, 1)), jnp.full(2, 0.1))
        >>> dynamics.outcomes(jnp.zeros(2), jnp.array([3.0])).means.tolist()
        [[3.0, 3.0]]
    """

    parameters: dict[str, Rows]
    noise: Vector

    def __init__(self, state: Rows, action: Rows, noise: Vector):
        matrices = (
            to_finite(state, "state", ("dimensions", "dimensions")),
            to_finite(action, "action", ("dimensions", "inputs")),
        )
        fits = matrices[0].shape == (len(matrices[0]),) * 2 and len(matrices[1]) == len(matrices[0])
        shapes = " and ".join(str(matrix.shape) for matrix in matrices)
        check(fits, f"expected a square matrix and one with as many rows, found {shapes}", field="state, action")
        self.noise = checked_noise(noise, len(matrices[0]))
        self.parameters = dict(zip(("state", "action"), map(jnp.asarray, matrices), strict=True))

    def example_action(self) -> Float[Array, " inputs"]:
        """Return an action with as many components as B has columns."""
        return jnp.zeros_like(self.parameters["action"][0])

    def outcomes(self, state: Vector, action: Float[Array, " inputs"]) -> Outcomes:
        """Return A s + B a as the only outcome.

        Args:
            state: The state s.
            action: The action a.
        """
        return Outcomes.single(self.parameters["state"] @ state + self.parameters["action"] @ action)


class TableDynamics(Dynamics):
    """A discrete world as dynamics: states and actions are whole numbers, T_θ is that of a transition model.

    Estimators for densities can so be checked against exact answers.

    Attributes:
        model: Any `TransitionModel`; its parameters are those of the dynamics.

    Raises:
        InputError: For a model with actions that are not available everywhere.
    """

    model: TransitionModel

    def __init__(self, model: TransitionModel):
        check_instance(model, TransitionModel, "model")
        message = "expected a model with all actions available: policies of continuous worlds have no masks"
        check(is_traced(model.graph.available) or np.all(model.graph.available), message, field="model")
        self.model = model

    @property
    def parameters(self) -> Tree:
        """The parameters θ of the model."""
        return self.model.parameters

    @property
    def reparameterized(self) -> bool:
        """Never, because states are whole numbers."""
        return False

    def _probabilities(self, state: State, action: Action) -> Float[Array, " outcomes"]:
        return self.model.probabilities()[state, action]

    def sample(self, key: PRNGKeyArray, state: State, action: Action) -> State:
        """Draw an outcome by its probability.

        Args:
            key: Draws everything random.
            state: The state s.
            action: The action a.

        Returns:
            The index of the next state, in the data type of `state`.
        """
        outcome = jax.random.categorical(key, jnp.log(self._probabilities(state, action)))
        return self.model.graph.successors[state, action, outcome].astype(state.dtype)

    def log_prob(self, state: State, action: Action, next_state: State) -> Real:
        """Return the logarithm of the total probability of all outcomes that are the next state.

        Args:
            state: The state s.
            action: The action a.
            next_state: The next state s′.

        Returns:
            ln T_θ(s, a, s′), in nats; −∞ for an impossible next state.
        """
        same = self.model.graph.successors[state, action] == next_state
        probability = jnp.sum(jnp.where(same, self._probabilities(state, action), 0.0))
        # the logarithm of 0 has no gradient, even where `where` discards it
        possible = probability > 0
        return jnp.where(possible, jnp.log(jnp.where(possible, probability, 1.0)), -jnp.inf)

    def transition_control_variate(
        self, value: ValueFunction, state: State, action: Action, next_state: State, key: PRNGKeyArray
    ) -> Real:
        """Return v(s′) − E[v(s′)] of the value function itself.

        Args:
            value: The value of next states, in units of reward.
            state: The state s.
            action: The action a.
            next_state: The next state s′.
            key: Draws everything random.
        """
        successors = self.model.graph.successors[state, action].astype(next_state.dtype)
        return value(next_state) - self._probabilities(state, action) @ jax.vmap(value)(successors)

    def score_control_variate(
        self, value: ValueFunction, state: State, action: Action, next_state: State, key: PRNGKeyArray
    ) -> Real:
        """Return a number with the derivative ∇ ln T(s, a, s′) v(s′) − ∇E[v(s′)] of the value function itself.

        Args:
            value: The value of next states, in units of reward; gradients by θ do not pass through it.
            state: The state s.
            action: The action a.
            next_state: The next state s′.
            key: Draws everything random.
        """
        successors = self.model.graph.successors[state, action].astype(next_state.dtype)
        log_prob = self.log_prob(state, action, next_state)
        return log_prob * value(next_state) - self._probabilities(state, action) @ jax.vmap(value)(successors)


def checked_noise(noise: Float[Array, " _"] | np.ndarray | Sequence[float], dimensions: int) -> Vector:
    """Return standard deviations as floating-point numbers; refuse any that are not finite and above 0.

    Args:
        noise: The standard deviations.
        dimensions: How many there should be.

    Returns:
        As many numbers as `dimensions`, in the units of the state.

    Raises:
        InputError: For another number of them, or any not finite and above 0.
    """
    return jnp.asarray(to_finite(noise, "noise", (dimensions,), above=0), jnp.result_type(float))


def check_finite(arrays: ArrayTree, field: str = "parameters") -> None:
    """Refuse arrays that are not finite; inside `jit` nothing is checked.

    Args:
        arrays: Any pytree of arrays.
        field: The name of the setting in the error.

    Raises:
        InputError: For numbers that are not finite.
    """
    for leaf in jax.tree.leaves(arrays):
        if getattr(getattr(leaf, "dtype", None), "kind", "f") not in "biu":  # whole numbers and booleans are finite
            to_finite(leaf, field)


def check_corners(low: Vector, high: Vector) -> None:
    """Refuse corners that are not finite, or a `high` that does not lie above `low`.

    Args:
        low: The lower corner.
        high: The upper corner.

    Raises:
        InputError: For corners that are not finite or not in order.
    """
    lower = np.asarray(to_finite(low, "low", ("dimensions",)))
    upper = np.asarray(to_finite(high, "high", lower.shape))
    if not (lower < upper).all():
        raise InputError(f"expected corners in order, found {low} and {high}", field="low, high")


def checked_counts(counts: Sequence[int], dimensions: int) -> tuple[int, ...]:
    """Return the number of points along each side of a lattice.

    Args:
        counts: The numbers.
        dimensions: How many there should be.

    Raises:
        InputError: For other than as many whole numbers of at least 2.
    """
    return tuple(to_integers(counts, "counts", (dimensions,), least=2, what="numbers of points").tolist())
