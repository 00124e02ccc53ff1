"""The command line: it parses, calls `sidestep.commands` and `sidestep.experiments`, and has `terminal` print."""

import os
import traceback
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import typer

from sidestep.cli.compare import compare
from sidestep.cli.display import console, errors, fitting, print_scores, print_table, stages, working
from sidestep.cli.evaluate import evaluate_map
from sidestep.cli.learn import learn
from sidestep.cli.plan import plan_path
from sidestep.cli.simulate import Walkers, simulate_walks
from sidestep.errors import SidestepError
from sidestep.experiments import motivation, pendulum, representations, room
from sidestep.experiments.demo import demo
from sidestep.experiments.reproduce import reproduce
from sidestep.maps.annotations import WalkAnnotations
from sidestep.maps.config import Settings, Terms, most_iterations
from sidestep.maps.sensors import Sensor
from sidestep.robots.robot import BUMP_COST

app = typer.Typer(
    help="Learn the obstacles that nobody touched from the walks of people who knew them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

BackupName = Literal["boltzmann", "max", "logsumexp", "mellowmax"]
EXPERIMENTS = {
    "room": room.run,
    "pendulum": pendulum.run,
    "representations": representations.run,
    "motivation": motivation.run,
}
Folder = Annotated[Path, typer.Option("--out", help="The folder to write to.", metavar="DIR")]
Seed = Annotated[int, typer.Option(help="Draws everything that is random.", min=0)]
Connected = Annotated[Literal["4", "8"], typer.Option(help="Moves: 4 directions, or 8 with diagonals.")]
Backup = Annotated[BackupName, typer.Option(help="How walkers value a state by its actions.")]
Beta = Annotated[float, typer.Option(help="How sharply walkers choose, in units of one over reward.")]
Discount = Annotated[float, typer.Option(help="γ, above 0 and at most 1.")]
Behaving = Annotated[
    Literal["given", "auto"],
    typer.Option(help="auto: reward, β, lapses and how much actions count, chosen by parts of the walks in turn."),
]
BumpCost = Annotated[
    float,
    typer.Option(help="What the first bump at a place costs a robot, in cell sides; further ones, a fifth."),
]
StepCost = Annotated[
    float | None,
    typer.Option(help="Cost of a cell side. Without it, the goal pays 1 and γ < 1 makes haste worthwhile."),
]


@app.command(name="demo", epilog="Example: sidestep demo --out demo")
def demo_command(out: Folder = Path("sidestep-demo"), seed: Seed = 0) -> None:
    """An office nobody mapped: simulate walkers, forget the map, learn it, plan to new goals, draw it all."""
    with working("simulating, learning, planning") as say:
        summary = demo(out, seed, report=say)
    print_scores({"learned map": summary["scores"]})
    console.print(f"pictures and numbers in {out}")


@app.command(name="reproduce", epilog="Example: sidestep reproduce --out figures")
def reproduce_command(out: Folder = Path("sidestep-reproduce"), seed: Seed = 0) -> None:
    """The paper's figures 1-4 as PNG, and the numbers behind them."""
    with working("starting") as say:
        summary = reproduce(out, seed, report=say)
    rows = {
        f"{name} {variant}": scores
        for name, variants in summary["maps"].items()
        for variant, scores in variants.items()
    }
    print_scores(rows)
    console.print(f"figures and numbers in {out}")


@app.command(name="experiment", epilog="Example: sidestep experiment room --out room")
def experiment_command(
    name: Annotated[
        Literal["room", "pendulum", "representations", "motivation"],
        typer.Argument(
            help="A wall nobody touches; gravity from actions alone; three ways to say where walls are; "
            "costs of places against a model of moves, when the reward changes."
        ),
    ],
    out: Annotated[Path | None, typer.Option("--out", help="The folder to write to.", metavar="DIR")] = None,
    seed: Seed = 0,
) -> None:
    """Experiments beyond the paper's figures: a picture and summary.json."""
    out = out or Path(f"sidestep-{name}")
    with working("starting") as say:
        summary = EXPERIMENTS[name](out, seed, say)
    for key, value in summary.items():
        if isinstance(value, int | float | str) and key != "command":
            console.print(f"{key.replace('_', ' ')}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}")
    console.print(f"picture and numbers in {out}")


@app.command(name="learn", epilog="Example: sidestep learn walks.csv --map office.yaml --out learned")
def learn_command(
    walks: Annotated[
        Path,
        typer.Argument(help="A table with walk, step, x, y and optionally goal_x, goal_y: CSV, Parquet, minari:ID."),
    ],
    map_file: Annotated[Path, typer.Option("--map", help="ROS map: what is already known.", metavar="MAP.yaml")],
    out: Folder,
    behavior: Behaving = "given",
    backup: Backup = Settings.backup,  # pyright: ignore[reportArgumentType]
    beta: Beta = Settings.beta,
    lapse: Annotated[float | None, typer.Option(help="The share of actions at random; none by default.")] = None,
    unknown: Annotated[
        list[str] | None,
        typer.Option(help="Learned of walkers with the map: sharpness, lapses, discount; repeat it for several."),
    ] = None,
    person: Annotated[
        str | None,
        typer.Option(help="The column that names who walked: each has a β of their own.", metavar="COLUMN"),
    ] = None,
    candidates: Annotated[
        Path | None,
        typer.Option(
            help="Where walks do not name their goals: a table of goal_x, goal_y that they may have had.",
            metavar="GOALS.csv",
        ),
    ] = None,
    tempering: Annotated[
        float,
        typer.Option(help="How much actions count, above 0 and at most 1; below 1 where steps are not independent."),
    ] = Settings.tempering,
    discount: Discount = Settings.discount,
    step_cost: StepCost = Settings.step_cost,
    prior_mean: Annotated[
        float, typer.Option(help="Prior mean of an unknown cell's logit (0: P = .5).")
    ] = Settings.prior_mean,
    prior_variance: Annotated[
        float, typer.Option(help="Prior variance of an unknown cell's logit.")
    ] = Settings.prior_variance,
    lines: Annotated[
        float, typer.Option(help="What it is worth to a blocked cell to lie between two others, in nats.")
    ] = Settings.lines,
    sensor_map: Annotated[
        Path | None,
        typer.Option(help="ROS map (mode scale or raw): P(occupied) where sensors looked.", metavar="MAP.yaml"),
    ] = None,
    sensor_variance: Annotated[
        str,
        typer.Option(help="Variance of sensed cells' logits: a number or a .npy file.", metavar="V|FILE.npy"),
    ] = "0.5",
    connectivity: Connected = "4",
    terms: Annotated[Terms, typer.Option(help="Which parts of the likelihood count.")] = Settings.terms,
    gradient: Annotated[
        Literal["exact", "fixed-policy"],
        typer.Option(help="exact (L-BFGS), or the paper's approximation (ascent)."),
    ] = "exact",
    horizon: Annotated[
        int | None, typer.Option(help="How many moves walkers look ahead; all of them by default.")
    ] = None,
    iterations: Annotated[int | None, typer.Option(help="At most this many.")] = None,
    memory: Annotated[
        float, typer.Option(help="About how many GiB the fit may take; goals are solved in batches.", metavar="GIB")
    ] = Settings.memory,
    sample: Annotated[int | None, typer.Option(help="Learn from this many walks only, drawn by the seed.")] = None,
    seed: Seed = Settings.seed,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where an interrupted run stopped.")] = False,
) -> None:
    """A learned map from a table of walks: map.yaml, map.pgm, blocked.npy, summary.json, learned.png."""
    settings = Settings(
        backup=backup,
        beta=beta,
        lapse=lapse,
        unknown=tuple(unknown or ()),
        tempering=tempering,
        discount=discount,
        step_cost=step_cost,
        prior_mean=prior_mean,
        prior_variance=prior_variance,
        lines=lines,
        connectivity=4 if connectivity == "4" else 8,
        terms=terms,
        gradient="exact" if gradient == "exact" else "fixed_policy",
        horizon=horizon,
        iterations=iterations,
        memory=memory,
        sample=sample,
        seed=seed,
    )
    sensor = None if sensor_map is None else Sensor(sensor_map, _number_or_file(sensor_variance))
    with fitting(most_iterations(settings)) as (report, say):
        choosing = say if behavior == "auto" else None
        summary = learn(
            walks, map_file, out, settings, report, resume, sensor, choosing, WalkAnnotations(person, candidates)
        )
    data = summary["data"]
    console.print(
        f"{data['walks']} walks, {data['moves']} moves, {data['goals']} goals, {data['unknown_cells']} unknown cells"
    )
    if data["walks_left_out"] or data["moves_left_out"]:
        console.print(
            f"left out: {data['walks_left_out']} walks that start at their goal, and {data['moves_left_out']} moves of "
            "walks that had arrived"
        )
    _print_reasons(summary)
    for note in summary["notes"]:
        errors.print(f"note: {note}", soft_wrap=True)
    console.print(
        f"objective {summary['objective']:.4f} after {summary['iterations']} iterations; {summary['message']}"
    )
    if not summary["converged"]:
        errors.print("warning: the fit has not converged; more --iterations may help")
    console.print(f"learned map in {out}")


@app.command(name="plan", epilog="Example: sidestep plan learned --start 0.5,0.5 --goal 3.5,6.5")
def plan_command(
    folder: Annotated[Path, typer.Argument(help="A folder that `sidestep learn` has written.", metavar="DIR")],
    start: Annotated[str, typer.Option(help="Metres.", metavar="X,Y")],
    goal: Annotated[str, typer.Option(help="Metres.", metavar="X,Y")],
    out: Annotated[Path | None, typer.Option("--out", help="The folder to write to (DIR/plan).", metavar="DIR")] = None,
    bump_cost: BumpCost = BUMP_COST,
) -> None:
    """A path in a learned map, as CSV and PNG."""
    out = out or folder / "plan"
    summary = plan_path(folder, _position(start, "--start"), _position(goal, "--goal"), out, bump_cost)
    console.print(
        f"{summary['moves']} moves, {summary['length_metres']:g} m; the likeliest obstacle on the way has "
        f"P(blocked) = {summary['max_probability_blocked']:.3f}"
    )
    console.print(f"path in {out}")


@app.command(name="evaluate", epilog="Example: sidestep evaluate learned --truth office.yaml")
def evaluate_command(
    folder: Annotated[Path, typer.Argument(help="A folder that `sidestep learn` has written.", metavar="DIR")],
    truth: Annotated[Path, typer.Option(help="The true map.", metavar="TRUE.yaml")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Where to write summary.json (added to DIR's own by default).", metavar="DIR"),
    ] = None,
    seed: Seed = 0,
    bump_cost: BumpCost = BUMP_COST,
) -> None:
    """AUC, average precision, recall, and how legal and how long the planned paths are."""
    with stages() as report:
        scores = evaluate_map(folder, truth, out, seed, report, bump_cost)
    print_scores({str(folder): scores})


@app.command(
    name="compare", epilog="Example: sidestep compare walks.csv --map blank.yaml --truth office.yaml --out compared"
)
def compare_command(
    walks: Annotated[Path, typer.Argument(help="CSV, Parquet or minari:ID, as for `sidestep learn`.")],
    map_file: Annotated[Path, typer.Option("--map", help="ROS map: what is already known.", metavar="MAP.yaml")],
    truth: Annotated[Path, typer.Option(help="The true map.", metavar="TRUE.yaml")],
    out: Folder,
    behavior: Behaving = "given",
    backup: Backup = Settings.backup,  # pyright: ignore[reportArgumentType]
    beta: Beta = Settings.beta,
    discount: Discount = Settings.discount,
    step_cost: StepCost = Settings.step_cost,
    connectivity: Connected = "4",
    hold_out: Annotated[float, typer.Option(help="The share of walks that are scored and not learned from.")] = 0.2,
    seed: Seed = Settings.seed,
) -> None:
    """Behavior-aware modeling beside its rivals: compare.png, summary.json."""
    settings = Settings(
        backup=backup,
        beta=beta,
        discount=discount,
        step_cost=step_cost,
        connectivity=4 if connectivity == "4" else 8,
        seed=seed,
    )
    with working("starting") as say:
        summary = compare(walks, map_file, truth, out, settings, hold_out, say, auto=behavior == "auto")
    columns = {
        "auc": "AUC",
        "average_precision": "average\nprecision",
        "average_precision_relevant": "of those\nthat matter",
        "legal_fraction": "legal\npaths",
        "regret": "regret",
        "arriving_fraction": "arrive",
        "heldout_log_likelihood": "held-out\nnats a move",
        "seconds": "seconds",
    }
    _print_reasons(summary)
    print_table(summary["methods"], columns)
    for name, scores in summary["methods"].items():
        if "failed" in scores:
            errors.print(f"note: nothing by {name}: {scores['failed']}", markup=False, soft_wrap=True)
        elif not scores["converged"]:
            errors.print(f"note: {name} did not converge; its scores are those of where it stopped", soft_wrap=True)
    console.print(f"picture and numbers in {out}")


@app.command(name="simulate", epilog="Example: sidestep simulate office.yaml --out walks.csv --walks 200 --goals 6")
def simulate_command(
    map_file: Annotated[Path, typer.Argument(help="The map that walkers know.", metavar="MAP.yaml")],
    out: Annotated[Path, typer.Option("--out", help="CSV or Parquet.", metavar="WALKS.csv")],
    walks: Annotated[int, typer.Option(help="How many.")] = Walkers.walks,
    goals: Annotated[int, typer.Option(help="How many different goals they have.")] = Walkers.goals,
    beta: Annotated[
        float | None, typer.Option(help="How sharply they choose; without it, optimally with ties at random.")
    ] = Walkers.beta,
    backup: Backup = Walkers.backup,  # pyright: ignore[reportArgumentType]
    discount: Discount = Walkers.discount,
    step_cost: StepCost = Walkers.step_cost,
    connectivity: Connected = "4",
    seed: Seed = Walkers.seed,
) -> None:
    """Walkers on a known map."""
    four_or_eight = 4 if connectivity == "4" else 8
    walkers = Walkers(walks, goals, beta, backup, discount, step_cost, four_or_eight, seed)
    with working("walking"):
        summary = simulate_walks(map_file, out, walkers)
    console.print(f"{walks} walks, {summary['moves']} moves, in {out}")


def _print_reasons(summary: dict[str, Any]) -> None:
    """Why people are taken to behave as they are, if that was chosen."""
    for reason in summary["behavior"].get("reasons", ()):
        console.print(reason, soft_wrap=True)


_INTERRUPTED = 130
"""What typer makes of a keyboard interrupt."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code: 0, 1 for an error, 2 for wrong usage."""
    jax.config.update("jax_enable_x64", True)
    try:
        app(args=arguments, prog_name="sidestep", standalone_mode=True)
    except SystemExit as stop:
        if stop.code != _INTERRUPTED:
            return stop.code if isinstance(stop.code, int) else 1
        errors.print("interrupted (a fit goes on from its last checkpoint with `sidestep learn … --resume`)")
    except SidestepError as error:
        errors.print(f"error: {error}", markup=False, soft_wrap=True)
    except Exception as error:
        # a defect of ours: say so in a line, with the details for those who ask
        if os.environ.get("SIDESTEP_DEBUG"):
            traceback.print_exc()
        errors.print(
            f"error: sidestep failed ({type(error).__name__}: {error}); set SIDESTEP_DEBUG=1 for details to report",
            markup=False,
            soft_wrap=True,
        )
    return 1


def _position(text: str, option: str) -> tuple[float, float]:
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
