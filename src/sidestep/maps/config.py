"""How a map is learned: the records that `learn_map` and the command line take.

`docs/real-people.md` says how the defaults were chosen. This module imports no numerical library, so that the command
line can show the defaults without delay.
"""

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from sidestep.errors import check, check_count, check_positive
from sidestep.tabular.reward import Reward

BackupName = Literal["boltzmann", "max", "logsumexp", "mellowmax"]
Terms = Literal["both", "actions", "transitions"]
GradientName = Literal["exact", "fixed_policy"]
Learnable = Literal["beta", "lapse", "discount"]


@dataclass(frozen=True)
class BehaviorConfig:
    """How agents choose their actions, and what of it is learned together with the map.

    Attributes:
        backup: The backup by which agents value states, a name in `sidestep.tabular.backups.BACKUPS`.
        beta: The inverse temperature β, above 0, in units of one over reward.
        lapse: The probability of a random action, at least 0 and below 1; None for no lapses.
        learn: What is learned together with the map: any of "beta", "lapse", "discount".
        tempering: κ in (0, 1], the weight of the actions' log-likelihood; below 1 where actions are not independent.
        horizon: The number of actions that agents look ahead; None for no limit.
        select: Choose the reward, β, and κ by cross-validation before learning; lapses are then learned.

    Raises:
        InputError: For an unknown backup or parameter.

    Example:
        >>> BehaviorConfig(beta=5.0, learn=("lapse",)).backup
        'boltzmann'
    """

    backup: BackupName = "boltzmann"
    beta: float = 7.0
    lapse: float | None = None
    learn: tuple[str, ...] = ()
    tempering: float = 1.0
    horizon: int | None = None
    select: bool = False

    def __post_init__(self) -> None:
        _check_choice(self.backup, BackupName, "backup")
        for name in self.learn:
            _check_choice(name, Learnable, "learn")


@dataclass(frozen=True)
class PriorConfig:
    """The prior over the logits of P(blocked) of unknown cells.

    Attributes:
        mean: The mean of each logit; 0 stands for P(blocked) = 1/2.
        variance: The variance of each logit, above 0.
        wall_prior: The weight of `WallPrior` in nats, at least 0: the worth of a blocked cell between two others.

    Example:
        >>> PriorConfig(mean=0.0).variance
        8.0
    """

    mean: float = -1.5
    variance: float = 8.0
    wall_prior: float = 1.0


@dataclass(frozen=True)
class FitConfig:
    """How the posterior is maximized.

    Attributes:
        terms: The parts of the likelihood that count.
        gradient: "exact" (L-BFGS, on large maps Rprop) or the paper's "fixed_policy" (Adam).
        max_iterations: The most iterations, at least 1; None for the optimizer's own limit.
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
        _check_choice(self.terms, Terms, "terms")
        _check_choice(self.gradient, GradientName, "gradient")
        if self.max_iterations is not None:
            check_count(self.max_iterations, 1, "max_iterations")
        check_positive(self.memory, "memory")


@dataclass(frozen=True)
class MapConfig:
    """How a map is learned from walks.

    Attributes:
        reward: The reward that agents pursue.
        behavior: How agents choose their actions.
        prior: The prior over unknown cells.
        fit: How the posterior is maximized.
        max_walks: Learn from this many walks, drawn by `seed`; None for all.
        seed: The seed of everything random.

    Example:
        >>> config = MapConfig(reward=Reward(discount=1.0, step_cost=1.0), behavior=BehaviorConfig(beta=0.5))
        >>> config.prior.mean
        -1.5
    """

    reward: Reward = field(default_factory=Reward)
    behavior: BehaviorConfig = field(default_factory=BehaviorConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    max_walks: int | None = None
    seed: int = 0


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
        _check_choice(self.backup, BackupName, "backup")


def _check_choice(value: str, choices: Any, field: str) -> None:
    check(value in get_args(choices), f"expected one of {', '.join(get_args(choices))}, found {value!r}", field=field)
