"""How often 95 % intervals cover the truth: β, a lapse and three logits of a world of six states, or a gravity.

Ring: agents walk around a ring of six places: on, back, two at once, or they rest. Each of the three moves fails with
an unknown probability, and then they stay. Pendulum: agents that know the gravity hold a hanging pendulum at two
angles, and it is learned from their torques alone, by rollouts. They plan on a lattice.

Many data sets are simulated, each is fitted, and the interval of `sidestep.laplace` of each number either covers the
number that the data were made with, or does not. A coverage has a standard error itself: 1.5 percentage points of 200
data sets, 3.4 of 40.

Records have `number`, `truth`, `covered` (of the data sets that were not refused), `below` and `above` (where the
truth was below or above the interval), `mean` and `spread` of the estimates and `error`, the mean standard error, all
on the unconstrained scale (ln β, logits, ln gravity); `refused`, the data sets with a fit that `laplace` refuses, and
the means of `distance` and `simulated` over the others.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import sidestep as ss
import sidestep.continuous as sc
from benchmarks import Record, option, print_table

STATES, GOALS = 6, (0, 3)
MOVES = (1, -1, 2)
"""How far each move leads; a fourth action rests."""
LOGITS, BETA, LAPSE = np.array([1.5, 0.5, -0.5]), 2.0, 0.1
"""The truth: logits of success, the inverse temperature, the fraction of random actions."""
START = ss.Behavior(ss.BoltzmannAverage(), 3.0, 0.05)
"""Where a fit starts, and the middle of the prior of behavior."""
PRIOR = ss.Normal(0.0, 4.0)
"""Of the logits."""
NUMBERS = {
    "ring": ("logit of a step on", "logit of a step back", "logit of two at once", "ln β", "logit of the lapse"),
    "pendulum": ("ln gravity",),
}
TRUTH = {
    "ring": np.array([*LOGITS, np.log(BETA), np.log(LAPSE / (1 - LAPSE))]),
    "pendulum": np.array([np.log(10.0)]),
}
DATA_SETS, WALKS = {"ring": 200, "pendulum": 40}, {"ring": 150, "pendulum": 24}
LEAST, MOST = 0.90, 0.99
"""What is asked of the coverage of 95 % intervals."""


@dataclass
class Options:
    """What to measure."""

    world: str = option("ring", "which world", choices=tuple(NUMBERS))
    data_sets: int = option(0, "simulated data sets; 0 for 200 (ring) or 40", quick=20, least=0)
    walks: int = option(0, "walks of each data set; 0 for 150 (ring) or 24", least=0)
    level: float = option(0.95, "the probability of an interval")
    seed: int = option(0, "the seed", least=0)


def ring() -> ss.TiedModel:
    """Return the world with the true logits."""
    states = np.arange(STATES)
    moved = np.stack([(states + by) % STATES for by in (*MOVES, 0)], axis=1)
    successors = np.stack([moved, np.broadcast_to(states[:, None], moved.shape)], axis=-1)
    index = np.broadcast_to(np.array([[i, ss.FIXED] for i in range(3)] + [[ss.FIXED, ss.IMPOSSIBLE]]), successors.shape)
    return ss.TiedModel(ss.graph(successors), index, LOGITS)


def tasks() -> list[ss.Task]:
    """Return a task for each goal: every action costs one."""
    terminals = [np.arange(STATES) == goal for goal in GOALS]
    return [ss.task(-np.ones((STATES, len(MOVES) + 1)), 0.95, terminal) for terminal in terminals]


def vector(tree: ss.Parameters | ss.NaturalScale) -> np.ndarray:
    """Return numbers in the order of `NUMBERS`."""
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def on_the_ring(key: jax.Array, walks: int) -> ss.Fit:
    """Return a fit to simulated walks around the ring."""
    world, goals, agents = ring(), tasks(), ss.Behavior(ss.BoltzmannAverage(), BETA, LAPSE)
    starts = [np.resize(np.delete(np.arange(STATES), goal), -(-walks // len(GOALS))) for goal in GOALS]
    shown = ss.gather(ss.simulate(key, world, goals, starts, agents), goals)
    behavior = ss.behavior_model(START, ["beta", "lapse"])
    return ss.fit(world.with_parameters(0 * world.parameters), shown, behavior, prior=PRIOR)


def of_the_pendulum(key: jax.Array, walks: int) -> sc.ContinuousFit:
    """Return a fit to simulated walks of pendulums, of 20 moves each."""
    noise, spread, torques = (0.1, 0.5), np.array([2.5, 3.0]), jnp.linspace(-2, 2, 5)[:, None]
    real, agents = sc.Pendulum(10.0, noise=noise), ss.Behavior(ss.LogSumExp(), 6.0)
    goals = [sc.PendulumTask(goal=jnp.asarray(np.pi + by), discount=jnp.asarray(0.8)) for by in (-0.25, 0.25)]
    start_key, walk_key, policy_key = jax.random.split(key, 3)
    uniform = np.asarray(jax.random.uniform(start_key, (len(goals), -(-walks // len(goals)), 2), minval=-1))
    starts = [np.array([float(goal.goal), 0.0]) + spread * each for goal, each in zip(goals, uniform, strict=True)]
    lattice = sc.Lattice(jnp.array([-np.pi, -8.0]), jnp.array([np.pi, 8.0]), (96, 81), (True, False))
    planner = sc.LatticePlanner(real, torques, agents, lattice)
    shown = sc.gather_trajectories(sc.simulate_trajectories(walk_key, planner, real, goals, starts, 20), goals)
    features = sc.task_features(sc.task_at(shown.tasks, shown.task), shown.states)
    return sc.fit_dynamics(
        sc.Pendulum(8.0, noise=noise), shown, agents, sc.finite_policy(policy_key, torques, features, width=32),
        sc.Planner(horizon=15, samples=2, learning_rate=0.01, critic_width=32),
        prior=ss.Normal(np.log(8.0), 0.5), terms=("actions",), estimator="pathwise",
        schedule=sc.Schedule(250, policy_warmup=100, batch_size=96, learning_rate=0.02),
    )  # fmt: skip


FITS: dict[str, Callable[[jax.Array, int], ss.Fit | sc.ContinuousFit]] = {
    "ring": on_the_ring,
    "pendulum": of_the_pendulum,
}


def measure(options: Options) -> Iterator[Record]:
    """Simulate, fit and compare; a record for each number."""
    learn, count = FITS[options.world], options.data_sets or DATA_SETS[options.world]
    results: list[ss.Laplace] = []
    for key in jax.random.split(jax.random.key(options.seed), count):
        fit = learn(key, options.walks or WALKS[options.world])
        with suppress(ss.InputError):
            results.append(ss.laplace(fit))
    ends = [result.interval(options.level) for result in results]
    truth = TRUTH[options.world]
    natural = vector(ss.natural_scale(ravel_pytree(results[0].parameters)[1](jnp.asarray(truth))))
    below = np.mean([natural < vector(lower) for lower, _ in ends], axis=0)
    above = np.mean([natural > vector(upper) for _, upper in ends], axis=0)
    estimates = [vector(result.parameters) for result in results]
    columns = 1 - below - above, below, above, np.mean(estimates, axis=0), np.std(estimates, axis=0)
    columns += (np.mean([vector(result.standard_errors) for result in results], axis=0),)
    names = "covered", "below", "above", "mean", "spread", "error"
    same = {"refused": count - len(results)}
    same |= {name: float(np.mean([getattr(each, name) for each in results])) for name in ("distance", "simulated")}
    for index, number in enumerate(NUMBERS[options.world]):
        own = {name: float(column[index]) for name, column in zip(names, columns, strict=True)}
        yield {"number": number, "truth": float(truth[index]), **own, **same}


def show(records: Sequence[Record], options: Options) -> None:
    """Print the coverage of each number, and whether all are where they should be."""
    title = f"intervals of {options.level:.0%}, {options.data_sets or DATA_SETS[options.world]} data sets of "
    title += f"{options.walks or WALKS[options.world]} walks"
    columns = {"number": "number", "truth": "truth .3f", "covered": "covered .1%"}
    columns |= {"truth below": "below .1%", "truth above": "above .1%", "mean estimate": "mean .3f"}
    print_table(title, records, columns | {"their spread": "spread .3f", "mean standard error": "error .3f"})
    inside = sum(LEAST <= record["covered"] <= MOST for record in records)
    print(
        "refused {refused}, {distance:.2g} standard errors from the maximum, simulated {simulated:.2g}".format(
            **records[0]
        )
    )
    print(f"{inside} of {len(records)} coverages are from {LEAST:.0%} to {MOST:.0%}")
