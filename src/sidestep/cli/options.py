"""The options of the command line; several commands share them."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from sidestep.maps.config import BackupName, BehaviorConfig, FitConfig, MapConfig, PriorConfig, Terms
from sidestep.tabular.reward import Reward

if TYPE_CHECKING:
    from sidestep.maps.annotations import WalkAnnotations
    from sidestep.maps.sensors import SensorMap
    from sidestep.tabular.grid import Connectivity, Grid

BUMP_COST = 40.0

Folder = Annotated[Path, typer.Option("--out", help="The folder to write to.", metavar="DIR")]
LearnedFolder = Annotated[Path, typer.Argument(help="A folder that `sidestep learn` has written.", metavar="DIR")]
Walks = Annotated[
    Path, typer.Argument(help="A table with walk, step, x, y and optionally goal_x, goal_y: CSV, Parquet, minari:ID.")
]
MapFile = Annotated[Path, typer.Option("--map", help="ROS map: what is already known.", metavar="MAP.yaml")]
TrueMap = Annotated[Path, typer.Option("--true-map", help="The true map.", metavar="TRUE.yaml")]
Seed = Annotated[int, typer.Option(help="The seed of everything random.", min=0)]
ConnectivityOption = Annotated[Literal["4", "8"], typer.Option(help="Moves: 4 directions, or 8 with diagonals.")]
Backup = Annotated[BackupName, typer.Option(help="The backup by which agents value states.")]
Discount = Annotated[float, typer.Option(help="γ, above 0 and at most 1.")]
StepCost = Annotated[
    float | None, typer.Option(help="The cost of a cell side. Without it, the goal pays 1 and γ is below 1.")
]
BumpCost = Annotated[
    float, typer.Option(help="The cost of a robot's first bump at a place, in cell sides; further ones cost a fifth.")
]


@dataclass(frozen=True)
class LearnOptions:
    """How a map is learned, as options of `learn` and `compare`; the defaults are those of `MapConfig`."""

    select_behavior: Annotated[
        bool, typer.Option("--select-behavior", help="Select reward, β, lapses and tempering by cross-validation.")
    ] = BehaviorConfig.select
    backup: Backup = BehaviorConfig.backup
    beta: Annotated[float, typer.Option(help="The inverse temperature β, in units of one over reward.")] = (
        BehaviorConfig.beta
    )
    lapse: Annotated[float | None, typer.Option(help="The probability of a random action; none by default.")] = (
        BehaviorConfig.lapse
    )
    learn: Annotated[
        list[str] | None,
        typer.Option(help="Learned together with the map; repeat it for several.", metavar="beta|lapse|discount"),
    ] = None
    person_column: Annotated[
        str | None, typer.Option(help="The column that names the person of a walk: each has their own β.")
    ] = None
    goal_candidates: Annotated[
        Path | None,
        typer.Option(
            help="For walks that do not name their goals: a table of goal_x, goal_y that they may have had.",
            metavar="GOALS.csv",
        ),
    ] = None
    tempering: Annotated[
        float, typer.Option(help="The weight of the actions, above 0 and at most 1; below 1 if they are dependent.")
    ] = BehaviorConfig.tempering
    horizon: Annotated[int | None, typer.Option(help="The actions that agents look ahead; no limit by default.")] = (
        BehaviorConfig.horizon
    )
    discount: Discount = Reward.discount
    step_cost: StepCost = Reward.step_cost
    prior_mean: Annotated[float, typer.Option(help="The prior mean of an unknown cell's logit (0: P = .5).")] = (
        PriorConfig.mean
    )
    prior_variance: Annotated[float, typer.Option(help="The prior variance of an unknown cell's logit.")] = (
        PriorConfig.variance
    )
    wall_prior: Annotated[
        float, typer.Option(help="The weight of a blocked cell between two others, in nats.", metavar="NATS")
    ] = PriorConfig.wall_prior
    sensor_map: Annotated[
        Path | None,
        typer.Option(help="ROS map (mode scale or raw): P(occupied) where sensors looked.", metavar="MAP.yaml"),
    ] = None
    sensor_variance: Annotated[
        str, typer.Option(help="The variance of a sensed logit: a number, or a .npy file with one a cell.")
    ] = "0.5"
    connectivity: ConnectivityOption = "4"
    terms: Annotated[Terms, typer.Option(help="The parts of the likelihood that count.")] = FitConfig.terms
    gradient: Annotated[
        Literal["exact", "fixed-policy"], typer.Option(help="exact (L-BFGS), or the paper's approximation (Adam).")
    ] = "exact"
    max_iterations: Annotated[int | None, typer.Option(help="The most iterations.")] = FitConfig.max_iterations
    memory: Annotated[float, typer.Option(help="About how many GiB the fit may take.", metavar="GIB")] = (
        FitConfig.memory
    )
    max_walks: Annotated[int | None, typer.Option(help="Learn from this many walks only, drawn by the seed.")] = None
    seed: Seed = MapConfig.seed
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False

    def config(self) -> MapConfig:
        """Return the configuration."""
        return MapConfig(
            reward=Reward(self.discount, self.step_cost),
            behavior=BehaviorConfig(
                backup=self.backup,
                beta=self.beta,
                lapse=self.lapse,
                learn=tuple(dict.fromkeys(self.learn or ())),
                tempering=self.tempering,
                horizon=self.horizon,
                select=self.select_behavior,
            ),
            prior=PriorConfig(self.prior_mean, self.prior_variance, self.wall_prior),
            fit=FitConfig(
                terms=self.terms,
                gradient="exact" if self.gradient == "exact" else "fixed_policy",
                max_iterations=self.max_iterations,
                memory=self.memory,
            ),
            max_walks=self.max_walks,
            seed=self.seed,
        )

    def grid(self, map_file: Path) -> "Grid":
        """Read the map."""
        from sidestep.io.maps import read_map

        return read_map(map_file, connectivity=connectivity_of(self.connectivity))

    def sensor(self, grid: "Grid") -> "SensorMap | None":
        """Read the map of the sensors, if there is one."""
        if self.sensor_map is None:
            return None
        from sidestep.maps.sensors import read_sensor

        return read_sensor(self.sensor_map, grid, _number_or_file(self.sensor_variance))

    def annotations(self) -> "WalkAnnotations":
        """Read the annotations of the walks."""
        from sidestep.maps.annotations import WalkAnnotations
        from sidestep.maps.goal_candidates import read_goal_candidates

        candidates = None if self.goal_candidates is None else read_goal_candidates(self.goal_candidates)
        return WalkAnnotations(self.person_column, candidates)


def connectivity_of(option: str) -> "Connectivity":
    """Return the connectivity that an option names."""
    return 4 if option == "4" else 8


def position_of(text: str, option: str) -> tuple[float, float]:
    """Return the position that an option names as X,Y."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"expected X,Y in metres, found {text!r}", param_hint=option) from None
    return x, y


def _number_or_file(text: str) -> float | Path:
    try:
        return float(text)
    except ValueError:
        return Path(text)


def with_learn_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `LearnOptions`; it receives them as one record, `options`."""
    signature, names = inspect.signature(command), [field.name for field in fields(LearnOptions)]
    hints = get_type_hints(LearnOptions, include_extras=True)
    shared = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
        )
        for field in fields(LearnOptions)
    ]
    own = [parameter for name, parameter in signature.parameters.items() if name != "options"]

    def run(**values: Any) -> None:
        options = LearnOptions(**{name: values.pop(name) for name in names})
        command(options=options, **values)

    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *shared)}
    own = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own]
    run.__signature__ = inspect.Signature([*own, *shared])  # pyright: ignore[reportFunctionMemberAccess]
    return run


OLD_SPELLINGS = {
    "--unknown": "--learn",
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

    Example:
        >>> present_spelling(["learn", "--behavior", "auto", "--lines=2", "--unknown", "lapses"])
        ['learn', '--select-behavior', '--wall-prior=2', '--learn', 'lapse']
    """
    result, rest = [], list(arguments)
    while rest:
        option, equals, value = rest.pop(0).partition("=")
        if option == "--behavior":
            selected = value if equals else rest.pop(0) if rest else ""
            result += {"auto": ["--select-behavior"], "given": []}.get(selected, ["--behavior", selected])
        elif option == "--unknown":
            value = value if equals else rest.pop(0) if rest else ""
            result += ["--learn", _OLD_VALUES.get(value, value)]
        else:
            result.append(OLD_SPELLINGS.get(option, option) + equals + value)
    return result
