"""Roll-outs: how fast they are, what an update of a model takes, and how noisy the estimators of eq. 11 are.

    python benchmarks/rollouts.py
    python benchmarks/rollouts.py --part noise --horizons 5 10 20 40 80 --problems "pendulum, upright"
    python benchmarks/rollouts.py --quick

**Speed.** The room and the pendulum of `sidestep experiment`, with the experiments' own planners and batches; the
demonstrations are made up, for what they say makes no difference here. An *update* is an iteration of `fit`, from
one report to the next: one step of the model, the policy and its critic. Its parts are compiled and timed by
themselves: the roll-outs; the model's gradient (`value_gradient` with its surprises, less the roll-outs); the policy's;
the critic's. What the whole shares among them it computes once, so the parts need not add up to it. Steps are those of
single roll-outs.

**Noise.** One roll-out gives one estimate of ∇_θ Q^π(s, a): by score, by score with a critic, along the path (with a
critic for the draws of the policy, as in a fit). Told are the standard deviation of one such estimate (a norm over
parameters, the root of the mean square over 16 places), what it is relative to the pathwise one, how many roll-outs it
takes until the standard deviation of their mean is a tenth of the gradient's norm, the time for one, and how far the
mean over all lies from that of the least noisy estimator, in standard errors (the largest of the parameters): all are
unbiased, so this should hardly be above 3, unless a few rare roll-outs make up the mean. The problems stand in
`rollout_noise.py`: linear dynamics that turn by 0.3 and shrink to 0.9 or grow to 1.05 a move, with a Gaussian policy
(∇ by six parameters); a pendulum held where it hangs, or upright, with five torques (∇ by the logarithm of gravity).

Everything is compiled before it is timed, takes turns in one process, and medians are told. With `--quick` the compiler
hardly optimises, so its times say nothing.

Records (`--json`): for speed `part`, `name`, `estimator`, `roll_outs` (a batch), `horizon`, `steps_per_second`,
`update_seconds`, `roll_outs_seconds`, `model_seconds`, `policy_seconds`, `critic_seconds`; for noise `part`, `name`,
`problem`, `horizon`, `deviation`, `relative`, `gradient`, `roll_outs_needed`, `seconds`, `split_by_person`.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from measuring import argument_parser, main, milliseconds, note, number, print_table, write_records
from rollout_noise import PROBLEMS, Noise, measured, planned, problem_of
from rollout_speed import CASES, timed

Record = dict[str, Any]


def noise_records(name: str, horizons: Sequence[int], arguments: argparse.Namespace) -> list[Record]:
    """The records of one problem."""
    problem, longest = problem_of(name), max(horizons)
    note(f"{name}: finding a policy")
    policy, critic = planned(problem, longest, arguments.steps)
    problem = eqx.tree_at(lambda whole: whole.policy, problem, policy)
    records = []
    for horizon in horizons:
        note(f"{name}: horizon {horizon}")
        own = critic if horizon == longest else planned(problem, horizon, arguments.steps, moving=False)[1]
        records += records_of(name, horizon, measured(problem, own, horizon, arguments.samples, arguments.turns))
    return records


def records_of(name: str, horizon: int, noise: dict[str, Noise]) -> list[Record]:
    """The records of all estimators at one horizon; the gradient's norm is by the least noisy of them."""
    best = min(noise.values(), key=lambda each: each.deviation)
    known = best.square > 0
    return [
        {
            "part": "noise",
            "name": estimator,
            "problem": name,
            "horizon": horizon,
            "deviation": own.deviation,
            "relative": own.deviation / noise["pathwise"].deviation,
            "gradient": float(np.sqrt(best.square)) if known else None,
            "roll_outs_needed": 100 * own.deviation**2 / best.square if known else None,
            "seconds": own.seconds,
            "apart": split_by_person(own, best),
        }
        for estimator, own in noise.items()
    ]


def split_by_person(one: Noise, other: Noise) -> float:
    """How far two means differ, in standard errors, at most over parameters; 0 of a mean and itself."""
    error = np.sqrt(one.error**2 + other.error**2)
    return float(np.max(np.abs(one.mean - other.mean) / np.where(error > 0, error, 1.0)))


def print_speed(records: Sequence[Record]) -> None:
    """The table of the first part."""
    parts = ("update", "roll_outs", "model", "policy", "critic")
    columns = ("fit", "estimator", "roll-outs", "horizon", "steps/s", "update", "rolling", "model", "policy", "critic")
    print_table(
        "Updates and their parts, each timed by itself; ms",
        columns,
        [
            (
                record["name"],
                record["estimator"],
                str(record["roll_outs"]),
                str(record["horizon"]),
                number(record["steps_per_second"], ",.0f"),
                *(milliseconds(record[f"{part}_seconds"]) for part in parts),
            )
            for record in records
        ],
        left=("fit", "estimator"),
    )


def print_noise(records: Sequence[Record]) -> None:
    """The table of the second part, and where the pathwise estimator is the noisier one."""
    print_table(
        "One roll-out's gradient: standard deviation, and how many it takes for an error of 10 %",
        ("problem", "horizon", "estimator", "deviation", "× pathwise", "‖gradient‖", "needed", "µs each", "apart"),
        [
            (
                record["problem"],
                str(record["horizon"]),
                record["name"],
                number(record["deviation"]),
                number(record["relative"], ".3g"),
                number(record["gradient"], ".3g"),
                number(record["roll_outs_needed"], ",.0f"),
                number(1e6 * record["seconds"], ".1f"),
                number(record["apart"], ".1f"),
            )
            for record in records
        ],
        left=("problem", "estimator"),
    )
    worse = [
        f"{record['problem']} at {record['horizon']}"
        for record in records
        if record["name"] == "score and critic" and record["relative"] < 1
    ]
    print("Noisier along the path than by score and critic: " + ("; ".join(worse) or "nowhere") + ".")


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes what the arguments ask for."""
    if arguments.quick:
        jax.config.update("jax_disable_most_optimizations", True)
        arguments.cases, arguments.problems, arguments.horizons = CASES[-1:], PROBLEMS[:1], [10]
        arguments.turns, arguments.iterations, arguments.steps, arguments.samples = 1, 1, 10, 64
    records: list[Record] = []
    if arguments.part != "noise":
        speed = [timed(name, arguments.turns, arguments.iterations) for name in arguments.cases]
        print_speed(speed)
        records += speed
    if arguments.part != "speed":
        noise = [each for name in arguments.problems for each in noise_records(name, arguments.horizons, arguments)]
        print_noise(noise)
        records += noise
    write_records(arguments, records)


def _arguments() -> argparse.Namespace:
    parser = argument_parser("Roll-outs: speed, and the noise of the estimators.", "one fit, one problem, one horizon")
    add = parser.add_argument
    add("--part", choices=("speed", "noise"), help="one of the two only")
    add("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="FIT", help=f"of {CASES}")
    add("--iterations", type=int, default=20, help="updates a turn")
    add("--turns", type=int, default=5)
    add("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), metavar="PROBLEM", help=f"of {PROBLEMS}")
    add("--horizons", type=int, nargs="+", default=[5, 10, 20, 40])
    add("--samples", type=int, default=256, help="roll-outs from each of 16 places, a turn")
    add("--steps", type=int, default=300, help="of the policy and the critic")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main(run, _arguments()))
