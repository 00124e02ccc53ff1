"""Calls of public functions with wrong arguments end in errors of the library, in its words; unusual right ones work.

`helpers.wrong_calls` has the calls. The checks of jaxtyping and beartype, which all other tests have, are off: they
would refuse most of these arguments first, and who uses the library has none.
"""

from pathlib import Path

import jax
import jaxtyping
import numpy as np
import pytest

import sidestep as ss
from helpers.wrong_calls import continuous, data, learning, maps, models, right, small, tabular
from sidestep.errors import InputError

CASES = [*data.CASES, *models.CASES, *learning.CASES, *maps.CASES, *tabular.CASES, *continuous.CASES]
RIGHT = right.CASES | tabular.RIGHT


@pytest.fixture(scope="module", autouse=True)
def _without_checks_of_types():
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.mark.parametrize(("call", "word"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_wrong_call_raises_an_error_that_says_what_was_expected(call, word):
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert word in message
    assert "expected" in message
    assert "found" in message
    assert len(message) < 400


@pytest.mark.parametrize("call", RIGHT.values(), ids=RIGHT)
def test_unusual_call_works(call):
    assert call()


@pytest.mark.parametrize("name", ["map.yaml", Path("map.yaml")])
def test_write_map_of_lists_writes_them(tmp_path, name):
    ss.write_map(tmp_path / name, [[0, 1], [0.5, 0]], ss.Grid.unknown(2, 2), unknown=[[True, False]] * 2)
    assert ss.read_map(str(tmp_path / name)).known.tolist() == [[-1, 1], [-1, 0]]


def test_fit_passes_an_error_of_report_on():
    def report(progress):
        raise LookupError(progress.iteration)

    with pytest.raises(LookupError):
        ss.fit(small.MODEL, small.DEMOS, small.BEHAVIOR, terms=("transitions",), report=report)


def test_wrong_call_under_jit_raises_by_shape():
    with pytest.raises(InputError, match=r"'logits': expected numbers of shape \(\) or \(20,\), found shape \(3,\)"):
        jax.eval_shape(lambda logits: ss.ObstacleGrid(small.GRID, logits).parameters, np.zeros(3))
