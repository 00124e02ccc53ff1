"""A fit that is interrupted and resumed ends as if it had not been, to the last bit."""

from functools import partial

import numpy as np
import pytest

from helpers.walled import BLANK, walks
from sidestep.errors import InputError
from sidestep.inference import batching
from sidestep.inference.checkpoints import Saver
from sidestep.inference.fit import fit
from sidestep.inference.optimizers import LBFGS, Adam, Rprop
from sidestep.inference.priors import Normal
from sidestep.tabular.backups import Behavior, BoltzmannAverage
from sidestep.tabular.models import ObstacleGrid
from sidestep.tabular.solve import SolveOptions
from sidestep.tabular.solvers.gauss_seidel import GaussSeidel

OPTIMISERS = {"L-BFGS": LBFGS(), "ascent": Adam(iterations=40), "resilient": Rprop(tolerance=1e-4)}
PEOPLE = Behavior(BoltzmannAverage(), 10.0)
DEMONSTRATIONS = walks()


def fit_with(name, report=None, **settings):
    model = ObstacleGrid(BLANK, -2.0)
    return fit(model, DEMONSTRATIONS, PEOPLE, optimizer=OPTIMISERS[name], report=report, **settings)


@pytest.fixture(autouse=True)
def _save_at_every_iteration(monkeypatch):
    monkeypatch.setattr(Saver, "pause", lambda *_: 0.0)


def interrupted_at(iteration):
    def report(progress):
        if progress.iteration == iteration:
            raise KeyboardInterrupt

    return report


def a_batch_for_each_task(monkeypatch):
    """As on large maps, where trials take over what other batches added."""
    monkeypatch.setattr(batching, "LARGE", 1)
    monkeypatch.setattr(batching, "cores", lambda: 1)


@pytest.mark.parametrize(("name", "large"), [*((name, False) for name in OPTIMISERS), ("resilient", True)])
def test_resumed_to_the_last_bit(tmp_path, monkeypatch, name, large):
    if large:
        a_batch_for_each_task(monkeypatch)
    fitted = partial(fit_with, name, options=SolveOptions(solver=GaussSeidel() if large else None))
    expected = fitted()
    checkpoint = tmp_path / "fit.checkpoint"
    for iteration in (3, 3, 9):
        with pytest.raises(KeyboardInterrupt):
            fitted(interrupted_at(iteration), checkpoint=checkpoint, resume=True)
    went_on_at = []
    found = fitted(lambda progress: went_on_at.append(progress.iteration), checkpoint=checkpoint, resume=True)
    assert went_on_at[0] == 9
    assert len(expected.history) > 12
    assert found.history == expected.history
    np.testing.assert_array_equal(found.model.parameters, expected.model.parameters)
    assert (found.message, found.converged) == (expected.message, expected.converged)


def test_without_resume_a_fit_starts_again(tmp_path):
    checkpoint = tmp_path / "fit.checkpoint"
    iterations = []
    with pytest.raises(KeyboardInterrupt):
        fit_with("L-BFGS", interrupted_at(5), checkpoint=checkpoint)
    fit_with("L-BFGS", lambda progress: iterations.append(progress.iteration), checkpoint=checkpoint)
    assert iterations[0] == 0


@pytest.mark.parametrize(("name", "settings"), [
    ("ascent", {}),
    ("L-BFGS", {"prior": Normal(0.0, 4.0)}),
    ("L-BFGS", {"terms": ("actions",)}),
    ("L-BFGS", {"options": SolveOptions(horizon=9)}),
])  # fmt: skip
def test_a_fit_with_other_settings_does_not_go_on(tmp_path, name, settings):
    checkpoint = tmp_path / "fit.checkpoint"
    with pytest.raises(KeyboardInterrupt):
        fit_with("L-BFGS", interrupted_at(2), checkpoint=checkpoint)
    before = checkpoint.read_bytes()
    with pytest.raises(InputError, match="belongs to a fit of other data or with other settings"):
        fit_with(name, checkpoint=checkpoint, resume=True, **settings)
    assert checkpoint.read_bytes() == before


def test_a_fit_of_other_data_does_not_go_on(tmp_path):
    checkpoint = tmp_path / "fit.checkpoint"
    with pytest.raises(KeyboardInterrupt):
        fit_with("L-BFGS", interrupted_at(2), checkpoint=checkpoint)
    with pytest.raises(InputError, match="other data"):
        fit(ObstacleGrid(BLANK, -2.0), walks(discount=0.9), PEOPLE, checkpoint=checkpoint, resume=True)
