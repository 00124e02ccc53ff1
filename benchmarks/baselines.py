"""Behavior-aware modeling beside its baselines: walls, the next actions of others, and robots with new goals.

    python -m benchmarks baselines --worlds offices
    python -m benchmarks baselines --worlds tartarus --walks 10 40 150
    python -m benchmarks baselines --worlds tartarus --walks 10 --methods behavior visits

`offices` are drawn by seed, with simulated agents that take the best paths, ties at random, between eight places;
robots go to 24 others. `tartarus` are the mazes of `people.py`, where all walks have one goal; robots go to twelve
other cells. N walks are learned from, but at most four fifths. Others, at most a hundred, show how probable each method
expects their actions to be (nats a move).

Robots start from every free cell and plan by what each method has learned. `legal` is the fraction of planned paths
without an impossible move, `regret` the mean excess of the executed paths in cells, bumps and detours included, and
`arriving` the fraction of robots that arrive. The regret is a mean over the worlds in which all robots arrive, that of
held-out actions over those in which values converge for all held-out goals. `pooled` is the calibration error of the
cells of all worlds of a draw together (all offices are one draw), and the picture has a reliability diagram for each
number of walks.

Records: those of `people.py`, with `legal_fraction`, `regret`, `arriving_fraction`, `heldout_log_likelihood`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks import SHARED_DATA, Record, changed, described, flat, option
from benchmarks.people import CELLS, METHODS, Maze, in_trials, learn_by, read_mazes, reliability_figure, show_means
from sidestep.io.demonstrations import walks_from_trajectories
from sidestep.maps.config import MapConfig, SimulationConfig
from sidestep.tabular.grid import Cell
from sidestep.worlds.offices import office, places
from sidestep.worlds.walks import simulate_walks

ROWS, COLUMNS = 14, 24
PLACES, NEW_PLACES, NEW_CELLS = 8, 24, 12
HELD_OUT = 100
PATHS = {"legal": "legal_fraction .3f", "regret": "regret .3f", "arriving": "arriving_fraction .3f"}
DEFAULTS = {"offices": ([20, 40, 160], 6), "tartarus": ([10, 40], 1)}


@dataclass
class Options:
    """The options of this benchmark."""

    worlds: str = option("offices", "which worlds", choices=tuple(DEFAULTS))
    data: Path = option(SHARED_DATA / "tartarus", "maze_*/ with walks and maps")
    walks: list[int] = option([], "how many are learned from; none for 20 40 160 (offices) or 10 40", quick=[10])
    seeds: int = option(0, "offices, or draws of each maze; 0 for 6 (offices) or 1", quick=1, least=0)
    methods: list[str] = option(list(METHODS), "names of methods", choices=METHODS)
    # the costs of bumps (`sidestep.robots.robot`) were chosen on offices of lower seeds
    first: int = option(200, "the seed of the first office", least=0)
    every: int = option(1, "learn every n-th maze only", quick=4)
    set: list[str] = option([], f"FIELD=VALUE, of {', '.join(flat(MapConfig()))}")


def problems(options: Options) -> Iterator[tuple[Maze, int, int, int, np.ndarray]]:
    """Yield worlds: a maze, its seed, the walks asked for and learned from, and goals that are new to it."""
    counts, seeds = DEFAULTS[options.worlds]
    counts, seeds = options.walks or counts, options.seeds or seeds
    if options.worlds == "offices":
        for seed in range(options.first, options.first + seeds):
            truth = office(ROWS, COLUMNS, seed)
            for count in counts:
                walking = SimulationConfig(walks=count + HELD_OUT, goals=PLACES, seed=seed)
                trajectories, goals = simulate_walks(truth, walking)
                elsewhere = places(truth, NEW_PLACES + len(goals), seed + 1)
                new = elsewhere[~np.isin(elsewhere, goals)][:NEW_PLACES]
                walks = walks_from_trajectories(trajectories, goals, truth)
                yield Maze(f"office {seed}", truth.forget(), truth, walks), seed, count, count, new
        return
    for read in read_mazes(options.data, "maze_*", "humans.csv", every=options.every):
        maze = in_trials(read, 5, 10)
        for count in counts:
            for seed in range(seeds):
                random = np.random.default_rng(seed)
                random.permutation(len(maze.walks))  # the draw of walks comes first
                free = np.flatnonzero(maze.truth.known == Cell.FREE)
                goals = np.sort(random.choice(free, NEW_CELLS, replace=False))
                blank = replace(maze, blank=maze.truth.forget())
                yield blank, seed, count, min(count, len(maze.walks) * 4 // 5), goals


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each world, number of walks and method."""
    config = changed(MapConfig(), options.set)
    for maze, seed, count, learned, goals in problems(options):
        drawn = np.random.default_rng(seed).permutation(len(maze.walks))
        own, others = (maze.walks.select(np.sort(d)) for d in (drawn[:learned], drawn[learned:][:HELD_OUT]))
        for record, *_ in learn_by(options.methods, replace(maze, walks=own), config, others, goals, paths=True):
            yield {"walks": count, "drawn": learned, "draw": seed, **record}


def show(records: Sequence[Record], options: Options) -> None:
    """Print the mean scores."""
    heldout = {"held-out nats a move": "heldout_log_likelihood .3f"}
    title = f"{options.worlds}, {described(changed(MapConfig(), options.set))}"
    show_means(records, title, CELLS | heldout | PATHS, within=None)


def draw(records: Sequence[Record], options: object = None) -> Figure:
    """Return the reliability diagrams of `behavior`."""
    del options
    return reliability_figure(records)
