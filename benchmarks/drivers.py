"""What drivers mind, and which links are closed: a road network, its model, and how both are learned from trips.

Drivers pursue known destinations. What they mind of each turn and link (`two_way.FEATURES`) is fitted first, by maximum
likelihood with all links open; then P(closed), with that held. A link that was driven is open; its prior says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import minimize

from sidestep.errors import InputError, NotConverged
from sidestep.inference.fit import Fit, fit
from sidestep.inference.optimizers import LBFGS, Optimizer, Rprop
from sidestep.inference.priors import Normal
from sidestep.io.roads import Roads, demonstrations_from_trips, read_roads, read_trips
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import TiedModel, closed, road_network
from two_way import FEATURES, TwoWay, turn_features, two_way

OPEN, SURELY = -7.0, 0.005
"""The prior of a link that was driven: the mean of its logit, and the variance."""
CLOSED = 3.0
"""The logit of a link that is taken as closed: some twenty tries, longer than most ways round."""
A_TURN = 1e-3
"""Of many trips all is learned when the next step promises less than this for each turn (nats)."""
LEAST = 1e-3
"""The least that a link costs: at no discount, every action must cost something."""
Trip = Int[np.ndarray, " _"]


@dataclass(frozen=True)
class Settings:
    """How closed links are learned; `docs/towns.md` tells what other priors come to.

    - `backup`: a name in `BACKUPS`. `tastes`: whether drivers mind turns, or lengths and the number of links only.
    - `prior_mean`, `prior_variance`: of the logit of each link that was not driven.
    - `iterations`, `tolerance`: those of `LBFGS`.
    - `many`: from so many turns on, the climb is that of large maps: from above, by `Rprop` (see `_climb`).
    """

    backup: str = "boltzmann"
    tastes: bool = True
    prior_mean: float = -4.0
    prior_variance: float = 0.15
    iterations: int = 100
    tolerance: float = 0.05
    many: int = 100_000


class Town(NamedTuple):
    """A network with both directions of every road, its model, and what drivers may mind of each action."""

    network: TwoWay
    model: TiedModel
    features: Float[Array, "links actions features"]

    @property
    def roads(self) -> Roads:
        """The network's links and turns."""
        return self.network.roads

    def demonstrations(self, trips: Sequence[Trip]) -> Demonstrations:
        """Trips as demonstrations."""
        return demonstrations_from_trips(trips, self.model.graph)

    def uses(self, trips: Sequence[Trip]) -> Int[np.ndarray, " links"]:
        """How often trips used each link."""
        return np.bincount(np.concatenate([np.empty(0, int), *trips]), minlength=len(self.roads))

    def paying(self, demos: Demonstrations, weights: Float[Array, " features"]) -> Demonstrations:
        """The demonstrations of drivers who mind features so much; a turn that is not there stays as dear as it is."""
        there = self.features[..., 1] == 1
        reward = jnp.where(there, -(self.features @ weights), -self.model.graph.lengths)
        rewards = jnp.broadcast_to(reward, (len(demos.tasks.terminal), *reward.shape))
        return eqx.tree_at(lambda demos: demos.tasks.reward, demos, rewards)


def read_town(folder: Path) -> tuple[Town, list[Trip]]:
    """The network and all trips; raises `InputError` for files that are none."""
    roads = read_roads(folder / "links.csv", folder / "turns.csv")
    network = two_way(roads)
    model = road_network(network.roads.turns, network.roads.lengths)
    features = turn_features(network.roads, model.graph)
    return Town(network, model, jnp.asarray(features)), read_trips(folder / "trips.csv", roads)


def learn_tastes(town: Town, demos: Demonstrations, people: Behavior, turns: bool) -> Float[Array, " features"]:
    """How much drivers mind each feature, per unit of it over β, as if all links were open; nothing below 0."""
    model = town.model.with_parameters(jnp.full(len(town.roads), -30.0))

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def loss(weights: Array, demos: Demonstrations) -> Array:
        shown = town.paying(demos, weights)
        return -log_likelihood(model, shown, people, terms=("actions",)).actions / len(demos)

    def loss_and_slope(weights: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = loss(jnp.asarray(weights), demos)
        if not jnp.isfinite(value):
            raise NotConverged("the values of drivers with other tastes do not converge: expected another backup")
        return float(value), np.asarray(slope)

    minded = [(LEAST, None)] * 2 + [(0.0, None if turns else 0.0)] * (len(FEATURES) - 2)
    start = np.where([most is None for _, most in minded], 0.5, 0.0)
    return jnp.asarray(minimize(loss_and_slope, start, jac=True, method="L-BFGS-B", bounds=minded).x)


class ModelResult(NamedTuple):
    """What was learned from trips: a model, the weights of `FEATURES` in what drivers pay, and how they behave."""

    found: Fit[TiedModel]
    weights: Float[Array, " features"]
    people: Behavior

    @property
    def closed(self) -> Float[np.ndarray, " links"]:
        """P(closed)."""
        return np.asarray(closed(self.found.model))

    def log_likelihood(self, town: Town, trips: Sequence[Trip]) -> float:
        """That of the turns of some trips, in nats a turn."""
        demos = town.paying(town.demonstrations(trips), self.weights)
        return float(log_likelihood(self.found.model, demos, self.people, terms=("actions",)).actions) / len(demos)


def learn(town: Town, trips: Sequence[Trip], settings: Settings) -> ModelResult:
    """What is learned from trips; raises `InputError` for a backup that is none."""
    if settings.backup not in BACKUPS:
        raise InputError(f"expected one of {', '.join(BACKUPS)}, found {settings.backup!r}", field="backup")
    people = Behavior(BACKUPS[settings.backup](), 1.0)
    demos = town.demonstrations(trips)
    weights = learn_tastes(town, demos, people, settings.tastes)
    driven = jnp.asarray(town.uses(trips) > 0)
    means = jnp.where(driven, OPEN, settings.prior_mean)
    prior = Normal(means, jnp.where(driven, SURELY, settings.prior_variance))
    optimizer, begin = _climb(settings, means, driven, len(demos))
    model = town.model.with_parameters(begin)
    found = fit(model, town.paying(demos, weights), people, prior=prior, optimizer=optimizer)
    return ModelResult(found, weights, people)


def _climb(
    settings: Settings, means: Float[Array, " links"], driven: Bool[Array, " links"], turns: int
) -> tuple[Optimizer, Float[Array, " links"]]:
    """The optimiser, and the logits that it begins with.

    Many trips make cliffs: links that thousands of drivers would take if they were a little more open. L-BFGS crawls
    along them. So all links that were not driven begin as closed, and the prior opens them until drivers would come.
    """
    if turns < settings.many:
        return LBFGS(iterations=settings.iterations, tolerance=settings.tolerance), means
    optimizer = Rprop(iterations=settings.iterations, tolerance=A_TURN * turns)
    return optimizer, jnp.where(driven, means, CLOSED)
