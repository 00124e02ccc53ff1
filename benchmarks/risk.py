"""Whether plans with risk mean what they say: P(path is open) in simulated offices, beside their true maps.

    python -m benchmarks risk --json risk.json --picture risk.png
    python -m benchmarks risk --offices 40 --first 100 --max-risk .1 --set sweeps=1000

Offices are drawn by seed (`sidestep.worlds`). Agents walk from random cells to a few goals on best paths, ties at
random. The learner knows no cell; a map is learned with the defaults of `sidestep learn`. In each map, paths are
planned as by `sidestep plan` between random pairs of free cells that are connected in truth, most of which no walk
begins or ends at: by the default robot, and with `--max-risk`. A path is open if all its moves are legal in the true
map; then the robot arrives without a bump.

The reliability error of P(open) is the expected calibration error of `sidestep.evaluation.reliability`, over the plans
of all offices together. The standard error of the fraction of open paths is that over offices, as plans in the same
office are not independent. Plans of which P(open) is too low for `--max-risk` come with a warning; they are counted on
their own. Plans are *not sure* where P(open) is below 1, as they need cells that no walk passed. Chains that have not
mixed are counted too; `learn` warns of these.

Constants of planning were chosen with the seeds 100 to 199, so none of these are judged here.

Records: `draw` (the seed of the office), `mixed`, `seconds` (of learning), `start` and `goal` (states), `walked`
(whether walks passed both), `max_risk` (None for the default robot), `open_probability` (as said), `met` (whether it is
high enough for `max_risk`; None without one), `open` (in truth), `length` and `shortest` (metres; the shortest path in
the true map).
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from benchmarks import Record, changed, described, flat, groups, note, option, print_table
from sidestep.evaluation.metrics import path_lengths, shortest_lengths
from sidestep.evaluation.reliability import Reliability, brier_score, reliability
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.maps.config import MapConfig, SimulationConfig
from sidestep.maps.learn import learn_map
from sidestep.maps.learned_map import LearnedMap
from sidestep.plotting.reliability import figure_reliability
from sidestep.tabular.graph import walkable_graph
from sidestep.tabular.grid import Grid
from sidestep.worlds.offices import connected_cells, office
from sidestep.worlds.walks import simulate_walks

COLUMNS = {"plans": "plans", "offices": "offices", "mean P(open)": "predicted .3f", "open": "open .3f"}
COLUMNS |= {"± s.e.": "error .3f", "reliability error": "calibration_error .3f", "Brier": "brier_score .3f"}
COLUMNS |= {"length / shortest": "excess .3f"}


@dataclass
class Options:
    """The options of this benchmark."""

    offices: int = option(200, "how many", quick=4)
    first: int = option(1, "the seed of the first office", least=0)
    rows: int = option(12, "of each office")
    columns: int = option(16, "of each office")
    walks: int = option(40, "in each office")
    goals: int = option(4, "different goals of walks")
    plans: int = option(10, "pairs of start and goal in each office")
    max_risk: float = option(0.05, "the bound of the second plan of each pair")
    set: list[str] = option([], f"FIELD=VALUE, of {', '.join(flat(MapConfig()))}")


def measure(options: Options) -> Iterator[Record]:
    """Yield two records for each office and pair of start and goal: without a bound of the risk and with it."""
    config = changed(MapConfig(), options.set)
    for seed in range(options.first, options.first + options.offices):
        truth = office(options.rows, options.columns, seed)
        walking = SimulationConfig(options.walks, options.goals, seed=seed)
        walks = walks_from_trajectories(*simulate_walks(truth, walking), truth)
        started = time.perf_counter()
        learned = learn_map(truth.forget(), walks, config)
        seconds = time.perf_counter() - started
        note(f"office {seed}: {seconds:.0f} s{'' if learned.converged else ', not mixed'}")
        for record in plans(learned, truth, pairs(truth, options.plans, seed), options.max_risk):
            yield {"draw": seed, "mixed": learned.converged, "seconds": seconds, **record}


def pairs(truth: Grid, count: int, seed: int) -> list[tuple[int, int]]:
    """Return random pairs of different free cells (states) that are connected."""
    random, cells = np.random.default_rng(seed), connected_cells(truth)
    return [tuple(random.choice(cells, 2, replace=False).tolist()) for _ in range(count)]


def plans(learned: LearnedMap, truth: Grid, ends: Sequence[tuple[int, int]], max_risk: float) -> Iterator[Record]:
    """Yield what a plan says of its path and what is true of it, for each pair without and with a bound of the risk."""
    graph, walked = walkable_graph(truth), set(learned.visited[:, 0].tolist())
    for start, goal in ends:
        (first, last), last_state = learned.grid.centers(np.array([start, goal])).tolist(), np.array([goal])
        shortest = shortest_lengths(graph, np.array([start]), last_state)[0] * truth.resolution
        for bound in (None, max_risk):
            path = learned.plan((first[0], first[1]), (last[0], last[1]), max_risk=bound)
            yield {
                "start": start,
                "goal": goal,
                "walked": {start, goal} <= walked,
                "max_risk": bound,
                "open_probability": path.open_probability,
                "met": None if bound is None else path.within(bound),
                "open": bool(np.isfinite(path_lengths(graph, [path.states], last_state)[0])),
                "length": path.length,
                "shortest": float(shortest),
            }


def scores(records: Sequence[Record]) -> Record:
    """Return the scores of some plans; of none, only their number."""
    if not records:
        return {"plans": 0, "offices": 0}
    predicted = np.array([record["open_probability"] for record in records])
    is_open = np.array([record["open"] for record in records])
    lengths = np.array([[record["length"], record["shortest"]] for record in records]).sum(axis=0)
    # the plans of an office are not independent: the error of a ratio of sums over offices
    residuals = [sum(one["open"] - is_open.mean() for one in own) for _, own in groups(records, "draw")]
    return {
        "plans": len(records),
        "offices": len(residuals),
        "predicted": float(predicted.mean()),
        "open": float(is_open.mean()),
        "error": float(np.linalg.norm(residuals) / len(records)),
        "calibration_error": reliability(predicted, is_open).calibration_error,
        "brier_score": brier_score(predicted, is_open),
        "excess": float(lengths[0] / lengths[1]),
    }


def kinds(records: Sequence[Record]) -> Mapping[str, list[Record]]:
    """Return the plans without and with a bound of the risk, and parts of these, by name."""
    named: dict[str, list[Record]] = {}
    for label, own in groups(records, "max_risk"):
        bound = label["max_risk"]
        name = "default robot" if bound is None else f"max risk {bound:g}"
        named[name] = own
        if bound is not None:
            named[f"{name}, met"] = [record for record in own if record["met"]]
            named[f"{name}, warned"] = [record for record in own if not record["met"]]
        named[f"{name}, not sure"] = [record for record in own if record["open_probability"] < 1]
        named[f"{name}, walked ends"] = [record for record in own if record["walked"]]
        named[f"{name}, other ends"] = [record for record in own if not record["walked"]]
        named[f"{name}, mixed"] = [record for record in own if record["mixed"]]
        named[f"{name}, not mixed"] = [record for record in own if not record["mixed"]]
    return named


def show(records: Sequence[Record], options: Options) -> None:
    """Print the scores of all plans and of parts of them, and how many plans with a bound arrive without a bump."""
    named = kinds(records)
    offices = [own[0] for _, own in groups(records, "draw")]
    size = f"{len(offices)} offices of {options.rows}×{options.columns}, {options.goals} goals, {options.walks} walks"
    rows = [{"kind": name, **scores(own)} for name, own in named.items()]
    print_table(f"{size}, {described(changed(MapConfig(), options.set))}", rows, {"plans of": "kind", **COLUMNS})
    for bound in dict.fromkeys(record["max_risk"] for record in records if record["max_risk"] is not None):
        met, warned = (scores(named[f"max risk {bound:g}, {part}"]) for part in ("met", "warned"))
        print(f"{met['plans']} plans with a risk of at most {bound:g}: {_arriving(met)}")
        print(f"{warned['plans']} plans with a warning that there is none: {_arriving(warned)}")
    mixed, seconds = sum(each["mixed"] for each in offices), np.median([each["seconds"] for each in offices])
    print(f"the chains of {mixed} of {len(offices)} offices had mixed; a map took {seconds:.1f} s (median)")


def _arriving(scored: Record) -> str:
    if not scored["plans"]:
        return "none to arrive"
    return f"{scored['open']:.1%} ± {scored['error']:.1%} arrive without a bump, {scored['predicted']:.1%} as said"


def draw(records: Sequence[Record], options: object = None) -> Figure:
    """Return the reliability diagrams of P(open), without a bound of the risk and with it."""
    del options
    diagrams: dict[str, Reliability] = {}
    for label, own in groups(records, "max_risk"):
        name = "default robot" if label["max_risk"] is None else f"max risk {label['max_risk']:g}"
        predicted, is_open = np.array([[record["open_probability"], record["open"]] for record in own]).T
        diagrams[name] = reliability(predicted, is_open.astype(bool))
    return figure_reliability(diagrams, probability="P(open)", event="open paths", unit="plans")
