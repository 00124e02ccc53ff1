"""How well maps of simulated domains are learned: offices, apartments, and floors with blocks.

    python -m benchmarks domains --json domains.json
    python -m benchmarks domains --domains offices --walks 100 --set prior.kind=normal wall_prior=2
    python -m benchmarks domains --rows 40 --columns 60 --goals 12 --walks 200 --beta 50

Maps are drawn by seed (`sidestep.worlds`). Agents walk from random cells to a few goals on best paths, ties at random;
with `--beta` they are Boltzmann-rational instead. The learner knows no cell. A map is learned from each number of walks
with the defaults of `sidestep learn`, and all cells are scored against the true map. The table has means over maps; the
pooled calibration error is that of the cells of all maps together, as in the picture's reliability diagrams.

Weights of priors were explored with maps of the seeds 0 and 100 to 199, so none of these are judged here.

Records: those of `people.py`, with `domain`; `draw` is the seed of the map.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from benchmarks import Record, changed, described, flat, groups, option, print_table
from benchmarks.people import CELLS, METHODS, Maze, learn_by, means, pool
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.maps.config import MapConfig, SimulationConfig
from sidestep.plotting.reliability import figure_reliability
from sidestep.tabular.grid import Grid
from sidestep.worlds.apartments import apartment
from sidestep.worlds.blocks import blocks
from sidestep.worlds.offices import office
from sidestep.worlds.walks import simulate_walks

DOMAINS: Mapping[str, Callable[[int, int, int], Grid]] = {"offices": office, "apartments": apartment, "blocks": blocks}
SCORES = {**CELLS, "s": "seconds .1f"}


@dataclass
class Options:
    """The options of this benchmark."""

    domains: list[str] = option(list(DOMAINS), "which domains", choices=tuple(DOMAINS))
    walks: list[int] = option([40, 100], "how many are learned from", quick=[40])
    maps: int = option(10, "maps of each domain", quick=2)
    first: int = option(1, "the seed of the first map", least=0)
    rows: int = option(20, "of each map", quick=12)
    columns: int = option(30, "of each map", quick=16)
    goals: int = option(6, "different goals")
    beta: float | None = option(None, "the agents' inverse temperature β; none for best paths, ties at random")
    methods: list[str] = option(["behavior"], "names of methods", choices=METHODS)
    set: list[str] = option([], f"FIELD=VALUE, of {', '.join(flat(MapConfig()))}")


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each map, number of walks and method."""
    config = changed(MapConfig(), options.set)
    for domain in options.domains:
        for seed in range(options.first, options.first + options.maps):
            truth = DOMAINS[domain](options.rows, options.columns, seed)
            for count in options.walks:
                walking = SimulationConfig(count, options.goals, options.beta, seed=seed)
                walks = walks_from_trajectories(*simulate_walks(truth, walking), truth)
                maze = Maze(f"{domain} {seed}", truth.forget(), truth, walks)
                for record, *_ in learn_by(options.methods, maze, config):
                    yield {"domain": domain, "walks": count, "draw": seed, **record}


def show(records: Sequence[Record], options: Options) -> None:
    """Print the mean scores."""
    rows = [{**label, **row} for label, own in groups(records, "domain") for row in means(own, SCORES, within=None)]
    size = f"{options.rows}×{options.columns}, {options.goals} goals"
    agents = "optimal agents" if options.beta is None else f"agents with β = {options.beta:g}"
    title = f"{options.maps} maps of {size}, {agents}, {described(changed(MapConfig(), options.set))}"
    print_table(title, rows, {"domain": "domain", "walks": "walks", "method": "method", **SCORES})


def draw(records: Sequence[Record], options: object = None) -> Figure:
    """Return the reliability diagrams of `behavior`, a curve for each domain and number of walks."""
    del options
    behavior = [record for record in records if record["method"] == "behavior"]
    pooled = {
        f"{each['domain']}, {each['walks']} walks": pool(own) for each, own in groups(behavior, "domain", "walks")
    }
    return figure_reliability({name: bins for name, bins in pooled.items() if bins is not None})
