"""Studies: records of methods that learn, do not converge, or fail."""

from dataclasses import dataclass

import numpy as np
import pytest

from sidestep.errors import NotConverged
from sidestep.evaluation.study import Problem, run_study
from sidestep.robots.planners import PolicyPlanner
from sidestep.tabular.demonstrations import Trajectory, gather
from sidestep.tabular.grid import Grid
from sidestep.tabular.tasks import reach

TRUTH, GRID = Grid(np.zeros((1, 4), dtype=int)), Grid.unknown(rows=1, columns=4)


@dataclass
class AlwaysRight:
    """A method's result in a corridor: a policy to the right, which the moves follow with a constant log π."""

    log_policy: float
    ranking: np.ndarray | None = None
    converged: bool = False
    ranks_by_probability: bool = False
    planner = PolicyPlanner(GRID, lambda goal: np.tile([0.0, 0.0, 0.0, 1.0], (4, 1)))  # noqa: ARG005

    def log_policies(self, demonstrations):
        return np.full(len(demonstrations), self.log_policy)


def problem(name, **parts) -> Problem:
    walk = Trajectory(np.array([0, 1, 2, 3]), np.array([3, 3, 3]), 0)
    return Problem(name, GRID, TRUTH, gather([walk], [reach(GRID, 3)]), **parts)


def fail(*_):
    raise NotConverged("no values")


def test_run_study_returns_a_record_for_each_problem_and_method():
    one, two = problem("one", goals=np.array([3])), problem("two", heldout=problem("").demonstrations)
    methods = {"right": lambda *_: AlwaysRight(-0.5), "nan": lambda *_: AlwaysRight(np.nan), "fail": fail}
    lines = []
    records = run_study([one, two], methods, notify=lines.append)
    assert [(record.problem, record.method) for record in records] == [
        (name, method) for name in ("one", "two") for method in methods
    ]
    assert lines[:3] == ["one: right learns", "one: right is evaluated", "one: nan learns"]
    right, _, failed, right_of_two, nan_of_two, _ = records
    assert right.evaluation.legal_fraction == right.evaluation.arriving_fraction == 1
    assert right.heldout_log_likelihood is right.evaluation.auc is right.failure is None
    assert right_of_two.evaluation.legal_fraction == 0.5
    assert right_of_two.heldout_log_likelihood == pytest.approx(-0.5)
    assert nan_of_two.heldout_log_likelihood is None
    row = right.to_dict()
    assert (row["method"], row["legal_fraction"], row["converged"]) == ("right", 1, False)
    assert set(row) == set(failed.to_dict())
    assert (failed.failure, failed.converged, failed.result) == ("no values", None, None)


def test_run_study_without_paths_scores_cells_only():
    ranked = AlwaysRight(0.0, ranking=np.array([[0.1, 0.2, 0.3, 0.4]]), converged=True)
    (record,) = run_study([problem("one")], {"ranked": lambda *_: ranked}, paths=False)
    assert record.evaluation.mean_free == pytest.approx(0.25)
    assert record.evaluation.legal_fraction is None
    assert record.result is ranked


@pytest.mark.parametrize("ranks_by_probability", [True, False])
def test_run_study_scores_calibration_of_probabilities_only(ranks_by_probability):
    """Costs of cells may happen to lie in [0, 1], and are no probabilities all the same."""
    blocked = np.array([[0.1, 0.2, 0.3, 0.4]])
    result = AlwaysRight(0.0, blocked, ranks_by_probability=ranks_by_probability)
    (record,) = run_study([problem("one")], {"ranked": lambda *_: result}, paths=False)
    row = record.to_dict()
    assert row["mean_free"] == pytest.approx(0.25)
    assert "reliability" not in row
    scores = [row[name] for name in ("calibration_error", "brier_score", "log_loss")]
    if ranks_by_probability:
        assert record.reliability is not None
        assert record.reliability.calibration_error == row["calibration_error"]
        # no cell is an obstacle
        assert scores == [pytest.approx(0.25), pytest.approx(0.075), pytest.approx(-np.log1p(-blocked).mean())]
    else:
        assert record.reliability is None
        assert scores == [None, None, None]
