"""The options of the command line; several commands share them."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast, get_type_hints

from typer import Argument, BadParameter, Option

from sidestep.maps.config import (
    NEAR_OPTIMAL,
    SOFT,
    BackupName,
    BehaviorConfig,
    FitConfig,
    MapConfig,
    PosteriorConfig,
    PosteriorMethod,
    PriorConfig,
    PriorKind,
    Terms,
)
from sidestep.tabular.reward import Reward

if TYPE_CHECKING:
    from sidestep.tabular.grid import Connectivity, Grid

_Config = TypeVar("_Config", Reward, BehaviorConfig, FitConfig)

BUMP_COST = 40.0

Folder = Annotated[Path, Option("--out", help="The folder to write to.", metavar="DIR")]
LearnedFolder = Annotated[Path, Argument(help="A folder that `sidestep learn` has written.", metavar="DIR")]
Walks = Annotated[Path, Argument(help="A table of walk, step, x, y, perhaps goal_x, goal_y: CSV, Parquet, minari:ID.")]
MapFile = Annotated[Path, Option("--map", help="ROS map: what is already known.", metavar="MAP.yaml")]
TrueMap = Annotated[Path, Option("--true-map", help="The true map.", metavar="TRUE.yaml")]
Seed = Annotated[int, Option(help="The seed of everything random.", min=0)]
ConnectivityOption = Annotated[Literal["4", "8"], Option(help="Moves: 4 directions, or 8 with diagonals.")]
Backup = Annotated[BackupName, Option(help="The backup by which agents value states.")]
Discount = Annotated[float, Option(help="γ, above 0 and at most 1.")]
StepCost = Annotated[float | None, Option(help="The cost of a cell side; without it the goal pays 1, and γ < 1.")]
BumpCost = Annotated[float, Option(help="The cost of a first bump at a place in cell sides; others cost a fifth.")]


@dataclass(frozen=True)
class LearnOptions:
    """How a map is learned, as options of `learn` and `compare`; the defaults are those of `MapConfig`."""

    backup: Backup = BehaviorConfig.backup
    beta: Annotated[
        float | None,
        Option(
            help=f"The inverse temperature β, in units of one over reward; by default {NEAR_OPTIMAL.beta:g}, but "
            f"{SOFT.beta:g} with the normal prior and with --lapse, --tempering, --learn, --person-column, "
            "--goal-candidates."
        ),
    ] = BehaviorConfig.beta
    lapse: Annotated[
        float | None,
        Option(
            help=f"The probability of a random action; {NEAR_OPTIMAL.lapse:g} where β is {NEAR_OPTIMAL.beta:g} by "
            "default, otherwise none."
        ),
    ] = BehaviorConfig.lapse
    learn: Annotated[
        list[str] | None, Option(help="Learned with the map; repeat it for several.", metavar="beta|lapse|discount")
    ] = None
    person_column: Annotated[str | None, Option(help="The column of each walk's person: each has their own β.")] = None
    goal_candidates: Annotated[
        Path | None,
        Option(help="A table of goal_x, goal_y that walks without goals may have had.", metavar="GOALS.csv"),
    ] = None
    tempering: Annotated[
        float | None,
        Option(
            help="The weight of the actions, above 0 and at most 1, below 1 if they are dependent; "
            f"{NEAR_OPTIMAL.tempering:g} where β is {NEAR_OPTIMAL.beta:g} by default, otherwise 1."
        ),
    ] = BehaviorConfig.tempering
    horizon: Annotated[int | None, Option(help="How many actions agents look ahead, if limited.")] = (
        BehaviorConfig.horizon
    )
    discount: Discount = Reward.discount
    step_cost: StepCost = Reward.step_cost
    prior: Annotated[
        PriorKind | None, Option(help="binary: a cell is blocked or not; normal: the paper's, of logits.")
    ] = None
    posterior: Annotated[
        Literal["sample", "mean-field", "mode"] | None,
        Option(help="Samples of maps, independent cells, or a mode; by default by the prior and the size."),
    ] = None
    sweeps: Annotated[
        int | None,
        Option(help="The sweeps of each chain of samples; by default until they mix, up to a number by the size."),
    ] = None
    log_odds: Annotated[
        float | None,
        Option(
            help="The log-odds of a blocked cell far from others (binary prior); by default sampled.", metavar="NATS"
        ),
    ] = PriorConfig.log_odds
    prior_mean: Annotated[float | None, Option(help="The mean of unknown cells' logits (normal prior).")] = None
    prior_variance: Annotated[float | None, Option(help="The variance of these logits (normal prior).")] = None
    wall_prior: Annotated[
        float | None, Option(help="The worth of a blocked cell between two others (normal prior).", metavar="NATS")
    ] = None
    sensor_map: Annotated[
        Path | None, Option(help="ROS map (mode scale or raw): P(occupied) where sensors looked.", metavar="MAP.yaml")
    ] = None
    sensor_variance: Annotated[str, Option(help="The variance of sensed logits: a number or a .npy file.")] = "0.5"
    connectivity: ConnectivityOption = "4"
    terms: Annotated[Terms, Option(help="The parts of the likelihood that count.")] = FitConfig.terms
    gradient: Annotated[
        Literal["exact", "fixed-policy"], Option(help="exact (L-BFGS), or the paper's approximation (Adam).")
    ] = "exact"
    max_iterations: Annotated[int | None, Option(help="The most iterations of a fit or a mean field.")] = (
        FitConfig.max_iterations
    )
    memory: Annotated[float, Option(help="About how many GiB the fit may take.", metavar="GIB")] = FitConfig.memory
    max_walks: Annotated[int | None, Option(help="Learn from this many walks only, drawn by the seed.")] = None
    unknown_below: Annotated[
        float, Option(help="Cells of which walks say less stay unknown in maps for ROS; 0: none.", metavar="NATS")
    ] = MapConfig.unknown_below
    seed: Seed = MapConfig.seed
    resume: Annotated[bool, Option("--resume", help="Continue an interrupted run.")] = False

    def config(self) -> MapConfig:
        """Return the configuration."""
        learned = tuple(dict.fromkeys(self.learn or ()))
        behavior = self._part(BehaviorConfig, learn=learned)
        prior, posterior = self._prior(), PosteriorConfig(self._method(), self.sweeps)
        fit = self._part(FitConfig, gradient=self.gradient.replace("-", "_"))
        others = {name: getattr(self, name) for name in ("max_walks", "unknown_below", "seed")}
        return MapConfig(self._part(Reward), behavior, prior, posterior, fit, **others)

    def _prior(self) -> PriorConfig:
        """Return the prior; options of the other kind are refused."""
        normal = {"mean": self.prior_mean, "variance": self.prior_variance, "wall_prior": self.wall_prior}
        kind: PriorKind = self.prior or ("normal" if self.posterior == "mode" else PriorConfig.kind)
        options = normal if kind == "normal" else {"log_odds": self.log_odds}
        others = {"log_odds": self.log_odds} if kind == "normal" else normal
        for name, value in others.items():
            flag = f"--{'' if name in ('log_odds', 'wall_prior') else 'prior-'}{name}".replace("_", "-")
            message = f"is an option of the {'binary' if kind == 'normal' else 'normal'} prior: add --prior"
            if value is not None:
                raise BadParameter(f"{message} {'binary' if kind == 'normal' else 'normal'}", param_hint=flag)
        return PriorConfig(kind, **{name: value for name, value in options.items() if value is not None})

    def _method(self) -> PosteriorMethod | None:
        return None if self.posterior is None else cast(PosteriorMethod, self.posterior.replace("-", "_"))

    def _part(self, record: type[_Config], **others: Any) -> _Config:
        """Return a record with the options that have the names of its fields."""
        names = {field.name for field in fields(record)} & vars(self).keys()
        return record(**{name: getattr(self, name) for name in names} | others)

    def grid(self, map_file: Path) -> "Grid":
        """Read the map.

        Args:
            map_file: The YAML file of the map.

        Returns:
            The map, with the connectivity of these options.
        """
        from sidestep.io.maps import read_map

        return read_map(map_file, connectivity=connectivity_of(self.connectivity))

    def more_inputs(self, grid: "Grid", checkpoint: Path) -> dict[str, Any]:
        """Read what sensors saw of the map, and the annotations of the walks, where there are any.

        Args:
            grid: The map.
            checkpoint: The file of the checkpoint.

        Returns:
            The arguments `sensor`, `annotations`, `checkpoint` and `resume` of `learn_map` and `compare_methods`.
        """
        from sidestep.maps.annotations import WalkAnnotations
        from sidestep.maps.goal_candidates import read_goal_candidates
        from sidestep.maps.sensors import read_sensor

        variance = _number_or_file(self.sensor_variance)
        sensor = None if self.sensor_map is None else read_sensor(self.sensor_map, grid, variance)
        candidates = None if self.goal_candidates is None else read_goal_candidates(self.goal_candidates)
        annotations = WalkAnnotations(self.person_column, candidates)
        return {"sensor": sensor, "annotations": annotations, "checkpoint": checkpoint, "resume": self.resume}


def connectivity_of(option: str) -> "Connectivity":
    """Return the connectivity that an option names.

    Args:
        option: "4" or "8".
    """
    return 4 if option == "4" else 8


def position_of(text: str, option: str) -> tuple[float, float]:
    """Return the position that an option names as X,Y.

    Args:
        text: The value of the option.
        option: The name of the option, for the error.

    Raises:
        BadParameter: For a text that is not two numbers with a comma between them.
    """
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise BadParameter(f"expected X,Y in metres, found {text!r}", param_hint=option) from None
    return x, y


def _number_or_file(text: str) -> float | Path:
    try:
        return float(text)
    except ValueError:
        return Path(text)


def with_learn_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `LearnOptions`; it receives them as one record, `options`.

    Args:
        command: A command with a parameter `options`, a `LearnOptions`.

    Returns:
        The same command, with a parameter for each option instead.
    """
    keyword, hints = inspect.Parameter.KEYWORD_ONLY, get_type_hints(LearnOptions, include_extras=True)
    own = [each for each in inspect.signature(command).parameters.values() if each.name != "options"]
    shared = [
        inspect.Parameter(field.name, keyword, default=field.default, annotation=hints[field.name])
        for field in fields(LearnOptions)
    ]
    parameters = [*(each.replace(kind=keyword) for each in own), *shared]

    def run(**values: Any) -> None:
        options = LearnOptions(**{each.name: values.pop(each.name) for each in shared})
        command(options=options, **values)

    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    return run


OLD_SPELLINGS = {
    "--person": "--person-column",
    "--candidates": "--goal-candidates",
    "--lines": "--wall-prior",
    "--sample": "--max-walks",
    "--iterations": "--max-iterations",
    "--truth": "--true-map",
}
"""Options of version 0.1 and their present names; the old ones work for one release."""
_OLD_VALUES = {"sharpness": "beta", "lapses": "lapse"}


def present_spelling(arguments: list[str]) -> list[str]:
    """Return the arguments with every option of version 0.1 under its present name.

    Args:
        arguments: The words of the command line.

    Example:
        >>> present_spelling(["learn", "--behavior", "given", "--lines=2", "--unknown", "lapses"])
        ['learn', '--wall-prior=2', '--learn', 'lapse']
    """
    result, rest = [], list(arguments)
    while rest:
        option, equals, value = rest.pop(0).partition("=")
        if option in ("--behavior", "--unknown") and not equals:
            value = rest.pop(0) if rest else ""
        if option == "--behavior":
            result += [] if value == "given" else [option, value]
        elif option == "--unknown":
            result += ["--learn", _OLD_VALUES.get(value, value)]
        else:
            result.append(OLD_SPELLINGS.get(option, option) + equals + value)
    return result
