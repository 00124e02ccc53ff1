"""People of whom not everything is known: what is learned of them beside the transition model.

Between the tasks that people pursue and what they do stand some numbers that nobody has written down:

    sharpness   β_p = exp b_p                            of all people alike, or of each person p
    lapses      ε = σ(e)                                 the share of actions at random (see `Behavior`)
    discount    γ = σ(g)                                 of all tasks
    tastes      R(s, a) + Σ_f w_f φ_f(s, a)              what they like or dislike on the way, by features φ
    costs       R(s, a) − ln(1 + exp k_c(s, a))          what it costs to aim at place c(s, a), whatever the goal

Each may be held to be known or be learned with θ, from the likelihood of the actions. What is learned has a normal
prior around where it starts: the typical b and g, and e, with standard deviation 1, the w with standard deviation
`taste_spread`, and the k with 2, around −4: a cost of .02, give or take a factor of seven. One person's b differs from
the typical one with standard deviation ½; so people are pooled, and who is seen little is taken to be like the others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logit
from jaxtyping import Array, Float, Int

from sidestep.errors import InputError
from sidestep.tabular.backups import Behavior
from sidestep.tabular.tasks import Task, with_state_costs

LEARNABLE = ("sharpness", "lapses", "discount")
"""What may be learned of people, beside tastes."""

_PERSONS_DIFFER = 0.5
"""The standard deviation of one person's log β around that of all."""
_A_FEW_LAPSES = 0.05
"""The share of lapses to start from where they are learned and none are given."""
_COST, _COSTS_DIFFER = -4.0, 2.0
"""The mean and the standard deviation of the k."""


class BehaviorParameters(NamedTuple):
    """The numbers that are learned; None for what is known.

    - `sharpness`: b of every person; one number where people are alike. `lapses`: e. `discount`: g. `tastes`: w.
    - `costs`: k of every place.
    """

    sharpness: Float[Array, " persons"] | None = None
    lapses: Float[Array, ""] | None = None
    discount: Float[Array, ""] | None = None
    tastes: Float[Array, " features"] | None = None
    costs: Float[Array, " states"] | None = None


class BehaviorModel(eqx.Module):
    """How people behave, what is known of them and what is to be learned.

    - `behavior`: what is known, and where sharpness and lapses start from. `discount`: likewise.
    - `parameters`: what is learned.
    - `person`: whose each task is, where people differ (see `split_by_person` in `sidestep.tabular.demonstrations`).
    - `features`: φ(s, a); an axis of length 1 holds for all states or all actions.
    - `aimed_at`: c(s, a), where places may cost something.
    """

    behavior: Behavior
    parameters: BehaviorParameters
    start: BehaviorParameters
    person: Int[Array, " tasks"] | None
    features: Float[Array, "#states #actions features"] | None
    aimed_at: Int[Array, "states actions"] | None
    taste_spread: float = eqx.field(static=True)

    def with_parameters(self, parameters: BehaviorParameters) -> "BehaviorModel":
        """The same people with other traits."""
        return eqx.tree_at(lambda people: people.parameters, self, parameters, is_leaf=lambda leaf: leaf is None)

    @property
    def costs(self) -> Float[Array, " states"] | None:
        """What it costs to aim at each place, in units of reward; None where nothing does."""
        return None if self.parameters.costs is None else jax.nn.softplus(self.parameters.costs)

    def behavior_of(self, person: Int[Array, ""] | int | None = None) -> Behavior:
        """How one person behaves; without a person, a typical one: the mean of log β."""
        sharpness, lapses = self.parameters.sharpness, self.parameters.lapses
        beta, lapse = self.behavior.beta, self.behavior.lapse
        if sharpness is not None:
            beta = jnp.exp(sharpness.mean() if person is None else sharpness[person])
        if lapses is not None:
            lapse = jax.nn.sigmoid(lapses)
        return Behavior(self.behavior.backup, beta, lapse)

    def tasks_of(self, tasks: Task) -> Task:
        """What people pursue, one task or a stack, with their discount, their tastes and their costs."""
        if self.costs is not None and self.aimed_at is not None:
            tasks = with_state_costs(tasks, self.costs, self.aimed_at)
        reward, discount = tasks.reward, tasks.discount
        if self.parameters.tastes is not None and self.features is not None:
            reward = reward + self.features @ self.parameters.tastes
        if self.parameters.discount is not None:
            discount = jnp.broadcast_to(jax.nn.sigmoid(self.parameters.discount), discount.shape)
        return Task(reward, tasks.terminal_reward, tasks.terminal, discount)

    def log_density(self) -> Float[Array, ""]:
        """The logarithm of the prior density of the traits, in nats, without the constant."""
        deviations = [jnp.zeros(1)]
        now, start = self.parameters, self.start
        if now.sharpness is not None and start.sharpness is not None:
            typical = now.sharpness.mean()
            deviations += [(typical - start.sharpness.mean())[None], (now.sharpness - typical) / _PERSONS_DIFFER]
        if now.lapses is not None and start.lapses is not None:
            deviations.append((now.lapses - start.lapses)[None])
        if now.discount is not None and start.discount is not None:
            deviations.append((now.discount - start.discount)[None])
        if now.tastes is not None and start.tastes is not None:
            deviations.append((now.tastes - start.tastes) / self.taste_spread)
        if now.costs is not None and start.costs is not None:
            deviations.append((now.costs - start.costs) / _COSTS_DIFFER)
        return -0.5 * jnp.sum(jnp.concatenate(deviations) ** 2)


def behavior_model(
    behavior: Behavior,
    learned: Sequence[str] = (),
    *,
    discount: float | None = None,
    person: Int[np.ndarray, " tasks"] | None = None,
    features: Float[np.ndarray, "#states #actions features"] | None = None,
    tastes: Float[np.ndarray, " features"] | None = None,
    taste_spread: float = 1.0,
    aimed_at: Int[np.ndarray, "states actions"] | None = None,
) -> BehaviorModel:
    """People who behave as `behavior` says, but for what is to be learned of them.

    - `learned`: those of `LEARNABLE` that are learned, from where `behavior` and `discount` have them (lapses from a
      share
      of .05 if it has none).
    - `person`: whose each task is, 0…persons − 1; then each has a sharpness of their own.
    - `features`: what people may like or dislike; `tastes` are the weights to start from, 0 by default, in units of
      reward for a feature of 1, and `taste_spread` is by how much they may differ from that.
    - `aimed_at`: the state that each action aims at, if it costs something to aim at states and that is to be learned.

    Raises `InputError` for a trait that there is not, a discount that is to be learned and not between 0 and 1, persons
    who are not numbered from 0, features that are not finite, as many tastes as there are not features, and aims that
    are not states.

    >>> from sidestep.tabular.backups import BoltzmannAverage
    >>> float(behavior_model(Behavior(BoltzmannAverage(), 7.0), ["sharpness"]).behavior_of().beta)
    7.0
    """
    unknown = [trait for trait in learned if trait not in LEARNABLE]
    if unknown:
        raise InputError(f"expected some of {LEARNABLE}, found {unknown[0]!r}", field="learned")
    if person is not None and not np.array_equal(np.unique(person), np.arange(np.max(person) + 1)):
        raise InputError("expected persons numbered from 0, each with a task", field="person")
    start = BehaviorParameters(
        sharpness=_sharpness(behavior, person) if "sharpness" in learned or person is not None else None,
        lapses=logit(jnp.asarray(_A_FEW_LAPSES if behavior.lapse is None else behavior.lapse))
        if "lapses" in learned
        else None,
        discount=_logit_of(discount) if "discount" in learned else None,
        tastes=None if features is None else _tastes(features, tastes),
        costs=None if aimed_at is None else _costs(aimed_at),
    )
    whose = None if person is None else jnp.asarray(person, jnp.int32)
    given = None if features is None else jnp.asarray(features, jnp.result_type(float))
    aims = None if aimed_at is None else jnp.asarray(aimed_at, jnp.int32)
    return BehaviorModel(behavior, start, start, whose, given, aims, taste_spread)


def _sharpness(behavior: Behavior, person: Int[np.ndarray, " tasks"] | None) -> Float[Array, " persons"]:
    return jnp.full(1 if person is None else int(np.max(person)) + 1, jnp.log(behavior.beta))


def _logit_of(discount: float | None) -> Float[Array, ""]:
    if discount is None or not 0 < discount < 1:
        raise InputError(f"to be learned, it must start between 0 and 1: found {discount}", field="discount")
    return logit(jnp.asarray(discount, jnp.result_type(float)))


def _tastes(
    features: Float[np.ndarray, "#states #actions features"], tastes: Float[np.ndarray, " features"] | None
) -> Float[Array, " features"]:
    if features.ndim != 3 or not np.isfinite(features).all():
        raise InputError("expected finite numbers of shape (states, actions, features)", field="features")
    weights = np.zeros(features.shape[-1]) if tastes is None else np.asarray(tastes)
    if weights.shape != features.shape[-1:] or not np.isfinite(weights).all():
        raise InputError(f"expected {features.shape[-1]} finite numbers, found {weights}", field="tastes")
    return jnp.asarray(weights, jnp.result_type(float))


def _costs(aimed_at: Int[np.ndarray, "states actions"]) -> Float[Array, " states"]:
    if aimed_at.min() < 0 or aimed_at.max() >= len(aimed_at):
        raise InputError(f"expected states 0…{len(aimed_at) - 1}", field="aimed_at")
    return jnp.full(len(aimed_at), _COST, jnp.result_type(float))
