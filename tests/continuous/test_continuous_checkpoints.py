"""Fits in continuous worlds that are interrupted, and resumed from a checkpoint."""

from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep as ss
import sidestep.continuous as sc
from helpers.drift_fits import AGENTS, BOTH, INITIAL, POLICY, SHORT, demonstrations_of, walks
from sidestep.continuous.fit import problem_fingerprint
from sidestep.continuous.policies import ScaledNetwork


@pytest.fixture
def checkpoint(tmp_path):
    """A file that is saved at every iteration."""
    return ss.Checkpoint(tmp_path / "fit.checkpoint", min_interval=0.0, max_fraction=1.0)


def interrupted_at(iteration):
    def report(progress: sc.FitProgress, _):
        if progress.iteration == iteration:
            raise KeyboardInterrupt

    return report


def leaves(result):
    return [np.asarray(leaf) for leaf in jax.tree.leaves((result.dynamics, result.planner_state)) if eqx.is_array(leaf)]


@pytest.mark.slow
def test_fit_dynamics_resumed_is_identical(checkpoint):
    whole = partial(BOTH, checkpoint=checkpoint)
    expected = whole()
    Path(checkpoint.path).unlink()
    for iteration in (2, 3, 9):
        with pytest.raises(KeyboardInterrupt):
            whole(report=interrupted_at(iteration), resume=True)
    went_on_at = []
    result = whole(report=lambda progress, _: went_on_at.append(progress.iteration), resume=True)
    assert went_on_at == list(range(10, 16))
    assert result.history == expected.history
    assert all(map(np.array_equal, leaves(result), leaves(expected)))
    assert (result.message, result.converged) == (expected.message, expected.converged)


def test_fit_dynamics_without_resume_starts_again(checkpoint):
    iterations = []
    with pytest.raises(KeyboardInterrupt):
        BOTH(report=interrupted_at(2), checkpoint=checkpoint)
    BOTH(report=lambda progress, _: iterations.append(progress.iteration), checkpoint=checkpoint)
    assert iterations[0] == 0


def test_fit_dynamics_checkpoint_of_another_problem_is_refused(checkpoint):
    with pytest.raises(KeyboardInterrupt):
        BOTH(report=interrupted_at(2), checkpoint=checkpoint)
    before = Path(checkpoint.path).read_bytes()
    others = {
        "seed": partial(BOTH, seed=1),
        "prior": partial(BOTH, prior=ss.Normal(0.0, 2.0)),
        "terms": partial(BOTH, terms=("actions",)),
        "data": partial(sc.fit_dynamics, INITIAL, demonstrations_of(*walks(1)), *AGENTS, schedule=SHORT),
    }
    for other in others.values():
        with pytest.raises(ss.InputError, match="belongs to a fit of other data or with other settings"):
            other(checkpoint=checkpoint, resume=True)
    assert Path(checkpoint.path).read_bytes() == before
    with pytest.raises(ss.InputError, match="'resume': expected a checkpoint to resume from"):
        BOTH(resume=True)


def test_problem_fingerprint_ignores_addresses_of_functions():
    def policy(offset):
        network = eqx.nn.MLP(1, 3, 4, 1, activation=lambda x: jnp.tanh(x + offset), key=jax.random.key(0))
        return sc.FinitePolicy(ScaledNetwork(network, jnp.zeros(1), jnp.ones(1)), POLICY.actions)

    first, second = policy(0), policy(0)
    assert str(jax.tree.leaves(first)) != str(jax.tree.leaves(second))
    assert problem_fingerprint(first) == problem_fingerprint(second)
