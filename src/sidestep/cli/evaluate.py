"""`sidestep evaluate`: a learned map against the truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sidestep.evaluation.evaluate import StageCallback, evaluate, sample_sizes
from sidestep.io.maps import read_map_like
from sidestep.maps.learned_map import add_to_summary, read_learned_map
from sidestep.robots.robot import BUMP_COST


def evaluate_map(
    folder: Path,
    truth_file: Path,
    out: Path | None = None,
    seed: int = 0,
    report: StageCallback = lambda *_: None,
    bump_cost: float = BUMP_COST,
) -> Mapping[str, Any]:
    """Scores the learned map of `folder` against a true map and returns the scores (see `sidestep.evaluation.metrics`).

    They are written to `summary.json` in `out`; without `out`, added to the learned map's own. Beside them stands
    `planned_at_most`: between how many starts and goals paths were planned, and how many of those with bumps were
    followed; and `bump_cost`, what the first bump at a place costs the robot that plans (`sidestep.robots.robot`). On
    maps
    too large for paths between all pairs of free cells `seed` draws them. Raises `InputError` for a true map of another
    size, resolution or origin.
    """
    learned = read_learned_map(folder)
    truth = read_map_like(truth_file, learned.grid)
    robot = learned.robot(bump_cost)
    scores = evaluate(robot, learned.blocked, truth, learned.unknown, learned.visited, seed, report).to_dict()
    limits = {"planned_at_most": sample_sizes(truth.size)._asdict(), "bump_cost": bump_cost}
    add_to_summary(folder, out or folder, None, {"truth": str(truth_file), **limits, **scores})
    return scores
