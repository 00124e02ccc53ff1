"""The sampler and the mean field against the exact posterior of small random worlds.

    python -m benchmarks enumeration --worlds 50

Each world is a grid of 24 cells, of which at most 10 are unknown and were not walked on, or one of 12 cells with as
many borders that may be walls. Agents act as the model says. Obstacles, what is known of them, the weights of the
prior, rewards, backups, moves and β differ between worlds. The exact posterior is that of all maps
(`enumerate_barriers`). The last lines say whether the errors are as small as expected.

Records: `world`, `kind`, `unknown`, `walks`, `method`, `error` (the mean over unknown barriers of the absolute error of
P(closed)), `largest_error`, `status`, `seconds`.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax
import numpy as np

import sidestep as ss
from benchmarks import Record, groups, note, option, print_table
from sidestep.inference.chain_evidence import PASSING, crossed_barriers
from sidestep.inference.enumeration import enumerate_barriers
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.sampler import sample_barriers
from sidestep.tabular.arrays import to_jax
from sidestep.tabular.demonstrations import flat_moves
from sidestep.tabular.graph import Graph
from sidestep.tabular.likelihood import ALL_TERMS
from sidestep.tabular.models.barriers import barriers_of, with_closed

MOST_UNKNOWN = 10
SHAPES = {"4 moves": (4, 6), "8 moves": (4, 6), "borders": (3, 4)}
"""The rows and columns of each kind of world; few shapes, because functions are compiled for each."""
MOST_SAMPLER, MOST_MEAN_FIELD = 0.015, 0.06
"""The errors expected of the sampler in each world, and of the mean field over all of them."""
REWARDS = (ss.Reward(0.95), ss.Reward(1.0, 1.0))
BACKUPS = (ss.BoltzmannAverage(), ss.LogSumExp(), ss.HardMax())


@dataclass
class Options:
    """The options of this benchmark."""

    worlds: int = option(50, "how many worlds", quick=3)
    sweeps: int = option(6000, "sweeps of each chain")
    chains: int = option(2, "chains", least=2)
    seed: int = option(0, "the seed of the first world", least=0)


@dataclass(frozen=True, eq=False)
class World:
    """A world with few unknown barriers, walks in it, the prior of its barriers, and their exact P(closed)."""

    kind: str
    model: ss.TransitionModel
    demonstrations: ss.Demonstrations
    behavior: ss.Behavior
    prior: BinaryMRF
    unknown: np.ndarray
    exact: np.ndarray


def random_world(seed: int) -> World:
    """Return the world of a seed.

    It is drawn again until no more than `MOST_UNKNOWN` barriers are open questions, and all maps have values.
    """
    random = np.random.default_rng(seed)
    while True:
        kind, reward = list(SHAPES)[seed % len(SHAPES)], REWARDS[random.integers(len(REWARDS))]
        shape = SHAPES[kind]
        known = np.where(random.random(shape) < 0.4, ss.Cell.FREE, ss.Cell.UNKNOWN).astype(np.int64)
        if kind == "borders":
            known[:] = ss.Cell.FREE
        grid = ss.Grid(known, connectivity=8 if kind == "8 moves" else 4)
        model = ss.walled_grid(grid) if kind == "borders" else ss.ObstacleGrid(grid)
        barriers = barriers_of(model)
        closed = (random.random(len(barriers.known)) < 0.35) & (barriers.known == ss.Cell.UNKNOWN)
        true_model = with_closed(model, np.where(closed, PASSING[0], PASSING[1]))
        places = np.arange(grid.size) if kind == "borders" else np.flatnonzero(~closed)
        goals = random.choice(places, 2, replace=False)
        backup = BACKUPS[random.integers(len(BACKUPS))]
        behavior = ss.Behavior(backup, random.uniform(4, 10) if reward.step_cost is None else random.uniform(2, 4))
        starts = [random.choice(places[places != goal], int(random.integers(1, 5))) for goal in goals]
        tasks = [reward.reach(grid, int(goal)) for goal in goals]
        try:
            walks = ss.simulate(jax.random.key(seed), true_model, tasks, starts, behavior)
        except ss.SidestepError:  # no way from a start to its goal
            continue
        demonstrations = ss.gather([walk for walk in walks if len(walk.actions)], tasks)
        unknown = (barriers.known == ss.Cell.UNKNOWN) & ~crossed_barriers(barriers, demonstrations, ALL_TERMS)
        if not 2 <= unknown.sum() <= MOST_UNKNOWN:
            continue
        weights = dict(zip(("lines", "pairs", "blocks", "isolated"), random.uniform(-1.5, 1.5, 4), strict=True))
        field = np.full(len(barriers.known), random.uniform(-2, 0))
        prior = BinaryMRF(field) if kind == "borders" else BinaryMRF(field, grid.shape, **weights)
        shown = with_all_moves(demonstrations, model.graph)
        try:
            exact = enumerate_barriers(model, shown, behavior, prior).closed
        except ss.NotConverged:
            continue
        return World(kind, model, demonstrations, behavior, prior, unknown, exact)


def with_all_moves(demonstrations: ss.Demonstrations, graph: Graph) -> ss.Demonstrations:
    """Return the same moves, and all that are possible with weight 0.

    So all worlds of a kind have the same number of distinct moves, and one compiled function serves them.
    """
    successors, tasks = np.asarray(graph.successors), len(demonstrations.tasks.terminal)
    task, states, actions, _ = np.indices((tasks, *successors.shape)).reshape(4, -1)
    fields = "states", "actions", "next_states", "task", "trajectory"
    last = np.full(len(task), demonstrations.trajectories - 1)
    added = states, actions, np.tile(successors.ravel(), tasks), task, last
    moves = {name: flat_moves([getattr(demonstrations, name), more]) for name, more in zip(fields, added, strict=True)}
    weights = to_jax(np.append(np.asarray(demonstrations.weights), np.zeros(len(task))))
    return ss.Demonstrations(**moves, tasks=demonstrations.tasks, weights=weights)


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each world and method."""
    for seed in range(options.seed, options.seed + options.worlds):
        world = random_world(seed)
        for record in _of_world(seed, world, options):
            note(f"world {seed} ({world.kind}), {record['method']}: error {record['error']:.4f}, {record['status']}")
            yield record


def _of_world(seed: int, world: World, options: Options) -> Iterator[Record]:
    """Yield a record for each method."""
    started = time.perf_counter()
    settings = {"prior": world.prior, "sweeps": options.sweeps, "chains": options.chains, "seed": seed}
    sampled = sample_barriers(world.model, world.demonstrations, world.behavior, **settings)
    ended = {"status": sampled.status.value, "seconds": time.perf_counter() - started}
    yield _record(seed, world, "sample", sampled.closed) | ended
    started = time.perf_counter()
    field = ss.mean_field_barriers(world.model, world.demonstrations, world.behavior, prior=world.prior, seed=seed)
    ended = {"status": field.status.value, "seconds": time.perf_counter() - started}
    yield _record(seed, world, "mean field", field.closed) | ended


def _record(seed: int, world: World, method: str, closed: np.ndarray) -> Record:
    errors, walks = np.abs(closed - world.exact)[world.unknown], world.demonstrations.trajectories
    return {
        **{"world": seed, "kind": world.kind, "unknown": len(errors), "walks": walks, "method": method},
        **{"error": errors.mean(), "largest_error": errors.max()},
    }


def show(records: Sequence[Record], options: Options) -> None:
    """Print the errors of each method over all worlds."""
    rows = [
        {
            **label,
            "worlds": len(own),
            "mean": np.mean([each["error"] for each in own]),
            "worst": max(each["error"] for each in own),
            "largest": max(each["largest_error"] for each in own),
            "seconds": np.median([each["seconds"] for each in own]),
        }
        for label, own in groups(records, "method")
    ]
    columns = {"method": "method", "worlds": "worlds", "mean error": "mean .4f", "worst world": "worst .4f"}
    columns |= {"largest error of a barrier": "largest .3f", "median seconds": "seconds .2f"}
    print_table(f"absolute error of P(closed), {options.sweeps} sweeps", rows, columns)
    worst, mean = rows[0]["worst"], rows[1]["mean"]
    print(f"sampler: mean error {worst:.4f} in the worst world, {_held(worst, MOST_SAMPLER)}")
    print(f"mean field: mean error {mean:.4f} over all worlds, {_held(mean, MOST_MEAN_FIELD)}")


def _held(error: float, most: float) -> str:
    return f"{'at most' if error <= most else 'NOT at most'} {most:g} as expected"
