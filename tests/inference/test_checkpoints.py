"""Checkpoints keep every bit, and know what they belong to."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.errors import InputError
from sidestep.inference.checkpoints import fingerprint, load_checkpoint, save_checkpoint

CARRIED = (np.array([0.1, -1e-300, np.pi]), jnp.arange(4), jnp.asarray(2.5, jnp.float32))
LIKE = (np.zeros(3), jnp.zeros(4, int), jnp.zeros((), jnp.float32))
HISTORY = [[0, -1.1, 0.1], [1, -1 / 3, 2e-9]]


def test_round_trip(tmp_path):
    path = tmp_path / "fit.checkpoint"
    save_checkpoint(path, "key", CARRIED, HISTORY)
    carried, history, _ = load_checkpoint(path, "key", LIKE)
    assert history == HISTORY
    for found, expected in zip(carried, CARRIED, strict=True):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    assert [file.name for file in tmp_path.iterdir()] == ["fit.checkpoint"]


GARBAGE = {
    "empty": b"",
    "text": b"walk,step\n0,1\n",
    "binary": bytes(range(128, 256)),
    "a number": b"123\n",
    "a list": b"[]\n",
    "no key": b"{}\n",
    "no history": b'{"fit": "key"}\n',
    "no arrays": b'{"fit": "key", "history": []}\n',
    "other arrays": b'{"fit": "key", "history": []}\nwhat is this',
}


@pytest.mark.parametrize("name", GARBAGE)
def test_what_is_no_checkpoint_is_refused(tmp_path, name):
    path = tmp_path / "fit.checkpoint"
    path.write_bytes(GARBAGE[name])
    with pytest.raises(InputError, match=r"fit\.checkpoint: (not a checkpoint|the file is empty)"):
        load_checkpoint(path, "key", LIKE)


@pytest.mark.parametrize("missing", [1, 5, 100])
def test_a_checkpoint_cut_short_is_refused(tmp_path, missing):
    path = tmp_path / "fit.checkpoint"
    save_checkpoint(path, "key", CARRIED, HISTORY)
    path.write_bytes(path.read_bytes()[:-missing])
    with pytest.raises(InputError, match=r"fit\.checkpoint: not a checkpoint"):
        load_checkpoint(path, "key", LIKE)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    path = tmp_path / "fit.checkpoint"
    save_checkpoint(path, "key", CARRIED, HISTORY)
    with pytest.raises(InputError, match=r"fit\.checkpoint: belongs to a fit of other data"):
        load_checkpoint(path, "another key", LIKE)


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
def test_the_fingerprint_tells_problems_apart(other, same):
    assert (fingerprint(PROBLEM) == fingerprint(other)) == same


def test_what_a_fit_can_do_without_is_read_where_it_fits(tmp_path):
    path = tmp_path / "fit.checkpoint"
    save_checkpoint(path, "key", CARRIED, HISTORY, [np.arange(6.0)])
    np.testing.assert_array_equal(load_checkpoint(path, "key", LIKE, [np.zeros(6)])[2][0], np.arange(6.0))
    for kept in ([], [np.zeros(3)], [np.zeros(6, np.float32)], [np.zeros(6)] * 2):
        carried, history, found = load_checkpoint(path, "key", LIKE, kept)
        assert history == HISTORY
        np.testing.assert_array_equal(carried[0], CARRIED[0])
        assert found is kept
