"""Towns of which the learner does not know where one cannot drive: one-way streets from taxis, buildings from drives.

    python -m benchmarks towns --picture shanghai.png
    python -m benchmarks towns --counts 200 --seeds 3 --set prior_mean=-2 prior_variance=2
    python -m benchmarks towns --what buildings --set beta=1 prior.mean=-1.5 --picture magellan.png

Streets. Zhao & Liang (2022): 12,000 taxi trips on 714 links of Shanghai's roads, 338 of them one-way. The learner knows
the reverse of each of these as well, with all turns, and learns P(closed) of every link from N trips: drivers go to
known destinations, at costs of turns and links (`FEATURES`). These costs are fitted first, by maximum likelihood with
all links open. A link that was driven is open; its prior says so. Scored are the links that no trip of the draw used:
how well P(closed) ranks the closed ones above the open ones (average precision), beside the fraction of closed links
among them (the value of any ranking by use, for all were used equally often) and two counts that know what the learner
does not: how often the other direction was driven, and how often drivers came by. Calibration error, Brier score and
log loss of P(closed) are over the same links. Over all links, P(closed) is beside
the ranking by how rarely links were used. Two more columns need no truth, and settings can be chosen by them: `later`
is the AUC of ranking the links that none of `--held-out` other trips used above those that one of them did;
`log_likelihood` is that of these other trips, in nats a turn. `likely` counts unused links with P(closed) above ½.

Buildings. Manning et al. (2014): four towns of 6×6 blocks, and drives with a virtual taxi to one store at a time. They
are gridded at a tenth of a block (8-connected) on a map without any known cell. All cells are scored against the
squares on which buildings stand; beside P(blocked) are the ranking by how rarely drives visit a cell, and P(blocked) by
the transitions alone. `into_buildings` counts moves that end in a building of the true map. Records as in `people.py`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.optimize import minimize
from scipy.stats import rankdata
from sklearn.metrics import average_precision_score, precision_recall_curve, roc_auc_score

from benchmarks import SHARED_DATA, Record, changed, described, flat, groups, mean_over, note, option, print_table, warn
from benchmarks.people import CELLS, draws, learn_by, read_mazes, show_means
from benchmarks.street_network import FEATURES, Town, Trip, layout, opposite, read_town
from sidestep.errors import InputError, NotConverged
from sidestep.evaluation.reliability import brier_score, log_loss, reliability
from sidestep.inference.fit import Fit, fit
from sidestep.inference.optimizers import LBFGS, Rprop
from sidestep.inference.priors import Normal
from sidestep.io.roads import Roads
from sidestep.maps.config import BehaviorConfig, MapConfig, PriorConfig
from sidestep.plotting.maps import Panel, figure_learned
from sidestep.tabular.backups import BACKUPS, Behavior
from sidestep.tabular.demonstrations import Demonstrations
from sidestep.tabular.grid import Cell, Grid
from sidestep.tabular.likelihood import log_likelihood
from sidestep.tabular.models import TiedModel, closed
from sidestep.tabular.reward import Reward

# Drives are long, so a step has a cost rather than the goal a reward; the prior is the paper's: buildings are no lines.
DRIVES = MapConfig(
    Reward(1.0, 1.0), BehaviorConfig(beta=0.3), PriorConfig("normal", mean=-2.0, variance=2.0, wall_prior=0.0)
)
DRIVEN, CERTAIN = -7.0, 0.005
"""The prior of a link that was driven: the mean of its logit, and the variance."""
CLOSED = 3.0
"""The logit of a link that is as good as closed: some twenty tries, longer than most detours."""
PER_TURN = 1e-3
"""Of many trips all is learned when the next step promises less than this for each turn (nats)."""
LEAST = 1e-3
"""The least cost of a link: without a discount, every action must cost something."""
SHADES, ASIDE = LinearSegmentedColormap.from_list("shades", ["0.72", "0.0"]), 14.0


@dataclass(frozen=True)
class StreetConfig:
    """How closed links are learned; `docs/towns.md` shows results with other priors.

    Attributes:
        backup: A name in `BACKUPS`.
        turn_costs: Whether turns have costs, or lengths and the number of links only.
        prior_mean: Of the logit of each link that was not driven.
        prior_variance: Of the same.
        iterations: Those of `LBFGS`.
        tolerance: That of `LBFGS`.
        many: From this number of turns on, the optimizer is that of large maps (see `learn`).
    """

    backup: str = "boltzmann"
    turn_costs: bool = True
    prior_mean: float = -4.0
    prior_variance: float = 0.15
    iterations: int = 100
    tolerance: float = 0.05
    many: int = 100_000


STREETS = StreetConfig()


@dataclass
class Options:
    """The options of this benchmark."""

    what: str = option("streets", "what is learned", choices=("streets", "buildings"))
    data: Path | None = option(None, "the folder of links.csv, turns.csv and trips.csv, or of town_*/")
    counts: list[int] = option([], "trips to draw; none for 200 2000 12000, or 14 56 drives", quick=[100])
    seeds: int = option(0, "how many draws; 0 for 5 (streets) or 3", quick=1, least=0)
    held_out: int = option(1000, "trips for the columns that need no truth")
    towns: int = option(4, "of buildings", quick=1)
    set: list[str] = option([], f"FIELD=VALUE: {', '.join(flat(STREETS))}; of buildings {', '.join(flat(DRIVES))}")

    @property
    def folder(self) -> Path:
        """The folder of the data."""
        return self.data or SHARED_DATA / ("shanghai" if self.what == "streets" else "magellan")


# ---------------------------------------------------------------------------------------------------- streets


class Learned(NamedTuple):
    """What was learned from trips: a fit, and the costs of `FEATURES`."""

    fit: Fit[TiedModel]
    costs: Array
    behavior: Behavior


def fit_costs(town: Town, trips: Sequence[Trip], behavior: Behavior, turn_costs: bool) -> Array:
    """Return the costs of features, per unit of it over β, as if all links were open; none below 0."""
    model = town.model.with_parameters(jnp.full(len(town.roads), -30.0))
    demos = town.demonstrations(trips)

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def loss(costs: Array, demos: Demonstrations) -> Array:
        return -log_likelihood(model, town.adding_costs(demos, costs), behavior, terms=("actions",)).actions / len(
            demos
        )

    def loss_and_slope(costs: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = loss(jnp.asarray(costs), demos)
        if not jnp.isfinite(value):
            raise NotConverged("the values of drivers with other costs do not converge: expected another backup")
        return float(value), np.asarray(slope)

    bounds = [(LEAST, None)] * 2 + [(0.0, None if turn_costs else 0.0)] * (len(FEATURES) - 2)
    start = np.where([most is None for _, most in bounds], 0.5, 0.0)
    return jnp.asarray(minimize(loss_and_slope, start, jac=True, method="L-BFGS-B", bounds=bounds).x)


def learn(town: Town, trips: Sequence[Trip], config: StreetConfig) -> Learned:
    """Return what is learned from trips; raises `InputError` for an unknown backup.

    Many trips make cliffs: links that thousands of drivers would take if they were a little more open. L-BFGS makes no
    progress along them. Then all links that were not driven begin as closed, and the prior opens them, by `Rprop`,
    until drivers would come.
    """
    if config.backup not in BACKUPS:
        raise InputError(f"expected one of {', '.join(BACKUPS)}, found {config.backup!r}", field="backup")
    behavior = Behavior(BACKUPS[config.backup](), 1.0)
    costs = fit_costs(town, trips, behavior, config.turn_costs)
    demos, driven = town.demonstrations(trips, costs), jnp.asarray(town.uses(trips) > 0)
    start = means = jnp.where(driven, DRIVEN, config.prior_mean)
    prior = Normal(means, jnp.where(driven, CERTAIN, config.prior_variance))
    optimizer = LBFGS(max_iterations=config.iterations, tolerance=config.tolerance)
    if len(demos) >= config.many:
        optimizer = Rprop(max_iterations=config.iterations, tolerance=PER_TURN * len(demos))
        start = jnp.where(driven, means, CLOSED)
    model = town.model.with_parameters(start)
    return Learned(fit(model, demos, behavior, prior=prior, optimizer=optimizer), costs, behavior)


def score(town: Town, trips: Sequence[Trip], others: Sequence[Trip], config: StreetConfig) -> Record:
    """Return the record of one draw of trips; `others` are trips that were not drawn."""
    learned = learn(town, trips, config)
    chances, truth, uses = np.asarray(closed(learned.fit.model)), town.added, town.uses(trips)
    unused, came_by = uses == 0, np.bincount(town.roads.ends, weights=uses)[town.roads.begins]
    rankings = {"P(closed)": chances, "came by": came_by, "other direction": uses[opposite(town.roads)]}
    precision = {
        name.replace(" ", "_"): average_precision_score(truth[unused], ranks[unused])
        for name, ranks in rankings.items()
    }
    fraction, likelihood = float(truth[unused].mean()), None
    if others:
        shown = town.demonstrations(others, learned.costs)
        likelihood = log_likelihood(learned.fit.model, shown, learned.behavior, terms=("actions",)).actions
        likelihood = float(likelihood) / len(shown)
    return {
        "unused": int(unused.sum()),
        "closed_fraction": fraction,
        **precision,
        "gain": precision["P(closed)"] - fraction,
        "calibration_error": reliability(chances[unused], truth[unused]).calibration_error,
        "brier_score": brier_score(chances[unused], truth[unused]),
        "log_loss": log_loss(chances[unused], truth[unused]),
        "likely": int((chances[unused] > 0.5).sum()),
        "all_by_closed": average_precision_score(truth, chances),
        "all_by_use": average_precision_score(truth, -uses),
        "costs": dict(zip(FEATURES, np.asarray(learned.costs).tolist(), strict=True)),
        "iterations": learned.fit.final.iteration,
        "converged": learned.fit.converged,
        "objective": learned.fit.final.objective,
        "largest_gradient": learned.fit.final.gradient,
        "later": later(chances[unused], town.uses(others)[unused]),
        "log_likelihood": likelihood,
        "uses": uses.tolist(),
        "rankings": {name: ranks.tolist() for name, ranks in rankings.items()},
    }


def later(chances: np.ndarray, uses: np.ndarray) -> float | None:
    """Return the AUC of ranking links without uses above those with some; None without both kinds."""
    never = uses == 0
    return float(roc_auc_score(never, chances)) if never.any() and not never.all() else None


def draw_trips(
    trips: Sequence[Trip], count: int, seeds: int, others: int
) -> Iterator[tuple[int, list[Trip], list[Trip]]]:
    """Yield for each seed some trips, and others that were not drawn; all trips, once, where there are no more."""
    for seed in range(seeds if count < len(trips) else 1):
        order = np.random.default_rng(seed).permutation(len(trips))
        drawn, rest = order[:count], order[count:][-others:]
        yield seed, [trips[index] for index in drawn], [trips[index] for index in rest]


# ---------------------------------------------------------------------------------------------------- both


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each draw (streets), or for each town, draw and method (buildings)."""
    if options.what == "streets":
        config, (town, trips) = changed(STREETS, options.set), read_town(options.folder)
        for count in options.counts or (200, 2000, 12000):
            for seed, drawn, others in draw_trips(trips, count, options.seeds or 5, options.held_out):
                record = {"trips": len(drawn), "draw": seed, **score(town, drawn, others, config)}
                note(f"{len(drawn)} trips, draw {seed}: gain {record['gain']:.3f}, converged: {record['converged']}")
                yield record
        return
    config = changed(DRIVES, options.set)
    for town in read_mazes(options.folder, "town_*", "drives.csv", connectivity=8)[: options.towns]:
        for count in options.counts or (14, 56):
            for seed, drives in draws(town.walks, count, options.seeds or 3):
                drawn = replace(town, walks=drives)
                for record, result, demos in learn_by(("behavior", "visits", "transitions"), drawn, config):
                    into = into_buildings(demos, town.truth)
                    label = {"walks": count, "drawn": len(drives), "draw": seed, "into_buildings": into}
                    yield {**label, **record, "blocked": None if result is None else result.ranking.tolist()}


def into_buildings(demonstrations: Demonstrations, truth: Grid) -> int:
    """Return how many moves end in a cell that the true map holds for building."""
    return int((truth.known.reshape(-1)[np.asarray(demonstrations.next_states)] == Cell.OCCUPIED).sum())


def show(records: Sequence[Record], options: Options) -> None:
    """Print means over draws, of the gain with its standard error; of buildings, means over draws and towns."""
    if options.what == "buildings":
        columns = {"moves": "moves .0f", "into buildings": "into_buildings .0f", **CELLS}
        show_means(records, described(changed(DRIVES, options.set)), columns, within="problem")
        return
    keys = ("unused", "closed_fraction", "P(closed)", "gain", "calibration_error", "brier_score", "log_loss")
    keys += ("came_by", "other_direction", "all_by_closed", "all_by_use", "later", "log_likelihood")
    rows = []
    for label, own in groups(records, "trips"):
        error = float(np.std([record["gain"] for record in own], ddof=1) / np.sqrt(len(own))) if len(own) > 1 else None
        rows.append({**label, "draws": len(own), **{key: mean_over(own, key) for key in keys}, "±": error})
    columns = {"trips": "trips", "draws": "draws", "unused": "unused .0f", "closed": "closed_fraction .3f"}
    columns |= {key.replace("_", "\n"): f"{key} .3f" for key in ("P(closed)", "gain", "±", *keys[4:])}
    print_table(f"one-way streets of Shanghai, {described(changed(STREETS, options.set))}", rows, columns)
    if not all(record["converged"] for record in records):
        warn("some fits have not converged; see the records")


def draw(records: Sequence[Record], options: Options) -> Figure:
    """Return the picture of the first draw of streets, or of the first town with most drives."""
    if options.what == "streets":
        town, _ = read_town(options.folder)
        return street_figure(town.roads, town.added, records)
    town = read_mazes(options.folder, "town_*", "drives.csv", connectivity=8)[0]
    own = [record for record in records if (record["problem"], record["method"]) == (town.name, "behavior")]
    record = max(own, key=lambda record: record["drawn"])
    drives = dict(draws(town.walks, record["walks"], record["draw"] + 1))[record["draw"]]
    goals, blocked = np.unique(drives.goals, axis=0), np.asarray(record["blocked"])
    known = Panel(f"{town.name}: {len(drives)} drives", town.truth, paths=list(drives), goals=goals)
    picture = figure_learned([known, Panel("learned from them", town.blank, blocked=blocked, truth=town.truth)])
    for axes in picture.axes[:2]:
        axes.set(xlabel="x (blocks)", ylabel="y (blocks)")
    # no cell is surely blocked: the scale ends where the most probable one is
    picture.axes[1].images[0].set_clim(0.0, blocked.max())
    return picture


# ---------------------------------------------------------------------------------------------------- the picture


def street_figure(roads: Roads, added: np.ndarray, records: Sequence[Record]) -> Figure:
    """Return the town as learned from the first record's trips, beside precision and recall by the number of trips."""
    first_records = [own[0] for _, own in groups(records, "trips")]
    picture = Figure(figsize=(10.4, 7.4), layout="constrained")
    grid = picture.add_gridspec(len(first_records), 2, width_ratios=[5.6, 4.6])
    town = picture.add_subplot(grid[:, 0])
    label = "rank by P(closed) among unused links (1: most surely closed)"
    picture.colorbar(_draw_town(town, roads, added, first_records[0]), ax=town, shrink=0.5, pad=0.01, label=label)
    for row, record in enumerate(first_records):
        axes, fraction = picture.add_subplot(grid[row, 1]), record["closed_fraction"]
        unused, open_links = np.asarray(record["uses"]) == 0, max(1 - fraction, 0.01)
        for (name, ranks), style in zip(record["rankings"].items(), ("-", "--", ":"), strict=True):
            precision, recall, _ = precision_recall_curve(added[unused], np.asarray(ranks)[unused])
            axes.plot(recall[:-1], precision[:-1], style, color="black", label=name)
        axes.axhline(fraction, color="0.6", linewidth=3, zorder=0, label="fraction of closed links")
        axes.set(ylim=(1 - 1.3 * open_links, 1 + 0.03 * open_links), ylabel="precision")
        axes.set(title=f"unused links, {record['trips']} trips")
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlabel("recall of closed links" if record is first_records[-1] else "")
        if record is first_records[0]:
            axes.legend(fontsize="small", frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.2))
    return picture


def _draw_town(axes: Axes, roads: Roads, added: np.ndarray, record: Record) -> LineCollection:
    """Draw used links lightly, wider with more use, and unused ones darker with P(closed), each right of its road."""
    places = layout(roads)
    ends = np.stack([places[roads.begins], places[roads.ends]], axis=1)
    along = ends[:, 1] - ends[:, 0]
    right = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    ends = ends + ASIDE * right[:, None]
    uses, placed = np.asarray(record["uses"]), np.isfinite(ends).all(axis=(1, 2))
    used, unused = (uses > 0) & placed, (uses == 0) & placed
    widths = 0.4 + 3 * np.sqrt(uses[used] / uses.max())
    axes.add_collection(LineCollection(list(ends[used]), colors="0.85", linewidths=widths))
    ranks = rankdata(np.asarray(record["rankings"]["P(closed)"])[unused]) / unused.sum()
    order = np.argsort(ranks)
    shades = LineCollection(list(ends[unused][order]), linewidths=2.2, array=ranks[order], cmap=SHADES, clim=(0, 1))
    axes.add_collection(shades)
    middles, shown = ends[unused].mean(axis=1)[~added[unused]], ranks[~added[unused]]
    axes.scatter(*middles.T, s=26, c=shown, cmap=SHADES, vmin=0, vmax=1, edgecolors="black", linewidths=0.7, zorder=3)
    wide, closed_line = {"color": "0.85", "linewidth": 3}, {"color": "0.3", "linewidth": 2.2}
    circle: dict[str, Any] = {**closed_line, "marker": "o", "markeredgecolor": "black"}
    labels = {"used (wider: more often)": wide, "unused, and closed": closed_line, "unused, but open": circle}
    handles = [Line2D([], [], label=label, **style) for label, style in labels.items()]
    where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.06), "ncols": 3}
    axes.legend(handles=handles, frameon=False, fontsize="small", **where)
    axes.autoscale()
    axes.set(aspect="equal", xlabel="metres", title=f"learned from {record['trips']} trips")
    return shades
