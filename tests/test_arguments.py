"""Arguments as arrays: what is taken, what is refused, and that nothing is copied without need."""

# ruff: noqa: E501

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidestep._arguments import (
    to_finite,
    to_floats,
    to_indices,
    to_integers,
    to_key,
    to_logits,
    to_mask,
    to_states,
)
from sidestep.errors import InputError

NAN = float("nan")


@pytest.mark.parametrize("array", [np.array([0.5, NAN]), np.array([0.5], np.float32), jnp.array([0.5, 1.5])])
def test_to_floats_of_floats_returns_them_without_a_copy(array):
    assert to_floats(array, "x") is array
    assert to_floats(array, "x", ("points",)) is array


def test_arrays_that_fit_are_returned_without_a_copy():
    numbers, mask, states = np.array([0.5]), np.array([True]), np.array([3])
    assert to_finite(numbers, "x", least=0) is numbers
    assert to_logits(numbers, 1) is numbers
    assert to_mask(mask, "x", (1,)) is mask
    assert to_integers(states, "x", least=0) is states
    assert to_states(states, 4, "x") is states


@given(st.lists(st.integers(-(2**40), 2**40), max_size=5))
def test_lists_of_integers_are_taken_as_they_are(numbers):
    assert to_integers(numbers, "x", ("n",)).tolist() == numbers
    assert to_floats(numbers, "x", ("n",)).tolist() == numbers


@given(st.lists(st.booleans(), min_size=1, max_size=6))
def test_to_indices_of_a_mask_equals_those_of_its_indices(mask):
    indices = [place for place, is_set in enumerate(mask) if is_set]
    count = len(mask)
    assert to_indices(mask, count, "x", "walks").tolist() == indices
    assert to_indices(indices, count, "x", "walks").tolist() == indices
    assert to_indices([place - count for place in indices], count, "x", "walks").tolist() == indices


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint64, np.int32])
def test_to_states_of_other_integers_returns_64_bits(dtype):
    states = to_states(np.array([200, 3], dtype), 201, "x")
    assert states.dtype == np.int64
    assert states.tolist() == [200, 3]


@pytest.mark.parametrize(("call", "message"), [
    (lambda: to_floats("a", "x"), "field 'x': expected numbers, found 'a'"),
    (lambda: to_floats([True], "x"), "field 'x': expected numbers, found bool of shape (1,)"),
    (lambda: to_floats(np.zeros(2), "x", (), (3,)), "field 'x': expected numbers of shape () or (3,), found shape (2,)"),
    (lambda: to_floats(np.zeros(2), "x", ("points", 2)), "field 'x': expected numbers of shape (points, 2), found shape (2,)"),
    (lambda: to_floats(3.0, "x", ("points",)), "field 'x': expected numbers of shape (points,), found 3.0"),
    (lambda: to_finite([0.0, NAN], "x"), "field 'x': expected finite numbers, found nan at 1"),
    (lambda: to_finite([[0.0, 2.0]], "x", least=0, most=1), "field 'x': expected finite numbers from 0 to 1, found 2.0 at (0, 1)"),
    (lambda: to_finite(0.0, "x", (), above=0), "field 'x': expected a finite number above 0, found 0.0"),
    (lambda: to_logits([0.0, NAN], 2), "field 'logits': expected numbers, found nan at 1"),
    (lambda: to_integers(2.0, "x"), "field 'x': expected whole numbers, found 2.0"),
    (lambda: to_integers([2**70], "x"), "field 'x': expected whole numbers, found [1180591620717411303424]"),
    (lambda: to_integers([3, -1], "x", least=0), "field 'x': expected whole numbers, at least 0, found -1 at 1"),
    (lambda: to_integers([3], "x", most=2), "field 'x': expected whole numbers, at most 2, found 3 at 0"),
    (lambda: to_states([0, 4], 4, "x"), "field 'x': expected states in 0…3, found 4 at 1"),
    (lambda: to_mask([0, 1], "x", (2,)), "field 'x': expected booleans, found int64 of shape (2,)"),
    (lambda: to_mask([True], "x", (2,)), "field 'x': expected booleans of shape (2,), found shape (1,)"),
    (lambda: to_indices([0.0], 2, "x", "walks"), "field 'x': expected indices of walks, found float64 of shape (1,)"),
    (lambda: to_key(3), "field 'key': expected a random key such as jax.random.key(0), found 3"),
    (lambda: to_key(np.zeros(2, np.uint32)), "field 'key': expected a random key such as jax.random.key(0), found uint32 of shape (2,)"),
])  # fmt: skip
def test_wrong_array_raises_and_says_what_was_expected(call, message):
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value) == message


def test_lists_of_unequal_lengths_raise():
    with pytest.raises(InputError, match=r"field 'x': expected numbers, found \[\[1\], \[1, 2\]\]"):
        to_floats([[1], [1, 2]], "x")


def test_tracers_are_checked_by_shape_and_type_only():
    assert float(jax.grad(lambda x: to_finite(x, "x", (), above=0) ** 2)(-3.0)) == -6.0
    assert jax.vmap(lambda state: to_states(state, 2, "x", ()))(jnp.array([0, 9])).tolist() == [0, 9]
    assert jax.vmap(lambda key: jax.random.normal(to_key(key)))(jax.random.split(jax.random.key(0), 3)).shape == (3,)
    for wrong in (lambda x: to_finite(x, "x", (3,)), lambda x: to_states(x, 2, "x"), lambda x: to_mask(x, "x")):
        with pytest.raises(InputError, match="field 'x': expected"):
            jax.eval_shape(wrong, jnp.zeros(2))
