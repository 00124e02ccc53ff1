"""One-way streets that are found from where taxis drove, on a network of which nobody says what is one-way.

    python benchmarks/shanghai.py --out shanghai.png
    python benchmarks/shanghai.py --trips 2000 --seeds 3 --json shanghai.json
    python benchmarks/shanghai.py --trips 200 --set prior_mean=-2 prior_variance=2
    python benchmarks/shanghai.py --quick

Zhao & Liang (2022): 12,000 taxi trips on 714 links of Shanghai's roads, 338 of them one-way. The learner is given the
reverse of each of these as well, with all turns, and learns P(closed) of every link from N trips: drivers pursue known
destinations, at a cost of what they mind of each turn and link (`two_way.FEATURES`). How much they mind what is fitted
first, by maximum likelihood with all links open. A link that was driven is open; its prior says so.

Scored are the links that no trip of the draw used: how well P(closed) ranks the closed ones above the open ones, as
average precision, beside the share of closed links among them (what any ranking by use comes to, for all were used
equally often) and beside two counts that know of streets what the learner does not: how often the other direction was
driven, and how often people came by. Over all links, P(closed) is beside the ranking by how rarely links were used.

Two more columns need no truth, and settings can be chosen by them. `later` is measured like an AUC: how well P(closed)
ranks the links that none of `--held-out` other trips used above those that one of them did. `log-likelihood` is that
of what these drivers did, in nats a turn.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.metrics import average_precision_score, roc_auc_score

from drivers import Settings, Town, Trip, learn, read_town
from measuring import argument_parser, complain, main, note, number, print_table, write_records
from settings import add_set_option, changed, described
from shanghai_picture import figure
from sidestep.plotting.maps import save
from two_way import FEATURES, opposite

DATA = Path(__file__).parents[2] / "shared" / "data" / "shanghai"


def score(town: Town, trips: Sequence[Trip], others: Sequence[Trip], settings: Settings) -> dict[str, Any]:
    """The record of one draw of trips; `others` are trips that were not drawn.

    Beside what the table has, `likely` counts the unused links that are more probably closed than open.
    """
    started = time.perf_counter()
    learned = learn(town, trips, settings)
    seconds = time.perf_counter() - started
    chances, truth, uses = learned.closed, town.network.added, town.uses(trips)
    unused = uses == 0
    rankings = {
        "P(closed)": chances,
        "came by": np.bincount(town.roads.ends, weights=uses)[town.roads.begins],
        "other direction": uses[opposite(town.roads)],
    }
    precision = {name: average_precision_score(truth[unused], ranks[unused]) for name, ranks in rankings.items()}
    share = float(truth[unused].mean())
    return {
        "unused": int(unused.sum()),
        "share": share,
        **precision,
        "gain": precision["P(closed)"] - share,
        "likely": int((chances[unused] > 0.5).sum()),
        "all: P(closed)": average_precision_score(truth, chances),
        "all: by use": average_precision_score(truth, -uses),
        "weights": dict(zip(FEATURES, np.asarray(learned.weights).tolist(), strict=True)),
        "destinations": len(learned.found.sweeps),
        "iterations": learned.found.final.iteration,
        "converged": learned.found.converged,
        "objective": learned.found.final.objective,
        "largest_gradient": learned.found.final.gradient,
        "seconds": round(seconds, 3),
        "later": later(chances[unused], town.uses(others)[unused]),
        "log-likelihood": learned.log_likelihood(town, others) if others else None,
        "uses": uses.tolist(),
        "rankings": {name: ranks.tolist() for name, ranks in rankings.items()},
    }


def later(chances: np.ndarray, uses: np.ndarray) -> float | None:
    """How well P(closed) ranks links that were not used above those that were, like an AUC; None without both kinds."""
    never = uses == 0
    return float(roc_auc_score(never, chances)) if never.any() and not never.all() else None


def draws(trips: Sequence[Trip], count: int, seeds: int, others: int) -> Iterator[tuple[int, list[Trip], list[Trip]]]:
    """For each seed some trips, and others that were not drawn; all trips, once, where there are no more."""
    for seed in range(seeds if count < len(trips) else 1):
        order = np.random.default_rng(seed).permutation(len(trips))
        drawn, rest = order[:count], order[count:][-others:]
        yield seed, [trips[index] for index in drawn], [trips[index] for index in rest]


COLUMNS = {
    "unused": ".0f",
    "share": ".3f",
    "P(closed)": ".3f",
    "gain": ".3f",
    "came by": ".3f",
    "other direction": ".3f",
    "all: P(closed)": ".3f",
    "all: by use": ".3f",
    "later": ".3f",
    "log-likelihood": ".3f",
    "seconds": ".0f",
}
"""The fields of a record in the table, and their form."""


def print_summary(records: Sequence[dict[str, Any]], title: str) -> None:
    """The table: means over draws, of the gain with its standard error."""
    rows = []
    for count in dict.fromkeys(record["trips"] for record in records):
        own = [record for record in records if record["trips"] == count]
        cells = [f"{count} ({len(own)})"]
        for key, form in COLUMNS.items():
            known = [record[key] for record in own if record[key] is not None]
            cells.append(number(float(np.mean(known)) if known else None, form))
            if key == "gain" and len(own) > 1:
                cells[-1] += f" ± {np.std(known, ddof=1) / np.sqrt(len(own)):.3f}"
        rows.append(cells)
    print_table(title, ["trips (draws)", *COLUMNS], rows)


def _arguments() -> argparse.Namespace:
    parser = argument_parser("One-way streets found from taxi trips, against the truth.", "200 trips, one draw")
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="links.csv, turns.csv and trips.csv")
    parser.add_argument(
        "--trips", type=int, nargs="+", default=[200, 2000, 12000], metavar="N", help="how many to draw"
    )
    parser.add_argument("--seeds", type=int, default=5, help="how many draws")
    parser.add_argument("--held-out", type=int, default=1000, help="trips for the columns that need no truth")
    parser.add_argument(
        "--out", type=Path, metavar="PICTURE.png", help="draw the first draw, and how precise rankings are"
    )
    add_set_option(parser, Settings)
    arguments = parser.parse_args()
    if min(*arguments.trips, arguments.seeds, arguments.held_out) < 1:
        parser.error("--trips, --seeds and --held-out: expected numbers above 0")
    if arguments.quick:
        arguments.trips, arguments.seeds = [200], 1
    return arguments


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints, draws and writes what the arguments ask for."""
    settings = changed(Settings(), arguments.set)
    town, trips = read_town(arguments.data)
    records = []
    for count in arguments.trips:
        for seed, drawn, others in draws(trips, count, arguments.seeds, arguments.held_out):
            records.append({"trips": len(drawn), "seed": seed, **score(town, drawn, others, settings)})
            note(f"{len(drawn)} trips, draw {seed}: gain {records[-1]['gain']:.3f}, {records[-1]['seconds']:.0f} s")
    print_summary(records, f"{len(trips)} trips, {len(town.roads)} links, {described(settings)}")
    if not all(record["converged"] for record in records):
        complain("some fits have not converged; see the records")
    if arguments.out:
        save(figure(town.roads, town.network.added, records), arguments.out)
    write_records(arguments, records, learner=asdict(settings))


if __name__ == "__main__":
    sys.exit(main(run, _arguments()))
