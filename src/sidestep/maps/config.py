"""How a map is learned: the records that `learn_map` and the command line take.

`docs/real-people.md` says how the defaults were chosen. This module imports no numerical library, so that the command
line can show the defaults without delay.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, get_args

from sidestep.errors import (
    check,
    check_choice,
    check_count,
    check_instance,
    check_not_negative,
    check_positive,
    describe,
    to_count,
    to_number,
)
from sidestep.tabular.reward import Reward

BackupName = Literal["boltzmann", "max", "logsumexp", "mellowmax"]
Terms = Literal["both", "actions", "transitions"]
GradientName = Literal["exact", "fixed_policy"]
Learnable = Literal["beta", "lapse", "discount"]
PriorKind = Literal["binary", "normal"]
PosteriorMethod = Literal["sample", "mean_field", "mode"]

_BINARY_FIELDS = ("log_odds", "lines", "pairs", "blocks", "isolated")
_NORMAL_FIELDS = ("mean", "variance", "wall_prior")
LOG_ODDS = -2.5
"""η of the binary prior for a mean field, where `PriorConfig.log_odds` is None."""
SHAPE_WEIGHTS = {
    "sample": {"lines": 2.5, "pairs": 0.0, "blocks": -3.0, "isolated": -1.0},
    "mean_field": {"lines": 0.5, "pairs": 1.5, "blocks": -3.0, "isolated": -1.0},
}
"""The default weights of the shape terms by the method: a mean field cannot follow strong ones."""
MAX_SAMPLED = 4_000_000_000
"""The number of unknown cells × cells × goals up to which maps are sampled: values of all cells may follow a change."""


class Agents(NamedTuple):
    """How random the actions of agents are, and how much they count.

    Attributes:
        beta: The inverse temperature β, above 0.
        lapse: The probability of a random action; None for no lapses.
        tempering: κ in (0, 1], the weight of the actions' log-likelihood.

    Example:
        >>> SOFT.beta
        7.0
    """

    beta: float
    lapse: float | None
    tempering: float


NEAR_OPTIMAL = Agents(28.0, 0.05, 0.5)
"""Agents that are near optimal, with lapses; the actions of a walk depend on each other, and so count half."""
SOFT = Agents(7.0, None, 1.0)
"""Agents that are softly random at every step."""


@dataclass(frozen=True)
class BehaviorConfig:
    """How agents choose their actions, and what of it is learned together with the map.

    Attributes:
        backup: The backup by which agents value states, a name in `sidestep.tabular.backups.BACKUPS`.
        beta: The inverse temperature β, above 0, in units of one over reward; None for a default (`agents`).
        lapse: The probability of a random action, at least 0 and below 1; None for the default.
        learn: What is learned together with the map: any of "beta", "lapse", "discount".
        tempering: κ in (0, 1], the weight of the actions' log-likelihood, below 1 where actions are not independent;
            None for the default.
        horizon: The number of actions that agents look ahead; None for no limit.

    Raises:
        InputError: For an unknown backup or parameter, and numbers out of these ranges.

    Example:
        >>> BehaviorConfig(beta=5.0, learn=("lapse",)).backup
        'boltzmann'
    """

    backup: BackupName = "boltzmann"
    beta: float | None = None
    lapse: float | None = None
    learn: tuple[str, ...] = ()
    tempering: float | None = None
    horizon: int | None = None

    def __post_init__(self) -> None:
        check_choice(self.backup, get_args(BackupName), "backup")
        listed = isinstance(self.learn, tuple | list)
        check(listed, f"expected a tuple of names, found {describe(self.learn)}", field="learn")
        for name in self.learn:
            check_choice(name, get_args(Learnable), "learn")
        object.__setattr__(self, "learn", tuple(self.learn))
        if self.beta is not None:
            to_number(self.beta, "beta", above=0)
        if self.lapse is not None:
            to_number(self.lapse, "lapse", least=0, below=1)
        if self.tempering is not None:
            to_number(self.tempering, "tempering", above=0, most=1)
        if self.horizon is not None:
            to_count(self.horizon, "horizon")


@dataclass(frozen=True)
class PriorConfig:
    """The prior over unknown cells.

    Attributes:
        kind: "binary", a cell is blocked or not (`BinaryMRF`); or "normal", the paper's prior of logits of P(blocked).
        log_odds: η of the binary prior, the log-odds of a blocked cell far from others. None is a density that is
            sampled along with the strength of shapes (`hierarchical_mrf`), and `LOG_ODDS` for a mean field.
        lines, pairs, blocks, isolated: Its weights in nats (`BinaryMRF`); None for those of `SHAPE_WEIGHTS`.
        mean: The mean of each logit of the normal prior; 0 stands for P(blocked) = 1/2.
        variance: The variance of each logit, above 0.
        wall_prior: The weight of `WallPrior` in nats, at least 0: the worth of a blocked cell between two others.

    Raises:
        InputError: For an unknown kind, numbers out of these ranges, and numbers of the other kind.

    Example:
        >>> PriorConfig(kind="normal", mean=0.0).variance
        8.0
    """

    kind: PriorKind = "binary"
    log_odds: float | None = None
    lines: float | None = None
    pairs: float | None = None
    blocks: float | None = None
    isolated: float | None = None
    mean: float = -1.5
    variance: float = 8.0
    wall_prior: float = 1.0

    def __post_init__(self) -> None:
        check_choice(self.kind, get_args(PriorKind), "prior")
        for name in ("log_odds", *SHAPE_WEIGHTS["sample"]):
            if getattr(self, name) is not None:
                to_number(getattr(self, name), name)
        to_number(self.mean, "prior mean")
        to_number(self.variance, "prior variance", above=0)
        to_number(self.wall_prior, "wall_prior", least=0)
        others = _NORMAL_FIELDS if self.kind == "binary" else _BINARY_FIELDS
        for name in others:
            unset = getattr(self, name) == getattr(type(self), name)
            message = f"belongs to the other prior: expected none for a {self.kind} prior, found {getattr(self, name)}"
            check(unset, message, field=name)

    @property
    def first_logit(self) -> float:
        """Return the logit of P(blocked) at which a fit starts."""
        if self.kind == "normal":
            return self.mean
        return LOG_ODDS if self.log_odds is None else self.log_odds


@dataclass(frozen=True)
class PosteriorConfig:
    """How the posterior is found.

    Attributes:
        method: "sample" draws maps, "mean_field" treats cells as independent, "mode" maximizes the posterior of the
            normal prior. None is "mode" for the normal prior, and for the binary one "sample" on maps up to
            `MAX_SAMPLED` unknown cells × cells × goals and "mean_field" beyond.
        sweeps: The number of sweeps of each chain, at least 12. None continues chains until they have mixed, up to a
            number by the size of the map.
        chains: The number of chains, at least 2.

    Raises:
        InputError: For values out of these ranges.

    Example:
        >>> PosteriorConfig("sample", sweeps=1000).chains
        2
    """

    method: PosteriorMethod | None = None
    sweeps: int | None = None
    chains: int = 2

    def __post_init__(self) -> None:
        if self.method is not None:
            check_choice(self.method, get_args(PosteriorMethod), "posterior")
        if self.sweeps is not None:
            check_count(self.sweeps, 12, "sweeps")
        check_count(self.chains, 2, "chains")


@dataclass(frozen=True)
class FitConfig:
    """How the posterior is maximized.

    Attributes:
        terms: The parts of the likelihood that count.
        gradient: "exact" (L-BFGS, on large maps Rprop) or the paper's "fixed_policy" (Adam).
        max_iterations: The most iterations of a fit, or sweeps of a mean field, at least 1; None for their own limits.
        memory: About how many GiB the arrays of the fit may take, above 0.
        large_map: The number of cells from which a map counts as large.

    Raises:
        InputError: For a value out of these ranges.

    Example:
        >>> FitConfig(terms="actions").gradient
        'exact'
    """

    terms: Terms = "both"
    gradient: GradientName = "exact"
    max_iterations: int | None = None
    memory: float = 2.0
    large_map: int = 10_000

    def __post_init__(self) -> None:
        check_choice(self.terms, get_args(Terms), "terms")
        check_choice(self.gradient, get_args(GradientName), "gradient")
        if self.max_iterations is not None:
            check_count(self.max_iterations, 1, "max_iterations")
        check_positive(self.memory, "memory")
        check_count(self.large_map, 0, "large_map")


@dataclass(frozen=True)
class MapConfig:
    """How a map is learned from walks.

    Attributes:
        reward: The reward that agents pursue.
        behavior: How agents choose their actions.
        prior: The prior over unknown cells.
        posterior: How their posterior is found.
        fit: How a posterior is maximized.
        max_walks: Learn from this many walks, drawn by `seed`; None for all.
        unknown_below: Cells of which walks say less (nats, at least 0) stay unknown in maps for ROS; 0 for none.
        seed: The seed of everything random.

    Example:
        >>> config = MapConfig(reward=Reward(discount=1.0, step_cost=1.0), behavior=BehaviorConfig(beta=0.5))
        >>> config.prior.kind, config.agents.lapse, MapConfig().agents.lapse
        ('binary', None, 0.05)

    Raises:
        InputError: For a method that does not go with the prior, parts of other types, and numbers out of these ranges.
    """

    reward: Reward = field(default_factory=Reward)
    behavior: BehaviorConfig = field(default_factory=BehaviorConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    posterior: PosteriorConfig = field(default_factory=PosteriorConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    max_walks: int | None = None
    unknown_below: float = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        kinds = {"reward": Reward, "behavior": BehaviorConfig, "prior": PriorConfig}
        for name, kind in (kinds | {"posterior": PosteriorConfig, "fit": FitConfig}).items():
            check_instance(getattr(self, name), kind, name)
        if self.max_walks is not None:
            check_count(self.max_walks, 1, "max_walks")
        check_count(self.seed, 0, "seed")
        check_not_negative(self.unknown_below, "unknown_below")
        method, kind = self.posterior.method, self.prior.kind
        expected = "mode" if kind == "normal" else "sample or mean_field"
        fits = method is None or (method == "mode") == (kind == "normal")
        check(fits, f"expected {expected} with the {kind} prior, found {method}", field="posterior")

    @property
    def agents(self) -> Agents:
        """Return β, the lapse and κ with their defaults.

        With the binary prior these are `NEAR_OPTIMAL` if none of the three is set and nothing of the behavior is
        learned. Otherwise `SOFT` has what is not set.
        """
        chosen = {name: value for name in Agents._fields if (value := getattr(self.behavior, name)) is not None}
        near_optimal = self.prior.kind == "binary" and not chosen and not self.behavior.learn
        return NEAR_OPTIMAL if near_optimal else SOFT._replace(**chosen)

    def completed(self) -> "MapConfig":
        """Return the configuration with the numbers of its agents in place of defaults."""
        return replace(self, behavior=replace(self.behavior, **self.agents._asdict()))


@dataclass(frozen=True)
class SimulationConfig:
    """How agents walk on a known map.

    Attributes:
        walks: The number of walks.
        goals: The number of different goals, which the walks have in turn.
        beta: The inverse temperature β; None for optimal agents that break ties at random.
        backup: The backup by which agents value states.
        reward: The reward that they pursue.
        seed: Draws goals, starts and choices.

    Raises:
        InputError: For numbers below 1 or an unknown backup.
    """

    walks: int = 100
    goals: int = 4
    beta: float | None = None
    backup: BackupName = "boltzmann"
    reward: Reward = field(default_factory=Reward)
    seed: int = 0

    def __post_init__(self) -> None:
        check_count(self.walks, 1, "walks")
        check_count(self.goals, 1, "goals")
        check_choice(self.backup, get_args(BackupName), "backup")
        check_instance(self.reward, Reward, "reward")
        check_count(self.seed, 0, "seed")
        if self.beta is not None:
            check_positive(self.beta, "beta")
