"""A fit that is interrupted and resumed ends as if it had not been, bit for bit."""

import numpy as np
import pytest

from helpers.walled import BLANK, walks
from sidestep.errors import InputError
from sidestep.inference.checkpoints import Checkpoint
from sidestep.inference.fit import fit
from sidestep.inference.optimizers import LBFGS, Adam, Rprop
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel

OPTIMIZERS = {"L-BFGS": LBFGS(), "Adam": Adam(max_iterations=40), "Rprop": Rprop(tolerance=1e-4)}
BEHAVIOR = Behavior(BoltzmannAverage(), 10.0)
DEMONSTRATIONS = walks()
# solves are loose at first, and approximate losses reuse the contributions of batches
LARGE = {"large_map": 1, "options": SolveOptions(solver=GaussSeidel())}


def fit_with(name, report=None, **settings):
    model = ObstacleGrid(BLANK, -2.0)
    return fit(model, DEMONSTRATIONS, BEHAVIOR, optimizer=OPTIMIZERS[name], report=report, **settings)


@pytest.fixture
def checkpoint(tmp_path):
    """A checkpoint that is saved at every iteration."""
    return Checkpoint(tmp_path / "fit.checkpoint", min_interval=0, max_fraction=1)


def interrupted_at(iteration):
    def report(progress):
        if progress.iteration == iteration:
            raise KeyboardInterrupt

    return report


@pytest.mark.slow
@pytest.mark.parametrize(("name", "settings"), [*((name, {}) for name in OPTIMIZERS), ("Rprop", LARGE)])
def test_fit_resumed_equals_fit_uninterrupted(checkpoint, name, settings):
    expected = fit_with(name, **settings)
    for iteration in (3, 3, 9):
        with pytest.raises(KeyboardInterrupt):
            fit_with(name, interrupted_at(iteration), checkpoint=checkpoint, resume=True, **settings)
    iterations = []
    resumed = fit_with(
        name, lambda progress: iterations.append(progress.iteration), checkpoint=checkpoint, resume=True, **settings
    )
    assert iterations[0] == 9
    assert len(expected.history) > 12
    assert resumed.history == expected.history
    np.testing.assert_array_equal(resumed.model.parameters, expected.model.parameters)
    assert (resumed.message, resumed.status) == (expected.message, expected.status)


def test_fit_without_resume_starts_again(checkpoint):
    iterations = []
    with pytest.raises(KeyboardInterrupt):
        fit_with("L-BFGS", interrupted_at(5), checkpoint=checkpoint)
    fit_with("L-BFGS", lambda progress: iterations.append(progress.iteration), checkpoint=checkpoint.path)
    assert iterations[0] == 0


def test_fit_of_another_problem_does_not_resume(checkpoint):
    with pytest.raises(KeyboardInterrupt):
        fit_with("L-BFGS", interrupted_at(2), checkpoint=checkpoint)
    before = checkpoint.path.read_bytes()
    for name, settings in (
        ("Adam", {}),
        ("L-BFGS", {"prior": Normal(0.0, 2.0)}),
        ("L-BFGS", {"terms": ("actions",)}),
        ("L-BFGS", {"options": SolveOptions(horizon=9)}),
    ):
        with pytest.raises(InputError, match="belongs to a fit of other data or with other settings"):
            fit_with(name, checkpoint=checkpoint, resume=True, **settings)
    with pytest.raises(InputError, match="other data"):
        fit(ObstacleGrid(BLANK, -2.0), walks(discount=0.9), BEHAVIOR, checkpoint=checkpoint, resume=True)
    assert checkpoint.path.read_bytes() == before
