"""Checkpoints keep every bit, and are refused by other fits."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.checkpoints import Saver, fingerprint

STATE = (np.array([0.1, -1e-300, np.pi]), jnp.arange(4), jnp.asarray(2.5, jnp.float32))
LIKE = (np.zeros(3), jnp.zeros(4, int), jnp.zeros((), jnp.float32))
HISTORY = [[0, -1.1, 0.1], [1, -1 / 3, 2e-9]]


@pytest.fixture
def path(tmp_path):
    """A saved checkpoint."""
    Saver(tmp_path / "fit.checkpoint", "key").save(STATE, HISTORY)
    return tmp_path / "fit.checkpoint"


def test_saver_load_returns_what_was_saved(path):
    state, history, _ = Saver(path, "key").load(LIKE)
    assert history == HISTORY
    for loaded, expected in zip(state, STATE, strict=True):
        assert loaded.dtype == expected.dtype
        np.testing.assert_array_equal(loaded, expected)
    assert list(path.parent.iterdir()) == [path]


GARBAGE = {
    "empty": b"",
    "text": b"walk,step\n0,1\n",
    "binary": bytes(range(128, 256)),
    "a number": b"123\n",
    "a list": b"[]\n",
    "no key": b"{}\n",
    "no history": b'{"fit": "key"}\n',
    "no arrays": b'{"fit": "key", "history": []}\n',
    "other arrays": b'{"fit": "key", "history": []}\nother bytes',
}


@pytest.mark.parametrize("name", GARBAGE)
def test_saver_load_of_another_file_raises(path, name):
    path.write_bytes(GARBAGE[name])
    with pytest.raises(InputError, match=r"fit\.checkpoint: (not a checkpoint|the file is empty)"):
        Saver(path, "key").load(LIKE)


@pytest.mark.parametrize("missing", [1, 100])
def test_saver_load_of_a_truncated_file_raises(path, missing):
    path.write_bytes(path.read_bytes()[:-missing])
    with pytest.raises(InputError, match=r"fit\.checkpoint: not a checkpoint"):
        Saver(path, "key").load(LIKE)


def test_saver_load_of_another_fit_raises(path):
    with pytest.raises(InputError, match=r"fit\.checkpoint: belongs to a fit of other data"):
        Saver(path, "another key").load(LIKE)


class Pair(NamedTuple):
    first: object
    second: object


PROBLEM = Pair(np.array([1.0, 2.0]), 3)


@pytest.mark.parametrize(("other", "same"), [
    (Pair(np.array([1.0, 2.0]), 3), True),
    (Pair(jnp.array([1.0, 2.0]), 3), True),
    (Pair(np.array([1.0, np.nextafter(2, 3)]), 3), False),
    (Pair(np.array([1.0, 2.0], dtype=np.float32), 3), False),
    (Pair(np.array([[1.0, 2.0]]), 3), False),
    (Pair(np.array([1.0, 2.0]), 4), False),
    (Pair(np.array([1.0, 2.0]), None), False),
    ((np.array([1.0, 2.0]), 3), False),
])  # fmt: skip
def test_fingerprint_differs_between_problems(other, same):
    assert (fingerprint(PROBLEM) == fingerprint(other)) == same


def test_saver_load_with_other_shapes_keeps_the_optional_arrays(path):
    Saver(path, "key").save(STATE, HISTORY, [np.arange(6.0)])
    np.testing.assert_array_equal(Saver(path, "key").load(LIKE, [np.zeros(6)])[2][0], np.arange(6.0))
    for optional in ([], [np.zeros(3)], [np.zeros(6, np.float32)], [np.zeros(6)] * 2):
        state, history, loaded = Saver(path, "key").load(LIKE, optional)
        assert history == HISTORY
        np.testing.assert_array_equal(state[0], STATE[0])
        assert loaded is optional
