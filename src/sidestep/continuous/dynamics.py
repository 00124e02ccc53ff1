"""Dynamics of continuous worlds: T_θ(s, a, s′) as a density that can be sampled.

A family says two things: how to draw a next state, and how probable a next state is,

    s′ ~ T_θ(s, a, ·),        ln T_θ(s, a, s′).

States and actions are arrays of any shape; most are vectors. Most families need only say where an action may lead, with
which probabilities, for noise is Gaussian around each outcome k:

    T_θ(s, a, s′) = Σ_k p_k N(s′; m_k, diag(noise²)),      p = p_θ(s, a),  m = m_θ(s, a).

With one outcome, s′ = m_θ(s, a) + noise · ε, so that the noise can be held fixed while θ moves: such dynamics are
*reparameterised*, and gradients may pass along the path.
"""

import abc
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.stats import norm
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, Scalar, Shaped

from sidestep.errors import InputError
from sidestep.tabular.models import TransitionModel

State = Shaped[Array, "*state"]
Action = Shaped[Array, "*action"]
Value = Callable[[State], Float[Scalar, ""]]

_Family = TypeVar("_Family", bound="Dynamics")
_Table = TypeVar("_Table", bound="TableDynamics")


class Dynamics(eqx.Module):
    """A density T_θ(s, a, ·) over next states.

    - `parameters`: θ, a pytree of floating-point arrays, all of which are learned.
    - `reparameterised`: whether `sample` moves smoothly with θ and the state while the key is held fixed.

    A new family is a subclass with `sample` and `log_prob`, or of `GaussianDynamics` with `outcomes`. Both take one
    state and one action; `jax.vmap` makes many of them.
    """

    parameters: eqx.AbstractVar[PyTree[Float[Array, "..."]]]

    @property
    @abc.abstractmethod
    def reparameterised(self) -> bool:
        """Whether gradients may pass along a sampled path."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, state: State, action: Action) -> State:
        """A next state s′ ~ T_θ(s, a, ·)."""

    @abc.abstractmethod
    def log_prob(self, state: State, action: Action, next_state: State) -> Float[Scalar, ""]:
        """ln T_θ(s, a, s′), in nats."""

    def surprise(self, value: Value, state: State, action: Action, next_state: State) -> Float[Scalar, ""]:
        """What a function of the next state is beyond what was to be expected: of this function, or of one like it.

        It averages to nothing over next states, and is taken off what roll-outs say, to make it less noisy. 0, unless a
        family knows better.
        """
        del value, state, action, next_state
        return jnp.zeros((), jnp.result_type(float))

    def with_parameters(self: _Family, parameters: PyTree[Float[Array, "..."]]) -> _Family:
        """The same family at another θ."""
        return eqx.tree_at(lambda dynamics: dynamics.parameters, self, parameters)


class Outcomes(NamedTuple):
    """Where an action may lead: ln p_k, and the mean next state m_k, of every outcome k."""

    log_probabilities: Float[Array, " outcomes"]
    means: Float[Array, "outcomes dimensions"]


class GaussianDynamics(Dynamics):
    """Gaussian noise around one or several outcomes.

    - `noise`: the standard deviation of every component of the state, above 0; it is not learned.

    A new family is a subclass with `outcomes`, and with `example_action` where actions are not of the state's shape.
    Who changes `sample` or `log_prob` as well must change `surprise`, which would not average to nothing any more.
    """

    noise: eqx.AbstractVar[Float[Array, " dimensions"]]

    @abc.abstractmethod
    def outcomes(self, state: Float[Array, " dimensions"], action: Float[Array, " inputs"]) -> Outcomes:
        """Where the action may lead."""

    @property
    def reparameterised(self) -> bool:
        """With a single outcome, the path moves with θ; which of several happens, jumps."""
        example = jnp.zeros_like(self.noise)
        return jax.eval_shape(self.outcomes, example, self.example_action()).means.shape[0] == 1

    def example_action(self) -> Float[Array, " inputs"]:
        """An action of the right shape; as many components as the state has, unless a family says otherwise."""
        return jnp.zeros_like(self.noise)

    def sample(self, key: PRNGKeyArray, state: State, action: Action) -> State:
        """An outcome drawn by its probability, and the noise around it."""
        choosing, shaking = jax.random.split(key)
        log_probabilities, means = self.outcomes(state, action)
        chosen = 0 if len(means) == 1 else jax.random.categorical(choosing, log_probabilities)
        return means[chosen] + self.noise * jax.random.normal(shaking, means.shape[1:], means.dtype)

    def log_prob(self, state: State, action: Action, next_state: State) -> Float[Scalar, ""]:
        """The logarithm of the mixture's density."""
        log_probabilities, means = self.outcomes(state, action)
        each = norm.logpdf(next_state, means, self.noise).sum(axis=-1)
        return jax.nn.logsumexp(log_probabilities + each)

    def surprise(self, value: Value, state: State, action: Action, next_state: State) -> Float[Scalar, ""]:
        """Of the function made linear around each outcome, v_k(s′) = v(m_k) + ∇v(m_k)·(s′ − m_k).

        That is Σ_k P(k | s′) v_k(s′) − Σ_k p_k v(m_k).
        """
        log_probabilities, means = self.outcomes(state, action)
        each = norm.logpdf(next_state, means, self.noise).sum(axis=-1)
        values, slopes = jax.vmap(jax.value_and_grad(value))(means)
        there = values + jnp.sum(slopes * (next_state - means), axis=-1)
        return jax.nn.softmax(log_probabilities + each) @ there - jnp.exp(log_probabilities) @ values


class LinearGaussian(GaussianDynamics):
    """s′ = A s + B a + noise · ε.

    - `parameters`: {"state": A, "action": B}, both learned.
    """

    parameters: dict[str, Float[Array, "dimensions _"]]
    noise: Float[Array, " dimensions"]

    def __init__(
        self,
        state: Float[Array, "dimensions dimensions"],
        action: Float[Array, "dimensions inputs"],
        noise: Float[Array, " dimensions"],
    ):
        """Raises `InputError` for numbers that are not finite, noise not above 0, and shapes that do not fit."""
        self.noise = checked_noise(noise, len(state))
        self.parameters = {"state": jnp.asarray(state), "action": jnp.asarray(action)}
        if np.shape(state) != (len(state),) * 2 or np.ndim(action) != 2 or len(action) != len(state):
            raise InputError(
                f"expected a square matrix and one with as many rows, found {np.shape(state)} and {np.shape(action)}",
                field="state, action",
            )
        check_finite(self.parameters)

    def example_action(self) -> Float[Array, " inputs"]:
        """As many components as B has columns."""
        return jnp.zeros_like(self.parameters["action"][0])

    def outcomes(self, state: Float[Array, " dimensions"], action: Float[Array, " inputs"]) -> Outcomes:
        """A s + B a, surely."""
        return certain(self.parameters["state"] @ state + self.parameters["action"] @ action)


class TableDynamics(Dynamics):
    """A discrete world seen as dynamics: states and actions are whole numbers, T_θ that of a transition model.

    What is built for densities can so be checked where exact answers are known.

    - `model`: any `TransitionModel`.
    """

    model: TransitionModel
    parameters: PyTree[Float[Array, "..."]]

    def __init__(self, model: TransitionModel):
        self.model, self.parameters = model, model.parameters

    @property
    def reparameterised(self) -> bool:
        """Never: states jump."""
        return False

    def with_parameters(self: _Table, parameters: PyTree[Float[Array, "..."]]) -> _Table:
        """The same family at another θ, which is also that of its model."""
        places = (lambda dynamics: dynamics.parameters, lambda dynamics: dynamics.model.parameters)
        moved = self
        for place in places:
            moved = eqx.tree_at(place, moved, parameters)
        return moved

    def _probabilities(self, state: State, action: Action) -> Float[Array, " outcomes"]:
        return self.model.probabilities()[state, action]

    def sample(self, key: PRNGKeyArray, state: State, action: Action) -> State:
        """An outcome drawn by its probability."""
        outcome = jax.random.categorical(key, jnp.log(self._probabilities(state, action)))
        return self.model.graph.successors[state, action, outcome].astype(state.dtype)

    def log_prob(self, state: State, action: Action, next_state: State) -> Float[Scalar, ""]:
        """The logarithm of the probabilities of all outcomes that are the next state."""
        same = self.model.graph.successors[state, action] == next_state
        probability = jnp.sum(jnp.where(same, self._probabilities(state, action), 0.0))
        # the logarithm of 0 has no gradient, even where it is not looked at
        possible = probability > 0
        return jnp.where(possible, jnp.log(jnp.where(possible, probability, 1.0)), -jnp.inf)

    def surprise(self, value: Value, state: State, action: Action, next_state: State) -> Float[Scalar, ""]:
        """Of the function itself."""
        successors = self.model.graph.successors[state, action].astype(next_state.dtype)
        return value(next_state) - self._probabilities(state, action) @ jax.vmap(value)(successors)


def certain(mean: Float[Array, " dimensions"]) -> Outcomes:
    """The only outcome."""
    return Outcomes(jnp.zeros(1, mean.dtype), mean[None])


def checked_noise(noise: Float[Array, " _"] | np.ndarray, dimensions: int) -> Float[Array, " dimensions"]:
    """The standard deviations as floating-point numbers.

    Raises `InputError` unless there is one for each dimension, finite and above 0.
    """
    noise = jnp.asarray(noise, jnp.result_type(float))
    if noise.shape != (dimensions,):
        raise InputError(f"expected {dimensions} numbers, one a component of the state, found {noise}", field="noise")
    if not isinstance(noise, Tracer) and not (np.isfinite(noise).all() and (np.asarray(noise) > 0).all()):
        raise InputError(f"expected finite numbers above 0, found {noise}", field="noise")
    return noise


def check_finite(parameters: PyTree[Float[Array, "..."]]) -> None:
    """Raises `InputError` unless all parameters are finite; inside `jit` nothing is checked."""
    for leaf in jax.tree.leaves(parameters):
        if not isinstance(leaf, Tracer) and not np.isfinite(leaf).all():
            raise InputError("expected finite numbers", field="parameters")
