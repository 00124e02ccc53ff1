"""How often 95 % intervals cover the truth: β, a lapse and three logits of a world of six states.

Agents walk around a ring of six places: on, back, two at once, or they rest. Each of the three moves fails with an
unknown probability, and then they stay. Many data sets are simulated, each is fitted, and the interval of
`sidestep.laplace` of each number either covers the number that the data were made with, or does not. A coverage has a
standard error itself: 1.5 percentage points of 200 data sets.

Records have `number`, `truth`, `covered` (of the data sets), `below` and `above` (where the truth was below or above
the interval), `mean` and `spread` of the estimates and `error`, the mean standard error, all on the unconstrained
scale (ln β, logits).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax
import numpy as np

import sidestep as ss
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
NUMBERS = "logit of a step on", "logit of a step back", "logit of two at once", "ln β", "logit of the lapse"
LEAST, MOST = 0.90, 0.99
"""What is asked of the coverage of 95 % intervals."""


@dataclass
class Options:
    """What to measure."""

    data_sets: int = option(200, "simulated data sets", quick=20)
    walks: int = option(150, "walks of each data set")
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


def measure(options: Options) -> Iterator[Record]:
    """Simulate, fit and compare; a record for each number."""
    world, goals, agents = ring(), tasks(), ss.Behavior(ss.BoltzmannAverage(), BETA, LAPSE)
    begin, behavior = world.with_parameters(0 * world.parameters), ss.behavior_model(START, ["beta", "lapse"])
    starts = [np.resize(np.delete(np.arange(STATES), goal), -(-options.walks // len(GOALS))) for goal in GOALS]
    estimates, errors, lower, upper = [], [], [], []
    for key in jax.random.split(jax.random.key(options.seed), options.data_sets):
        shown = ss.gather(ss.simulate(key, world, goals, starts, agents), goals)
        result = ss.laplace(ss.fit(begin, shown, behavior, prior=PRIOR))
        estimates.append(vector(result.parameters))
        errors.append(vector(result.standard_errors))
        for into, interval in zip((lower, upper), result.interval(options.level), strict=True):
            into.append(vector(interval))
    natural, true = np.array([*LOGITS, BETA, LAPSE]), np.array([*LOGITS, np.log(BETA), np.log(LAPSE / (1 - LAPSE))])
    below, above = (natural < np.array(lower)).mean(axis=0), (natural > np.array(upper)).mean(axis=0)
    columns = 1 - below - above, below, above, np.mean(estimates, axis=0), np.std(estimates, axis=0)
    names = "covered", "below", "above", "mean", "spread"
    for index, number in enumerate(NUMBERS):
        own = {name: float(column[index]) for name, column in zip(names, columns, strict=True)}
        yield {"number": number, "truth": float(true[index]), **own, "error": float(np.mean(errors, axis=0)[index])}


def show(records: Sequence[Record], options: Options) -> None:
    """Print the coverage of each number, and whether all are where they should be."""
    title = f"intervals of {options.level:.0%}, {options.data_sets} data sets of {options.walks} walks"
    columns = {"number": "number", "truth": "truth .3f", "covered": "covered .1%"}
    columns |= {"truth below": "below .1%", "truth above": "above .1%", "mean estimate": "mean .3f"}
    print_table(title, records, columns | {"their spread": "spread .3f", "mean standard error": "error .3f"})
    inside = sum(LEAST <= record["covered"] <= MOST for record in records)
    print(f"{inside} of {len(records)} coverages are from {LEAST:.0%} to {MOST:.0%}")
