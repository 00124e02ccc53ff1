"""Behavior models: which numbers of the agents' behavior are learned beside the transition model.

    beta              β_p = exp b_p                            of all agents, or of each person p
    lapse             ε = σ(e)                                 the fraction of random actions (see `Behavior`)
    discount          γ = σ(g)                                 of all tasks
    reward_weights    R(s, a) + Σ_f w_f φ_f(s, a)              of the features φ of states and actions
    costs             R(s, a) − ln(1 + exp k_c(s, a))          of aiming at state c(s, a), whatever the goal

Each is known, or learned together with θ from the likelihood of the actions. Learned parameters have a normal prior
around their start, with standard deviation 1 for e, g, the w and the mean of the b_p, and 2 for the k around −4 (a
cost of .02, within a factor of seven). One person's b differs from the mean with standard deviation ½: this partial
pooling pulls a person with few moves towards the others.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logit
from jaxtyping import Array, ArrayLike, Float, Int, Shaped

from sidestep._arguments import to_finite, to_integers, to_states
from sidestep._repr import short_repr
from sidestep.errors import check, check_choice, check_instance, describe, to_list, to_number
from sidestep.tabular.arrays import is_traced, to_jax
from sidestep.tabular.backups import Behavior
from sidestep.tabular.tasks import Task, with_state_costs

LEARNABLE = ("beta", "lapse", "discount")
"""The numbers that can be learned by name."""

_PERSON_STD = 0.5
"""The standard deviation of one person's log β around the mean."""
_INITIAL_LAPSE = 0.05
"""Where a lapse starts that is learned, if the behavior has none."""
_COST_MEAN, _COST_STD = -4.0, 2.0
"""The mean and the standard deviation of the prior of k."""


@short_repr()
class BehaviorParameters(NamedTuple):
    """The learned numbers, unconstrained; None for what is known.

    Attributes:
        log_beta: b of each person; a single number where persons are not distinguished.
        logit_lapse: e.
        logit_discount: g.
        reward_weights: w of each feature.
        cost_parameters: k of each state.
    """

    log_beta: Float[Array, " persons"] | None = None
    logit_lapse: Float[Array, ""] | None = None
    logit_discount: Float[Array, ""] | None = None
    reward_weights: Float[Array, " features"] | None = None
    cost_parameters: Float[Array, " states"] | None = None


@short_repr("behavior", "parameters", "person", "features", "aimed_at")
class BehaviorModel(eqx.Module):
    """How agents behave: what is known, and what is learned; made by `behavior_model`.

    Attributes:
        behavior: The known numbers, and the start of a learned β and lapse.
        parameters: The learned numbers.
        start: The mean of their prior.
        person: The person of each task, where persons are distinguished (see
            `sidestep.tabular.demonstrations.split_by_person`).
        features: φ(s, a); an axis of length 1 holds for all states or all actions.
        aimed_at: c(s, a), where states have costs.

    Example:
        >>> from sidestep.tabular.backups import BoltzmannAverage
        >>> model = behavior_model(Behavior(BoltzmannAverage(), 7.0), learn=["lapse"])
        >>> round(float(model.behavior_of().lapse), 2)  # where a learned lapse starts
        0.05
    """

    behavior: Behavior
    parameters: BehaviorParameters
    start: BehaviorParameters
    person: Int[Array, " tasks"] | None
    features: Float[Array, "#states #actions features"] | None
    aimed_at: Int[Array, "states actions"] | None

    def with_parameters(self, parameters: BehaviorParameters) -> "BehaviorModel":
        """Return the same model at other parameters.

        Args:
            parameters: With None for the same numbers.
        """
        return eqx.tree_at(lambda model: model.parameters, self, parameters, is_leaf=lambda leaf: leaf is None)

    @property
    def costs(self) -> Float[Array, " states"] | None:
        """Return the cost of aiming at each state, in units of reward; None where there are none."""
        return None if self.parameters.cost_parameters is None else jax.nn.softplus(self.parameters.cost_parameters)

    def behavior_of(self, person: Int[Array, ""] | int | None = None) -> Behavior:
        """Return the behavior of one person: backup, β and lapse.

        A learned discount and learned rewards belong to the tasks, and are not in it. `plan`, `solve`, `simulate` and
        `log_likelihood` take the behavior model itself, with all that was learned.

        Args:
            person: Its index; None for a typical person, of the mean log β.

        Returns:
            The behavior, with the learned β and lapse.

        Raises:
            InputError: For a person that does not exist; one that JAX is tracing is not looked at.
        """
        log_beta, logit_lapse = self.parameters.log_beta, self.parameters.logit_lapse
        beta, lapse = self.behavior.beta, self.behavior.lapse
        if log_beta is None:
            message = f"expected none without persons, found {person!r}"
            check(person is None or is_traced(person), message, field="person")
        elif person is None:
            beta = jnp.exp(log_beta.mean())
        else:
            own = to_integers(person, "person", (), least=0, most=len(log_beta) - 1, what="a person")
            beta = jnp.exp(log_beta[own])
        if logit_lapse is not None:
            lapse = jax.nn.sigmoid(logit_lapse)
        return Behavior(self.behavior.backup, beta, lapse)

    def betas(self, tasks: int) -> Float[Array, " tasks"]:
        """Return β of each task: that of its person, or of a typical one where persons are not distinguished.

        Args:
            tasks: Their number.
        """
        if self.person is None or self.parameters.log_beta is None:
            return jnp.broadcast_to(self.behavior_of().beta, (tasks,))
        return jnp.exp(self.parameters.log_beta[self.person])

    def tasks_of(self, tasks: Task) -> Task:
        """Return tasks with the agents' discount, reward weights and costs.

        Args:
            tasks: One task or a stack of tasks.

        Returns:
            As many tasks as given.
        """
        if self.costs is not None and self.aimed_at is not None:
            tasks = with_state_costs(tasks, self.costs, self.aimed_at)
        reward, discount = tasks.reward, tasks.discount
        if self.parameters.reward_weights is not None and self.features is not None:
            reward = reward + self.features @ self.parameters.reward_weights
        if self.parameters.logit_discount is not None:
            discount = jnp.broadcast_to(jax.nn.sigmoid(self.parameters.logit_discount), discount.shape)
        return replace(tasks, reward=reward, discount=discount)

    def log_density(self) -> Float[Array, ""]:
        """Return the logarithm of the prior density of the parameters, in nats, without its constant."""
        deviations = [jnp.zeros(1)]
        now, start = self.parameters, self.start
        if now.log_beta is not None and start.log_beta is not None:
            mean = now.log_beta.mean()
            deviations += [(mean - start.log_beta.mean())[None], (now.log_beta - mean) / _PERSON_STD]
        # the other numbers in the order of the fields
        for value, mean, std in zip(now[1:], start[1:], (1.0, 1.0, 1.0, _COST_STD), strict=True):
            if value is not None and mean is not None:
                deviations.append(jnp.atleast_1d((value - mean) / std))
        return -0.5 * jnp.sum(jnp.concatenate(deviations) ** 2)


def as_behavior_model(behavior: Behavior | BehaviorModel) -> BehaviorModel:
    """Return a behavior model, or from a behavior one in which nothing is learned.

    Args:
        behavior: Either.
    """
    return behavior if isinstance(behavior, BehaviorModel) else behavior_model(behavior)


def behavior_model(
    behavior: Behavior,
    learn: Sequence[str] = (),
    *,
    discount: float | None = None,
    person: Shaped[ArrayLike, "..."] | Sequence[int] | None = None,
    features: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
    reward_weights: Shaped[ArrayLike, "..."] | Sequence[float] | None = None,
    aimed_at: Shaped[ArrayLike, "..."] | Sequence[Any] | None = None,
) -> BehaviorModel:
    """Return a model of agents that behave as `behavior` describes, except for what is learned.

    Each learned number has a normal prior around its start: log β (of the mean person), the logits of a lapse and of a
    discount with standard deviation 1. The log β of one person differs from that of the mean person with standard
    deviation ½. Where choices say little, the result is the start; two starts show that.

    Args:
        behavior: The known behavior, and the start of a learned β and lapse (.05 if it has no lapse); a lapse of 0
            cannot be the start, because its logit is infinite.
        learn: Names out of `LEARNABLE`.
        discount: The start of a learned discount, between 0 and 1.
        person: The person of each task, 0…persons − 1; with it, each person's β is learned.
        features: φ(s, a) of rewards with learned weights; an axis of length 1 holds for all states or all actions.
        reward_weights: Their start, in units of reward; 0 by default. Their prior has standard deviation 1, so scale
            the features.
        aimed_at: The state that each action aims at; with it, the costs of states are learned.

    Returns:
        The behavior model, with the learned numbers at their start.

    Raises:
        InputError: For a name that is not in `LEARNABLE`, a learned discount or lapse that is not between 0 and 1, a
            discount that is not learned, persons that are not numbered from 0, features or weights that are not finite,
            another number of weights than of features, weights without features, and aims that are not states.

    Example:
        >>> from sidestep.tabular.backups import BoltzmannAverage
        >>> round(float(behavior_model(Behavior(BoltzmannAverage(), 7.0), learn=["beta"]).behavior_of().beta), 3)
        7.0
    """
    check_instance(behavior, Behavior, "behavior")
    for name in to_list(learn, str, "learn", least=0):
        check_choice(name, LEARNABLE, "learn")
    if person is not None:
        own = np.asarray(to_integers(person, "person", ("tasks",), least=0))
        numbered = own.size and np.array_equal(np.unique(own), np.arange(own.max() + 1))
        check(numbered, f"expected persons numbered from 0, each with a task, found {describe(person)}", field="person")
        person = to_jax(own, jnp.int32)
    log_beta = logit_lapse = logit_discount = weights = cost_parameters = None
    if "beta" in learn or person is not None:
        to_finite(behavior.beta, "beta", (), above=0)
        log_beta = jnp.full(1 if person is None else int(np.max(person)) + 1, jnp.log(behavior.beta))
    if "lapse" in learn:
        logit_lapse = _logit_of(_INITIAL_LAPSE if behavior.lapse is None else behavior.lapse, "lapse")
    learns_discount = "discount" in learn
    message = f"expected none unless it is learned (a task has its own), found {discount!r}"
    check(learns_discount or discount is None, message, field="discount")
    if learns_discount:
        logit_discount = _logit_of(to_number(discount, "discount", above=0, below=1), "discount")
    message = "expected none without features, found some"
    check(features is not None or reward_weights is None, message, field="reward_weights")
    if features is not None:
        features = to_jax(to_finite(features, "features", ("states", "actions", "features")), jnp.result_type(float))
        count = features.shape[-1]
        initial = np.zeros(count) if reward_weights is None else to_finite(reward_weights, "reward_weights", (count,))
        weights = to_jax(initial, jnp.result_type(float))
    if aimed_at is not None:
        states = len(np.asarray(aimed_at))
        aims = to_states(aimed_at, states, "aimed_at", (states, "actions"))
        cost_parameters, aimed_at = to_jax(np.full(states, _COST_MEAN)), to_jax(aims, jnp.int32)
    start = BehaviorParameters(log_beta, logit_lapse, logit_discount, weights, cost_parameters)
    return BehaviorModel(behavior, start, start, person, features, aimed_at)


def _logit_of(start: float | Float[Array, ""], field: str) -> Float[Array, ""]:
    """Return the logit of a number between 0 and 1, as JAX holds it: in 32 bits, .99999999 is 1."""
    number = to_jax(start, jnp.result_type(float))
    to_finite(number, field, (), above=0, below=1)
    return logit(number)
